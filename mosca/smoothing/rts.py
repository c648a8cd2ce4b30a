"""Smoothing of finished trajectories, and gaps filled with an honest covariance.

Each track is smoothed by itself with Singer's motion (``mosca.tracking.motion_models``); the variance of its
acceleration is the likeliest of a ladder. Measured samples stay as they are: ``smoothed`` gives its estimates as
tracks of their own, ``filled`` adds samples of status ``filled`` only where a track has none. How far to trust a
model inside a gap is measured on the tracks themselves: pieces that were seen are left out, predicted and compared,
and the covariance of filled samples is scaled until these errors fit it.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Samples, Tracks, table
from mosca.smoothing.smooth_kernels import smooth_one
from mosca.tracking.motion_models import motion

LADDER = 2.0 ** np.arange(-2, 9)
"""Accelerations that are tried [m/s^2, standard deviation an axis]."""
TRIALS = 12
"""Pieces of each track that are left out to learn what a gap costs."""
ENOUGH = 30
"""Pieces that must have been tried before a covariance is made narrower than the model's."""
LASTING_S = 0.1
"""How long a half-hidden target stays so, and its error with it: that of limbs which pass each other."""
CHI2_95 = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom."""


@dataclass(frozen=True)
class SmoothSettings:
    """``memory_s``: how long an acceleration lasts; ``speed_mps``: of a track's first velocity; ``longest_gap_s``:
    gaps up to this are filled; ``acceleration_mps2``: of all tracks, None: each track's likeliest.
    """

    memory_s: float = 0.1
    speed_mps: float = 3.0
    longest_gap_s: float = 0.25
    acceleration_mps2: float | None = None


@dataclass(frozen=True, eq=False)
class _Path:
    """One track on all its instants: rows measured and, between them, instants without."""

    track: int
    frame: Array
    time_ns: Array
    xyz: Array
    covariance: Array
    measured: Array
    move: Array
    noise: Array


def smoothed(tracks: Tracks, settings: SmoothSettings | None = None) -> Tracks:
    """Return the measured samples with smoothed positions [m] and covariances [m^2]; other samples are left out.

    A smoothed position depends on the samples around it: its error is smaller, and correlated in time.
    """
    settings = SmoothSettings() if settings is None else settings
    tracks = tracks.select(np.asarray(tracks.status) == "measured")
    xyz, covariance = np.array(tracks.xyz), np.array(tracks.covariance)
    for rows in _rows_of_tracks(tracks):
        path = _path(tracks, rows, np.empty(0, np.int64), np.empty(0, np.int64), settings)
        variance = _likeliest(path, settings)
        xyz[rows], covariance[rows], _, _ = _smooth(path, path.measured, variance, settings)
    return Tracks(
        tracks.frame, tracks.time_ns, tracks.track, tracks.label, xyz, covariance,
        tracks.n_cameras, tracks.residual_px, tracks.status,
    )  # fmt: skip


def filled(tracks: Tracks, settings: SmoothSettings | None = None) -> Tracks:
    """Return ``tracks`` and, where a track pauses for ``longest_gap_s`` or less, samples of status ``filled``.

    Instants are those at which any track has a sample. Filled samples have 0 cameras and residual NaN.
    """
    settings = SmoothSettings() if settings is None else settings
    frames, first = np.unique(tracks.frame, return_index=True)
    times = np.asarray(tracks.time_ns)[first]
    measured = tracks.select(np.asarray(tracks.status) == "measured")
    paths = []
    for rows in _rows_of_tracks(measured):
        own = measured.frame[rows]
        missing = np.setdiff1d(frames[(frames > own[0]) & (frames < own[-1])], own)
        paths.append(_path(measured, rows, missing, times[np.searchsorted(frames, missing)], settings))
    variances = [_likeliest(path, settings) for path in paths]
    paths = [_with_lasting_errors(path) for path in paths]
    widths = _widening(paths, variances, settings)
    parts = [_fill(p, v, widths, settings) for p, v in zip(paths, variances, strict=True)]
    added = _named(table([part for part in parts if len(part)]), measured)
    both = [np.concatenate([getattr(tracks, n), getattr(added, n)]) for n in Tracks.__dataclass_fields__]
    together = Tracks(*both)
    return together.select(np.lexsort((together.track, together.frame)))


def _with_lasting_errors(path: _Path) -> _Path:
    """Return ``path`` with wider covariances where a target is measured worse than it mostly is.

    It is half hidden there, as it is before a gap and after it, and errs alike from one frame to the next: many
    such frames tell no more than one in ``LASTING_S`` does.
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


def _rows_of_tracks(tracks: Tracks) -> list[Array]:
    order = np.lexsort((tracks.frame, tracks.track))
    cuts = np.flatnonzero(np.diff(np.asarray(tracks.track)[order])) + 1
    return [rows for rows in np.split(order, cuts) if len(rows)]


