"""Fixed-lag smoothing: samples leave ``lag`` frames late, corrected by all that was measured until then.

The motion model is the same as offline (``mosca.smoothing.rts``): Singer's, each track by itself. With a lag longer
than the tracks and the same acceleration, both give equal results. Online a track's acceleration is not known
beforehand: the value of the ladder that is likeliest so far is used, with exponential forgetting.
"""

from typing import NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.smoothing.augmented_filter import Filters, Prior, TrackMeasurements, empty_filters, release, update
from mosca.smoothing.rts import LADDER, axis_moves

FIRST_SLOTS = 32
FIRST_WAITING = 64
"""Samples of a track that may wait before the tables grow, at most."""
START_MPS2 = 16.0
"""Acceleration that is most probable a priori."""
PRIOR_COST = 0.5
"""Prior cost of a factor of 2 away from that, in units of -2 log-likelihood."""


@dataclass(frozen=True, config=SETTINGS)
class LagSettings:
    """How long samples wait, and how targets move."""

    lag: int = 10
    """Frames that a sample waits; 0: filtered only."""
    memory_s: Positive = 0.1
    """Correlation time of the acceleration [s]."""
    speed_mps: Positive = 3.0
    """Standard deviation of a track's first velocity, an axis."""
    acceleration_mps2: NotNegative | None = None
    """Standard deviation of all tracks' acceleration, an axis; None: adapted."""
    learn_s: Positive = 2.0
    """Time constant with which its likelihoods are forgotten."""
    forget_s: Positive = 60.0
    """A track not seen for so long is initiated anew."""


class _Waiting(NamedTuple):
    """Further columns of ``Samples`` for the earlier positions, (s, w) each."""

    frame: Array
    time_ns: Array
    n_cameras: Array
    residual_px: Array


class _Slots(NamedTuple):
    """Owners of s slots."""

    track: Array
    """(s,) -1 where free."""
    last_ns: Array
    """(s,) time of the newest measurement."""


