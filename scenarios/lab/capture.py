"""Capture: the rig's frames, or the detections in them, into a recording that is readable at any moment."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hardware.drivers import open_camera
from hardware.onboard.commands import ProgramRun, read_program
from hardware.pulse_grid import SentPulse
from hardware.settings import RigHardware, read_hardware
from hardware.source import HardwareSource, OpenCamera, OpenTrigger
from hardware.triggers import open_trigger
from mosca.data.files.bounded import read_text
from mosca.data.files.rig_file import read_rig, read_rig_file
from mosca.data.files.whole_file import check_folder
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.recording import RecordingWriter
from reports.viewer_program import check_window, viewer_program
from scenarios.lab.intake import Intake
from scenarios.lab.recorder import WAITING_BYTES, Recorder
from scenarios.run.interrupt import between_steps
from scenarios.run.one_writer import one_writer
from scenarios.run.priority import before_others, prompt

if TYPE_CHECKING:
    from mosca.pipeline import PipelineSettings
    from scenarios.lab.live_view import LiveView

POLL_S = 0.05
STATISTICS_S = 1.0
TAIL_PULSES = 4
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class CaptureRequest:
    """Arguments of a capture."""

    rig: Path
    out: Path
    frames: int | None = None
    """Number of pulses; None: until Ctrl-C."""
    seconds: float | None = None
    detections: bool = False
    """Keep only these, no images."""
    view: bool = False
    """Show it live."""
    view_log: Path | None = None
    """Show it in this .rrd file instead of the viewer."""
    settings: Path | None = None
    """Settings file as for ``mosca reconstruct``, for detections and view."""
    program: Path | None = None
    """Commands and events (``hardware.onboard.commands``)."""
    waiting_bytes: int = WAITING_BYTES

    @property
    def ends(self) -> bool:
        """Whether it ends without Ctrl-C."""
        return self.frames is not None or self.seconds is not None


@dataclass
class CameraRow:
    """Counts of one camera's pulses."""

    frames: int = 0
    """Frames in the recording, or processed."""
    failed: int = 0
    dropped: int = 0
    overrun: int = 0
    relocked: int = 0
    reopened: int = 0
    unproven: int = 0
    """Frames whose pulses are not certain."""
    untimed: int = 0
    """Frames whose times are not certain."""


@dataclass
class CaptureOutcome:
    """A finished capture."""

    pulses: int = 0
    lost: int = 0
    """Frame sets for which this machine was too slow."""
    lost_text: str = ""
    skipped: int = 0
    """Pulses that this machine could not send in their periods."""
    stopped: bool = False
    shown: int = 0
    cameras: dict[str, CameraRow] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    accept_unproven: bool = False
    """Setting of the rig file: frames whose pulses are not certain count like others."""

    @property
    def whole(self) -> bool:
        """Whether each pulse has a whole frame of each camera that is certainly, or accepted as, of that pulse."""
        lacks = [c.failed or c.dropped or c.overrun for c in self.cameras.values()]
        doubtful = [c.unproven for c in self.cameras.values() if not self.accept_unproven]
        return not self.lost and not any(lacks + doubtful)


def capture(
    request: CaptureRequest,
    progress: Progress | None = None,
    opener: OpenCamera = open_camera,
    trigger_opener: OpenTrigger = open_trigger,
) -> CaptureOutcome:
    """Capture until all wanted frames have come, Ctrl-C, or a full disk (InputError); DeviceError for devices.

    ``opener`` and ``trigger_opener`` are for tests.
    """
    check_out(request.out)
    with one_writer(request.out):
        return _captured(request, progress, opener, trigger_opener)


