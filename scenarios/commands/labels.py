"""Labels of tracks: marker models learned and applied, blink codes, coded targets."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mosca.coded_targets.detect import CodedSettings, find_coded
from mosca.data.files.rig_file import read_rig
from mosca.data.files.whole_file import check_writable
from mosca.data.lamp_codes import LAMP_NUMBERS
from mosca.data.tracks import Samples, Tracks, table
from mosca.errors import InputError
from mosca.formats.bodies.model_file import read_model, write_model
from mosca.formats.tracks.tracks_file import check_tracks_file, read_tracks, write_tracks
from mosca.labelling.assign import label_tracks
from mosca.labelling.blinking_leds import BlinkSettings, label_lamps
from mosca.labelling.coded_targets import coded_label, coded_points, coded_samples
from mosca.labelling.marker_model import learn_model
from mosca.pipeline import check_source
from mosca.recording import open_recording
from mosca.synchronisation import assemble
from scenarios.run.interrupt import between_steps


def learn_from(path: Path, out: Path, names: tuple[str, ...], limbs: tuple[str, ...], frames: str | None) -> str:
    """Learn a marker model from the tracks in ``path`` and write it to ``out``; return the line to print.

    ``names``: ``TRACK=LABEL`` texts, ``limbs``: ``LIMB=LABEL,LABEL,...``, ``frames``: ``FIRST:LAST``. Where ``names``
    has tracks, only these are used. InputError where the arguments cannot be used.
    """
    if out.suffix.lower() != ".toml":
        raise InputError(f"{out}: suffix '{out.suffix}' given; a marker model is a .toml file")
    check_writable(out)
    tracks = read_tracks(path)
    if frames is not None:
        tracks = between(tracks, frames)
    if names:
        tracks = _named(tracks, names, path)
    elif not (tracks.label != "").any():
        raise InputError(
            f"{path}: no sample has a label; name its tracks with --name TRACK=LABEL, e.g. --name "
            f"{int(tracks.track[0]) if len(tracks) else 0}=LFHD"
        )
    members = _limbs(limbs)
    try:
        model = learn_model(tracks, members)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    write_model(model, out)
    pairs = int(model.rigid.sum()) // 2
    return f"{len(model.names)} markers, {pairs} pairs that keep their distance, in {out}"


def apply_to(path: Path, model_path: Path, out: Path, fps: float | None) -> list[str]:
    """Name the tracks in ``path`` by a model, write them to ``out`` and return the lines to print."""
    check_tracks_file(out)
    model = read_model(model_path)
    tracks = label_tracks(read_tracks(path), model)
    write_tracks(tracks, out, rate_of(tracks, fps, path))
    found = [name for name in model.names if (tracks.label == name).any()]
    missing = [name for name in model.names if name not in found]
    lines = [f"{len(found)} of {len(model.names)} markers found in {len(np.unique(tracks.track))} tracks, in {out}"]
    if missing:
        lines.append(f"not found: {', '.join(missing)}")
    return lines


def label_blinking(
    path: Path, out: Path, settings: BlinkSettings, names: tuple[str, ...], fps: float | None
) -> list[str]:
    """Name the tracks in ``path`` by their lamps' blink codes, write them to ``out``; return the lines to print.

    ``names``: ``NUMBER=LABEL`` texts; without them lamps are called ``lamp/NUMBER``, and all numbers are possible.
    """
    check_tracks_file(out)
    label_of = _lamp_labels(names)
    tracks = label_lamps(read_tracks(path), label_of or None, settings)
    write_tracks(tracks, out, rate_of(tracks, fps, path))
    named = np.unique(tracks.track[tracks.label != ""])
    lines = [f"{len(named)} of {len(np.unique(tracks.track))} tracks have a label, in {out}"]
    if missing := [label for label in label_of.values() if not (tracks.label == label).any()]:
        lines.append(f"not found: {', '.join(missing)}")
    return lines


def label_coded(
    recording: Path,
    rig_path: Path,
    out: Path,
    fps: float | None,
    settings: CodedSettings,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Find coded targets in a recording and write their tracks, numbered and labelled; return the lines to print."""
    check_tracks_file(out)
    rig = read_rig(rig_path)
    samples: list[Samples] = []
    with open_recording(recording, rig, fps) as source, between_steps() as stop:
        check_source(source, rig)
        rate = source.cameras[0].frame_rate_hz
        bits = {info.name: info.bit_depth for info in source.cameras}
        for done, frames in enumerate(assemble(source, source.cameras), start=1):
            stop()
            found = {
                name: find_coded(frame.image, name, settings, bits[name])
                for name, frame in frames.frames.items()
                if frame.image is not None
            }
            samples.append(coded_samples(*coded_points(rig, found), frames.pulse, frames.time_ns))
            if progress is not None:
                progress(done, done)
    tracks = table(samples)
    label = np.array([coded_label(number) for number in tracks.track.tolist()], dtype=np.str_)
    tracks = replace(tracks, label=label)
    write_tracks(tracks, out, rate)
    lines = [f"{len(np.unique(tracks.track))} coded targets with {len(tracks)} samples in {out}"]
    if not len(tracks):
        lines.append(
            "no coded target is seen by two cameras: check --colour, focus, and that a dot is 4 px or larger"
        )
    return lines


