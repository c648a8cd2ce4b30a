"""The real rig as a source of frames: stop the pulses, arm all cameras, start the pulses, number what arrives.

Threads read the cameras (``hardware.camera_readers``); their buffers are numbered by pulse
(``hardware.pulse_numbers.numbering``), made into frames in pulse time and put in order of pulses
(``hardware.reorder_buffer``). A camera that fails is noted, reopened and aligned again while the others go on;
``statistics`` accounts for every buffer.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from typing import Self

from hardware.camera_readers import QUEUED_BYTES, CameraReaders
from hardware.driver import REFUSED, CameraDriver, ClockReading, DeviceError, DeviceReport, Grabbed
from hardware.drivers import open_camera
from hardware.end_of_take import EndOfTake, drained
from hardware.frame_maker import FrameMaker
from hardware.pulse_grid import SentPulse
from hardware.pulse_numbers.camera_state import Found, NumberedBuffer
from hardware.pulse_numbers.clock_poller import ClockPoller
from hardware.pulse_numbers.numbering import PulseNumbers
from hardware.reorder_buffer import ReorderBuffer
from hardware.settings import CameraHardware, RigHardware
from hardware.statistics import BufferCounts, RigStatistics
from hardware.trigger import Trigger
from hardware.triggers import open_trigger
from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame, StampEvent

OpenCamera = Callable[[str, CameraHardware], CameraDriver]
OpenTrigger = Callable[[RigHardware, Mapping[str, CameraDriver]], Trigger]
log = logging.getLogger("mosca.hardware.source")


class HardwareSource:
    """Frames of a rig of devices; a ``FrameSource``. Opens and configures all devices, or raises DeviceError.

    Parameters
    ----------
    rig
        The hardware tables of the rig file.
    pulses
        Number of pulses after which the take ends; None: it goes on until ``stop``.
    opener, trigger_opener
        Other ways to open the devices, for tests.
    """

    reorder = True
    """Whether frames wait for those of other cameras, so that they come pulse by pulse."""

    def __init__(
        self,
        rig: RigHardware,
        pulses: int | None = None,
        opener: OpenCamera = open_camera,
        trigger_opener: OpenTrigger = open_trigger,
    ) -> None:
        self.rig = rig
        self.statistics = RigStatistics({name: BufferCounts() for name in rig.cameras})
        self.reports: dict[str, DeviceReport] = {}
        self._opener = opener
        self._drivers: dict[str, CameraDriver] = {}
        with ExitStack() as opened:
            for name in rig.cameras:
                self._open(name)
                opened.callback(self._drivers[name].close)
                self.reports[name] = self._configured(name)
            self._trigger = trigger_opener(rig, self._drivers)
            opened.callback(self._trigger.close)
            self._trigger.stop()
            opened.pop_all()
        self._stop = threading.Event()
        self._closed = False
        self._started = False
        self._numbers: PulseNumbers | None = None
        self._readers = CameraReaders(self._drivers, self.statistics, self._reopen, self._stop)
        # a reading wakes the iteration, which waits for buffers
        self._clocks = ClockPoller(self._drivers, self._readers.wake)
        self._buffer = ReorderBuffer(tuple(rig.cameras), QUEUED_BYTES // 2)
        self._end = EndOfTake(pulses, rig.shared.rate_hz, rig.shared.wait_s)
        self._past_end: set[str] = set()
        events = {name: self._event(name) for name in rig.cameras}
        self._frames = FrameMaker(rig.shared, events, self.reports)

    @property
    def on_image(self) -> Callable[[Array], object] | None:
        """Called with each image as it arrives, in its camera's own thread."""
        return self._readers.on_image

    @on_image.setter
    def on_image(self, function: Callable[[Array], object] | None) -> None:
        self._readers.on_image = function

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """The cameras, as their devices report them."""
        return tuple(
            CameraInfo(
                name,
                report.width,
                report.height,
                report.bit_depth,
                self.rig.shared.rate_hz,
                "session",
                self._event(name),
            )
            for name, report in self.reports.items()
        )

    def __iter__(self) -> Iterator[Frame]:
        """Arm, start the pulses and yield frames, pulse by pulse, until ``pulses`` are over or ``stop``."""
        return (frame for frame, _ in self.with_buffers())

    def with_buffers(self) -> Iterator[tuple[Frame, NumberedBuffer]]:
        """Yield as ``iter`` does, each frame with its buffer and its pulse, and how that was found."""
        if self._started:
            raise DeviceError("the source of this rig was iterated before; open it again for another take")
        self._started = True
        try:
            start_ns = self._arm_and_start()
            numbers = self._numbers = PulseNumbers(
                tuple(self._drivers),
                self.rig.shared.rate_hz,
                start_ns,
                free=free_running(self.rig.cameras, self._drivers),
                played=[name for name, driver in self._drivers.items() if not driver.capabilities.real_time],
            )
            for received in self._received(numbers):
                if received is not None:
                    self._push(numbers, self._numbered(numbers, *received))
                yield from self._buffer.release(self._active())
            self._push(numbers, numbers.rest())
            # after ``stop`` it ends with the last pulse that all cameras have reached
            yield from self._buffer.release(self._active() if self._stop.is_set() else ())
        finally:
            self._end_threads()
            self._disarm()

    def stop(self) -> None:
        """End the iteration after the last pulse that all cameras have reached; may be called from another thread."""
        self._stop.set()

    def session_ns(self, host_ns: int) -> int | None:
        """Return a host time (monotonic) in the frames' clock [ns]; None before frames are numbered."""
        own = self._trigger.session_ns(host_ns)
        return own if own is not None or self._numbers is None else self._numbers.session_ns(host_ns)

    def new_pulses(self) -> Sequence[SentPulse]:
        """Return the pulses that this machine sent since the last call, for the recording."""
        return self._trigger.new_pulses()

    def account(self) -> dict[str, object]:
        """Return what each camera received, the trigger's report and the notes, for a run's record."""
        return {
            "cameras": {name: asdict(one) for name, one in self.statistics.cameras.items()},
            "trigger": self.trigger_report(),
            "notes": list(self.statistics.notes),
        }

    def trigger_report(self) -> dict[str, object]:
        """Return the trigger's report on its pulses."""
        return self._trigger.report()

    def close(self) -> None:
        """Stop and free trigger and devices; may be called twice."""
        self._stop.set()
        if self._closed:
            return
        self._closed = True
        self._end_threads()
        self._trigger.close()
        for driver in self._drivers.values():
            driver.close()
        log.info("rig %s: closed", self.rig.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _open(self, name: str) -> None:
        self._drivers[name] = self._opener(name, self.rig.cameras[name])

    def _reopen(self, name: str) -> None:
        self._open(name)
        self._configured(name)
        self._drivers[name].arm()
        self._clocks.begin(name)

    def _configured(self, name: str) -> DeviceReport:
        report = self._drivers[name].configure(self.rig.cameras[name])
        wanted = self.rig.sizes[name]
        if (report.width, report.height) != tuple(wanted):
            raise DeviceError(
                f"camera '{name}': frames of {report.width} x {report.height} px, the rig file says "
                f"{wanted[0]} x {wanted[1]}; set window in [camera.hardware] or mend size in {self.rig.path}"
            )
        log.info("camera '%s': %s, serial %s, opened", name, report.model, report.serial)
        return report

    def _event(self, name: str) -> StampEvent:
        return self._drivers[name].capabilities.stamp_event

    def _arm_and_start(self) -> int | None:
        # a master camera comes last: its exposures are the pulses
        master = self.rig.shared.trigger.camera
        for name in sorted(self._drivers, key=lambda name: name == master):
            self._drivers[name].arm()
        self._clocks.start()
        self._readers.start(self._trigger)
        start_ns = self._trigger.start()
        log.info("trigger '%s' started at %g Hz", self.rig.shared.trigger.source, self.rig.shared.rate_hz)
        return start_ns

    def _end_threads(self) -> None:
        self._stop.set()
        self._clocks.close()
        self._readers.join()

    def _disarm(self) -> None:
        self._stop_trigger()
        self._note_skipped()
        for note in self._trigger.notes(self._end.pulses):
            self.statistics.note(note)
        for name, counter in ({} if self._numbers is None else self._numbers.trigger_counters).items():
            camera = self.statistics.cameras[name]
            camera.unreached, camera.ignored = counter.unreached, counter.ignored
            for note in counter.notes(name):
                self.statistics.note(note)
        for name, driver in self._drivers.items():
            try:
                counts = self.statistics.cameras[name].driver = dict(driver.statistics())
                for what, number in counts.items():
                    if what.startswith(REFUSED):
                        self.statistics.note(f"camera '{name}': {number} {what}, which sent to its ports")
                driver.disarm()
            except DeviceError as error:
                self.statistics.note(str(error))
        self.statistics.log_summary()

    def _stop_trigger(self) -> None:
        """Stop the pulses; a trigger that is gone makes none, and earlier frames are kept."""
        try:
            self._trigger.stop()
        except DeviceError as error:
            if str(error) not in self.statistics.notes:
                self.statistics.note(str(error))

    def _active(self) -> list[str]:
        """Return the cameras that the others' frames wait for."""
        return self._readers.active() if self.reorder else []

    def _received(self, numbers: PulseNumbers) -> Iterator[tuple[str, Grabbed | ClockReading] | None]:
        """Yield buffers until the last pulse is over and its frames had time to arrive; clock readings go first.

        None: a poll has passed without any.
        """
        noted: set[str] = set()
        readers = self._readers
        while True:
            received = readers.get()
            if received is None and self._stop.is_set():
                return
            while self._clocks.readings:
                yield self._clocks.readings.popleft()
            name, buffer = ("", None) if received is None else received
            yield None if buffer is None else (name, buffer)
            self._note_silent(noted)
            self._note_skipped()
            if readers.end_ns is None and self._pulses_over(numbers):
                self._stop_trigger()
                readers.end_ns = time.monotonic_ns()
                log.info("the last pulse wanted is over")
            end_ns = readers.end_ns
            if end_ns is not None and readers.empty:
                done = self._past_end | readers.lost
                if drained(end_ns, readers.polling, done):
                    return

    def _pulses_over(self, numbers: PulseNumbers) -> bool:
        """Return whether to wait no longer for pulses; add a note where none came."""
        now_ns = time.monotonic_ns()
        if self._end.pulses_over(self._trigger, numbers, now_ns):
            return True
        silent_s = min(polled.idle_s for polled in self._readers.polling.values())
        if not self._end.none_came(self._trigger, numbers, now_ns, silent_s):
            return False
        self.statistics.note(
            f"trigger '{self.rig.shared.trigger.source}': no pulse came in {self.rig.shared.wait_s:g} s; check "
            "that the pulses run, and their line to the cameras; wait_s in [hardware] is how long they are waited for"
        )
        return True

    def _note_silent(self, noted: set[str]) -> None:
        """Note once that a camera is silent, by the polling time of its own thread."""
        for name, polled in self._readers.polling.items():
            if polled.idle_s <= self.rig.shared.silence_s:
                noted.discard(name)
            elif name not in noted:
                noted.add(name)
                self.statistics.note(
                    f"camera '{name}': silent for {self.rig.shared.silence_s:g} s; check its trigger line, its "
                    "exposure time against the rate, and its cable"
                )

    def _note_skipped(self) -> None:
        """Count the pulses that the trigger skipped; note the first at once, the number at the end (``_disarm``)."""
        skipped = self._trigger.skipped(self._end.pulses)
        if skipped and not self.statistics.skipped_pulses:
            self.statistics.note(
                f"trigger '{self.rig.shared.trigger.source}': pulses are skipped, since they cannot be sent in their "
                f"periods at rate_hz = {self.rig.shared.rate_hz:g}; use a lower one, or a trigger line"
            )
        self.statistics.skipped_pulses = skipped

    def _numbered(self, numbers: PulseNumbers, name: str, buffer: Grabbed | ClockReading) -> Iterator[NumberedBuffer]:
        """Yield ``buffer`` with its pulse: the trigger's, where each pulse waits for its frames, else the clock's."""
        if isinstance(buffer, ClockReading):
            yield from numbers.read(name, buffer)
            return
        certain = self._trigger.pulse_of(name, buffer, numbers.host_time(name, buffer))
        if certain is not None:
            found: Found = "trigger" if certain.certain else "arrival"
            yield NumberedBuffer(name, certain.pulse, certain.residual_ns, buffer, found, certain.error_ns)
        else:
            yield from numbers.take(name, buffer)

    def _push(self, numbers: PulseNumbers, numbered: Iterator[NumberedBuffer]) -> None:
        """Make frames of numbered buffers and put them in order."""
        for one in numbered:
            camera = self.statistics.cameras[one.camera]
            camera.whole += one.buffer.image is not None
            camera.failed += one.buffer.image is None
            camera.unproven += one.found == "arrival"
            frame = self._frames.frame(one)
            camera.untimed += bool(frame.doubt) and one.found != "arrival"
            self._buffer.advance(one.camera, one.pulse)
            if self._end.is_past(one.pulse):
                self._past_end.add(one.camera)
            else:
                self._buffer.push(one.pulse, frame, one)
        self._clocks.ask(numbers)
        if numbers.notes:  # each clock that was aligned again left one
            for name, relocks in numbers.relocks.items():
                self.statistics.cameras[name].relocked = relocks
            for note in numbers.notes:
                self.statistics.note(f"camera {note}")
            numbers.notes.clear()


def free_running(cameras: Mapping[str, CameraHardware], drivers: Mapping[str, CameraDriver]) -> list[str]:
    """Return the cameras that nothing triggers; a file that is played follows no clock."""
    return [n for n, c in cameras.items() if c.trigger == "Off" and drivers[n].capabilities.real_time]
