"""``mosca twin serve``: a scenario or a recording on the network as GigE Vision cameras."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from hardware.emulate.faults import Faults
from hardware.emulate.pulse_generators import PulseBox
from hardware.emulate.serve import FIRST_ADDRESS, Served, served
from hardware.streams.content import TakeFrames
from hardware.streams.fault_line import FaultLine
from hardware.streams.faults import ordered_faults
from hardware.streams.stream_server import StreamServer
from hardware.streams.turns import UpAxis
from mosca.data.files.rig_file import CameraTable, read_rig, read_rig_file, rig_toml
from mosca.data.files.toml import Positive, Table, check, read_toml
from mosca.data.files.whole_file import check_writable, whole_file
from mosca.data.frames import CameraInfo, FrameSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.recording import open_recording
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.frame_sources import SelectedCameras
from scenarios.build.scene import build_scene
from scenarios.lab.serve_streams import PulsedStream, recorded_frames, tracked_frames, true_frames
from scenarios.run.interrupt import between_steps
from scenarios.run.stream_servers import StreamSettings, opened_streams
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario

MEMORY_BYTES = 1 << 30
"""Most bytes of frames kept in memory without ``--ahead``."""
POLL_S = 0.02
LOOPBACK_PACKET = 8000
"""Packet size on loopback, which carries large packets; five times as many small ones would keep a core busy."""
TriggerKind = Literal["Line1", "serial", "Software", "Action1", "Off"]
TRIGGER_SOURCES: Mapping[TriggerKind, str] = {
    "Line1": "external",
    "serial": "serial",
    "Software": "software",
    "Action1": "action",
    "Off": "external",
}


class TwinTable(Table):
    """``[twin]`` of a rig file: the scene of its cameras when they are served."""

    scenario: str = ""
    recording: str = ""
    fps: Positive | None = None


@dataclass(frozen=True)
class InjectedFaults:
    """Faults of the served cameras; all except ``reboots`` apply to every camera."""

    loss: float = 0.0
    withhold: float = 0.0
    drift_ppm: float = 0.0
    """Largest drift of the cameras' clocks, which are evenly spread from minus to plus this."""
    reboots: Mapping[str, float] = field(default_factory=dict)
    """Camera -> seconds from the start of its acquisition to its reboot."""
    seed: int = 0


@dataclass(frozen=True)
class ServeRequest:
    """Arguments of ``mosca twin serve``."""

    what: str
    address: str = FIRST_ADDRESS
    rate_hz: float | None = None
    """Frame rate; None: that of the source."""
    seconds: float | None = None
    loop: bool = False
    ahead: int | None = None
    """Pulses read ahead; None: as many as fit in memory."""
    trouble: InjectedFaults = InjectedFaults()
    switchover: bool = False
    """Whether a client with a key may take over a camera from another client."""
    rig_out: Path | None = None
    trigger: TriggerKind = "Line1"
    workers: int = 1
    streams: tuple[StreamSettings, ...] = ()
    """Streams that serve the tracks of the same instants."""
    up: UpAxis = "z"
    """Upward axis of the streams."""
    tracks: Path | None = None
    """Streamed data: a run folder or file of tracks; None: the truth."""
    fault: tuple[str, ...] = ()
    faults: Path | None = None
    """File of the streams' faults; their seed is that of ``trouble``."""


@dataclass(frozen=True, eq=False)
class ServedSource:
    """The served source; its cameras' calibration, None where unknown; addresses and serials, where given."""

    source: FrameSource
    rig: Rig | None
    addresses: Mapping[str, str] = field(default_factory=dict)
    serials: Mapping[str, str] = field(default_factory=dict)
    truth: Callable[[], TakeFrames] | None = None
    """Function that returns the true tracks at the pulses; called where they are streamed."""


