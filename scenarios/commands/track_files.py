"""``mosca tracks``: the contents of a file of tracks, its page, and conversion to another format."""

from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.rig_file import read_rig
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.rigs.lens_conversion import RigFileOptions
from mosca.formats.ros2.bag import Bag, written_bag
from mosca.formats.tracks.tracks_file import check_tracks_file, read_tracks, write_tracks
from mosca.recording.open import open_recording
from reports.evidence import Evidence
from reports.page import write_page
from reports.record import Metric, RunRecord
from scenarios.commands.labels import rate_of
from scenarios.run.take_files import RIG_FILE, take_files

MOST_ROWS = 200
"""Most tracks with a row of their own."""


def tracks_info(path: Path) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return lines about the tracks of a file, and a row for each track: name, samples, share, gaps, longest gap [s].

    InputError where the file cannot be read.
    """
    tracks = read_tracks(path)
    if not len(tracks):
        return [f"{path}: no tracks"], []
    frames = np.unique(tracks.frame)
    rate_hz = rate_of(tracks, None, path) if len(frames) > 1 else float("nan")
    seconds = float(np.ptp(tracks.time_ns)) * 1e-9
    low, high = np.nanmin(tracks.xyz, axis=0), np.nanmax(tracks.xyz, axis=0)
    statuses, counts = np.unique(tracks.status, return_counts=True)
    span = " x ".join(f"{edge:.3g}" for edge in high - low)
    sigma = np.sqrt(np.trace(tracks.covariance, axis1=1, axis2=2))
    lines = [
        f"{path}: {len(np.unique(tracks.track))} tracks, {len(tracks)} samples in {len(frames)} frames, "
        f"{seconds:.3f} s at {rate_hz:.6g} Hz",
        f"positions within {span} m, from ({', '.join(f'{x:.3g}' for x in low)}) m",
        "samples " + ", ".join(f"{status} {count}" for status, count in zip(statuses, counts, strict=True)),
    ]
    known = sigma[np.isfinite(sigma)]
    stated = (
        f"stated 3D standard deviation {1e3 * np.median(known):.3g} mm (median)" if len(known) else "no covariances"
    )
    lines.append(f"{stated}; {np.sum(np.unique(tracks.label) != '')} names")
    numbers = np.unique(tracks.track)
    rows = [_row(tracks, number, frames, rate_hz) for number in numbers[:MOST_ROWS].tolist()]
    if len(numbers) > MOST_ROWS:
        lines.append(f"the first {MOST_ROWS} tracks are shown")
    return lines, rows


def convert_tracks(path: Path, out: Path, rate_hz: float | None, names: tuple[str, ...]) -> list[str]:
    """Write the tracks of ``path`` to ``out`` in the format of its suffix; return the lines to print.

    ``rate_hz``: rate stated in C3D and TRC files, default: that of the samples' times; ``names``: the labels to keep,
    all where empty. InputError where a file cannot be read or written, or a name does not exist.
    """
    check_tracks_file(out)
    tracks = read_tracks(path)
    tracks = _of_names(tracks, names, path)
    write_tracks(tracks, out, rate_of(tracks, rate_hz, path))
    kept = f"{len(np.unique(tracks.track))} tracks, {len(tracks)} samples"
    lost = []
    if out.suffix.lower() in (".c3d", ".trc"):
        known = np.isfinite(tracks.covariance).any()
        lost = [f"{out.suffix} holds no covariances; .csv, .npz and .parquet do"] if known else []
    return [f"{out}: {kept}", *lost]


def page_of_tracks(take: Path, out: Path, rig_file: Path | None) -> list[str]:
    """Write the page of a take's tracks to ``out``, with the cameras of ``rig_file``; return the lines to print.

    Without ``rig_file`` the cameras are those of ``take`` if it is a run folder, else none. InputError where a file
    cannot be read or written, or there is no sample.
    """
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out}: suffix '{out.suffix}' given; a page is .html")
    files = take_files(take)
    tracks = read_tracks(files.tracks)
    if not np.isfinite(tracks.xyz).all(axis=1).any():
        raise InputError(f"{files.tracks}: no tracks: there is nothing to see")
    rig_file = rig_file or files.rig
    rig = Rig(()) if rig_file is None else read_rig(rig_file)
    low, high = np.nanmin(tracks.xyz, axis=0), np.nanmax(tracks.xyz, axis=0)
    residual_px = tracks.residual_px[np.isfinite(tracks.residual_px)]
    rms = float(np.sqrt(np.mean(residual_px**2))) if len(residual_px) else 0.0
    metrics = (Metric("reprojection_rms", rms, "px", len(residual_px)),) if len(residual_px) else ()
    verdict = f"{len(np.unique(tracks.track))} tracks with {len(tracks)} samples; nothing is claimed of them"
    record = RunRecord(str(files.tracks), take.stem, 0, "file", "", "pass", True, verdict, metrics)
    write_page(out, record, Evidence(rig, (low + high) / 2, np.maximum(high - low, 1e-3), tracks))
    return [f"{out}"]


def _of_names(tracks: Tracks, names: tuple[str, ...], path: Path) -> Tracks:
    there = np.unique(tracks.label)
    for name in names:
        if name not in there:
            known = ", ".join(there[there != ""][:12].tolist()) or "none"
            raise InputError(f"--only {name}: {path} has no marker of that name; names there: {known}")
    return tracks.select(np.flatnonzero(np.isin(tracks.label, names))) if names else tracks


def _row(tracks: Tracks, number: int, frames: Array, rate_hz: float) -> tuple[str, ...]:
    mine = tracks.track == number
    names = [name for name in np.unique(tracks.label[mine]).tolist() if name]
    at = np.searchsorted(frames, np.unique(tracks.frame[mine]))
    missing = np.diff(at) - 1
    holes = missing[missing > 0]
    return (
        "/".join(names) or str(number),
        str(len(at)),
        f"{100 * len(at) / len(frames):.1f}",
        str(len(holes)),
        f"{holes.max(initial=0) / rate_hz:.2f}",
    )


def tracks_as_bag(
    take: Path, out: Path, rig_file: Path | None, recording: Path | None, most_px: float | None
) -> list[str]:
    """Write a take, its rig and a recording's images as a ROS 2 bag; return the lines to print.

    ``take``: file of tracks or run folder, from which poses of bodies and the rig are also taken; ``rig_file``:
    another rig; without both, that of the recording; ``most_px``: largest error of ROS's model of a lens, None: no
    cameras. InputError for files that cannot be read or written, for images whose stamps are not on the session's
    clock, and where there is nothing of the take or no image of the recording to write.
    """
    files = take_files(take)
    tracks = read_tracks(files.tracks)
    rig_file = rig_file or files.rig
    if rig_file is None and recording is not None and (recording / RIG_FILE).is_file():
        rig_file = recording / RIG_FILE
    rig = None if rig_file is None else read_rig(rig_file)
    times = np.unique(tracks.time_ns).tolist()
    notes: list[str] = []
    with written_bag(out) as bag:
        bag.add_markers(tracks)
        if files.bodies is not None:
            bag.add_bodies(read_bodies_csv(files.bodies))
        if not bag.counts:
            raise InputError(f"{take}: no marker and no pose of a body: there is nothing to write")
        if rig is not None and most_px is not None:
            options = RigFileOptions(max_residual_px=most_px)
            for camera in rig.cameras:
                notes += bag.add_camera(camera, times, options)
        images = 0 if recording is None else _add_images(bag, recording, rig)
    return [*notes, f"{out} written: {bag.counts.total()} messages, {len(times)} frame sets, {images} images"]


def _add_images(bag: Bag, recording: Path, rig: Rig | None) -> int:
    with open_recording(recording, rig) as source:
        for info in source.cameras:
            if info.clock != "session":
                raise InputError(
                    f"{recording}: camera '{info.name}' stamps by the {info.clock}'s clock, tracks by the session's; "
                    "leave --recording out"
                )
        images = sum(bag.add_image(frame) for frame in source)
    if not images:
        raise InputError(f"{recording}: no image: there is nothing to write; leave --recording out")
    return images
