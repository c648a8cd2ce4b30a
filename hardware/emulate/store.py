"""Frames for emulated cameras: read ahead of the pulses, held in a bounded part of memory."""

import time
from collections.abc import Callable
from threading import Condition, Thread

from mosca.data.frames import CameraInfo, Frame, FrameSource
from mosca.errors import InputError

MISSING_AFTER = 8
"""A frame counts as lost when the source has given frames of this many later pulses."""
WAIT_S = 30.0
"""Time-out of a camera's wait for a frame that has not been read yet."""
POLL_INTERVAL_S = 0.5


class FrameStore:
    """Frames of ``source`` by camera and pulse, at most ``ahead`` pulses of them (and as many requested ones).

    A source that fits is kept, and looped or restarted without reading it again. Frames of a longer source are read
    while pulses pass, and a restart iterates over it anew. ``loop``: the first pulse follows the last.

    Where the source uses the session's clock (twin, captures, folders of images), a camera's first frame belongs to
    the pulse of its index, and later frames to the pulses of their time stamps. With other clocks the pulse follows
    from the time since the camera's previous frame.
    """

    def __init__(self, source: FrameSource, ahead: int, loop: bool = False) -> None:
        if ahead < 1:
            raise InputError(f"ahead = {ahead} given; at least 1 pulse must be kept")
        self._source, self._ahead, self._loop = source, ahead, loop
        self.infos: tuple[CameraInfo, ...] = source.cameras
        self._changed = Condition()
        self._frames: dict[tuple[str, int], Frame] = {}
        self._asked = 0
        self._newest = -1
        self._length: int | None = None
        self._whole = self._ended = self._forgot = False
        self._wanted_round = 0
        self._closed = False
        self._failed: Exception | None = None
        self._thread = Thread(target=self._read, name="frames", daemon=True)
        self._thread.start()

    @property
    def length(self) -> int | None:
        """Number of pulses of the source, None until its end was seen."""
        return self._length

    @property
    def last_pulse(self) -> int | None:
        """The last pulse with frames, None where there is none or it is not known."""
        return None if self._loop or self._length is None else self._length - 1

    def fill(self, progress: Callable[[int, int | None], None] | None = None) -> None:
        """Wait until ``ahead`` pulses, or all of them, are in memory; raise what the source raised.

        ``progress``: called with pulses done and to do; at the end both are the number in memory.
        """
        with self._changed:
            while self._failed is None and self._length is None and self._newest < self._ahead - 1:
                self._changed.wait(POLL_INTERVAL_S)
                if progress is not None:
                    progress(max(self._newest, 0), self._ahead)
        self.check()
        if progress is not None:
            progress(self._newest + 1, self._newest + 1)

    def check(self) -> None:
        """Raise what the source raised."""
        if self._failed is not None:
            raise self._failed

    def first(self, camera: str) -> Frame | None:
        """Return the earliest frame of ``camera`` in memory."""
        with self._changed:
            numbers = [number for name, number in self._frames if name == camera]
            return self._frames[camera, min(numbers)] if numbers else None

    def frame(self, camera: str, pulse: int) -> Frame | None:
        """Return the frame of ``camera`` at ``pulse``; None where the source has none, or has it much too late."""
        until = time.monotonic() + WAIT_S
        with self._changed:
            if self._loop and self._whole and self._length:
                pulse %= self._length
            if pulse > self._asked:
                self._asked = pulse
                self._forget()
                self._changed.notify_all()
            while (camera, pulse) not in self._frames:
                gone = self._ended or pulse < self._newest - MISSING_AFTER
                if gone or self._closed or self._failed is not None or time.monotonic() > until:
                    return None
                self._changed.wait(POLL_INTERVAL_S)
            return self._frames[camera, pulse]

    @property
    def kept(self) -> int:
        """Number of frames in memory."""
        return len(self._frames)

    def rewind(self) -> None:
        """Begin again with pulse 0."""
        with self._changed:
            self._asked = 0
            if self._forgot:
                self._wanted_round += 1
                self._start_round()
            self._changed.notify_all()

    def close(self) -> None:
        """Stop reading; the source must be closed by its owner."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _read(self) -> None:
        """Iterate over the source, again after each restart, until closed."""
        try:
            while self._read_once():
                pass
        except Exception as error:  # raised where the store is filled; a reader without frames ends
            with self._changed:
                self._failed = error
                self._changed.notify_all()

    def _start_round(self) -> None:
        self._frames.clear()
        self._newest = -1
        self._ended = self._forgot = False

    def _read_once(self) -> bool:
        """Read the source to its end, or until it must be read anew; return whether it must."""
        with self._changed:
            this_round = self._wanted_round
            self._start_round()
        base = 0
        while True:
            numbering = _Numbering(self.infos)
            for frame in self._source:
                if not self._keep(frame, base + numbering.pulse_of(frame), this_round):
                    return not self._closed
            with self._changed:
                if self._over(this_round):
                    return not self._closed
                self._whole = base == 0 and self._newest < self._ahead
                if self._whole or not self._loop:
                    self._length = self._newest + 1
                    self._ended = True
                    self._changed.notify_all()
                    while not self._over(this_round):
                        self._changed.wait(POLL_INTERVAL_S)
                    return not self._closed
                base = self._newest + 1

    def _keep(self, frame: Frame, pulse: int, this_round: int) -> bool:
        """Keep ``frame`` as soon as there is space; False when this reading is over."""
        with self._changed:
            while pulse >= self._asked + self._ahead and not self._over(this_round):
                self._changed.wait(POLL_INTERVAL_S)
            if self._over(this_round):
                return False
            self._frames.setdefault((frame.camera, pulse), frame)
            if pulse > self._newest:
                self._newest = pulse
                self._changed.notify_all()
            return True

    def _over(self, this_round: int) -> bool:
        return self._closed or self._wanted_round != this_round

    def _forget(self) -> None:
        """Drop frames that lie too far behind, unless the whole source is kept."""
        if self._whole:
            return
        oldest = self._asked - self._ahead
        for key in [key for key in self._frames if key[1] < oldest]:
            del self._frames[key]
            self._forgot = True


class _Numbering:
    """Pulse numbers of frames in one iteration over a source."""

    def __init__(self, infos: tuple[CameraInfo, ...]) -> None:
        self._one_clock = all(info.clock == "session" for info in infos)
        self._rates = {info.name: info.frame_rate_hz for info in infos}
        self._first: int | None = None
        self._last: dict[str, tuple[int, int]] = {}
        self._began: dict[str, tuple[int, int]] = {}

    def pulse_of(self, frame: Frame) -> int:
        if self._one_clock:
            self._first = frame.index if self._first is None else self._first
            index, time_ns = self._began.setdefault(frame.camera, (frame.index, frame.time_ns))
            # the counter of a real camera does not count the pulses that it missed: its stamps show them
            since = round((frame.time_ns - time_ns) * self._rates[frame.camera] / 1e9)
            return max(index - self._first + since, 0)
        self._first = frame.time_ns if self._first is None else self._first
        pulse, time_ns = self._last.get(frame.camera, (0, self._first))
        pulse = max(pulse + round((frame.time_ns - time_ns) * self._rates[frame.camera] / 1e9), 0)
        self._last[frame.camera] = pulse, frame.time_ns
        return pulse