def serve(
    request: ServeRequest,
    progress: Callable[[int, int | None], None] | None,
    on_ready: Callable[[Served], None],
    report: Callable[[str], None] = lambda line: None,
) -> Served:
    """Serve until Ctrl-C or for ``request.seconds``; return what was served, closed, with its counts.

    ``on_ready``: called once the devices answer. ``report``: called with lines about the streams.
    Raises InputError for a source that cannot be served.
    """
    if request.rig_out is not None:
        check_writable(request.rig_out)
    if request.streams and request.trigger not in ("Line1", "serial"):
        raise InputError(f"--trigger {request.trigger}: excludes --stream, whose frames come with the line's pulses")
    with ExitStack() as stack:
        subject = _subject(request, stack)
        infos = subject.source.cameras
        names = [info.name for info in infos]
        for name in request.trouble.reboots:
            if name not in names:
                raise InputError(f"--reboot {name}: there are the cameras {', '.join(names)}")
        rate_hz = request.rate_hz or infos[0].frame_rate_hz
        stream = _stream(request, subject, rate_hz, stack)
        up = stack.enter_context(
            served(
                subject.source,
                ahead=request.ahead or max(1, MEMORY_BYTES // sum(info.image_bytes for info in infos)),
                loop=request.loop,
                first_address=request.address,
                addresses=subject.addresses,
                serials=subject.serials,
                faults=_faults(names, request.trouble),
                switchover=request.switchover,
                progress=progress,
            )
        )
        box = stack.enter_context(PulseBox(up.pulse)) if request.trigger == "serial" else None
        if request.rig_out is not None:
            text = rig_text(subject.rig, up, rate_hz, request.trigger, "" if box is None else box.port)
            with whole_file(request.rig_out) as temporary:
                temporary.write_text(text, encoding="utf-8")
        on_ready(up)
        if stream is None:
            _stay(up, rate_hz, request)
            return up
        server, frames, faults = stream
        with closing(_on_line(up, server, frames, faults, request.loop, 1.0 / rate_hz)) as pulsed:
            report(server.where())
            _stay(up, rate_hz, request)
        made = () if faults is None else (account.line() for account in faults.accounts)
        for line in (f"{pulsed.sent} frames", *server.lines(), *made):
            report(f"stream: {line}")
        return up


def _stream(
    request: ServeRequest, subject: ServedSource, rate_hz: float, stack: ExitStack
) -> tuple[StreamServer, TakeFrames, FaultLine | None] | None:
    """Return the streams' server, frames and faults; None where no stream is requested."""
    if not request.streams:
        given = {"--tracks": request.tracks, "--faults": request.faults, "--fault": " ".join(request.fault) or None}
        for option, value in given.items():
            if value is not None:
                raise InputError(f"{option} {value}: is of streams; give --stream natnet")
        return None
    ordered = ordered_faults(request.fault, request.faults, request.trouble.seed)
    if request.tracks is not None:
        frames = tracked_frames(request.tracks, request.up)
    else:
        assert subject.truth is not None
        frames = subject.truth()
    faults = FaultLine(ordered, frames.model, frames.numbers) if ordered.program else None
    server = opened_streams(request.streams, frames.model, frames.names, rate_hz)
    return stack.enter_context(server), frames, faults


def _on_line(
    up: Served, server: StreamServer, frames: TakeFrames, faults: FaultLine | None, loop: bool, period_s: float
) -> PulsedStream:
    """Return the stream as an additional device on the cameras' trigger line."""
    exposure_ns = round(up.devices[0].identity.exposure_us * 1000)
    by_pulse = {frame.number: frame for frame in frames}
    # the cameras' frames loop; where the source is not wholly in memory, the tracks give their number
    length = up.store.length or max(by_pulse) + 1
    pulsed = PulsedStream(server, by_pulse, exposure_ns, length if loop else None, faults, period_s)
    up.line.add(pulsed)
    return pulsed


def rig_text(rig: Rig | None, up: Served, rate_hz: float, trigger: TriggerKind, port: str = "") -> str:
    """Return a rig file with which ``mosca capture --rig`` grabs from the devices of ``up``.

    ``rig``: the cameras' calibration, if it is known; ``port``: port of a serial trigger.
    """
    hardware = {
        device.identity.name: {
            "driver": "gige",
            "address": str(device.identity.address.ip),
            "serial": device.identity.serial,
            "trigger": "Line1" if trigger == "serial" else trigger,
            "exposure_us": device.identity.exposure_us,
            **({"packet_bytes": LOOPBACK_PACKET} if device.identity.address.is_loopback else {}),
        }
        for device in up.devices
    }
    if rig is not None:
        text = rig_toml(Rig(tuple(rig.camera(name) for name in hardware)), hardware)
    else:
        text = "\n".join(
            _table("[camera]", {"name": who.name, "size": [who.width, who.height]})
            + _table("camera.hardware", hardware[who.name])
            for who in (device.identity for device in up.devices)
        )
    source: dict[str, object] = {"source": TRIGGER_SOURCES[trigger]}
    if trigger == "serial":
        source["port"] = port
    if trigger == "Action1":
        source["broadcast"] = str(up.devices[0].identity.address.network.broadcast_address)
    return f"{text}\n{_table('hardware', {'rate_hz': rate_hz})}{_table('hardware.trigger', source)}"


def _table(heading: str, values: Mapping[str, object]) -> str:
    # texts, numbers and lists of numbers are written in the same way in JSON and TOML
    return "\n".join((f"[{heading}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items()), ""))


def _stay(up: Served, rate_hz: float, request: ServeRequest) -> None:
    """Give pulses while cameras are armed: from pulse 0 once all are armed, until none is."""
    until = None if request.seconds is None else time.monotonic() + request.seconds
    waits = True
    with between_steps() as stop:
        try:
            while until is None or time.monotonic() < until:
                stop()
                up.store.check()
                armed = [device.camera.armed for device in up.devices]
                if waits and all(armed):
                    if request.trigger == "Line1":
                        up.start(rate_hz)
                    elif request.trigger != "serial":
                        up.store.rewind()
                    waits = False
                elif not waits and not any(armed):
                    up.line.stop()
                    waits = True
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            return


def _subject(request: ServeRequest, stack: ExitStack) -> ServedSource:
    path = Path(request.what)
    if path.is_dir() or path.name.endswith((".mcap", ".mcap.part")):
        return _recording(path, request.rate_hz, request.up, stack)
    if path.is_file():
        document = read_toml(path)
        if "twin" in document or ("camera" in document and "scene" not in document):
            return _rig(path, request, stack)
    return _scenario(request.what, request.workers, request.up, stack)


def _scenario(what: str, workers: int, up: UpAxis, stack: ExitStack) -> ServedSource:
    path = find(what)
    spec = load_scenario(path)
    cameras = virtual_cameras(spec, true_rig(spec, path.parent))
    rig = calibrated(spec, cameras).rig
    source: FrameSource = stack.enter_context(twin_source(spec, build_scene(spec, path.parent), cameras, workers))
    if any(info.name not in rig.names for info in source.cameras):
        source = SelectedCameras(source, rig.names)
    return ServedSource(source, rig, truth=partial(true_frames, spec, build_scene(spec, path.parent), up))


def _recording(path: Path, fps: float | None, up: UpAxis, stack: ExitStack) -> ServedSource:
    source = open_recording(path, None, fps)
    stack.enter_context(source)
    return ServedSource(source, None, truth=partial(recorded_frames, path, up))


def _rig(path: Path, request: ServeRequest, stack: ExitStack) -> ServedSource:
    """Return the scenario or recording that a rig file's ``[twin]`` names, under the rig's addresses and serials."""
    document = read_rig_file(path)
    twin = check(TwinTable, dict(document.twin), f"{path}: [twin]")
    if bool(twin.scenario) == bool(twin.recording):
        raise InputError(f"{path}: [twin] wants scenario = or recording =, one of them: what the cameras look at")
    if twin.scenario:
        beside = path.parent / twin.scenario
        name = str(beside) if beside.is_file() else twin.scenario
        subject = _scenario(name, request.workers, request.up, stack)
    else:
        subject = _recording(path.parent / twin.recording, twin.fps or request.rate_hz, request.up, stack)
    names = tuple(table.name for table in document.camera)
    there = {info.name: info for info in subject.source.cameras}
    for table in document.camera:
        _check_camera(path, table, there)
    source = SelectedCameras(subject.source, names) if set(names) != set(there) else subject.source
    whole = all(table.lens is not None and table.pose is not None for table in document.camera)
    rig = read_rig(path) if whole else None

    def given(key: str) -> dict[str, str]:
        return {t.name: str(t.hardware[key]) for t in document.camera if t.hardware.get(key)}

    return replace(subject, source=source, rig=rig, addresses=given("address"), serials=given("serial"))


def _check_camera(path: Path, table: CameraTable, there: Mapping[str, CameraInfo]) -> None:
    info = there.get(table.name)
    if info is None:
        raise InputError(f"{path}: camera '{table.name}': what [twin] names has {', '.join(there)}")
    if (info.width, info.height) != tuple(table.size):
        raise InputError(
            f"{path}: camera '{table.name}': size = {list(table.size)} given; what [twin] names has "
            f"{info.width}x{info.height} px"
        )


def _faults(names: Sequence[str], trouble: InjectedFaults) -> dict[str, Faults]:
    drifts = np.linspace(-trouble.drift_ppm, trouble.drift_ppm, len(names)) if len(names) > 1 else [trouble.drift_ppm]
    return {
        name: Faults(
            packet_loss=trouble.loss,
            withheld=trouble.withhold,
            drift_ppm=float(drift),
            reboot_at_s=trouble.reboots.get(name),
            seed=trouble.seed,
        )
        for name, drift in zip(names, drifts, strict=True)
    }
