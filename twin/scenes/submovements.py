"""Sequences of movements: channels that go from target to target, smooth also where movements overlap.

Each movement adds its displacement times the minimum-jerk curve 10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan 1985), and
movements that overlap are summed (Flash and Henis 1991, superposition): a hand with a new target before it has
arrived does not stop. The curve's position, velocity and acceleration are zero at its start, and its velocity and
acceleration are zero at its end, so that every sum is C2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array

Values = float | Sequence[float] | Array


def minimum_jerk(u: Array) -> Array:
    """Return the completed share (n,) of a movement, 0 to 1, at shares of its time ``u`` (n,); held outside 0..1."""
    held = np.clip(u, 0.0, 1.0)
    return np.asarray(held**3 * (10 - 15 * held + 6 * held * held))


def there_and_back(u: Array) -> Array:
    """Return a C2 hill (n,) over shares of the time ``u`` (n,): 0 at 0 and 1, 1 in the middle."""
    held = np.clip(u, 0.0, 1.0)
    return np.asarray((4 * held * (1 - held)) ** 3)


@dataclass(eq=False)
class MovementSequence:
    """Named channels with the movements of each and their times; written by a choreography, then read once."""

    _start: dict[str, Array] = field(default_factory=dict)
    _target: dict[str, Array] = field(default_factory=dict)
    _moves: dict[str, list[tuple[float, float, Array]]] = field(default_factory=dict)
    _hills: dict[str, list[tuple[float, float, Array]]] = field(default_factory=dict)

    def begin(self, **values: Values) -> None:
        """Add channels with the values (k,) at which they start."""
        for name, value in values.items():
            self._start[name] = np.atleast_1d(np.asarray(value, dtype=np.float64))
            self._target[name] = self._start[name]
            self._moves[name], self._hills[name] = [], []

    def move(self, channel: str, start_s: float, end_s: float, target: Values) -> None:
        """Move ``channel`` from its last target to ``target`` (k,) between two times."""
        goal = np.atleast_1d(np.asarray(target, dtype=np.float64))
        self._moves[channel].append((start_s, end_s, goal - self._target[channel]))
        self._target[channel] = goal

    def visit(self, channel: str, out_s: tuple[float, float], back_s: tuple[float, float], there: Values) -> None:
        """Move ``channel`` to ``there`` (k,) between the times ``out_s``, and back between the times ``back_s``."""
        home = self._target[channel]
        self.move(channel, *out_s, there)
        self.move(channel, *back_s, home)

    def hill(self, channel: str, start_s: float, end_s: float, height: Values) -> None:
        """Raise ``channel`` by ``height`` (k,) and lower it again between two times."""
        self._hills[channel].append((start_s, end_s, np.atleast_1d(np.asarray(height, dtype=np.float64))))

    def target(self, channel: str) -> Array:
        """Return the last target (k,) of ``channel``."""
        return self._target[channel]

    def at(self, time_s: Array) -> dict[str, Array]:
        """Return each channel's values (n, k) at ``time_s`` (n,)."""
        return {name: self._channel(name, time_s) for name in self._start}

    def _channel(self, name: str, time_s: Array) -> Array:
        values = np.tile(self._start[name], (len(time_s), 1))
        for curve, parts in ((minimum_jerk, self._moves[name]), (there_and_back, self._hills[name])):
            for start, end, way in parts:
                values += curve((time_s - start) / (end - start))[:, None] * way
        return values
