"""Smoothing of finished tracks: Rauch-Tung-Striebel with Singer's motion, each track by itself.

The variance of a track's acceleration is the likeliest of a ladder of values. The compiled smoother is a Kalman
filter forwards and Bryson and Frazier's recursion backwards. This form (Bierman 1973) needs no inverse of a predicted
covariance, so that instants without a measurement are only steps without an update. Matrices this small are
multiplied in loops: a library call costs more, and is slow to compile.
"""

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.tracks import Tracks
from mosca.numba_support.decorators import kernel, step
from mosca.numba_support.linalg3 import cofactors3, determinant3, divided3, store3, sum3, symmetric3
from mosca.tracking.motion_models import motion
from mosca.tracking.state import Scratch

LADDER = 2.0 ** np.arange(-2, 9)
"""Accelerations that are tried [m/s^2, standard deviation an axis]."""


@dataclass(frozen=True, config=SETTINGS)
class SmoothSettings:
    """How targets move, for smoothing and filling of finished tracks."""

    memory_s: Positive = 0.1
    """Correlation time of the acceleration [s]."""
    speed_mps: Positive = 3.0
    """Standard deviation of a track's first velocity, an axis."""
    longest_gap_s: NotNegative = 0.25
    """Gaps up to this are filled."""
    acceleration_mps2: NotNegative | None = None
    """Standard deviation of all tracks' acceleration, an axis; None: each track's likeliest."""


@plain_dataclass(frozen=True, eq=False)
class TrackInstants:
    """One track on all its instants: measured ones and, between them, instants without a measurement."""

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
    for rows in rows_of_tracks(tracks):
        path = instants_of(tracks, rows, np.empty(0, np.int64), np.empty(0, np.int64), settings)
        variance = likeliest_variance(path, settings)
        xyz[rows], covariance[rows], _, _ = smooth_track(path, path.measured, variance, settings)
    return replace(tracks, xyz=xyz, covariance=covariance)


def rows_of_tracks(tracks: Tracks) -> list[Array]:
    """Return the rows of each track, in order of time."""
    order = np.lexsort((tracks.frame, tracks.track))
    cuts = np.flatnonzero(np.diff(np.asarray(tracks.track)[order])) + 1
    return [rows for rows in np.split(order, cuts) if len(rows)]


def instants_of(tracks: Tracks, rows: Array, frames: Array, times: Array, settings: SmoothSettings) -> TrackInstants:
    """Return the track in ``rows`` (n,), with instants without a measurement at ``frames`` and ``times`` (k,)."""
    frame = np.concatenate([tracks.frame[rows], frames])
    time_ns = np.concatenate([tracks.time_ns[rows], times])
    order = np.argsort(time_ns, kind="stable")
    n, gap = len(frame), len(frames)
    xyz = np.concatenate([tracks.xyz[rows], np.zeros((gap, 3))])[order]
    covariance = np.concatenate([tracks.covariance[rows], np.tile(np.eye(3), (gap, 1, 1))])[order]
    measured = (np.arange(n) < len(rows))[order]
    steps = np.diff(time_ns[order], prepend=time_ns[order][0]) * 1e-9
    move, noise = axis_moves(steps, settings.memory_s)
    return TrackInstants(
        int(tracks.track[rows[0]]), frame[order], time_ns[order], xyz, covariance, measured, move, noise
    )


def axis_moves(steps_s: Array, memory_s: float) -> tuple[Array, Array]:
    """Return transition and noise (n, 3, 3) of one axis over steps (n,) [s], noise for variance of acceleration 1."""
    move, noise = np.empty((len(steps_s), 3, 3)), np.empty((len(steps_s), 3, 3))
    for step_s in np.unique(steps_s):
        m, same = motion("acceleration", float(step_s), memory_s), steps_s == step_s
        move[same] = [[1.0, m.pv, m.pa], [0.0, 1.0, m.va], [0.0, 0.0, m.aa]]
        noise[same] = [[m.qpp, m.qpv, m.qpa], [m.qpv, m.qvv, m.qva], [m.qpa, m.qva, m.qaa]]
    return move, noise


def smooth_track(
    path: TrackInstants, measured: Array, variance: float, settings: SmoothSettings
) -> tuple[Array, Array, float, float]:
    """Smooth a track of which only the ``measured`` (t,) instants count; return what ``smooth_one`` does."""
    xyz, spread, cost, nis = smooth_one(
        path.xyz, path.covariance, measured, path.move, path.noise, settings.speed_mps**2, variance
    )
    return xyz, spread, float(cost), float(nis)


