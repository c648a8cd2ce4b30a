"""The operation ``fill``: gaps of markers, by smoothing or from the markers of the same rigid cluster."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.rotations import aligning_rotation
from mosca.data.tracks import Tracks
from mosca.editing.operation import EditError, Frames, Labels, marker_names, rows_between, rows_of
from mosca.smoothing.gap_filling import filled
from mosca.smoothing.rts import SmoothSettings

FEWEST = 3
"""Fewest markers of a cluster, not in a line, that determine its pose."""
IN_LINE = 0.05
"""Ratio of a cluster's second largest to largest extent below which it is a line: its spin is 20 times less sure."""
TRIALS = 12
"""Most stretches of measured frames, as far apart as possible, that are predicted to measure the error."""


@dataclass(frozen=True, config=SETTINGS)
class FillGaps:
    """Fill gaps up to ``longest_s`` [s]; samples have the status "filled", 0 cameras and a measured covariance.

    Without ``cluster`` by the motion before and after (``mosca.smoothing.gap_filling``), else from the pose of three
    or more of these markers in each frame, joined to both ends of the gap.
    """

    labels: Labels | None = None
    longest_s: Positive = 0.2
    cluster: Labels | None = None
    frames: Frames | None = None

    def apply(self, take: Tracks) -> Tracks:
        """Return the take with samples added; EditError where a named marker has no gap to fill."""
        inside = np.unique(take.frame[rows_between(take.frame, self.frames)])
        names = marker_names(take) if self.labels is None else list(self.labels)
        # a sample without a position is a gap
        empty = ~np.isfinite(take.xyz).all(axis=1)
        take = take.select(~(empty & np.any([rows_of(take, name) for name in names], axis=0)))
        gaps = {name: _gaps(take, rows_of(take, name), inside) for name in names}
        short = {name: [g for g in gaps[name] if g.seconds <= self.longest_s + 1e-9] for name in names}
        for name in names:
            if not short[name] and (self.labels is not None or not any(short.values())):
                raise EditError("longest_s" if gaps[name] else "labels", _without(name, gaps[name], self.longest_s))
        wanted = {name: some for name, some in short.items() if some}
        if self.cluster is None:
            added = _by_smoothing(take, wanted, self.longest_s)
        else:
            added = [_by_cluster(take, name, some, self.cluster) for name, some in wanted.items()]
        both = [np.concatenate([getattr(one, n) for one in (take, *added)]) for n in Tracks.__dataclass_fields__]
        together = Tracks(*both)
        return together.select(np.lexsort((together.track, together.frame)))


@dataclass(frozen=True)
class _Gap:
    missing: tuple[int, ...]  # frames
    seconds: float  # between the samples at its two ends
    before: int  # row of the last sample before it


def _without(name: str, gaps: list[_Gap], longest_s: float) -> str:
    if not gaps:
        return f"'{name}' given; it has no gap between samples there: leave it out"
    told = ", ".join(f"{g.missing[0]} to {g.missing[-1]} ({g.seconds:.3g} s)" for g in gaps[:5])
    return f"{longest_s:g} given; the gaps of '{name}' are longer: frames {told}; fill from a cluster, or give more"


def _gaps(take: Tracks, rows: Array, inside: Array) -> list[_Gap]:
    """Return the gaps of a marker that lie wholly within ``inside`` (k,), frames of the take."""
    own = np.flatnonzero(rows)
    own = own[np.argsort(take.frame[own], kind="stable")]
    found = []
    every = np.unique(take.frame)
    for a, b in pairwise(own):
        missing = (
            every[(every > take.frame[a]) & (every < take.frame[b])] if take.frame[b] > take.frame[a] + 1 else ()
        )
        if len(missing) and np.isin(missing, inside).all():
            seconds = 1e-9 * float(take.time_ns[b] - take.time_ns[a])
            found.append(_Gap(tuple(int(f) for f in missing), seconds, int(a)))
    return found


def _new(take: Tracks, gap: _Gap, xyz: Array, covariance: Array) -> Tracks:
    frames, first = np.unique(take.frame, return_index=True)
    n = len(gap.missing)
    return Tracks(
        np.array(gap.missing), take.time_ns[first[np.searchsorted(frames, gap.missing)]],
        np.full(n, take.track[gap.before]), np.full(n, take.label[gap.before]), xyz, covariance,
        np.zeros(n, np.int64), np.full(n, np.nan), np.full(n, "filled"),
    )  # fmt: skip


