"""``mosca reconstruct --continuous``: tracks on a grid of instants from a recording of unsynchronised cameras."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from mosca.continuous.association.associate import AssociationSettings, gather_seen
from mosca.continuous.association.frame_detections import FrameCount
from mosca.continuous.association.given_points import gather_named, seen_in_table
from mosca.continuous.estimator.estimate import ContinuousSettings
from mosca.continuous.moving_cameras.body_worn import Lamps, reconstruct_worn
from mosca.continuous.reconstruct import Reconstructed, reconstruct, reconstruct_gathered
from mosca.data.arrays import Array
from mosca.data.files.rig_file import read_rig
from mosca.data.files.whole_file import whole_file
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.formats.image_points import read_image_points
from mosca.formats.tracks.tracks_file import check_tracks_file, write_tracks
from mosca.recording import McapRecording, open_recording
from scenarios.build.cameras import overlap_of
from scenarios.build.frame_sources import SelectedCameras
from scenarios.commands.lamp_file import read_lamps
from scenarios.commands.reconstruct import reconstruct_settings, reconstruct_spec, recorded_backgrounds
from scenarios.run.continuous import clock_line, record_clocks
from scenarios.run.interrupt import between_steps

HIGHEST_RATE_HZ = 10_000.0


@dataclass(frozen=True)
class ContinuousOptions:
    """Options of ``mosca reconstruct --continuous``."""

    rate_hz: float | None = None
    """Rate of the grid; None: that of the fastest camera."""
    clocks: Literal["auto", "common", "own"] = "auto"
    """See ``AssociationSettings``."""
    search_s: float = 10.0
    """Largest difference of the start times of cameras with clocks of their own."""
    limbs: bool = True
    """Whether constant distances are used."""
    worn: Path | None = None
    """File of the lamps of cameras on limbs; only the rig's poses of the cameras that it names are used."""


