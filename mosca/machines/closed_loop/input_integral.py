"""A known acceleration, constant from one instant to the next, integrated once and twice."""

from bisect import bisect_right

import numpy as np

from mosca.data.arrays import Array


class InputIntegral:
    """Known acceleration (3,) [m/s^2] over time; each value holds until the next, the last one without end.

    Values are appended in order of time; before the first value the acceleration is zero.
    """

    def __init__(self) -> None:
        self._time: list[float] = []
        self._value: list[Array] = []
        self._speed: list[Array] = []
        self._way: list[Array] = []

    def append(self, time_s: float, acceleration: Array) -> None:
        """Let ``acceleration`` (3,) hold from ``time_s`` on; it replaces a last value at the same instant."""
        if self._time and time_s < self._time[-1]:
            raise ValueError(f"time_s = {time_s} given after {self._time[-1]}; inputs come in order of time")
        speed, way = self._at(time_s)
        if self._time and time_s == self._time[-1]:
            self._value[-1] = np.asarray(acceleration, dtype=float)
            return
        self._time.append(time_s)
        self._value.append(np.asarray(acceleration, dtype=float))
        self._speed.append(speed)
        self._way.append(way)

    def effect(self, from_s: float, until_s: float) -> tuple[Array, Array]:
        """Return the change of position (3,) [m] and velocity (3,) [m/s] of a body from rest by the input."""
        v0, x0 = self._at(from_s)
        v1, x1 = self._at(until_s)
        return x1 - x0 - v0 * (until_s - from_s), v1 - v0

    def _at(self, time_s: float) -> tuple[Array, Array]:
        k = bisect_right(self._time, time_s) - 1
        if k < 0:
            return np.zeros(3), np.zeros(3)
        h = time_s - self._time[k]
        return (self._speed[k] + h * self._value[k], self._way[k] + h * self._speed[k] + 0.5 * h * h * self._value[k])
