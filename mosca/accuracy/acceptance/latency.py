"""Latency: time at which a result was available minus mid-exposure of its frame, in the manner of ASTM E3124.

Not "per" ASTM E3124: the standard's text was not at hand; the definition is from its abstract.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.accuracy.acceptance.decision import Decided, decided
from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import parsed, read_columns

COLUMNS = ("frame", "available_ns")


@dataclass(frozen=True, eq=False)
class ResultArrivals:
    """Columns of the times at which results were available, by the clock of the tracks' ``time_ns``."""

    frame: Array
    """(n,) pulse number, each at most once."""
    available_ns: Array
    """(n,) time [ns]."""


@dataclass(frozen=True)
class LatencyResult:
    """Latency over all frames with tracks and an arrival."""

    samples: int
    mean_s: float
    p99_s: float
    max_s: float
    sigma_p99_s: float
    """Standard uncertainty of the percentile, from the order statistics about it."""
    decided: Decided | None


def read_arrivals(path: Path) -> ResultArrivals:
    """Read an ``arrivals.csv`` with columns ``frame,available_ns``; InputError names line and column."""
    cells = read_columns(Path(path), COLUMNS, "arrivals.csv")
    frame, available = (parsed(cells[name], name, int, Path(path)) for name in COLUMNS)
    every, counts = np.unique(frame, return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{path}: frame {every[counts > 1][0]} stands twice; give each frame once")
    return ResultArrivals(frame, available)


def latency_result(tracks: Tracks, arrivals: ResultArrivals, limit_s: float | None, source: str) -> LatencyResult:
    """Return the latency of the frames of ``tracks`` in ``arrivals``; InputError for no frame or negative latency."""
    frame, first = np.unique(tracks.frame, return_index=True)
    _, a, b = np.intersect1d(frame, arrivals.frame, return_indices=True)
    if not len(a):
        raise InputError(f"{source}: no frame of the tracks is in it; it must be of the same take")
    late_s = np.sort((arrivals.available_ns[b] - tracks.time_ns[first][a]) * 1e-9)
    if late_s[0] < 0:
        raise InputError(
            f"{source}: a result is available {-late_s[0]:.3g} s before its mid-exposure; both must be of one clock"
        )
    n = len(late_s)
    p99 = float(late_s[int(np.ceil(0.99 * n)) - 1])
    # the rank of a quantile has a binomial distribution
    reach = np.sqrt(n * 0.99 * 0.01)
    low, high = (late_s[int(np.clip(np.ceil(0.99 * n + way * reach) - 1, 0, n - 1))] for way in (-1, 1))
    sigma = float(high - low) / 2
    judged = None if limit_s is None else decided(p99, limit_s, sigma)
    return LatencyResult(n, float(late_s.mean()), p99, float(late_s[-1]), sigma, judged)
