"""The real rig as a source of frames: stop the pulses, arm all cameras, start the pulses, number what comes.

Each camera is read by a thread of its own, so that none waits for another and buffers are free at once. The numbered
frames carry pulse time: pulse k is at k periods, plus what the camera's stamp says of its own lateness. A camera that
fails is said, reopened and found again while the others go on; ``account`` tells what became of every buffer.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Self

from hardware.driver import CameraDriver, ClockReading, DeviceError, DeviceReport, Grabbed
from hardware.drivers import open_camera
from hardware.pulse_numbers.clock_poller import ClockReader
from hardware.pulse_numbers.numbering import Numbered, PulseNumbers
from hardware.reorder_buffer import Abreast
from hardware.settings import CameraHardware, RigHardware, read_hardware
from hardware.silence import LOOK_S, Looks
from hardware.statistics import Account, CameraAccount
from hardware.trigger import Trigger
from hardware.triggers import open_trigger
from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame, StampEvent

DRAIN_S = 0.3
"""After the last pulse no more is waited for once every camera was looked at in vain for so long."""
LONGEST_DRAIN_S = 60.0
BEHIND_S = 0.5
"""A camera whose reader has looked in vain for so long is not expected; before, it may be the line that is late."""
MARGIN_S = 0.05
"""The pulses go on for so long after the last one wanted: a busy machine makes and sees them late."""
REOPEN_S = 1.0
QUEUED_BYTES = 1 << 30
"""Frames that may wait for whoever reads the source; what comes after is lost, and said."""

OpenCamera = Callable[[str, CameraHardware], CameraDriver]
OpenTrigger = Callable[[RigHardware, Mapping[str, CameraDriver]], Trigger]


class HardwareSource:
    """Frames of a rig of devices; a ``FrameSource``. Opens and configures all devices, or raises DeviceError.

    ``pulses``: end after so many; None goes on until ``stop``. ``came``: is shown each image as it comes, by its
    camera's own thread. ``prompt``: frames do not wait for those of other cameras. ``opener`` and
    ``trigger_opener`` are for tests.
    """

    came: Callable[[Array], object] | None = None
    prompt = False

    def __init__(
        self,
        rig: RigHardware,
        pulses: int | None = None,
        opener: OpenCamera = open_camera,
        trigger_opener: OpenTrigger = open_trigger,
    ) -> None:
        self.rig = rig
        self.account = Account({name: CameraAccount() for name in rig.cameras})
        self.reports: dict[str, DeviceReport] = {}
        self._pulses = pulses
        self._opener = opener
        self._drivers: dict[str, CameraDriver] = {}
        self._stop = threading.Event()
        self._closed = False
        self._started = False
        self._trigger: Trigger | None = None
        self._numbers: PulseNumbers | None = None
        self._queue: queue.Queue[tuple[str, Grabbed | None]] = queue.Queue()
        # a reading wakes whoever waits for buffers
        self._clocks = ClockReader(self._drivers, lambda name: self._queue.put((name, None)))
        self._looks = {name: Looks() for name in rig.cameras}
        self._lost: set[str] = set()
        self._past: set[str] = set()
        self._over_ns: int | None = None
        self._abreast = Abreast(tuple(rig.cameras), QUEUED_BYTES // 2)
        self._queued_bytes = 0
        self._guard = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._last_index: dict[str, int] = {}
        self._index_base = dict.fromkeys(rig.cameras, 0)
        try:
            for name, settings in rig.cameras.items():
                self._drivers[name] = opener(name, settings)
                self.reports[name] = self._configured(name)
            self._trigger = trigger_opener(rig, self._drivers)
            self._trigger.stop()
        except BaseException:
            self.close()
            raise

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """What each camera says of itself."""
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

    def with_buffers(self) -> Iterator[tuple[Frame, Grabbed]]:
        """Yield as ``iter`` does, each frame with its buffer: when it arrived, the device's own stamp and count."""
        if self._started:
            raise DeviceError("the source of this rig was iterated before; open it again for another take")
        self._started = True
        try:
            start_ns = self._arm_and_start()
            numbers = self._numbers = PulseNumbers(
                tuple(self._drivers), self.rig.shared.rate_hz, start_ns, free=self._free_running()
            )
            for arrived in self._arrivals():
                if arrived is not None:
                    self._frames(self._numbered(*arrived))
                yield from self._abreast.ready(self._expected())
            self._frames(numbers.rest())
            # who stops it ends it with the last pulse that all cameras' readers have come to
            yield from self._abreast.ready(self._expected() if self._stop.is_set() else ())
        finally:
            self._end_threads()
            self._disarm()

    def _free_running(self) -> list[str]:
        """Return the cameras that nothing triggers; a file that is played follows no clock."""
        cameras = self.rig.cameras.items()
        return [n for n, c in cameras if c.trigger == "Off" and self._drivers[n].capabilities.real_time]

    def stop(self) -> None:
        """End the iteration after what is under way; may be called from another thread."""
        self._stop.set()

    def session_ns(self, host_ns: int) -> int | None:
        """Return this machine's monotonic time in the frames' clock [ns]; None before frames are numbered."""
        return None if self._numbers is None else self._numbers.session_ns(host_ns)

    def trigger_report(self) -> dict[str, object]:
        """Return what the trigger knows of its pulses."""
        return {} if self._trigger is None else self._trigger.report()

    def close(self) -> None:
        """Stop and free trigger and devices; may be called twice."""
        self._stop.set()
        if self._closed:
            return
        self._closed = True
        self._end_threads()
        if self._trigger is not None:
            self._trigger.close()
        for driver in self._drivers.values():
            driver.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _configured(self, name: str) -> DeviceReport:
        report = self._drivers[name].configure(self.rig.cameras[name])
        wanted = self.rig.sizes[name]
        if (report.width, report.height) != tuple(wanted):
            raise DeviceError(
                f"camera '{name}': frames of {report.width} x {report.height} px, the rig file says "
                f"{wanted[0]} x {wanted[1]}; set window in [camera.hardware] or mend size in {self.rig.path}"
            )
        return report

    def _event(self, name: str) -> StampEvent:
        return self._drivers[name].capabilities.stamp_event

    def _arm_and_start(self) -> int | None:
        assert self._trigger is not None
        # a master camera comes last: its exposures are the pulses
        master = self.rig.shared.trigger.camera
        for name in sorted(self._drivers, key=lambda name: name == master):
            self._drivers[name].arm()
        self._clocks.start()
        for name in self._drivers:
            thread = threading.Thread(target=self._grab, args=(name,), name=f"camera {name}", daemon=True)
            thread.start()
            self._threads.append(thread)
        return self._trigger.start()

    def _end_threads(self) -> None:
        self._stop.set()
        self._clocks.close()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def _disarm(self) -> None:
        if self._trigger is not None:
            self._trigger.stop()
        for name, witness in ({} if self._numbers is None else self._numbers.witnesses).items():
            account = self.account.cameras[name]
            account.unreached, account.ignored = witness.unreached, witness.ignored
            self.account.notes += witness.lines(name)
        for name, driver in self._drivers.items():
            try:
                self.account.cameras[name].driver = dict(driver.statistics())
                driver.disarm()
            except DeviceError as error:
                self.account.notes.append(str(error))

    def _grab(self, name: str) -> None:
        """Read one camera until the end; a lost device is reopened, again and again."""
        account = self.account.cameras[name]
        while not self._stop.is_set():
            began_ns = time.monotonic_ns()
            try:
                buffer = self._drivers[name].grab(LOOK_S)
            except DeviceError as error:
                self.account.notes.append(str(error))
                self._lost.add(name)
                if self._trigger is not None:
                    self._trigger.camera_lost(name)
                if not self._reopened(name):
                    return
                self._lost.discard(name)
                account.reopened += 1
                continue
            if buffer is None:
                ended_ns = time.monotonic_ns()
                self._looks[name].in_vain(began_ns, ended_ns, self._over_ns)
                if self._trigger is not None:
                    self._trigger.looked_in_vain(name, began_ns, ended_ns)
                continue
            self._looks[name].found()
            if self._trigger is not None:
                self._trigger.frame_arrived(name, buffer.host_ns)
            size = 0
            if buffer.image is not None:
                size = buffer.image.nbytes
                if self.came is not None:
                    self.came(buffer.image)
            with self._guard:
                full = self._queued_bytes + size > QUEUED_BYTES
                self._queued_bytes += 0 if full else size
            if full:
                account.overrun += 1
                buffer = replace(buffer, image=None, note="no room to wait")
            self._queue.put((name, buffer))

    def _reopened(self, name: str) -> bool:
        """Close and reopen the camera until it answers; False when the source ends before."""
        self._drivers[name].close()
        while not self._stop.wait(REOPEN_S):
            try:
                self._drivers[name] = self._opener(name, self.rig.cameras[name])
                self._configured(name)
                self._drivers[name].arm()
                self._clocks.begin(name)
            except DeviceError:
                continue
            self.account.notes.append(f"camera '{name}': answers again")
            return True
        return False

    def _expected(self) -> list[str]:
        """Return the cameras whose next frame may be here and not read yet: those that delivered lately."""
        if self.prompt:
            return []
        return [n for n, looks in self._looks.items() if looks.vain_s < BEHIND_S and n not in self._lost]

    def _arrivals(self) -> Iterator[tuple[str, Grabbed | ClockReading] | None]:
        """Yield buffers until the last pulse is over and its frames had time to arrive; readings go first.

        None says that a while has passed.
        """
        told: set[str] = set()
        while True:
            try:
                name, buffer = self._queue.get(timeout=LOOK_S)
            except queue.Empty:
                if self._stop.is_set():
                    return
                name, buffer = "", None
            while self._clocks.readings:
                yield self._clocks.readings.popleft()
            if buffer is not None:
                with self._guard:
                    self._queued_bytes -= 0 if buffer.image is None else buffer.image.nbytes
                yield name, buffer
            else:
                yield None
            self._tell_silent(told)
            if self._over_ns is None and self._pulses_over(time.monotonic_ns()):
                if self._trigger is not None:
                    self._trigger.stop()
                self._over_ns = time.monotonic_ns()
            if self._over_ns is not None and self._queue.empty() and self._drained(self._over_ns):
                return

    def _pulses_over(self, now_ns: int) -> bool:
        """Tell whether all pulses wanted were made; a trigger that counts them may be behind the clock."""
        if self._pulses is None or self._trigger is None:
            return False
        certain = self._trigger.pulse_at(now_ns)
        if certain is not None:  # the last one wanted has had its frames: the next one was made
            return certain >= self._pulses
        reached = None if self._numbers is None else self._numbers.pulse_at(now_ns)
        if reached is None or reached < self._pulses + MARGIN_S * self.rig.shared.rate_hz:
            return False
        made = self._trigger.report().get("pulses")
        return not isinstance(made, int) or made >= self._pulses

    def _drained(self, over_ns: int) -> bool:
        """Tell whether nothing of the pulses wanted is under way, as far as each camera's reader has looked."""
        if time.monotonic_ns() - over_ns > LONGEST_DRAIN_S * 1e9:
            return True
        done = self._past | self._lost
        return all(looks.over_s >= DRAIN_S for name, looks in self._looks.items() if name not in done)

    def _tell_silent(self, told: set[str]) -> None:
        """Note once who is silent: by its own thread's looks, however late this is read."""
        for name, looks in self._looks.items():
            if looks.vain_s <= self.rig.shared.silence_s:
                told.discard(name)
            elif name not in told:
                told.add(name)
                self.account.notes.append(
                    f"camera '{name}': silent for {self.rig.shared.silence_s:g} s; check its trigger line, its "
                    "exposure time against the rate, and its cable"
                )

    def _numbered(self, name: str, buffer: Grabbed | ClockReading) -> Iterator[Numbered]:
        """Yield ``buffer`` with its pulse: the trigger's, where each pulse waits for its frames, else the clock's."""
        assert self._trigger is not None
        assert self._numbers is not None
        if isinstance(buffer, ClockReading):
            yield from self._numbers.read(name, buffer)
            return
        certain = self._trigger.pulse_at(buffer.host_ns)
        if certain is not None:
            yield Numbered(name, certain, 0.0, buffer)
        else:
            yield from self._numbers.take(name, buffer)

    def _frames(self, numbered: Iterator[Numbered]) -> None:
        """Make frames of what is numbered; each waits for those of other cameras."""
        assert self._numbers is not None
        period_ns = 1e9 / self.rig.shared.rate_hz
        for one in numbered:
            buffer = one.buffer
            account = self.account.cameras[one.camera]
            account.whole += buffer.image is not None
            account.failed += buffer.image is None
            self._abreast.reached(one.camera, one.pulse)
            if self._pulses is not None and one.pulse >= self._pulses:
                self._past.add(one.camera)
                continue
            frame = Frame(
                one.camera,
                self._index(one),
                round(one.pulse * period_ns + one.residual_ns),
                buffer.exposure_ns,
                buffer.image,
                "corrupt" if buffer.image is None else "ok",
                self._event(one.camera),
                note=buffer.note,
                rows=self.reports[one.camera].height,
            )
            self._abreast.take(one.pulse, frame, buffer)
        self._clocks.ask(self._numbers)
        self._tell_clocks()

    def _index(self, one: Numbered) -> int:
        """Return the camera's counter, made to rise on where the camera began anew."""
        name = one.camera
        last = self._last_index.get(name, -1)
        if one.buffer.nameless:
            self._last_index[name] = last + 1
            return last + 1
        block = one.pulse if one.buffer.block_id is None else one.buffer.block_id
        if block + self._index_base[name] <= last:
            self._index_base[name] = last + 1 - block
        self._last_index[name] = block + self._index_base[name]
        return self._last_index[name]

    def _tell_clocks(self) -> None:
        assert self._numbers is not None
        if self._numbers.notes:  # each clock that was found again left one
            for name, relocked in self._numbers.relocks.items():
                self.account.cameras[name].relocked = relocked
            self.account.notes += [f"camera {note}" for note in self._numbers.notes]
            self._numbers.notes.clear()


def open_rig(path: Path, pulses: int | None = None) -> HardwareSource:
    """Open the devices of the rig file at ``path``; InputError for the file, DeviceError for a device."""
    return HardwareSource(read_hardware(path), pulses)