class FixedLag:
    """Smooths samples online. Stateful: pass the tracker's samples frame set by frame set."""

    def __init__(self, settings: LagSettings | None = None) -> None:
        self.settings = LagSettings() if settings is None else settings
        if self.settings.lag < 0:
            raise InputError(f"lag = {self.settings.lag} given; 0 frames or more are allowed")
        self._slot_of: dict[int, int] = {}
        s, width = self.settings, min(self.settings.lag + 2, FIRST_WAITING)
        self._slots, self._filters, self._waiting = _tables(FIRST_SLOTS, width)
        self._free = list(range(FIRST_SLOTS - 1, -1, -1))
        self._prior = motion_prior(s.speed_mps, s.acceleration_mps2)

    @property
    def capacity(self) -> int:
        """For how many tracks there are slots; it grows with the tracks that are seen within ``forget_s``."""
        return len(self._slots.track)

    def step(self, frame: int, samples: Samples) -> Samples:
        """Take the samples that left the tracker at ``frame``; return those of ``frame - lag`` and before, smoothed.

        Samples of one track must be in order of time; one that is not is returned at once, as measured. The
        covariance is that of the smoothed position; its errors are correlated in time. Samples that are not measured
        are returned at once too.
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
        before = np.where(first, self._slots.last_ns[slots], np.roll(samples.time_ns, 1))
        fresh = before < 0
        late = ~fresh & (samples.time_ns <= before)
        if late.any():
            # samples after a late one are compared again, with those that are left
            times, rest = self._take(samples.select(~late))
            return times, Samples.joined([samples.select(late), rest])
        steps = np.where(fresh, 0, samples.time_ns - before) * 1e-9
        count, n_slots = self._filters.kept, len(self._slots.track)
        most = int((count[slots] + np.bincount(slots, minlength=n_slots)[slots]).max())
        if most >= self._waiting.frame.shape[1]:
            self._enlarge(n_slots, 2 * most)
        column = self._filters.kept[slots] + np.arange(len(slots)) - np.flatnonzero(first)[np.cumsum(first) - 1]
        move, noise = axis_moves(steps, s.memory_s)
        xyz, covariance = np.ascontiguousarray(samples.xyz), np.ascontiguousarray(samples.covariance)
        measured = TrackMeasurements(slots, fresh, xyz, covariance, move, noise, np.exp(-steps / s.learn_s))
        update(measured, self._prior, self._filters)
        waiting = self._waiting
        for name in _Waiting._fields:
            getattr(waiting, name)[slots, column] = getattr(samples, name)
        self._slots.last_ns[slots] = samples.time_ns  # the last of equal slots wins
        return samples.time_ns, Samples.none()

    def _leave(self, upto: int) -> Samples:
        filters, waiting = self._filters, self._waiting
        total = int(filters.kept.sum())
        gone = np.zeros(len(filters.kept), np.int64)
        xyz, own = np.empty((total, 3)), np.empty((total, 3, 3))
        n = release(upto, waiting.frame, filters, gone, xyz, own)
        if n == 0:
            return Samples.none()
        slots = np.flatnonzero(gone)
        slot = np.repeat(slots, gone[slots])
        column = np.concatenate([np.arange(k) for k in gone[slots]])
        frame, time_ns, cameras, residual = (table[slot, column] for table in waiting)
        out = Samples(
            frame, time_ns, self._slots.track[slot], xyz[:n], own[:n], cameras, residual, np.zeros(n, np.int8)
        )
        for s, k in zip(slots.tolist(), gone[slots].tolist(), strict=True):
            for table in waiting:
                table[s, :-k] = table[s, k:].copy()
        return out.select(np.lexsort((out.track, out.frame)))

    def _slot(self, track: int) -> int:
        slot = self._slot_of.get(track)
        if slot is None:
            if not self._free:
                self._enlarge(2 * len(self._slots.track), self._waiting.frame.shape[1])
            slot = self._free.pop()
            self._slot_of[track] = slot
            self._slots.track[slot], self._slots.last_ns[slot] = track, -1
        return slot

    def _forget(self, now_ns: int) -> None:
        """Free the slots of tracks that have not been seen for long and have nothing waiting."""
        for track, slot in list(self._slot_of.items()):
            if now_ns - self._slots.last_ns[slot] > self.settings.forget_s * 1e9 and self._filters.kept[slot] == 0:
                del self._slot_of[track]
                self._free.append(slot)

    def _enlarge(self, slots: int, width: int) -> None:
        """Enlarge the tables to ``slots`` tracks with ``width`` samples waiting each; their contents are kept."""
        old, new = (self._slots, self._filters, self._waiting), _tables(slots, width)
        for before, after in zip(old, new, strict=True):
            for one, other in zip(before, after, strict=True):
                other[tuple(slice(size) for size in one.shape)] = one
        self._free = [*range(slots - 1, len(self._slots.track) - 1, -1), *self._free]
        self._slots, self._filters, self._waiting = new


def motion_prior(speed: float, acceleration: float | None) -> Prior:
    """Return the prior of a first velocity, and of an acceleration that is given or, where None, learned.

    Both are standard deviations of an axis, in the measured quantity's unit a second and a second squared.
    """
    cost = PRIOR_COST * np.log2(LADDER / START_MPS2) ** 2
    return Prior(speed**2, LADDER**2, cost, -1.0 if acceleration is None else acceleration**2)


def _tables(n: int, w: int) -> tuple[_Slots, Filters, _Waiting]:
    """Return empty tables for ``n`` tracks with ``w`` samples waiting each."""
    filters = empty_filters(n, w, len(LADDER))
    waiting = _Waiting(
        np.zeros((n, w), np.int64), np.zeros((n, w), np.int64), np.zeros((n, w), np.int64), np.zeros((n, w))
    )
    return _Slots(np.full(n, -1), np.full(n, -1)), filters, waiting