def _captured(
    request: CaptureRequest, progress: Progress | None, opener: OpenCamera, trigger_opener: OpenTrigger
) -> CaptureOutcome:
    check_out(request.out)
    hardware = read_hardware(request.rig)
    program = None if request.program is None else read_program(request.program)
    settings = _settings(request)
    if request.view and request.view_log is None:
        viewer_program("--view")  # a missing viewer is reported before cameras are opened
        check_window("--view", "leave it out")
    pulses = pulses_of(request, hardware)
    with ExitStack() as stack:
        stack.enter_context(before_others())
        source = stack.enter_context(HardwareSource(hardware, pulses, opener, trigger_opener))
        if settings is not None:
            from scenarios.lab.detecting import warm_up

            warm_up(source.cameras, settings)
        stack.enter_context(prompt())
        writer = stack.enter_context(_recording(request, source, pulses))
        recorder = Recorder(writer, source.cameras, request.waiting_bytes)
        stack.callback(recorder.close)
        source.on_image = None if request.detections else recorder.keep_early
        run = None
        if program is not None:
            run = ProgramRun(program, source.session_ns, recorder.write_message)
            stack.callback(run.close)
        view = None if settings is None else _view(stack, request, source, settings, recorder)
        detection = settings if request.detections else None
        intake = Intake(source, recorder, detection, view, request.waiting_bytes)
        stack.callback(intake.close)
        stopped = _watch(source, intake, recorder, run, lambda done: progress and progress(done, pulses))
        if run is not None:
            run.close()
        if view is not None:
            view.close()
        outcome = _outcome(source, intake, run, view, None if stopped else pulses)
        outcome.stopped = stopped
        _write_statistics(recorder, source, intake)
        recorder.write_message("trigger", _now_ns(source), source.trigger_report())
        recorder.close()
        _check(recorder)
        writer.about["capture"] = _about(source, outcome)
        writer.close()
    return outcome


def _settings(request: CaptureRequest) -> "PipelineSettings | None":
    """Return the settings of detection; None without detection, and then nothing heavy is imported."""
    if not (request.detections or request.view or request.view_log or request.settings):
        return None
    from scenarios.commands.reconstruct import live_spec, reconstruct_settings

    return reconstruct_settings(live_spec(request.settings), request.settings)