def likeliest_variance(path: TrackInstants, settings: SmoothSettings) -> float:
    """Return the variance of acceleration under which the path's measurements are likeliest."""
    if settings.acceleration_mps2 is not None:
        return settings.acceleration_mps2**2
    costs = [smooth_track(path, path.measured, float(a) ** 2, settings)[2] for a in LADDER]
    return float(LADDER[int(np.argmin(costs))]) ** 2


class _Filtered(NamedTuple):
    """Results of the forward pass over t instants for the backward pass."""

    predicted_p: Array
    """(t, 9, 9) covariance before the update."""
    x: Array
    """(t, 9) state after it."""
    p: Array
    """(t, 9, 9)"""
    inverse: Array
    """(t, 3, 3) of the innovation's covariance, 0 without a measurement."""
    innovation: Array
    """(t, 3)"""


@kernel
def smooth_one(xyz, covariance, measured, move, noise, speed2, variance):
    """Smooth one trajectory of t instants.

    Returns positions (t, 3), covariances (t, 3, 3), -2 log-likelihood and mean normalised innovation squared.

    Parameters
    ----------
    xyz, covariance
        (t, 3), (t, 3, 3): used where ``measured``.
    measured
        (t,), the first one True.
    move, noise
        (t, 3, 3): one axis' transition and noise from the previous instant, for unit variance of acceleration; the
        first is not used.
    speed2
        Variance of the first velocity.
    variance
        Of the acceleration.
    """
    t = xyz.shape[0]
    filtered = _Filtered(
        np.empty((t, 9, 9)), np.empty((t, 9)), np.empty((t, 9, 9)), np.zeros((t, 3, 3)), np.zeros((t, 3))
    )
    cost, nis = _forward(xyz, covariance, measured, move, noise, speed2, variance, filtered)
    position, spread = np.empty((t, 3)), np.empty((t, 3, 3))
    _backward(measured, move, filtered, position, spread)
    return position, spread, cost, nis


@kernel
def smooth_states(xyz, covariance, measured, move, noise, speed2, variance):
    """Smooth one trajectory as ``smooth_one`` does.

    Returns position, velocity and acceleration (t, 9), their covariances (t, 9, 9) and -2 log-likelihood.
    """
    t = xyz.shape[0]
    filtered = _Filtered(
        np.empty((t, 9, 9)), np.empty((t, 9)), np.empty((t, 9, 9)), np.zeros((t, 3, 3)), np.zeros((t, 3))
    )
    cost, _ = _forward(xyz, covariance, measured, move, noise, speed2, variance, filtered)
    state, spread = np.empty((t, 9)), np.empty((t, 9, 9))
    _backward(measured, move, filtered, state, spread)
    return state, spread, cost


@step
def _forward(xyz, covariance, measured, move, noise, speed2, variance, filtered):
    """Run the Kalman filter; fill ``filtered``, return -2 log-likelihood and mean normalised innovation squared."""
    x, p, scratch = np.zeros(9), np.zeros((9, 9)), Scratch(np.empty((9, 3)), np.empty((3, 9)))
    for a in range(3):
        x[a] = xyz[0, a]
        for b in range(3):
            p[a, b] = covariance[0, a, b]
        p[3 + a, 3 + a], p[6 + a, 6 + a] = speed2, variance
    cost, nis, count = 0.0, 0.0, 0
    for k in range(xyz.shape[0]):
        if k > 0:
            predict_state(x, move[k])
            predict_covariance(p, move[k])
            add_process_noise(p, noise[k], variance)
        _copy(p, filtered.predicted_p, k)
        if measured[k] and k > 0:
            inverse, innovation = filtered.inverse[k], filtered.innovation[k]
            for a in range(3):
                innovation[a] = xyz[k, a] - x[a]
            determinant = innovation_inverse(p, covariance[k], inverse)
            square = 0.0
            for a in range(3):
                for b in range(3):
                    square += innovation[a] * inverse[a, b] * innovation[b]
            update_state(x, p, innovation, inverse, scratch)
            cost += square + np.log(determinant)
            nis += square
            count += 1
        for i in range(9):
            filtered.x[k, i] = x[i]
        _copy(p, filtered.p, k)
    return cost, nis / max(count, 1)


