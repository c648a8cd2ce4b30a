"""Interpolating curves: positions of tracks between the instants at which they were measured."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks


@dataclass(frozen=True, eq=False)
class SampledCurves:
    """Tracks as curves (``mosca.continuous.model.observations.Curves``): cubic Hermite pieces through their samples.

    ``points``: names; ``track`` (points,): numbers of their tracks; ``start`` (points + 1,): first sample of each;
    ``time_s`` (n,): rising within a point; ``xyz`` and ``speed`` (n, 3). A curve is unknown before the first and
    after the last sample of its point and in gaps above ``longest_s``.
    """

    points: tuple[str, ...]
    track: Array
    start: Array
    time_s: Array
    xyz: Array
    speed: Array
    longest_s: float

    @classmethod
    def of(cls, tracks: Tracks, fewest: int, longest_s: float) -> "SampledCurves":
        """Return the curves of tracks of at least ``fewest`` samples, named m000, m001 and so on by age."""
        measured = tracks.select(tracks.status == "measured")
        order = np.lexsort((measured.time_ns, measured.track))
        track, time_s = measured.track[order], measured.time_ns[order] * 1e-9
        xyz = measured.xyz[order]
        numbers, first, count = np.unique(track, return_index=True, return_counts=True)
        kept = np.flatnonzero(count >= fewest)
        kept = kept[np.argsort(time_s[first[kept]], kind="stable")]
        rows = [np.arange(first[k], first[k] + count[k]) for k in kept]
        start = np.concatenate([[0], np.cumsum(count[kept])]).astype(np.int64)
        at = np.concatenate(rows) if rows else np.empty(0, np.int64)
        names = tuple(f"m{k:03d}" for k in range(len(kept)))
        speeds = [np.gradient(xyz[r], time_s[r], axis=0) for r in rows]
        speed = np.concatenate(speeds) if rows else np.empty((0, 3))
        return cls(names, numbers[kept], start, time_s[at], xyz[at], speed, longest_s)

    def at(self, time_s: Array) -> Array:
        """Return the positions (t, points, 3) at ``time_s`` (t,) [s], world frame [m]; NaN where unknown."""
        wanted = np.asarray(time_s, dtype=float)
        out = np.full((len(wanted), len(self.points), 3), np.nan)
        for k in range(len(self.points)):
            own = slice(self.start[k], self.start[k + 1])
            t, p, v = self.time_s[own], self.xyz[own], self.speed[own]
            inside = np.flatnonzero((wanted >= t[0]) & (wanted <= t[-1]))
            left = np.clip(np.searchsorted(t, wanted[inside], "right") - 1, 0, len(t) - 2)
            h = t[left + 1] - t[left]
            near = h <= self.longest_s
            inside, left, h = inside[near], left[near], h[near][:, None]
            u = (wanted[inside] - t[left])[:, None] / h
            place = (1 + 2 * u) * (1 - u) ** 2 * p[left] + u * (1 - u) ** 2 * h * v[left]
            out[inside, k] = place + u**2 * (3 - 2 * u) * p[left + 1] - u**2 * (1 - u) * h * v[left + 1]
        return out
