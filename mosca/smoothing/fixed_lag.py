"""Fixed-lag smoothing: samples leave ``lag`` frames late, corrected by all that was measured until then.

The same motion as offline (``mosca.smoothing.rts``): Singer's, each track by itself. With a lag longer than the
tracks and the same acceleration the two are equal. Online nobody knows a track's acceleration beforehand: the
likeliest of the ladder so far is used, and what is long past counts less.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.smoothing.rts import LADDER, axis_moves
from mosca.smoothing.smooth_lag_kernels import leave, take

FIRST_SLOTS = 32
START_MPS2 = 16.0
"""Acceleration that is believed before anything is known."""
DOUBT = 0.5
"""What a factor of 2 away from that costs, in units of -2 log-likelihood."""


@dataclass(frozen=True)
class LagSettings:
    """``lag``: frames that a sample waits, 0: filtered only; ``memory_s``: how long an acceleration lasts;
    ``speed_mps``: of a track's first velocity; ``acceleration_mps2``: of all tracks, None: learned;
    ``learn_s``: how long what was learned of it counts; ``forget_s``: a track not seen for so long begins anew.
    """

    lag: int = 10
    memory_s: float = 0.1
    speed_mps: float = 3.0
    acceleration_mps2: float | None = None
    learn_s: float = 2.0
    forget_s: float = 60.0


class FixedLag:
    """Smooths samples on their way. The state is its own; hand it what left the tracker, frame set by frame set."""

    # by slot: a track's filter, and its samples that wait, oldest first
    _track: Array
    _last_ns: Array
    _count: Array
    _mean: Array
    _spread: Array
    _xyz: Array
    _own: Array
    _cross: Array
    _rung_mean: Array
    _rung_spread: Array
    _rung_cost: Array
    _frame: Array
    _time_ns: Array
    _cameras: Array
    _residual: Array
    _free: list[int]

    def __init__(self, settings: LagSettings | None = None) -> None:
        self.settings = LagSettings() if settings is None else settings
        if self.settings.lag < 0:
            raise InputError(f"lag = {self.settings.lag} given; 0 frames or more are allowed")
        self._slot_of: dict[int, int] = {}
        self._room(FIRST_SLOTS, min(self.settings.lag, 62) + 2)

    def step(self, frame: int, samples: Samples) -> Samples:
        """Take the samples that left the tracker at ``frame``; return those of ``frame - lag`` and before, smoothed.

        Samples of one track come in order of time; one that is not after its track's last (no tracker gives such)
        leaves at once, as it was measured. The covariance is that of the smoothed position; its errors are correlated
        in time. Samples that are not measured leave at once too.
        """
        usable, rows = samples.status == 0, np.empty(0, np.int64)
        passed = samples.select(~usable)
        if usable.any():
            rows, late = self._take(samples.select(usable))
            if len(late):
                passed = Samples.joined([passed, late])
        out = self._leave(frame - self.settings.lag)
        if len(rows):
            self._forget(int(rows.max()))
        return Samples.joined([passed, out]) if len(passed) else out

    def rest(self) -> Samples:
        """Return the samples that still wait: no more will be measured."""
        return self._leave(np.iinfo(np.int64).max)

    def _take(self, samples: Samples) -> tuple[Array, Samples]:
        """Take measured samples; return their times and those that come too late."""
        if not len(samples):
            return samples.time_ns, samples
        s = self.settings
        order = np.lexsort((samples.time_ns, samples.track))
        samples = samples.select(order)
        slots = np.array([self._slot(int(track)) for track in samples.track], dtype=np.int64)
        first = np.ones(len(slots), bool)
        first[1:] = slots[1:] != slots[:-1]
        before = np.where(first, self._last_ns[slots], np.roll(samples.time_ns, 1))
        fresh = before < 0
        late = ~fresh & (samples.time_ns <= before)
        if late.any():
            # what follows a late one is judged anew, against what is left
            times, rest = self._take(samples.select(~late))
            return times, Samples.joined([samples.select(late), rest])
        steps = np.where(fresh, 0, samples.time_ns - before) * 1e-9
        most = int((self._count[slots] + np.bincount(slots, minlength=len(self._count))[slots]).max())
        if most >= self._frame.shape[1]:
            self._room(len(self._count), 2 * most)
        at = self._count[slots] + np.arange(len(slots)) - np.flatnonzero(first)[np.cumsum(first) - 1]
        fixed = -1.0 if s.acceleration_mps2 is None else s.acceleration_mps2**2
        start = DOUBT * np.log2(LADDER / START_MPS2) ** 2
        take(
            slots, fresh, np.ascontiguousarray(samples.xyz), np.ascontiguousarray(samples.covariance),
            *axis_moves(steps, s.memory_s), s.speed_mps**2, LADDER**2, fixed, start, np.exp(-steps / s.learn_s),
            self._mean, self._spread, self._count, self._xyz, self._own, self._cross,
            self._rung_mean, self._rung_spread, self._rung_cost,
        )  # fmt: skip
        self._frame[slots, at], self._time_ns[slots, at] = samples.frame, samples.time_ns
        self._cameras[slots, at], self._residual[slots, at] = samples.n_cameras, samples.residual_px
        self._last_ns[slots] = samples.time_ns  # the last of equal slots wins
        return samples.time_ns, Samples.none()

    def _leave(self, upto: int) -> Samples:
        waiting = int(self._count.sum())
        gone, xyz, own = (
            np.zeros(len(self._count), np.int64),
            np.empty((waiting, 3)),
            np.empty((waiting, 3, 3)),
        )
        n = leave(upto, self._frame, gone, self._count, self._xyz, self._own, self._cross, xyz, own)
        if n == 0:
            return Samples.none()
        slots = np.flatnonzero(gone)
        slot = np.repeat(slots, gone[slots])
        column = np.concatenate([np.arange(k) for k in gone[slots]])
        out = Samples(
            self._frame[slot, column], self._time_ns[slot, column], self._track[slot], xyz[:n], own[:n],
            self._cameras[slot, column], self._residual[slot, column], np.zeros(n, np.int8),
        )  # fmt: skip
        for s, k in zip(slots.tolist(), gone[slots].tolist(), strict=True):
            for column_of in (self._frame, self._time_ns, self._cameras, self._residual):
                column_of[s, :-k] = column_of[s, k:].copy()
        return out.select(np.lexsort((out.track, out.frame)))

    def _slot(self, track: int) -> int:
        slot = self._slot_of.get(track)
        if slot is None:
            if not self._free:
                self._room(2 * len(self._count), self._frame.shape[1])
            slot = self._free.pop()
            self._slot_of[track] = slot
            self._track[slot], self._last_ns[slot] = track, -1
        return slot

    def _forget(self, now_ns: int) -> None:
        """Free the slots of tracks that have not been seen for long and have nothing waiting."""
        for track, slot in list(self._slot_of.items()):
            if now_ns - self._last_ns[slot] > self.settings.forget_s * 1e9 and self._count[slot] == 0:
                del self._slot_of[track]
                self._free.append(slot)

    def _room(self, slots: int, width: int) -> None:
        """Make room for ``slots`` tracks with ``width`` samples waiting each; what is there stays."""
        n, w, r = slots, width, len(LADDER)
        empty = {
            "_track": np.full(n, -1), "_last_ns": np.full(n, -1), "_count": np.zeros(n, np.int64),
            "_mean": np.zeros((n, 9)), "_spread": np.zeros((n, 9, 9)),
            "_xyz": np.zeros((n, w, 3)), "_own": np.zeros((n, w, 3, 3)), "_cross": np.zeros((n, w, 3, 9)),
            "_rung_mean": np.zeros((n, r, 3, 3)), "_rung_spread": np.zeros((n, r, 3, 3, 3)),
            "_rung_cost": np.zeros((n, r)), "_frame": np.zeros((n, w), np.int64),
            "_time_ns": np.zeros((n, w), np.int64), "_cameras": np.zeros((n, w), np.int64),
            "_residual": np.zeros((n, w)),
        }  # fmt: skip
        old = len(self.__dict__.get("_count", ()))
        for name, array in empty.items():
            if old:
                before = self.__dict__[name]
                array[tuple(slice(size) for size in before.shape)] = before
            setattr(self, name, array)
        self._free = [*range(n - 1, old - 1, -1), *self.__dict__.get("_free", ())]


def lagged(steps: Iterable[tuple[int, Samples]], settings: LagSettings | None = None) -> Iterator[Samples]:
    """Smooth the samples of (frame, samples) as they come; yield one part a step and, at the end, what waits."""
    smoother = FixedLag(settings)
    for frame, samples in steps:
        yield smoother.step(frame, samples)
    yield smoother.rest()
