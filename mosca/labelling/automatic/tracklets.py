"""Tracklets: runs of samples that are certainly of one marker, from tracks that may change identity, or from points.

Where most tracks are one or two samples long, their numbers are not used. Points are then linked from frame to frame:
to the point near the prediction by constant velocity, if no other point is nearly as near.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks

ACCELERATION = 150.0
"""Largest acceleration of a marker on a person [m/s^2]: heels and boxers' fists reach 50 to 100 between frames."""
NOISE_M = 0.003
"""Largest error of a measured place [m]: half hidden markers are off by millimetres."""
FIRST_SPEED = 3.0
"""Largest speed, relative to those around it, of a marker whose velocity is not known yet [m/s]."""
CLEARLY = 2.0
"""A linked point's rivals must be this many times farther."""
SHORT = 3.0
"""Tracks shorter than this number of samples (median over samples) are treated as points without identity."""
BRIDGED = 3
"""Longest gap of a track within a tracklet [frames]."""


@dataclass(frozen=True, eq=False)
class TrackletSet:
    """Samples (n) sorted by tracklet, then frame."""

    sample: Array
    """(n,) row of the tracks."""
    row: Array
    """(n,) index of the frame among those of the tracks."""
    xyz: Array
    """(n, 3)"""
    starts: Array
    """(k + 1,) where each tracklet begins."""
    frames: int
    linked: bool
    """Whether tracks had no identity."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    def part(self, k: int) -> slice:
        """Return the samples of tracklet ``k``."""
        return slice(int(self.starts[k]), int(self.starts[k + 1]))

    def window(self, pieces: Array, rows: slice) -> Array:
        """Return the positions (t, k, 3) of tracklets ``pieces`` (k,) in a range of frames, NaN where not seen."""
        out = np.full((rows.stop - rows.start, len(pieces), 3), np.nan)
        for column, k in enumerate(pieces.tolist()):
            part = self.part(k)
            there = (self.row[part] >= rows.start) & (self.row[part] < rows.stop)
            out[self.row[part][there] - rows.start, column] = self.xyz[part][there]
        return out


def tracklets_of(tracks: Tracks) -> TrackletSet:
    """Return the tracklets of the measured samples of ``tracks``."""
    measured = np.flatnonzero((tracks.status == "measured") & np.isfinite(tracks.xyz).all(axis=1))
    frames, row = np.unique(tracks.frame[measured], return_inverse=True)
    xyz, track = tracks.xyz[measured], tracks.track[measured]
    if not len(measured):
        return TrackletSet(measured, row, xyz, np.zeros(1, dtype=int), 0, False)
    times = tracks.time_ns[measured] * 1e-9
    dt = max(float(times.max() - times.min()) / max(int(frames[-1] - frames[0]), 1), 1e-4)
    _, number, count = np.unique(track, return_inverse=True, return_counts=True)
    linked = bool(np.median(count[number]) < SHORT)
    if linked:
        number = _link(xyz, row, tracks.frame[measured], dt)
    order = np.lexsort((row, number))
    measured, row, xyz, number = measured[order], row[order], xyz[order], number[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = number[1:] != number[:-1]
    new |= _jumps(xyz, tracks.frame[measured], new, dt)
    starts = np.append(np.flatnonzero(new), len(order))
    return TrackletSet(measured, row, xyz, starts, len(frames), linked)


def _jumps(xyz: Array, frame: Array, new: Array, dt: float) -> Array:
    """Return whether a track may change to another marker at each sample (n,): after a long gap or a jump."""
    gap = np.diff(frame, prepend=frame[0])
    step = np.diff(xyz, axis=0, prepend=xyz[:1]) / np.maximum(gap, 1)[:, None]
    change = np.zeros(len(frame))
    change[2:] = np.linalg.norm(step[2:] - step[1:-1], axis=1) * gap[2:]
    # only a step longer than half the one before: not the step after a jump
    long = np.linalg.norm(step, axis=1)
    known = ~new & ~np.roll(new, 1) & (long > 0.5 * np.roll(long, 1))
    reach = gap * (gap + 1) / 2 * ACCELERATION * dt**2 + 2 * NOISE_M
    return np.asarray(~new & ((gap > BRIDGED + 1) | (known & (change > reach))))


def _link(xyz: Array, row: Array, frame: Array, dt: float) -> Array:
    """Return the tracklet (n,) of each point, linked from frame to frame."""
    order = np.argsort(row, kind="stable")
    bounds = np.append(np.flatnonzero(np.diff(row[order], prepend=-1)), len(order))
    number = np.full(len(xyz), -1)
    total, before, velocity = 0, np.empty(0, dtype=int), np.empty((0, 3))
    for start, stop in pairwise(bounds.tolist()):
        now = order[start:stop]
        follows = len(before) > 0 and frame[now[0]] == frame[before[0]] + 1
        of = _matched(xyz[before], velocity, xyz[now], dt) if follows else np.full(len(now), -1)
        old = of >= 0
        number[now[old]] = number[before[of[old]]]
        number[now[~old]] = total + np.arange((~old).sum())
        total += int((~old).sum())
        moved = np.full((len(now), 3), np.nan)
        moved[old] = xyz[now[old]] - xyz[before[of[old]]]
        before, velocity = now, moved
    return number


def _matched(last: Array, step: Array, now: Array, dt: float) -> Array:
    """Return the point of ``last`` (k, 3), which moved by ``step`` (NaN: unknown), of each ``now`` (n, 3), or -1."""
    known = np.isfinite(step[:, 0])
    guess = step.copy()
    if known.any() and not known.all():
        near = cKDTree(last[known]).query(last[~known], k=min(3, int(known.sum())))[1].reshape((~known).sum(), -1)
        guess[~known] = step[known][near].mean(axis=1)
    guess = np.nan_to_num(guess)
    reach = np.where(known, ACCELERATION * dt**2 + NOISE_M, FIRST_SPEED * dt + NOISE_M)
    away = np.linalg.norm((last + guess)[:, None] - now[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(away, reach[:, None]))
    found = away[rows, columns]
    # rival: another point nearly as near for this track, or another track for this point
    rival = away.copy()
    rival[rows, columns] = np.inf
    least = np.minimum(rival.min(axis=1)[rows], rival.min(axis=0)[columns])
    sure = (found < reach[rows]) & (least > CLEARLY * found + NOISE_M)
    of = np.full(len(now), -1)
    of[columns[sure]] = rows[sure]
    return of