def _path(tracks: Tracks, rows: Array, frames: Array, times: Array, settings: SmoothSettings) -> _Path:
    frame = np.concatenate([tracks.frame[rows], frames])
    time_ns = np.concatenate([tracks.time_ns[rows], times])
    order = np.argsort(time_ns, kind="stable")
    n, gap = len(frame), len(frames)
    xyz = np.concatenate([tracks.xyz[rows], np.zeros((gap, 3))])[order]
    covariance = np.concatenate([tracks.covariance[rows], np.tile(np.eye(3), (gap, 1, 1))])[order]
    measured = (np.arange(n) < len(rows))[order]
    steps = np.diff(time_ns[order], prepend=time_ns[order][0]) * 1e-9
    move, noise = axis_moves(steps, settings.memory_s)
    return _Path(
        int(tracks.track[rows[0]]), frame[order], time_ns[order], xyz, covariance, measured, move, noise
    )


def axis_moves(steps_s: Array, memory_s: float) -> tuple[Array, Array]:
    """Return transition and noise (n, 3, 3) of one axis over steps (n,) [s], noise for variance of acceleration 1."""
    move, noise = np.empty((len(steps_s), 3, 3)), np.empty((len(steps_s), 3, 3))
    for step in np.unique(steps_s):
        m = motion("acceleration", float(step), memory_s)
        move[steps_s == step] = [[1.0, m.pv, m.pa], [0.0, 1.0, m.va], [0.0, 0.0, m.aa]]
        noise[steps_s == step] = [[m.qpp, m.qpv, m.qpa], [m.qpv, m.qvv, m.qva], [m.qpa, m.qva, m.qaa]]
    return move, noise


def _smooth(
    path: _Path, measured: Array, variance: float, settings: SmoothSettings
) -> tuple[Array, Array, float, float]:
    place, spread, cost, nis = smooth_one(
        path.xyz, path.covariance, measured, path.move, path.noise, settings.speed_mps**2, variance
    )
    return place, spread, float(cost), float(nis)


def _likeliest(path: _Path, settings: SmoothSettings) -> float:
    """Return the variance of acceleration under which the path's measurements are likeliest."""
    if settings.acceleration_mps2 is not None:
        return settings.acceleration_mps2**2
    costs = [_smooth(path, path.measured, float(a) ** 2, settings)[2] for a in LADDER]
    return float(LADDER[int(np.argmin(costs))]) ** 2


def _widening(paths: list[_Path], variances: list[float], settings: SmoothSettings) -> dict[int, float]:
    """Return by gap length (instants, powers of two) how the errors compare with the model's covariance: a factor.

    Pieces that were seen are left out, as far apart as four times their length; what counts is their mean squared
    error in units of the stated covariance, over 3, or their 95 % quantile over a normal distribution's where that
    is more. It is below 1 only where ENOUGH pieces say so.
    """
    squares: dict[int, list[float]] = {}
    shares: dict[int, list[float]] = {}
    longest = max((_longest(path.measured) for path in paths), default=0)
    lengths = [2**k for k in range(12) if 2**k < 2 * longest]
    for path, variance in zip(paths, variances, strict=True):
        for length in lengths:
            hidden = _left_out(path.measured, length)
            if not hidden.any():
                continue
            place, spread, _, _ = _smooth(path, path.measured & ~hidden, variance, settings)
            away = place[hidden] - path.xyz[hidden]
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
    """Return by how much to scale a covariance for errors of these ``squares`` (n,), ``length`` of each piece.

    ``shares`` (n,): of the estimate in the errors' variance; the rest is that of the measurement compared with.
    """
    if not len(squares):
        return 1.0
    whole = max(float(squares.mean()) / 3.0, float(np.quantile(squares, 0.95)) / CHI2_95)
    whole *= 1.0 + np.sqrt(2.0 * length / (3.0 * len(squares)))  # few pieces leave it uncertain by this much
    own = float(shares.mean())
    # to take the measurements' share off where it is most of it would be guessing: narrower by the whole, never more
    factor = whole if whole < 1.0 else (whole - (1.0 - own)) / own
    return factor if len(squares) >= ENOUGH * length else max(1.0, factor)


def _longest(measured: Array) -> int:
    seen = np.flatnonzero(measured)
    return int(np.diff(seen).max(initial=1)) - 1


def _left_out(measured: Array, length: int) -> Array:
    """Return the mask of up to TRIALS pieces of ``length`` within what was measured, with room around each.

    They are spread over the whole track: how it moves changes on its way.
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


def _fill(path: _Path, variance: float, widths: dict[int, float], settings: SmoothSettings) -> Samples:
    """Return the samples that close a path's gaps."""
    place, spread, _, _ = _smooth(path, path.measured, variance, settings)
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
        path.frame[r], path.time_ns[r], np.full(n, path.track), place[r], spread[r] * factor,
        np.zeros(n, np.int64), np.full(n, np.nan), np.ones(n, np.int8),
    )  # fmt: skip
