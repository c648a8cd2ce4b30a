"""Editing of takes by a file of operations, and undoing of edits."""

from functools import partial
from pathlib import Path
from typing import Any

from mosca.data.motion.bvh import read_bvh
from mosca.data.tracks import Tracks
from mosca.editing.edit_file import read_motion_edits, read_track_edits
from mosca.editing.history import Edited, TakeFormat, read_edited, sidecars, write_edited
from mosca.errors import InputError
from mosca.formats.bodies.bvh_writer import write_bvh
from mosca.formats.tracks.tracks_file import SUFFIXES, check_tracks_file, read_tracks, write_tracks
from scenarios.commands.labels import rate_of

MOTION = ".bvh"


def edit_take(path: Path, edits_path: Path, out: Path, fps: float | None, metres_per_unit: float) -> list[str]:
    """Apply the edits of a file to the tracks or the motion in ``path``, write ``out``; return the lines to print."""
    form = _format(path, out, fps, metres_per_unit)
    edits = form.read_edits(edits_path)
    before = read_edited(path, form)
    after = before.edited(edits)
    whole = write_edited(after, out, form)
    told = zip(edits.names, after.changes[len(before.changes) :], strict=True)
    lines = [f"edit[{k}] {name}: {one.rows} rows changed or removed" for k, (name, one) in enumerate(told)]
    return [*lines, f"{_written(after, out, whole)}; what was changed is kept beside it, in {sidecars(out)[1].name}"]


def undo_take(path: Path, last: int | None, out: Path, fps: float | None, metres_per_unit: float) -> list[str]:
    """Undo the ``last`` edits of ``path`` (None: all) and write ``out``; return the lines to print."""
    form = _format(path, out, fps, metres_per_unit)
    before = read_edited(path, form)
    there = len(before.edits)
    if not there:
        raise InputError(f"{path}: no edits are kept beside it in {sidecars(path)[0].name}; there is nothing to undo")
    if last is not None and not 0 < last <= there:
        raise InputError(f"--undo {last}: {path} has {there} edits; 1 to {there}, or all, can be undone")
    after = before.undone(there if last is None else last)
    whole = write_edited(after, out, form)
    return [f"{there - len(after.edits)} of {there} edits undone", _written(after, out, whole)]


def _written(edited: Edited[Any], out: Path, whole: bool) -> str:
    lost = "" if whole else f", as far as {out.suffix} holds numbers (a .npz file holds all of tracks)"
    rows = len(edited.take) if isinstance(edited.take, Tracks) else len(edited.take.root_xyz)
    return f"{rows} {'samples' if isinstance(edited.take, Tracks) else 'frames'} in {out}{lost}"


def _format(path: Path, out: Path, fps: float | None, metres_per_unit: float) -> TakeFormat[Any]:
    """Return the format to read ``path`` and write ``out``; InputError where one is tracks and the other a motion."""
    if path.suffix.lower() == MOTION:
        if out.suffix.lower() != MOTION:
            raise InputError(f"{out}: suffix '{out.suffix}' given; a motion is written as {MOTION}")
        read = partial(read_bvh, metres_per_unit=metres_per_unit, frame_rate_hz=fps)
        return TakeFormat(read, partial(write_bvh, metres_per_unit=metres_per_unit), read_motion_edits)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: suffix '{path.suffix}' given; {', '.join((*SUFFIXES, MOTION))} are allowed")
    check_tracks_file(out)
    return TakeFormat(
        read_tracks, lambda tracks, to: write_tracks(tracks, to, rate_of(tracks, fps, path)), read_track_edits
    )