def _by_smoothing(take: Tracks, gaps: dict[str, list[_Gap]], longest_s: float) -> list[Tracks]:
    # One track per marker, since a gap may lie between two tracks. Other tracks only provide their instants.
    track = np.full(len(take), -1)
    covariance = np.array(take.covariance)
    for k, name in enumerate(gaps):
        rows = rows_of(take, name)
        track[rows] = k
        unknown = rows & ~np.isfinite(take.covariance).all(axis=(1, 2))
        covariance[unknown] = _noise_m(take.xyz[rows]) ** 2 * np.eye(3)
    seen = (track >= 0) & (take.status != "predicted")
    status = np.where(seen, "measured", "filled")
    whole = filled(replace(take, track=track, covariance=covariance, status=status), SmoothSettings(
        longest_gap_s=longest_s
    ))  # fmt: skip
    added = []
    for k, some in enumerate(gaps.values()):
        own = whole.select((whole.track == k) & (whole.status == "filled"))
        for gap in some:
            new = own.select(np.isin(own.frame, gap.missing))
            added.append(_new(take, gap, new.xyz, new.covariance))
    return added


def _noise_m(xyz: Array) -> float:
    """Return the standard deviation per axis [m] of positions (n, 3) without a covariance.

    It is estimated from third differences, in which smooth motion is small and white noise has 20 times its variance.
    Their median excludes gaps and jerks. The result is at least a micrometre.
    """
    third = np.abs(np.diff(xyz, 3, axis=0))
    return max(float(np.median(third)) / 0.6745 / np.sqrt(20.0), 1e-6) if len(third) else 1e-3


def _by_cluster(take: Tracks, name: str, gaps: list[_Gap], cluster: Labels) -> Tracks:
    if name in cluster or len(set(cluster)) < FEWEST:
        raise EditError("cluster", f"{list(cluster)} given; {FEWEST} or more other markers than '{name}' are wanted")
    frames = np.unique(take.frame)
    grid = np.full((1 + len(cluster), len(frames), 3), np.nan)
    for k, one in enumerate((name, *cluster)):
        rows = rows_of(take, one, "cluster" if k else "labels")
        grid[k, np.searchsorted(frames, take.frame[rows])] = take.xyz[rows]
    marker, others = grid[0], grid[1:].transpose(1, 0, 2)
    parts = []
    for gap in gaps:
        at = np.searchsorted(frames, gap.missing)
        xyz = _carried(marker, others, int(at[0]), len(at))
        if not np.isfinite(xyz).all():
            bad = gap.missing[int(np.argmax(~np.isfinite(xyz).all(axis=1)))]
            raise EditError(
                "cluster",
                f"{list(cluster)} given; in frame {bad} fewer than {FEWEST} of them, not in a line, are there and "
                f"at the ends of the gap of '{name}' from {gap.missing[0]} to {gap.missing[-1]}",
            )
        parts.append(_new(take, gap, xyz, np.tile(_error2(marker, others, len(at)) * np.eye(3), (len(at), 1, 1))))
    return Tracks(*(np.concatenate([getattr(p, n) for p in parts]) for n in Tracks.__dataclass_fields__))


def _carried(marker: Array, others: Array, start: int, n: int) -> Array:
    """Return the marker's path (n, 3) from ``start`` on, fixed to the ``others`` (t, m, 3); NaN if undetermined.

    It is computed with the place in the frame before the path and with that in the frame after it, and blended from
    one to the other in proportion to time.
    """
    share = (np.arange(n) + 1.0)[:, None] / (n + 1)
    ends = [
        np.array([_moved(others[end], others[start + k], marker[end]) for k in range(n)])
        for end in (start - 1, start + n)
    ]
    result: Array = (1.0 - share) * ends[0] + share * ends[1]
    return result


def _moved(before: Array, after: Array, point: Array) -> Array:
    """Return ``point`` (3,) moved as the markers (m, 3) from ``before`` to ``after`` (Kabsch 1976), or NaN."""
    both = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if both.sum() < FEWEST:
        return np.full(3, np.nan)
    a, b = before[both].mean(axis=0), after[both].mean(axis=0)
    sizes = np.linalg.svd((before[both] - a).T @ (after[both] - b), compute_uv=False)
    if sizes[1] < IN_LINE**2 * sizes[0]:
        return np.full(3, np.nan)
    result: Array = aligning_rotation(before[both], after[both]) @ (point - a) + b
    return result


def _error2(marker: Array, others: Array, n: int) -> float:
    """Return the variance per axis [m^2] of such predictions over n measured frames; NaN without such stretches."""
    seen = np.isfinite(marker).all(axis=1)
    whole = np.convolve(seen, np.ones(n + 2), "valid") > n + 1.5
    starts = np.flatnonzero(whole) + 1
    some = starts[np.unique(np.linspace(0, len(starts) - 1, min(TRIALS, len(starts))).astype(int))]
    away = [_carried(marker, others, int(k), n) - marker[k : k + n] for k in some]
    finite = [one for one in away if np.isfinite(one).all()]
    return float(np.mean(np.square(finite))) if finite else float("nan")
