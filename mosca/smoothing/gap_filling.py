"""Filling of gaps in finished tracks, with a covariance that is measured on the tracks themselves.

Measured samples stay as they are; samples of status ``filled`` are added only where a track has none. The errors of
the motion model inside a gap are measured: intervals that were seen are left out, predicted and compared. The
covariance of filled samples is scaled until it fits these errors.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Samples, Tracks, table
from mosca.smoothing.rts import (
    SmoothSettings,
    TrackInstants,
    instants_of,
    likeliest_variance,
    rows_of_tracks,
    smooth_track,
)

TRIALS = 12
"""Intervals of each track that are left out to measure the error inside a gap."""
ENOUGH = 30
"""Intervals that must have been tried before a covariance is made smaller than the model's."""
LASTING_S = 0.1
"""Typical duration of a partial occlusion [s], over which its error is correlated: limbs that pass each other."""
CHI2_95 = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom."""


def filled(tracks: Tracks, settings: SmoothSettings | None = None) -> Tracks:
    """Return ``tracks`` and, where a track pauses for ``longest_gap_s`` or less, samples of status ``filled``.

    Instants are those at which any track has a sample. Filled samples have 0 cameras and residual NaN.
    """
    settings = SmoothSettings() if settings is None else settings
    frames, first = np.unique(tracks.frame, return_index=True)
    times = np.asarray(tracks.time_ns)[first]
    measured = tracks.select(np.asarray(tracks.status) == "measured")
    paths = []
    for rows in rows_of_tracks(measured):
        own = measured.frame[rows]
        missing = np.setdiff1d(frames[(frames > own[0]) & (frames < own[-1])], own)
        paths.append(instants_of(measured, rows, missing, times[np.searchsorted(frames, missing)], settings))
    variances = [likeliest_variance(path, settings) for path in paths]
    paths = [_with_lasting_errors(path) for path in paths]
    widths = _widening(paths, variances, settings)
    parts = [_fill(p, v, widths, settings) for p, v in zip(paths, variances, strict=True)]
    added = _named(table([part for part in parts if len(part)]), measured)
    both = [np.concatenate([getattr(tracks, n), getattr(added, n)]) for n in Tracks.__dataclass_fields__]
    together = Tracks(*both)
    return together.select(np.lexsort((together.track, together.frame)))


def _with_lasting_errors(path: TrackInstants) -> TrackInstants:
    """Return ``path`` with wider covariances where a target is measured worse than it mostly is.

    There the target is partly occluded, as before and after a gap, and its errors are correlated: frames within
    ``LASTING_S`` hold no more information than one.
    """
    size = np.trace(path.covariance, axis1=1, axis2=2)
    usual = np.median(size[path.measured])
    step = np.median(np.diff(path.time_ns)) * 1e-9 if len(size) > 1 else LASTING_S
    frames = max(LASTING_S / step, 1.0)
    worse = np.clip(1.0 - usual / size, 0.0, 1.0)
    factor = np.where(path.measured, 1.0 + (frames - 1.0) * worse, 1.0)
    return replace(path, covariance=path.covariance * factor[:, None, None])


def _named(added: Tracks, measured: Tracks) -> Tracks:
    """Return filled samples with the labels that their tracks have."""
    some = measured.select(measured.label != "")
    label_of = dict(zip(some.track.tolist(), some.label.tolist(), strict=True))
    labels = np.array([label_of.get(track, "") for track in added.track.tolist()], dtype=np.str_)
    return replace(added, label=labels)


def _widening(paths: list[TrackInstants], variances: list[float], settings: SmoothSettings) -> dict[int, float]:
    """Return, by gap length (instants, powers of two), the factor of the observed errors over the model's covariance.

    Intervals that were seen are left out, four times their length apart. The factor is their mean squared error in
    units of the stated covariance, over 3, or their 95 % quantile over that of a normal distribution where this is
    more. It is below 1 only where ENOUGH intervals were tried.
    """
    squares: dict[int, list[float]] = {}
    shares: dict[int, list[float]] = {}
    longest = max((int(np.diff(np.flatnonzero(path.measured)).max(initial=1)) - 1 for path in paths), default=0)
    lengths = [2**k for k in range(12) if 2**k < 2 * longest]
    for path, variance in zip(paths, variances, strict=True):
        for length in lengths:
            hidden = _left_out(path.measured, length)
            if not hidden.any():
                continue
            xyz, spread, _, _ = smooth_track(path, path.measured & ~hidden, variance, settings)
            away = xyz[hidden] - path.xyz[hidden]
            total = spread[hidden] + path.covariance[hidden]
            nees = np.einsum("ni,ni->n", away, np.linalg.solve(total, away[:, :, None])[:, :, 0])
            squares.setdefault(length, []).extend(nees.tolist())
            own = np.trace(spread[hidden], axis1=1, axis2=2) / np.trace(total, axis1=1, axis2=2)
            shares.setdefault(length, []).extend(own.tolist())
    return {
        length: _factor(np.array(squares.get(length, [])), np.array(shares.get(length, [])), length)
        for length in lengths
    }


def _factor(squares: Array, shares: Array, length: int) -> float:
    """Return the factor on a covariance for errors with these ``squares`` (n,), ``length`` of them an interval.

    ``shares`` (n,): shares of the estimate in the errors' variance; the rest is that of the measurement it is
    compared with.
    """
    if not len(squares):
        return 1.0
    whole = max(float(squares.mean()) / 3.0, float(np.quantile(squares, 0.95)) / CHI2_95)
    whole *= 1.0 + np.sqrt(2.0 * length / (3.0 * len(squares)))  # few intervals leave it uncertain by this much
    own = float(shares.mean())
    # where the measurements' share dominates, subtracting it is unreliable: narrow by the total factor at most
    factor = whole if whole < 1.0 else (whole - (1.0 - own)) / own
    result: float = factor if len(squares) >= ENOUGH * length else max(1.0, factor)
    return result


def _left_out(measured: Array, length: int) -> Array:
    """Return the mask of up to TRIALS measured intervals of ``length``, with a margin around each.

    They are spread over the whole track, since its motion varies.
    """
    starts, at = [], 2 * length + 1
    while at + 3 * length < len(measured):
        if measured[at - length : at + 2 * length].all():
            starts.append(at)
            at += 4 * length
        at += 1
    hidden = np.zeros(len(measured), bool)
    for k in np.unique(np.linspace(0, len(starts) - 1, min(TRIALS, len(starts))).round().astype(int)):
        hidden[starts[k] : starts[k] + length] = True
    return hidden


def _fill(path: TrackInstants, variance: float, widths: dict[int, float], settings: SmoothSettings) -> Samples:
    """Return the samples that close a path's gaps."""
    xyz, spread, _, _ = smooth_track(path, path.measured, variance, settings)
    seen = np.flatnonzero(path.measured)
    rows: list[int] = []
    wide: list[float] = []
    for a, b in pairwise(seen.tolist()):
        if b > a + 1 and (path.time_ns[b] - path.time_ns[a]) * 1e-9 <= settings.longest_gap_s + 1e-9:
            length = min(k for k in widths if k >= b - a - 1)
            rows += range(a + 1, b)
            wide += [widths[length]] * (b - a - 1)
    r, n = np.array(rows, dtype=int), len(rows)
    factor = np.array(wide).reshape(-1, 1, 1)
    return Samples(
        path.frame[r], path.time_ns[r], np.full(n, path.track), xyz[r], spread[r] * factor,
        np.zeros(n, np.int64), np.full(n, np.nan), np.ones(n, np.int8),
    )  # fmt: skip