def reconstruct_continuous(
    recording: Path,
    rig_path: Path,
    out: Path,
    fps: float | None,
    settings_path: Path | None,
    overrides: tuple[str, ...],
    options: ContinuousOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Write the tracks of a recording to ``out`` and its clocks beside them; return the lines to print.

    The grid begins at the first image point's instant; times are the first camera's stamps.
    """
    options = ContinuousOptions() if options is None else options
    check_tracks_file(out)
    if options.rate_hz is not None and not 0.0 < options.rate_hz <= HIGHEST_RATE_HZ:
        raise InputError(f"--rate {options.rate_hz:g}: above 0 and at most {HIGHEST_RATE_HZ:g} Hz is allowed")
    if not 0.0 < options.search_s <= 3600.0:
        raise InputError(f"--search {options.search_s:g}: above 0 and at most 3600 s is allowed")
    rig = read_rig(rig_path)
    lamps = None if options.worn is None else read_lamps(options.worn, rig)
    if lamps is None:
        check_overlap(rig, rig_path)
    spec = reconstruct_spec(settings_path, overrides)
    gathering = AssociationSettings(reconstruct_settings(spec, settings_path), options.clocks, options.search_s)
    wanted = ContinuousSettings(clocks="known", limbs=options.limbs)
    if recording.suffix == ".csv":
        if lamps is not None:
            raise InputError(f"{recording}: a table of image points has no lamps to read; leave --worn out")
        found = _of_table(recording, rig, fps, gathering, wanted)
    else:
        backgrounds = recorded_backgrounds(recording, rig, fps, spec.background)
        found = _of_images(recording, rig, fps, gathering, wanted, backgrounds, lamps, progress)
    rate = options.rate_hz or max(1.0 / one.period_s for one in found.gathered.seen)
    tracks = found.tracks(grid_ns(found, rate))
    write_tracks(tracks, out, rate)
    clocks = out.with_suffix(".clocks.json")
    with whole_file(clocks) as part:
        text = json.dumps({"clocks": record_clocks(found), "findings": list(found.findings)}, indent=2)
        part.write_text(text + "\n", encoding="utf-8")
    measured = int((tracks.status == "measured").sum())
    return [
        f"{sum(found.gathered.count.frames.values())} frames of {len(rig.cameras)} cameras, each at its own instant",
        f"{len(found.estimated.curves.points)} markers; {len(tracks)} samples at {rate:g} Hz in "
        f"{out}, {measured} of them "
        "measured, the others filled",
        f"reprojection error {found.residual_rms_px():.3f} px rms",
        *(f"{one.camera} {clock_line(one)}" for one in found.clocks[1:] if lamps is None),
        f"clocks in {clocks}",
        *_without_stamps(recording, fps, options),
        *found.findings,
    ]


def _of_table(
    path: Path, rig: Rig, fps: float | None, gathering: AssociationSettings, wanted: ContinuousSettings
) -> Reconstructed:
    """Return the reconstruction from a table of image points."""
    table = read_image_points(path, fps)
    seen, names = seen_in_table(table, rig)
    if (table.point != "").all():
        return reconstruct_gathered(gather_named(seen, names, rig, gathering), rig, wanted)
    # a table has no sizes from which partly hidden targets could be recognised
    pipeline = gathering.pipeline
    pipeline = replace(pipeline, match=replace(pipeline.match, judge_sizes=False))
    count = FrameCount({one.info.name: len(one.frame_ns) for one in seen})
    gathered = gather_seen(seen, rig, replace(gathering, pipeline=pipeline), count)
    return reconstruct_gathered(gathered, rig, wanted)


def _of_images(
    recording: Path, rig: Rig, fps: float | None, gathering: AssociationSettings, wanted: ContinuousSettings,
    backgrounds: Mapping[str, Array], lamps: tuple[tuple[str, ...], Lamps] | None,
    progress: Callable[[int, int], None] | None
) -> Reconstructed:  # fmt: skip
    """Return the reconstruction from a recording's images."""
    with open_recording(recording, rig, fps) as opened, between_steps() as stop:
        source: FrameSource = opened
        if isinstance(opened, McapRecording) and opened.holds == "detections":
            raise InputError(
                f"{recording}: holds detections of frame sets, not images; --continuous needs each camera's frames"
            )
        if any(info.name not in rig.names for info in source.cameras):
            source = SelectedCameras(source, rig.names)

        def attend(done: int) -> None:
            stop()
            if progress is not None:
                progress(done, done)

        if lamps is None:
            return reconstruct(source, rig, gathering, wanted, backgrounds, attend)
        return reconstruct_worn(source, rig, *lamps, gathering, wanted, backgrounds, attend).reconstructed


def _without_stamps(recording: Path, fps: float | None, options: ContinuousOptions) -> list[str]:
    """Return a line on the assumptions made where frames have no stamps of their own."""
    if fps is None or options.clocks == "own" or not recording.is_dir():
        return []
    if any((recording / name).exists() for name in ("frames.csv", "recording.mcap")):
        return []
    return [
        f"no frames.csv gives stamps: frames are taken to be 1/{fps:g} s apart and all cameras to have begun "
        "together; if they did not, say --clocks own"
    ]


def grid_ns(found: Reconstructed, rate_hz: float) -> Array:
    """Return instants (t,) at ``rate_hz`` over all image points, in the first camera's stamps [ns]."""
    begin, end = found.span_ns()
    count = int((end - begin) * 1e-9 * rate_hz) + 1
    result: Array = begin + np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return result


def check_overlap(rig: Rig, path: Path) -> None:
    """Raise InputError where the view of a camera does not overlap with that of another."""
    for camera in rig.cameras:
        if not any(overlap_of(camera, other) for other in rig.cameras if other is not camera):
            raise InputError(
                f"{path}: camera '{camera.name}' sees nothing that another camera sees; check its pose "
                "(world_from_camera, z forward, m), or leave it out of the rig file"
            )
