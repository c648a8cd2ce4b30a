"""``mosca reconstruct``: tracks from a recording of real images."""

import logging
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from mosca.data.arrays import Array
from mosca.data.files.rig_file import read_rig
from mosca.data.files.toml import Table, check, read_toml
from mosca.data.rig import Camera, Rig
from mosca.detection.detect import mean_background, minimum_background
from mosca.diagnostics.camera_health import Health
from mosca.diagnostics.sensor import Sensors
from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import check_tracks_file, write_tracks
from mosca.pipeline import PipelineSettings, check_source, run, run_seen
from mosca.recording import McapRecording, open_recording
from mosca.recording.count_sets import counted
from mosca.synchronisation import Assembly
from scenarios.build.cameras import overlap_of
from scenarios.build.scene import stage_settings
from scenarios.run.interrupt import between_steps
from scenarios.run.postprocess import NONE, Postprocessing, Postprocessor
from scenarios.spec.scenario import apply_overrides
from scenarios.spec.stages import StageTables

LOG = logging.getLogger(__name__)


class VolumeSpec(Table):
    """The box in which targets can be."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    @model_validator(mode="after")
    def _not_empty(self) -> "VolumeSpec":
        if any(low >= high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(f"low_m {self.low_m} must lie below high_m {self.high_m} on each axis")
        return self


class BackgroundSpec(Table):
    """What is taken off each camera's images before detection; made in a first pass over the recording."""

    kind: Literal["none", "minimum", "mean"] = Field(
        "none",
        description="'minimum' of each pixel where targets are in every frame and move, "
        "'mean' where the first frames show no targets",
    )
    frames: int = Field(100, ge=1, description="how many frames of each camera, from the first")


class ReconstructSpec(StageTables):
    """Settings file of ``mosca reconstruct``."""

    FILE_KIND: ClassVar[str] = "settings"

    background: BackgroundSpec = BackgroundSpec()
    volume: VolumeSpec | None = Field(None, description="box in which targets can be; default: everywhere")
    lookahead: int = Field(
        PipelineSettings().lookahead,
        ge=0,
        description="frame sets of a recording that are looked at before the first is processed; 0: as live",
    )


def reconstruct_recording(
    recording: Path,
    rig_path: Path,
    out: Path,
    fps: float | None,
    settings_path: Path | None,
    overrides: tuple[str, ...],
    progress: Callable[[int, int], None] | None = None,
    after: Postprocessing = NONE,
) -> list[str]:
    """Run the pipeline on a recording, write its tracks to ``out`` and return the lines to print.

    ``after``: smoothing, labelling and gap filling of the measured tracks.
    """
    check_tracks_file(out)
    postprocessor = Postprocessor(after)
    rig = read_rig(rig_path)
    if not any(overlap_of(a, b) for a in rig.cameras for b in rig.cameras if a is not b):
        raise InputError(
            f"{rig_path}: no two cameras see a common point; check poses (world_from_camera, z forward) and units (m)"
        )
    spec = reconstruct_spec(settings_path, overrides)
    settings = reconstruct_settings(spec, settings_path)
    LOG.info("%s: rig of %d cameras; background: %s", recording, len(rig.cameras), spec.background.kind)
    backgrounds = recorded_backgrounds(recording, rig, fps, spec.background)
    LOG.info("frames to tracks")
    assembly, health = Assembly(), Health.of(rig, settings.match)
    counts = np.zeros(3)
    with open_recording(recording, rig, fps) as source, between_steps() as stop:
        rate = source.cameras[0].frame_rate_hz
        sensors = Sensors(source.cameras, settings.detection)
        if isinstance(source, McapRecording) and source.holds == "detections":
            check_source(source, rig)
            found = counted(source.detection_sets(), source.cameras, assembly)
            steps = run_seen(found, rig, settings, health=health)
        else:
            steps = run(source, rig, settings, assembly, backgrounds, health=health, sensors=sensors)
        for step in steps:
            stop()
            postprocessor.take(step.frame_set.pulse, step.samples)
            counts += 1, sum(len(d) for d in step.detections.values()), len(step.points)
            if progress is not None:
                progress(int(counts[0]), int(counts[0]))
    LOG.info("%d frame sets tracked; smoothing, labels and gaps", int(counts[0]))
    tracks, more = postprocessor.finished()
    write_tracks(tracks, out, rate)
    LOG.info("%s written", out)
    tracks = tracks.select(tracks.status == "measured")
    sets = max(counts[0], 1)
    lines = [
        f"{assembly.frames} frames in {assembly.sets} sets, {assembly.complete_sets} of them complete",
        f"a set has {counts[1] / sets:.1f} detections and {counts[2] / sets:.1f} points",
        f"{len(np.unique(tracks.track))} tracks with {len(tracks)} samples in {out}",
    ]
    if len(tracks):
        lines.append(f"reprojection error {np.sqrt(np.mean(tracks.residual_px**2)):.3f} px rms")
    else:
        lines.append(_why_no_tracks(counts, settings, health))
    lines += [*health.left_out().values(), *health.findings(), *more]
    lines += [
        f"{name}: {c.dropped} dropped, {c.corrupt} corrupt, {c.late} late, {c.doubled} doubled"
        for name, c in assembly.cameras.items()
        if c.dropped or c.corrupt or c.late or c.doubled
    ]
    lines += [*sensors.lines(), *sensors.findings()]
    lines += [f"{kind}: {note}" for kind, note in assembly.notes.items()]
    if assembly.skipped_sets:
        lines.append(f"{assembly.skipped_sets} frame sets are missing in the recording")
    return lines


