"""Sources of a station's frames: its devices, or a recording; both wait for the order to start."""

import threading
import time
from collections.abc import Iterator, Mapping

from hardware.driver import CameraDriver
from hardware.drivers import open_camera
from hardware.settings import RigHardware
from hardware.source import HardwareSource, OpenCamera, OpenTrigger
from hardware.transport.sender import Sender
from hardware.trigger import Trigger
from hardware.triggers import open_trigger
from mosca.data.frames import Frame, FrameSource, WrappedSource

WAIT_S = 0.1
LATE_S = 0.1
"""Lateness above which frames of a recording are skipped when it begins to play."""


class PacedRecording(WrappedSource):
    """A recording that is played at its own rate, as from a rig, from the order to start.

    Recordings of one session start together on all stations; a later one continues where the others are.
    """

    def __init__(self, source: FrameSource) -> None:
        super().__init__(source)
        self.gate = StartGate()

    def __iter__(self) -> Iterator[Frame]:
        if not self.gate.hold():
            return
        sender = self.gate.station
        assert sender.start_ns is not None
        begun = False
        for frame in super().__iter__():
            ahead_s = (sender.start_ns + frame.time_ns - sender.now_ns()) * 1e-9
            if not begun and ahead_s < -LATE_S:
                continue
            begun = True
            while ahead_s > 0 and not self.gate.left:
                time.sleep(min(ahead_s, WAIT_S))
                ahead_s = (sender.start_ns + frame.time_ns - sender.now_ns()) * 1e-9
            if self.gate.left:
                return
            yield frame

    def arrival_ns(self, frame: Frame) -> int:
        """Return when the frame was due, by the station's clock: late playing on a busy machine counts as delay."""
        assert self.gate.station.start_ns is not None
        return self.gate.station.start_ns + frame.time_ns

    def stop(self) -> None:
        """End at once; may be called from another thread."""
        self.gate.leave()


class StartGate:
    """Start barrier of a station: own pulses, and recordings, begin on the order of the reconstructing station.

    Give ``open`` to the HardwareSource.
    """

    def __init__(self, opener: OpenTrigger = open_trigger) -> None:
        self.sender: Sender | None = None
        self._opener = opener
        self._stop = threading.Event()

    def open(self, rig: RigHardware, drivers: Mapping[str, CameraDriver]) -> Trigger:
        """Open the rig's trigger behind the gate."""
        return _Gated(self._opener(rig, drivers), self, rig.shared.trigger.makes_pulses)

    @property
    def station(self) -> Sender:
        """The station whose gate this is."""
        assert self.sender is not None
        return self.sender

    @property
    def left(self) -> bool:
        """Whether the station must end."""
        return self._stop.is_set()

    def hold(self) -> bool:
        """Wait for the order to start; False when the station ends before."""
        self.station.set_state("holding")
        while not self.left:
            if self.station.ordered(WAIT_S):
                return True
        return False

    def leave(self) -> None:
        """Stop waiting."""
        self._stop.set()


class _Gated:
    """A trigger that begins when the gate opens."""

    def __init__(self, trigger: Trigger, gate: StartGate, own_pulses: bool) -> None:
        self._trigger, self._gate, self._own_pulses = trigger, gate, own_pulses
        self.stop, self.pulse_at, self.frame_arrived = trigger.stop, trigger.pulse_at, trigger.frame_arrived
        self.poll_timed_out, self.camera_lost = trigger.poll_timed_out, trigger.camera_lost
        self.pulse_of, self.session_ns, self.new_pulses = trigger.pulse_of, trigger.session_ns, trigger.new_pulses
        self.skipped, self.notes = trigger.skipped, trigger.notes
        self.report, self.close = trigger.report, trigger.close

    def start(self) -> int | None:
        """Report that the cameras are armed; if the pulses are this station's, start them on the order."""
        if not self._own_pulses:
            self._gate.station.set_state("armed")
            return self._trigger.start()
        return self._trigger.start() if self._gate.hold() else None


class RigOfStation(WrappedSource):
    """The devices of a station as a source: a master camera, whose exposures are the pulses, waits for the order.

    ``opener`` and ``trigger_opener`` are for tests.
    """

    def __init__(
        self, rig: RigHardware, opener: OpenCamera = open_camera, trigger_opener: OpenTrigger = open_trigger
    ) -> None:
        self.gate = StartGate(trigger_opener)
        self.hardware = HardwareSource(rig, opener=opener, trigger_opener=self.gate.open)
        # the merger does not wait long for any station: a camera that lags must lose only its own frames
        self.hardware.reorder = False
        super().__init__(self.hardware)
        self._notes_sent = 0
        self._latest: tuple[Frame, int] | None = None

    def __iter__(self) -> Iterator[Frame]:
        if self.hardware.rig.shared.trigger.source == "master" and not self.gate.hold():
            return
        for frame, numbered in self.hardware.with_buffers():
            self._latest = frame, numbered.buffer.host_ns
            yield frame

    def arrival_ns(self, frame: Frame) -> int:
        """Return when the buffer of the last yielded frame was whole."""
        assert self._latest is not None
        latest, host_ns = self._latest
        assert latest is frame
        return host_ns

    def send_notes(self, sender: Sender) -> None:
        """Send the notes of the devices since the last call."""
        notes = self.hardware.statistics.notes
        for note in notes[self._notes_sent :]:
            sender.note(note)
        self._notes_sent = len(notes)

    def stop(self) -> None:
        """End after the work in progress; may be called from another thread."""
        self.gate.leave()
        self.hardware.stop()

    def close(self) -> None:
        """Free the devices."""
        self.stop()
        super().close()
