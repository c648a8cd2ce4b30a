"""When a camera that runs free took its frames: no pulse says so, and counting frames would follow its own rate.

A free-running camera has a rate and a phase of its own: 29.97 Hz beside 30 is a whole frame in half a minute. So its
frames are not counted; each has the instant at which it was taken, on this machine's clock, and belongs to the pulse
nearest to it. With a clock of its own that instant is the stamp, brought to this machine's clock by the frames that
arrived quickest (arrivals are late by what network and operating system make of it, never early); without one it is
the arrival itself, milliseconds late, and late by different times for cameras of different kinds.
"""

from collections import deque

from hardware.driver import Grabbed

WINDOW_S = 2.0
"""Clocks 50 ppm apart run 0.1 ms apart in this time, less than arrivals tell."""
JUMP_NS = 1_000_000_000
"""A clock that is off by more than this against the last frame's was set, or its camera restarted."""


class FreeClock:
    """The instants of one camera's frames on this machine's clock; ``rate_hz``: about its own."""

    def __init__(self, rate_hz: float) -> None:
        self._ahead: deque[int] = deque(maxlen=max(round(WINDOW_S * rate_hz), 8))
        self._last_ns: int | None = None

    def at(self, buffer: Grabbed) -> int:
        """Return this machine's monotonic time [ns] of what the frame's stamp marks; of its arrival without one."""
        if buffer.device_ns is None:
            return buffer.host_ns
        ahead = buffer.host_ns - buffer.exposure_ns - buffer.device_ns
        jumped = self._ahead and abs(ahead - self._ahead[-1]) > JUMP_NS
        if jumped or (self._last_ns is not None and buffer.device_ns <= self._last_ns):
            self._ahead.clear()
        self._ahead.append(ahead)
        self._last_ns = buffer.device_ns
        return buffer.device_ns + min(self._ahead)