@step
def _backward(measured, move, filtered, state, spread):
    """Run Bryson and Frazier's recursion; fill the state's first s of 9 values (t, s), covariances (t, s, s)."""
    # lead, weight: adjoint of the later measurements, at the corrected state
    lead, weight, left, work = np.zeros(9), np.zeros((9, 9)), np.empty((9, 9)), np.empty((9, 9))
    f = np.empty((3, 3))
    for k in range(state.shape[0] - 1, -1, -1):
        for a in range(state.shape[1]):
            state[k, a] = filtered.x[k, a]
            for i in range(9):
                state[k, a] -= filtered.p[k, a, i] * lead[i]
                work[a, i] = 0.0
                for j in range(9):
                    work[a, i] += filtered.p[k, a, j] * weight[j, i]
            for b in range(state.shape[1]):
                spread[k, a, b] = filtered.p[k, a, b]
                for i in range(9):
                    spread[k, a, b] -= work[a, i] * filtered.p[k, b, i]
        if k == 0:
            break
        if measured[k]:
            inverse, innovation = filtered.inverse[k], filtered.innovation[k]
            for i in range(9):
                for j in range(9):
                    left[i, j] = 1.0 if i == j else 0.0
                for b in range(3):
                    for a in range(3):
                        left[i, b] -= filtered.predicted_p[k, i, a] * inverse[a, b]
            _adjoint(left, lead, weight, work)
            for a in range(3):
                for b in range(3):
                    lead[a] -= inverse[a, b] * innovation[b]
                    weight[a, b] += inverse[a, b]
        for i in range(3):
            for j in range(3):
                f[i, j] = move[k, j, i]
        predict_state(lead, f)
        predict_covariance(weight, f)


@step
def add_process_noise(p, noise, variance):
    """Add to a covariance (9, 9) one axis' noise (3, 3) for an acceleration of ``variance``."""
    for i in range(3):
        for j in range(3):
            for a in range(3):
                p[3 * i + a, 3 * j + a] += variance * noise[i, j]


@step
def innovation_inverse(p, covariance, inverse):
    """Fill the inverse (3, 3) of a position's innovation covariance; returns its determinant."""
    s = sum3(symmetric3(p), symmetric3(covariance))
    cofactors = cofactors3(s)
    determinant = determinant3(s, cofactors)
    store3(divided3(cofactors, determinant), inverse)
    return determinant


@step
def _copy(p, kept, k):
    for i in range(9):
        for j in range(9):
            kept[k, i, j] = p[i, j]


@step
def _adjoint(left, lead, weight, work):
    """Carry ``lead`` (9,) and ``weight`` (9, 9) back over an update: left' lead and left' weight left."""
    for i in range(9):
        for j in range(9):
            work[i, j] = 0.0
            for k in range(9):
                work[i, j] += weight[i, k] * left[k, j]
    for i in range(9):
        for j in range(9):
            weight[i, j] = 0.0
            for k in range(9):
                weight[i, j] += left[k, i] * work[k, j]
    for i in range(9):
        work[0, i] = 0.0
        for k in range(9):
            work[0, i] += left[k, i] * lead[k]
    for i in range(9):
        lead[i] = work[0, i]


@step
def predict_state(x, f):
    """Multiply position, velocity and acceleration of three axes (9,) by one axis' transition (3, 3), in place."""
    for a in range(3):
        u, v, w = x[a], x[3 + a], x[6 + a]
        for i in range(3):
            x[3 * i + a] = f[i, 0] * u + f[i, 1] * v + f[i, 2] * w


@step
def predict_covariance(p, f):
    """Multiply a state's symmetric covariance (9, 9) by one axis' transition (3, 3) from both sides, in place."""
    for _ in range(2):
        for i in range(9):
            for a in range(3):
                u, v, w = p[i, a], p[i, 3 + a], p[i, 6 + a]
                for k in range(3):
                    p[i, 3 * k + a] = f[k, 0] * u + f[k, 1] * v + f[k, 2] * w
        for i in range(9):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]


@step
def update_state(x, p, innovation, inverse, scratch):
    """Kalman update of a state (9,) and its covariance (9, 9) in place by the innovation (3,) of a position.

    ``inverse`` (3, 3) of the innovation's covariance. ``scratch``: filled with the covariance's first rows before the
    update and the gain.
    """
    top, gain = scratch.rows, scratch.gain
    for i in range(9):
        for b in range(3):
            top[b, i] = p[b, i]
    for i in range(9):
        for b in range(3):
            gain[i, b] = top[0, i] * inverse[0, b] + top[1, i] * inverse[1, b] + top[2, i] * inverse[2, b]
        x[i] += gain[i, 0] * innovation[0] + gain[i, 1] * innovation[1] + gain[i, 2] * innovation[2]
    for i in range(9):
        for j in range(i + 1):
            less = gain[i, 0] * top[0, j] + gain[i, 1] * top[1, j] + gain[i, 2] * top[2, j]
            same = gain[j, 0] * top[0, i] + gain[j, 1] * top[1, i] + gain[j, 2] * top[2, i]
            p[i, j] = p[j, i] = 0.5 * (p[i, j] - less + p[j, i] - same)
