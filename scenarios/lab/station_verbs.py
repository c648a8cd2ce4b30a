"""The station commands: open, run until the end or Ctrl-C, and report."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from hardware.settings import HardwareTable, RigHardware, read_hardware
from hardware.transport import Trust, open_transport
from hardware.transport.merger import MergeSettings
from hardware.transport.receiver import Receiver
from hardware.transport.sender import Sender
from hardware.transport.station_state import Event, ReceiverSettings
from hardware.transport.transport import check_station, check_stations
from mosca.data.files.bounded import read_text
from mosca.data.files.rig_file import read_rig, read_rig_file
from mosca.data.files.toml import check
from mosca.data.tracks import Samples, table
from mosca.formats.tracks.tracks_file import check_tracks_file, write_tracks
from mosca.recording import open_recording
from scenarios.build.frame_sources import SelectedCameras
from scenarios.commands.reconstruct import reconstruct_settings, reconstruct_spec, recorded_backgrounds
from scenarios.lab.merge import Delays, all_whole, calibrated_rig, run_merged, summary_lines
from scenarios.lab.station import run_station
from scenarios.lab.station_background import Backgrounds
from scenarios.lab.station_source import PacedRecording, RigOfStation
from scenarios.run.interrupt import first_ctrl_c
from scenarios.run.priority import before_others, prompt

RIGS_S = 15.0
Report = Callable[[str], None]


def detect_on_station(
    rig: Path,
    name: str,
    connect: Sequence[str],
    recording: Path | None,
    fps: float | None,
    seconds: float | None,
    settings_path: Path | None,
    overrides: tuple[str, ...],
    trust: Trust,
    report: Report,
) -> list[str]:
    """Run a detecting station until its source ends, ``seconds`` are over, or Ctrl-C; return the report."""
    check_station(name)
    spec = reconstruct_spec(settings_path, overrides)
    detection = reconstruct_settings(spec, settings_path).detection
    names = tuple(table.name for table in read_rig_file(rig).camera)
    text = read_text(rig, "a rig file")
    given = read_hardware(rig) if recording is None else recording
    devices: RigOfStation | None = None
    with before_others(), ExitStack() as failing:  # the engine's threads too
        # an endpoint that cannot be used is reported before cameras are opened or a background is made
        transport = open_transport(connect, trust=trust)
        failing.callback(transport.close)
        if isinstance(given, RigHardware):
            devices = RigOfStation(given)
            source: RigOfStation | PacedRecording = devices
            backgrounds = Backgrounds(spec.background, on_made=report)
        else:
            cameras = read_rig(rig)
            backgrounds = Backgrounds(ready=recorded_backgrounds(given, cameras, fps, spec.background))
            source = PacedRecording(SelectedCameras(open_recording(given, cameras, fps), names))
        failing.callback(source.close)
        sender = Sender(transport, name, source.cameras, text)
        failing.pop_all()
        source.gate.sender = sender
        report(f"station {name}: {', '.join(names)}; sends to {', '.join(connect)}")
        until = None if seconds is None else time.monotonic() + seconds
        stopped = threading.Event()
        with first_ctrl_c(stopped.set):

            def every() -> bool:
                if devices is not None:
                    devices.send_notes(sender)
                return not stopped.is_set() and (until is None or time.monotonic() < until)

            totals = run_station(source, sender, detection, source.arrival_ns, every, source.stop, backgrounds)
    lines = [
        f"station {name}: {totals.frames} frames, {totals.detected} looked at, {totals.targets} targets found",
        f"{1e3 * totals.seconds / max(totals.detected, 1):.2f} ms a frame; {sender.skipped} frames skipped, "
        f"{sender.refused} messages refused",
    ]
    if devices is not None:
        lines += devices.hardware.statistics.notes
    return lines


def reconstruct_stations(
    rig_path: Path,
    stations: Sequence[str],
    listen: Sequence[str],
    out: Path,
    seconds: float | None,
    deadline_s: float,
    settings_path: Path | None,
    overrides: tuple[str, ...],
    trust: Trust,
    report: Report,
) -> tuple[list[str], bool]:
    """Merge and reconstruct until all stations end, ``seconds`` are over, or Ctrl-C.

    Return the report, and whether every camera is in every set. The tracks are written in any case.
    """
    check_tracks_file(out)
    # [background] is a setting of the detecting stations
    settings = reconstruct_settings(reconstruct_spec(settings_path, overrides), settings_path)
    file = read_rig_file(rig_path)
    rate = check(HardwareTable, dict(file.hardware), f"{rig_path}: [hardware]").rate_hz if file.hardware else None
    check_stations(stations)
    samples: list[Samples] = []
    delays, points = Delays(), 0
    with ExitStack() as stack:
        stack.enter_context(before_others())
        stack.enter_context(prompt())
        receiver = Receiver(
            open_transport(listen=listen, trust=trust),
            stations,
            {table.name: table.size for table in file.camera},
            rate,
            ReceiverSettings(MergeSettings(deadline_s)),
            read_text(rig_path, "a rig file"),
            on_event=lambda event: report(_line(event)),
        )
        stack.enter_context(receiver)
        # stopping waits for the thread that Ctrl-C interrupted
        stack.enter_context(first_ctrl_c(lambda: threading.Thread(target=receiver.stop, daemon=True).start()))
        report(f"listens on {', '.join(listen)} for {', '.join(stations)}")
        rig, lines = calibrated_rig(rig_path, lambda: receiver.rigs(RIGS_S))
        timer = threading.Timer(seconds or 0, receiver.stop)
        if seconds is not None:
            timer.start()
        try:
            for step in run_merged(delays.passed(receiver), rig, settings):
                samples.append(step.samples)
                points += len(step.points)
        finally:
            timer.cancel()
    tracks = table(samples)
    write_tracks(tracks, out, receiver.rate_hz or 1.0)
    lines += summary_lines(receiver.statistics)
    sets = max(receiver.statistics.merge.sets, 1)
    lines.append(
        f"{len(np.unique(tracks.track))} tracks with {len(tracks)} samples in {out}; {points / sets:.1f} points a set"
    )
    if receiver.statistics.merge.sets:
        half, most = delays.percentiles(0.5), delays.percentiles(0.99)
        lines.append(
            f"merged {1e3 * half[0]:.1f} ms (median), {1e3 * most[0]:.1f} ms (99 %) after the frames arrived, "
            f"{1e3 * half[1]:.1f} and {1e3 * most[1]:.1f} ms after their detections were sent"
        )
    return lines, all_whole(receiver.statistics)


def _line(event: Event) -> str:
    return f"station {event.station}: {event.text}"