def _lamp_labels(names: tuple[str, ...]) -> dict[int, str]:
    label_of: dict[int, str] = {}
    for text in names:
        number, equals, label = text.partition("=")
        if not equals or not number.isdecimal() or int(number) >= LAMP_NUMBERS or not label:
            raise InputError(
                f"--name {text}: NUMBER=LABEL is wanted, numbers 0 to {LAMP_NUMBERS - 1}, for example --name 12=LWRI"
            )
        if int(number) in label_of or label in label_of.values():
            raise InputError(f"--name {text}: its number or label is given twice; name each lamp once")
        label_of[int(number)] = label
    return label_of


def rate_of(tracks: Tracks, fps: float | None, path: Path) -> float:
    """Return the frame rate [Hz]: the given one, else that of the samples' times."""
    if fps is not None:
        return fps
    frames, first = np.unique(tracks.frame, return_index=True)
    times = np.asarray(tracks.time_ns)[first]
    if len(frames) < 2 or times[-1] <= times[0]:
        raise InputError(f"{path}: its times do not tell a frame rate; give it with --fps")
    return float((frames[-1] - frames[0]) * 1e9 / (times[-1] - times[0]))


def between(tracks: Tracks, frames: str) -> Tracks:
    """Return the samples of the frames ``FIRST:LAST``, ends included; InputError where there are none."""
    first, colon, last = frames.partition(":")
    if not colon or not first.isdecimal() or not last.isdecimal() or int(first) > int(last):
        raise InputError(f"--frames {frames}: FIRST:LAST is wanted, for example --frames 100:400")
    return tracks.select((tracks.frame >= int(first)) & (tracks.frame <= int(last)))


def _named(tracks: Tracks, names: tuple[str, ...], path: Path) -> Tracks:
    label_of: dict[int, str] = {}
    there = set(tracks.track.tolist())
    for text in names:
        track, equals, label = text.partition("=")
        if not equals or not track.isdecimal() or not label:
            raise InputError(f"--name {text}: TRACK=LABEL is wanted, for example --name 7=LFHD")
        if int(track) not in there:
            known = ", ".join(map(str, sorted(there)[:20])) or "none"
            raise InputError(f"--name {text}: {path} has no track {int(track)}; its tracks are {known}")
        if int(track) in label_of:
            raise InputError(f"--name {text}: track {int(track)} has the name {label_of[int(track)]} already")
        label_of[int(track)] = label
    kept = tracks.select(np.isin(tracks.track, list(label_of)))
    labels = np.array([label_of[track] for track in kept.track.tolist()], dtype=np.str_)
    return replace(kept, label=labels)


def _limbs(texts: tuple[str, ...]) -> dict[str, tuple[str, ...]] | None:
    found: dict[str, tuple[str, ...]] = {}
    for text in texts:
        limb, members = _limb(text)
        if limb in found:
            raise InputError(f"--limb {text}: limb '{limb}' is given twice; name all its labels in one --limb")
        found[limb] = members
    return found or None


def _limb(text: str) -> tuple[str, tuple[str, ...]]:
    limb, equals, members = text.partition("=")
    parts = tuple(part.strip() for part in members.split(",") if part.strip())
    if not equals or not limb or len(parts) < 2:
        raise InputError(f"--limb {text}: LIMB=LABEL,LABEL,... is wanted, for example --limb head=LFHD,RFHD,LBHD")
    return limb, parts
