"""Sources with their own pace: devices, and recordings and scenarios that are played as if they were filmed now."""

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Self

from hardware.streams.turns import UpAxis
from mosca.data.files.rig_file import read_rig
from mosca.data.frames import CameraInfo, Frame, FrameSource, mid_exposure_ns
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from mosca.recording import McapRecording, open_recording
from scenarios.build.calibration_faults import with_fault
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.frame_sources import SelectedCameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.commands.reconstruct import live_spec, reconstruct_settings
from scenarios.run.stream_servers import StreamSettings
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from twin.scenes.scene import Scene

MEMORY_BYTES = 1 << 30
"""Most bytes of a scenario's frames that are rendered beforehand."""


@dataclass(frozen=True)
class LiveOptions:
    """The options of ``mosca live``, under their names; its help describes them."""

    source: str
    rig: Path | None = None
    out: Path | None = None
    record: Path | None = None
    seconds: float | None = None
    fps: float | None = None
    rate: float | None = None
    queued: int = 2
    lag: int | None = None
    settings: Path | None = None
    overrides: tuple[str, ...] = ()
    skeleton: Path | None = None
    joints: Path | None = None
    rrd: Path | None = None
    view: bool = False
    images: int = 0
    """Number of frame sets a second whose images are shown."""
    virtual: Path | None = None
    bodies: Path | None = None
    bind: tuple[str, ...] = ()
    display_hz: float | None = None
    display_lead: float | None = None
    display_delay: float | None = None
    horizon: float | None = None
    stream: tuple[StreamSettings, ...] = ()
    """Streams that serve markers and bodies."""
    up: UpAxis = "z"
    """Upward axis of the stream."""
    workers: int | None = None
    """Rendering threads of a scenario; default: all cores."""


class PacedFrames:
    """Frames of a source, each yielded when it is due by its time, at ``speed``. ``stop`` ends this at once."""

    def __init__(self, cameras: tuple[CameraInfo, ...], frames: Iterable[Frame], speed: float = 1.0) -> None:
        self.cameras = cameras
        self._frames, self._speed = frames, speed
        self._stopped = threading.Event()
        self._begin: tuple[float, int] | None = None

    def session_ns(self, host_ns: int) -> int | None:
        """Return a host time (monotonic) on the frames' clock [ns]; None before the first frame.

        A frame is due at the middle of its exposure, as if readout and transport took no time.
        """
        if self._begin is None:
            return None
        start, first_ns = self._begin
        return first_ns + round((host_ns - start * 1e9) * self._speed)

    def __iter__(self) -> Iterator[Frame]:
        start, first = time.monotonic(), None
        for frame in self._frames:
            at = mid_exposure_ns(frame)
            if first is None:
                first = at
                self._begin = start, first
            wait = start + (at - first) * 1e-9 / self._speed - time.monotonic()
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
    """Input of a live run: frames, rig, settings; ``stop`` ends it; ``notes``: lines to print.

    ``session_ns``: host time (monotonic) -> time on the frames' clock [ns], None while unknown. ``scene``: that of
    the twin.
    """

    frames: FrameSource
    rig: Rig
    settings: PipelineSettings
    stop: Callable[[], None]
    session_ns: Callable[[int], int | None]
    notes: tuple[str, ...] = ()
    scene: Scene | None = None


def opened_live(options: LiveOptions, stack: ExitStack) -> LiveSource:
    """Open hardware:RIG.toml, recording:DIR or a scenario; InputError for other sources and unsuitable options."""
    source = options.source
    kind, colon, place = source.partition(":")
    if colon and not place:
        raise InputError(f"{source}: allowed are hardware:RIG.toml, recording:DIR and a scenario")
    if kind == "hardware":
        if options.rate is not None or options.fps is not None:
            raise InputError(f"{source}: --rate and --fps are of recordings; devices run at [hardware] rate_hz")
        return _devices(Path(place), options, stack)
    if kind == "recording":
        return _recording(Path(place), options, stack)
    for option, value in (("--rig", options.rig), ("--settings", options.settings), ("--fps", options.fps)):
        if value is not None:
            raise InputError(f"{option} {value}: a scenario has its own; change its keys with --set")
    return _scenario(options, stack)


def _recording(path: Path, options: LiveOptions, stack: ExitStack) -> LiveSource:
    if options.rig is None:
        raise InputError(f"recording:{path}: --rig RIG.toml is wanted, the calibration of its cameras")
    rig = read_rig(options.rig)
    recording = open_recording(path, rig, options.fps)
    stack.enter_context(recording)
    if isinstance(recording, McapRecording) and recording.holds == "detections":
        raise InputError(f"recording:{path}: holds detections, no images; 'mosca reconstruct' reads it")
    speed = 1.0 if options.rate is None else options.rate / recording.cameras[0].frame_rate_hz
    paced = PacedFrames(recording.cameras, recording, speed)
    return LiveSource(paced, rig, _settings(options), paced.stop, paced.session_ns)


def _devices(path: Path, options: LiveOptions, stack: ExitStack) -> LiveSource:
    from hardware.settings import read_hardware
    from hardware.source import HardwareSource

    rig = read_rig(path if options.rig is None else options.rig)
    devices = read_hardware(path)
    missing = [name for name in rig.names if name not in devices.cameras]
    if missing:
        raise InputError(f"{path}: no camera '{missing[0]}'; it names {', '.join(devices.cameras)}")
    source = stack.enter_context(HardwareSource(devices))
    frames: FrameSource = source if set(rig.names) == set(devices.cameras) else SelectedCameras(source, rig.names)
    return LiveSource(frames, rig, _settings(options), source.stop, source.session_ns)


def _settings(options: LiveOptions) -> PipelineSettings:
    return reconstruct_settings(live_spec(options.settings, options.overrides), options.settings)


def _scenario(options: LiveOptions, stack: ExitStack) -> LiveSource:
    name, seconds = options.source, options.seconds
    path = find(name)
    spec = load_scenario(path, options.overrides)
    cameras = virtual_cameras(spec, true_rig(spec, path.parent))
    rig = with_fault(calibrated(spec, cameras).rig, spec.fault)
    if spec.zone:
        raise InputError(f"{path}: a scenario of zones is stitched when it is over; 'mosca run {name}' does that")
    nominal = spec.capture.frame_rate_hz
    speed = 1.0 if options.rate is None else options.rate / nominal
    size = sum(v.camera.width * v.camera.height * (1 if spec.errors.bits <= 8 else 2) for v in cameras)
    wanted = spec.capture.pulses if seconds is None else min(spec.capture.pulses, round(seconds * nominal * speed))
    pulses = max(1, min(wanted, MEMORY_BYTES // size))
    notes: tuple[str, ...] = ()
    if pulses < wanted:
        notes = (f"{pulses / nominal:g} s of {wanted / nominal:g} s fit in memory and are played",)
    workers = options.workers or os.cpu_count() or 1
    scene = build_scene(spec, path.parent)
    source: FrameSource = stack.enter_context(twin_source(spec, scene, cameras, workers))
    if any(info.name not in rig.names for info in source.cameras):
        source = SelectedCameras(source, rig.names)
    frames = list(islice(iter(source), pulses * len(source.cameras)))
    paced = PacedFrames(source.cameras, frames, speed)
    return LiveSource(paced, rig, pipeline_settings(spec), paced.stop, paced.session_ns, notes, scene)
