"""Sources that come at their own pace: devices, recordings and scenarios played as if they were filmed now."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Self

from mosca.data.files.rig_file import read_rig
from mosca.data.frames import CameraInfo, Frame, FrameSource, mid_exposure_ns
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from mosca.recording import McapRecording, open_recording
from scenarios.build.calibration_faults import with_fault
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.commands.reconstruct import live_spec, reconstruct_settings
from scenarios.run.sources import Chosen
from scenarios.spec.scenario import load_scenario
from scenarios.suite.catalog import find

MEMORY_BYTES = 1 << 30
"""How much of a scenario's frames is rendered beforehand."""


class Paced:
    """Frames of a source, each when it is due: by its time, ``speed`` times as fast. ``stop`` ends it at once."""

    def __init__(self, cameras: tuple[CameraInfo, ...], frames: Iterable[Frame], speed: float = 1.0) -> None:
        self.cameras = cameras
        self._frames, self._speed = frames, speed
        self._stopped = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        start, first = time.perf_counter(), None
        for frame in self._frames:
            at = mid_exposure_ns(frame)
            first = at if first is None else first
            wait = start + (at - first) * 1e-9 / self._speed - time.perf_counter()
            if self._stopped.wait(wait) if wait > 0 else self._stopped.is_set():
                return
            yield frame

    def stop(self) -> None:
        """End the iteration; may be called from another thread."""
        self._stopped.set()

    def close(self) -> None:
        """End the iteration."""
        self._stopped.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@dataclass(frozen=True, eq=False)
class LiveSource:
    """What a live run reads: frames, the rig to measure with, settings; ``stop`` ends it; ``notes``: what to tell."""

    frames: FrameSource
    rig: Rig
    settings: PipelineSettings
    stop: Callable[[], None]
    notes: tuple[str, ...] = ()


def opened_live(
    source: str,
    rig: Path | None,
    settings: Path | None,
    overrides: tuple[str, ...],
    fps: float | None,
    rate: float | None,
    seconds: float | None,
    workers: int,
    stack: ExitStack,
) -> LiveSource:
    """Open hardware:RIG.toml, recording:DIR or a scenario; InputError for another, and for options it cannot have."""
    kind, colon, place = source.partition(":")
    if colon and not place:
        raise InputError(f"{source}: allowed are hardware:RIG.toml, recording:DIR and a scenario")
    if kind == "hardware":
        if rate is not None or fps is not None:
            raise InputError(
                f"{source}: --rate and --fps are of recordings; devices run at [hardware] rate_hz"
            )
        return _devices(Path(place), rig, settings, overrides, stack)
    if kind == "recording":
        return _recording(Path(place), rig, settings, overrides, fps, rate, stack)
    for option, value in (("--rig", rig), ("--settings", settings), ("--fps", fps)):
        if value is not None:
            raise InputError(f"{option} {value}: a scenario has its own; change its keys with --set")
    return _scenario(source, overrides, rate, seconds, workers, stack)


def _recording(
    path: Path,
    rig_path: Path | None,
    settings: Path | None,
    overrides: tuple[str, ...],
    fps: float | None,
    rate: float | None,
    stack: ExitStack,
) -> LiveSource:
    if rig_path is None:
        raise InputError(f"recording:{path}: --rig RIG.toml is wanted, the calibration of its cameras")
    rig = read_rig(rig_path)
    recording = open_recording(path, rig, fps)
    stack.enter_context(recording)
    if isinstance(recording, McapRecording) and recording.holds == "detections":
        raise InputError(f"recording:{path}: holds detections, no images; 'mosca reconstruct' reads it")
    speed = 1.0 if rate is None else rate / recording.cameras[0].frame_rate_hz
    paced = Paced(recording.cameras, recording, speed)
    return LiveSource(paced, rig, _settings(settings, overrides), paced.stop)


def _devices(
    path: Path, rig_path: Path | None, settings: Path | None, overrides: tuple[str, ...], stack: ExitStack
) -> LiveSource:
    from hardware.settings import read_hardware
    from hardware.source import HardwareSource

    rig = read_rig(path if rig_path is None else rig_path)
    devices = read_hardware(path)
    missing = [name for name in rig.names if name not in devices.cameras]
    if missing:
        raise InputError(f"{path}: no camera '{missing[0]}'; it names {', '.join(devices.cameras)}")
    source = stack.enter_context(HardwareSource(devices))
    frames: FrameSource = source if set(rig.names) == set(devices.cameras) else Chosen(source, rig.names)
    return LiveSource(frames, rig, _settings(settings, overrides), source.stop)


def _settings(path: Path | None, overrides: tuple[str, ...]) -> PipelineSettings:
    return reconstruct_settings(live_spec(path, overrides), path)


def _scenario(
    name: str,
    overrides: tuple[str, ...],
    rate: float | None,
    seconds: float | None,
    workers: int,
    stack: ExitStack,
) -> LiveSource:
    path = find(name)
    spec = load_scenario(path, overrides)
    cameras = virtual_cameras(spec, true_rig(spec, path.parent))
    rig = with_fault(calibrated(spec, cameras).rig, spec.fault)
    if spec.zone:
        raise InputError(
            f"{path}: a scenario of zones is stitched when it is over; 'mosca run {name}' does that"
        )
    nominal = spec.capture.frame_rate_hz
    speed = 1.0 if rate is None else rate / nominal
    size = sum(v.camera.width * v.camera.height * (1 if spec.errors.bits <= 8 else 2) for v in cameras)
    wanted = (
        spec.capture.pulses if seconds is None else min(spec.capture.pulses, round(seconds * nominal * speed))
    )
    pulses = max(1, min(wanted, MEMORY_BYTES // size))
    notes: tuple[str, ...] = ()
    if pulses < wanted:
        notes = (f"{pulses / nominal:g} s of {wanted / nominal:g} s fit in memory and are played",)
    source: FrameSource = stack.enter_context(
        twin_source(spec, build_scene(spec, path.parent), cameras, workers)
    )
    if any(info.name not in rig.names for info in source.cameras):
        source = Chosen(source, rig.names)
    frames = list(islice(iter(source), pulses * len(source.cameras)))
    paced = Paced(source.cameras, frames, speed)
    return LiveSource(paced, rig, pipeline_settings(spec), paced.stop, notes)
