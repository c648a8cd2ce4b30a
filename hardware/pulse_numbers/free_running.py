"""Exposure times of a free-running camera: no pulse triggers it, and a frame count would follow its own rate.

A free-running camera has a rate and a phase of its own: 29.97 Hz beside 30 is a whole frame in half a minute. So its
frames are not counted; each belongs to the pulse nearest to its exposure time on the host clock. With a device clock
that time is the stamp, brought to the host clock by the frames that arrived quickest (network and operating system
delay arrivals, never advance them); without one it is the arrival itself, milliseconds late, by different times for
cameras of different kinds.
"""

from collections import deque

from hardware.driver import Grabbed

WINDOW_S = 2.0
"""Clocks 50 ppm apart drift by 0.1 ms in this time, less than the scatter of arrivals."""
JUMP_NS = 1_000_000_000
"""A clock that changed by more than this since the last frame was set, or its camera restarted."""


class FreeClock:
    """Host times of one camera's frames; ``rate_hz``: about its own rate."""

    def __init__(self, rate_hz: float) -> None:
        self._ahead: deque[int] = deque(maxlen=max(round(WINDOW_S * rate_hz), 8))
        self._last_ns: int | None = None

    def at(self, buffer: Grabbed) -> int:
        """Return the host time [ns] of the frame's stamp, or of its arrival where it has none."""
        if buffer.device_ns is None:
            return buffer.host_ns
        ahead = buffer.host_ns - buffer.exposure_ns - buffer.device_ns
        jumped = self._ahead and abs(ahead - self._ahead[-1]) > JUMP_NS
        if jumped or (self._last_ns is not None and buffer.device_ns <= self._last_ns):
            self._ahead.clear()
        self._ahead.append(ahead)
        self._last_ns = buffer.device_ns
        return buffer.device_ns + min(self._ahead)