def check_out(out: Path) -> None:
    """Raise InputError where ``out`` exists already, before any device is opened."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: is there already; choose another folder for this take")
    check_folder(out)


def pulses_of(request: CaptureRequest, hardware: RigHardware) -> int | None:
    """Return the number of wanted pulses; None: without end."""
    if request.seconds is not None:
        return max(round(request.seconds * hardware.shared.rate_hz), 1)
    return request.frames


def _calibrated(path: Path) -> Rig | None:
    """Return the rig if all its cameras have lens and pose, else None."""
    tables = read_rig_file(path).camera
    if any(table.lens is None or table.pose is None for table in tables):
        return None
    return read_rig(path)


def _recording(request: CaptureRequest, source: HardwareSource, pulses: int | None) -> RecordingWriter:
    text = read_text(request.rig, "a rig file")
    if request.detections:
        return RecordingWriter(request.out, source.cameras, text, holds="detections", tail_bytes=0)
    # size before packing, since the compression of these images is unknown; without an end the take may fill the disk
    check_folder(request.out, (pulses or 0) * sum(info.image_bytes for info in source.cameras))
    return RecordingWriter(request.out, source.cameras, text, holds="frames", tail_bytes=request.waiting_bytes)


def _view(
    stack: ExitStack,
    request: CaptureRequest,
    source: HardwareSource,
    settings: "PipelineSettings",
    recorder: Recorder,
) -> "LiveView | None":
    if not request.view and request.view_log is None:
        return None
    from reports.viewer import RerunLog
    from reports.viewer_process import log_in_viewer
    from scenarios.lab.live_view import LiveView, uncalibrated

    rig = _calibrated(request.rig)
    shown = rig or uncalibrated(source.cameras)
    log = stack.enter_context(log_in_viewer(shown) if request.view_log is None else RerunLog(request.view_log, shown))
    view = LiveView(log, source.cameras, rig, settings, lambda: recorder.behind)
    stack.callback(view.close)
    return view


def _watch(
    source: HardwareSource,
    intake: Intake,
    recorder: Recorder,
    run: ProgramRun | None,
    progress: Callable[[int], object],
) -> bool:
    """Write clocks and accounts while the capture runs; return whether Ctrl-C ended it."""
    stopped, next_statistics = False, time.monotonic() + STATISTICS_S
    with between_steps() as check:
        intake.start()
        if run is not None:
            run.start()
        while intake.running:
            intake.wait(POLL_S)
            try:
                check()
            except KeyboardInterrupt:
                stopped = True
                source.stop()
            if recorder.failed is not None:
                source.stop()
            _write_clocks(recorder, source, intake)
            if time.monotonic() >= next_statistics:
                next_statistics += STATISTICS_S
                _write_statistics(recorder, source, intake)
            progress(intake.pulses)
    _write_clocks(recorder, source, intake)
    _check(recorder)
    intake.check()
    return stopped


def _check(recorder: Recorder) -> None:
    if recorder.failed is not None:
        raise recorder.failed


def _now_ns(source: HardwareSource) -> int:
    return source.session_ns(time.monotonic_ns()) or 0


def _write_clocks(recorder: Recorder, source: HardwareSource, intake: Intake) -> None:
    """Write the latest pulses and raw stamps of frames, and one instant on all clocks of this machine."""
    now_ns = time.monotonic_ns()
    session_ns = source.session_ns(now_ns)
    if session_ns is None:
        return
    stamps, sent = intake.new_stamps(), source.new_pulses()
    if stamps or sent:
        clocks = {"host_ns": now_ns, "utc_ns": time.time_ns(), "session_ns": session_ns}
        pulses = {key: [getattr(one, key) for one in sent] for key in SentPulse._fields}
        recorder.write_message("clock", session_ns, {**clocks, "pulses": pulses, "cameras": stamps})


def _write_statistics(recorder: Recorder, source: HardwareSource, intake: Intake) -> None:
    """Record the counts of the buffers until now; the last record is that at the end."""
    account = {
        "cameras": {name: asdict(one) for name, one in source.statistics.cameras.items()},
        "skipped_pulses": source.statistics.skipped_pulses,
        "notes": list(source.statistics.notes),
        "lost_sets": [list(pair) for pair in intake.lost.ranges],
    }
    recorder.write_message("account", _now_ns(source), account)


def _outcome(
    source: HardwareSource, intake: Intake, run: ProgramRun | None, view: "LiveView | None", wanted: int | None
) -> CaptureOutcome:
    """Return the summary; ``wanted``: number of expected pulses, None where it was stopped by hand."""
    pulses = wanted if wanted is not None else _whole_pulses(intake)
    rows = {}
    for name, seen in intake.cameras.items():
        kept = source.statistics.cameras[name]
        dropped = max(pulses - seen.pulses, 0)
        rows[name] = CameraRow(
            seen.whole - seen.left_out,
            seen.failed,
            dropped,
            kept.overrun,
            kept.relocked,
            kept.reopened,
            kept.unproven,
            kept.untimed,
        )
    notes = list(source.statistics.notes)
    lost = intake.lost
    if lost.count:
        notes.append(
            f"{lost.count} frame sets were lost whole ({lost.text()}): this machine was too slow for them; use a "
            "lower rate, smaller windows, a faster disk, or nothing else beside the capture"
        )
    if run is not None:
        notes += run.notes
    if view is not None and view.failed is not None:
        notes.append(f"view: ended early ({view.failed})")
    return CaptureOutcome(
        pulses,
        lost.count,
        lost.text(),
        source.statistics.skipped_pulses,
        shown=0 if view is None else view.shown,
        cameras=rows,
        notes=notes,
        accept_unproven=source.rig.shared.accept_unproven,
    )


def _whole_pulses(intake: Intake) -> int:
    """Return the number of pulses at Ctrl-C, when the last set may not have been whole yet."""
    last = intake.pulses - 1
    return min(seen.last for seen in intake.cameras.values() if seen.last > last - TAIL_PULSES) + 1


def _about(source: HardwareSource, outcome: CaptureOutcome) -> dict[str, Any]:
    """Return the description of the capture for ``recording.toml``."""
    devices = {
        name: {
            "model": report.model,
            "serial": report.serial,
            "exposure_us": report.exposure_ns / 1e3,
            "settings": {key: value for key, value in report.settings.items() if _is_plain(value)},
        }
        for name, report in source.reports.items()
    }
    return {
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        "pulses": outcome.pulses,
        "skipped_pulses": outcome.skipped,
        "stopped_by_hand": outcome.stopped,
        "lost_sets": outcome.lost,
        "lost_set_numbers": outcome.lost_text,
        "notes": outcome.notes,
        "camera": {name: asdict(row) for name, row in outcome.cameras.items()},
        "device": devices,
        "trigger": {key: value for key, value in source.trigger_report().items() if _is_plain(value)},
    }


def _is_plain(value: object) -> bool:
    return isinstance(value, bool | int | float | str)