def _why_no_tracks(counts: Array, settings: PipelineSettings, health: Health) -> str:
    """Return advice for the first stage without results; ``counts``: sets, detections, points."""
    if health.withheld:
        return f"no tracks: look at track.worst_sigma_m ({settings.track.worst_sigma_m:g})"
    if counts[1] == 0:
        detection = settings.detection
        if detection.thresholds == "noise":
            return f"no detections: look at detection.false_alarms ({detection.false_alarms:g}) and sizes"
        return f"no detections: look at detection.contrast_dn ({detection.paper_thresholds()[0]:g}) and sizes"
    if counts[2] == 0:
        return (
            "no points: look at the rig, [volume], match.camera_sigma_px "
            f"({settings.match.camera_sigma_px:g}) and match.worst_sigma_m ({settings.match.worst_sigma_m:g})"
        )
    return (
        f"no tracks: look at track.confirm_weight ({settings.track.confirm_weight:g}), at the frame rate, and at "
        "track.speed_mps and track.gate_m, which come from the cameras' fields of view by default"
    )


def reconstruct_spec(path: Path | None, overrides: tuple[str, ...] = ()) -> ReconstructSpec:
    """Return the settings of a file with ``KEY=VALUE`` overrides; InputError names file, key and value."""
    document = {} if path is None else read_toml(path)
    apply_overrides(document, overrides)
    return check(ReconstructSpec, document, path or "--set")


def live_spec(path: Path | None, overrides: tuple[str, ...] = ()) -> ReconstructSpec:
    """Return ``reconstruct_spec`` for frames that are seen once; InputError where it needs a first pass over them."""
    spec = reconstruct_spec(path, overrides)
    if spec.background.kind != "none":
        raise InputError(
            f"{path or '--set'}: key 'background.kind': '{spec.background.kind}' given; a live run has no first pass "
            'over its frames: "none" is wanted'
        )
    return spec


def reconstruct_settings(spec: ReconstructSpec, path: Path | None = None) -> PipelineSettings:
    """Return the pipeline's settings of ``spec``; ``path`` is the file that an InputError names."""
    volume = None if spec.volume is None else (spec.volume.low_m, spec.volume.high_m)
    try:
        return replace(stage_settings(spec, volume), lookahead=spec.lookahead)
    except InputError as error:  # the stages do not name files
        raise InputError(f"{path or '--set'}: {error}") from None


def recorded_backgrounds(recording: Path, rig: Rig, fps: float | None, spec: BackgroundSpec) -> dict[str, Array]:
    """Return camera -> background (H, W) of a recording's first frames, by the settings ``spec``.

    It is made camera by camera and frame by frame, so that only a few images are in memory.
    """
    if spec.kind == "none":
        return {}
    return {camera.name: _background(recording, camera, fps, spec) for camera in rig.cameras}


def _background(recording: Path, camera: Camera, fps: float | None, spec: BackgroundSpec) -> Array:
    with open_recording(recording, Rig((camera,)), fps) as source:
        images = (frame.image for frame in islice(source, spec.frames) if frame.image is not None)
        first = next(images, None)
        if first is None:
            raise InputError(
                f"{recording}: key 'background.frames': {spec.frames} given, but camera '{camera.name}' has no "
                'readable image among them; give more, or background.kind = "none"'
            )
        make = minimum_background if spec.kind == "minimum" else mean_background
        return make(chain((first,), images))
