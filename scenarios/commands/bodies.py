"""Rigid bodies from tracks files: learning their definitions, finding their poses."""

from pathlib import Path

import numpy as np

from mosca.data.bodies import FEWEST_MARKERS, RigidBody
from mosca.data.files.whole_file import check_writable
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import write_bodies_csv
from mosca.formats.bodies.body_file import read_bodies, write_bodies
from mosca.formats.bodies.tum import write_tum
from mosca.formats.tracks.tracks_file import check_tracks_file, read_tracks, write_tracks
from mosca.rigid_bodies.ambiguity import check_bodies
from mosca.rigid_bodies.learn import learn_body
from mosca.rigid_bodies.tracker import body_poses, labelled_by_bodies
from scenarios.commands.labels import between, rate_of

POSES = (".csv", ".tum")


def learn_from(path: Path, out: Path, bodies: tuple[str, ...], frames: str | None) -> list[str]:
    """Learn rigid bodies from the tracks in ``path``, write them to ``out`` and return the lines to print.

    ``bodies``: ``NAME=TRACK,TRACK,...`` texts; ``frames``: ``FIRST:LAST``. InputError where these cannot be used.
    """
    if out.suffix.lower() != ".toml":
        raise InputError(f"{out}: suffix '{out.suffix}' given; definitions of bodies are a .toml file")
    check_writable(out)
    tracks = read_tracks(path)
    if frames is not None:
        tracks = between(tracks, frames)
    there = set(tracks.track.tolist())
    found: list[RigidBody] = []
    for text in bodies:
        name, ids = _body(text)
        if missing := [one for one in ids if one not in there]:
            known = ", ".join(map(str, sorted(there)[:20])) or "none"
            raise InputError(f"--body {text}: {path} has no track {missing[0]}; its tracks are {known}")
        if name in [one.name for one in found]:
            raise InputError(f"--body {text}: body '{name}' is given twice; each has a name of its own")
        try:
            found.append(learn_body(tracks, ids, name))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    check_bodies(found)
    write_bodies(found, out)
    return [
        f"body '{one.name}': {len(one.markers)} markers, each known to {1e3 * one.sigma_m:.3g} mm, in {out}"
        for one in found
    ]


def find_in(
    path: Path, definitions: Path, out: Path, body: str | None, tracks_out: Path | None, fps: float | None
) -> list[str]:
    """Find the poses of the bodies of a file in the tracks of another, write them and return the lines to print.

    ``out``: .csv for all bodies with covariance, or .tum for one; ``body``: the one for .tum; ``tracks_out``: file
    for the same tracks, labelled by the bodies to which they belong.
    """
    if out.suffix.lower() not in POSES:
        raise InputError(f"{out}: suffix '{out.suffix}' given; poses are written as {' or '.join(POSES)}")
    check_writable(out)
    if tracks_out is not None:
        check_tracks_file(tracks_out)
    bodies = read_bodies(definitions)
    names = [one.name for one in bodies]
    if body is not None and body not in names:
        raise InputError(f"--body {body}: {definitions} defines {', '.join(names)}; name one of them")
    tracks = read_tracks(path)
    poses = body_poses(tracks, bodies)
    if out.suffix.lower() == ".tum":
        write_tum(poses, out, body)
    else:
        write_bodies_csv(poses if body is None else poses.select(np.asarray(poses.body) == body), out)
    if tracks_out is not None:
        labelled = labelled_by_bodies(tracks, bodies)
        write_tracks(labelled, tracks_out, rate_of(labelled, fps, path))
    frames = len(np.unique(tracks.frame))
    lines = []
    for one in bodies:
        mine = poses.of(one.name)
        rms = np.sqrt(np.nanmean(mine.residual_m**2)) if np.isfinite(mine.residual_m).any() else np.nan
        lines.append(
            f"body '{one.name}': a pose in {len(mine)} of {frames} frames"
            + (f", its markers {1e3 * rms:.3g} mm rms off their places" if np.isfinite(rms) else "")
        )
    return [*lines, f"poses in {out}"]


def _body(text: str) -> tuple[str, tuple[int, ...]]:
    name, equals, tracks = text.partition("=")
    parts = [part.strip() for part in tracks.split(",")]
    if not equals or not name or len(parts) < FEWEST_MARKERS or not all(part.isdecimal() for part in parts):
        raise InputError(
            f"--body {text}: NAME=TRACK,TRACK,... of {FEWEST_MARKERS} tracks or more is wanted, as drone=0,3,4,7"
        )
    return name, tuple(int(part) for part in parts)
