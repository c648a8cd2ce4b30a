"""The tracker's compiled Kalman filters: predict all tracks, update them with their points, initiate new ones.

Filters of 6 or 9 states, all axes coupled, because points are far less certain along the cameras' view. The variance
of acceleration is adapted for each track from its normalised innovations squared (NIS).
"""

import numpy as np

from mosca.numba_support.decorators import bare_step, inlined_step, step
from mosca.numba_support.linalg3 import inverse3, sum3, symmetric3, times3
from mosca.tracking.state import (
    BY_MOTION,
    BY_NEIGHBOURS,
    CONFIRMED,
    FREE,
    NEXT_SERIAL,
    SLOTS_USED,
    TENTATIVE,
    UNPREDICTED,
)

ADAPTATION_RATE = 0.12
"""Rate at which the logarithm of the variance of acceleration follows the innovations, per instant."""
LARGEST_NIS_RATIO = 4.0
"""A normalised innovation squared counts up to this many times its expectation."""
EXPECTED_NIS = 3.0
"""Expectation of the normalised innovation squared: the measured degrees of freedom."""
INCONSISTENT_NIS = 16.0
"""Normalised innovation squared from which the filter was overconfident (probability 0.1 %)."""
TENTATIVE_MISSES = 2
"""A tentative track is deleted after so many instants without a point."""


@bare_step
def predict(bank, motion, time_s, coast_s, remember_s):
    """Predict all tracks one step ahead; one not seen for ``coast_s`` has no prediction by its own motion."""
    for i in range(bank.counters[SLOTS_USED]):
        if bank.state[i] == FREE:
            continue
        away = time_s - bank.seen_s[i]
        bank.source[i] = UNPREDICTED
        if away > remember_s or (bank.state[i] == TENTATIVE and away > coast_s):
            _delete(bank, i)
        elif away <= coast_s:
            _predict_one(bank.mean[i], bank.covariance[i], motion, bank.variance[i])
            bank.source[i] = BY_MOTION
            for a in range(3):
                bank.predicted[i, a] = bank.mean[i, a]
                for b in range(3):
                    bank.predicted_covariance[i, a, b] = bank.covariance[i, a, b]


@step
def predictions(bank):
    """Return predicted positions (k, 3) and covariances (k, 3, 3) of the confirmed tracks that have them."""
    top = bank.counters[SLOTS_USED]
    xyz, covariance = np.empty((top, 3)), np.empty((top, 3, 3))
    n = 0
    for i in range(top):
        if bank.state[i] == CONFIRMED and bank.source[i] != UNPREDICTED:
            for a in range(3):
                xyz[n, a] = bank.predicted[i, a]
                for b in range(3):
                    covariance[n, a, b] = bank.predicted_covariance[i, a, b]
            n += 1
    return xyz[:n], covariance[:n]


@bare_step
def update(bank, slot_of, points, jitter_s, time_s, rules, scratch):
    """Update each track with its point; a point without one begins a new track.

    ``slot_of`` (m,): slot of each point's track; -1 for none, then filled in. ``points``: ``Measurements`` (m).
    ``jitter_s``: of the triggers; it spreads moving points along their paths, which is added to their covariance.
    ``scratch``: a ``Scratch``. Returns how many confirmed tracks have no identity yet.
    """
    for row in range(slot_of.shape[0]):
        i = slot_of[row]
        if i >= 0:
            share = jitter_s * jitter_s / max(points.cameras[row], 1)
            for a in range(3):
                for b in range(3):
                    points.covariance[row, a, b] += share * bank.mean[i, 3 + a] * bank.mean[i, 3 + b]
            if bank.source[i] == BY_NEIGHBOURS and time_s - bank.seen_s[i] > rules.coast_s:
                for a in range(3):
                    bank.mean[i, 3 + a] = 0.0  # a velocity of so long ago is no information
            _update_track(bank, i, points.xyz[row], points.covariance[row], rules, scratch)
        else:
            i = _begin(bank, points.xyz[row], points.covariance[row], rules)
            bank.born_s[i], bank.reacquired_s[i], bank.missed[i] = time_s, -1.0, 0
            slot_of[row] = i
        if bank.missed[i] > 0:
            bank.reacquired_s[i], bank.lost_s[i] = time_s, bank.seen_s[i]
        bank.seen_s[i] = time_s
        bank.missed[i] = -1
        bank.reliable[i] = points.trusted[row] >= rules.reliable_from
        bank.weight[i] += max(0.0, points.trusted[row] - 1.0)
        if bank.state[i] == TENTATIVE and bank.weight[i] >= rules.confirm_weight - 1e-9:
            bank.state[i] = CONFIRMED
    nameless = 0
    for i in range(bank.counters[SLOTS_USED]):
        if bank.state[i] != FREE:
            bank.missed[i] += 1
            nameless += bank.state[i] == CONFIRMED and bank.identity[i] < 0
            if bank.state[i] == TENTATIVE and bank.missed[i] >= TENTATIVE_MISSES:
                _delete(bank, i)
    return nameless


@inlined_step
def _update_track(bank, i, xyz, covariance, rules, scratch):
    """Update a track with its point and adapt its variance of acceleration."""
    if bank.source[i] == BY_NEIGHBOURS:
        _restart(bank, i, xyz, covariance, rules.speed_mps)
        return
    size = 3 * rules.order
    nis = _update_one(bank.mean[i], bank.covariance[i], xyz, covariance, size, scratch)
    if nis > INCONSISTENT_NIS:
        _inflate(bank.covariance[i], nis / INCONSISTENT_NIS, size)
    if bank.missed[i] == 0:
        excess = min(nis / EXPECTED_NIS, LARGEST_NIS_RATIO) - 1.0
        bank.variance[i] = min(
            max(bank.variance[i] * np.exp(ADAPTATION_RATE * excess), rules.least_variance), rules.largest_variance
        )


@bare_step
def _delete(bank, i):
    bank.state[i] = FREE
    bank.serial[i] = -1
    bank.identity[i] = -1
    bank.source[i] = UNPREDICTED


@bare_step
def _begin(bank, xyz, covariance, rules):
    """Initiate a track at a point; its velocity is 0 +- ``rules.speed_mps``. Returns its slot."""
    i = 0
    while i < bank.counters[SLOTS_USED] and bank.state[i] != FREE:
        i += 1
    if i == bank.counters[SLOTS_USED]:
        bank.counters[SLOTS_USED] += 1
    bank.state[i], bank.identity[i], bank.weight[i] = TENTATIVE, -1, 0.0
    bank.variance[i] = np.sqrt(rules.least_variance * rules.largest_variance)
    bank.serial[i] = bank.counters[NEXT_SERIAL]
    bank.counters[NEXT_SERIAL] += 1
    bank.source[i] = UNPREDICTED
    for a in range(9):
        bank.mean[i, a] = 0.0
    _restart(bank, i, xyz, covariance, rules.speed_mps)
    return i


@bare_step
def _restart(bank, i, xyz, covariance, speed):
    """Restart a filter at a point; its velocity stays the best estimate, with the standard deviation ``speed``."""
    for a in range(9):
        for b in range(9):
            bank.covariance[i, a, b] = 0.0
    for a in range(3):
        bank.mean[i, a] = xyz[a]
        bank.mean[i, 6 + a] = 0.0
        bank.covariance[i, 3 + a, 3 + a] = speed * speed
        bank.covariance[i, 6 + a, 6 + a] = bank.variance[i]
        for b in range(3):
            bank.covariance[i, a, b] = covariance[a, b]


@bare_step
def _inflate(covariance, factor, size):
    """Inflate the covariance of velocity and acceleration; that of the measured position stays."""
    root = np.sqrt(factor)
    for a in range(size):
        for b in range(size):
            covariance[a, b] *= (root if a >= 3 else 1.0) * (root if b >= 3 else 1.0)


@bare_step
def _predict_one(mean, covariance, m, variance):
    """One step of a filter: F x, F P F' + Q; the same 3 x 3 kinematics for each pair of axes."""
    for a in range(3):
        mean[a] += m.pv * mean[3 + a] + m.pa * mean[6 + a]
        mean[3 + a] += m.va * mean[6 + a]
        mean[6 + a] *= m.aa
    for a in range(3):
        for b in range(a, 3):
            pp, pv, pa = covariance[a, b], covariance[a, 3 + b], covariance[a, 6 + b]
            vp, vv, va = covariance[3 + a, b], covariance[3 + a, 3 + b], covariance[3 + a, 6 + b]
            ap, av, aa = covariance[6 + a, b], covariance[6 + a, 3 + b], covariance[6 + a, 6 + b]
            # rows: F P
            pp, pv, pa = pp + m.pv * vp + m.pa * ap, pv + m.pv * vv + m.pa * av, pa + m.pv * va + m.pa * aa
            vp, vv, va = vp + m.va * ap, vv + m.va * av, va + m.va * aa
            ap, av, aa = m.aa * ap, m.aa * av, m.aa * aa
            # columns: (F P) F'
            pp, pv, pa = pp + m.pv * pv + m.pa * pa, pv + m.va * pa, m.aa * pa
            vp, vv, va = vp + m.pv * vv + m.pa * va, vv + m.va * va, m.aa * va
            ap, av, aa = ap + m.pv * av + m.pa * aa, av + m.va * aa, m.aa * aa
            if a == b:
                pp, pv, pa = pp + variance * m.qpp, pv + variance * m.qpv, pa + variance * m.qpa
                vp, vv, va = vp + variance * m.qpv, vv + variance * m.qvv, va + variance * m.qva
                ap, av, aa = ap + variance * m.qpa, av + variance * m.qva, aa + variance * m.qaa
            covariance[a, b], covariance[a, 3 + b], covariance[a, 6 + b] = pp, pv, pa
            covariance[3 + a, b], covariance[3 + a, 3 + b], covariance[3 + a, 6 + b] = vp, vv, va
            covariance[6 + a, b], covariance[6 + a, 3 + b], covariance[6 + a, 6 + b] = ap, av, aa
            if a != b:
                covariance[b, a], covariance[3 + b, a], covariance[6 + b, a] = pp, pv, pa
                covariance[b, 3 + a], covariance[3 + b, 3 + a], covariance[6 + b, 3 + a] = vp, vv, va
                covariance[b, 6 + a], covariance[3 + b, 6 + a], covariance[6 + b, 6 + a] = ap, av, aa


@bare_step
def _update_one(mean, covariance, xyz, noise, size, scratch):
    """Kalman update by a measured position; returns the normalised innovation squared (3 degrees of freedom)."""
    gain, top = scratch.gain, scratch.rows
    weight = inverse3(sum3(symmetric3(covariance), symmetric3(noise)))
    u, v, w = xyz[0] - mean[0], xyz[1] - mean[1], xyz[2] - mean[2]
    wu, wv, ww = times3(weight, u, v, w)
    nis = u * wu + v * wv + w * ww
    for a in range(size):
        x, y, z = covariance[a, 0], covariance[a, 1], covariance[a, 2]
        top[0, a], top[1, a], top[2, a] = x, y, z
        gain[a, 0], gain[a, 1], gain[a, 2] = times3(weight, x, y, z)
    for a in range(size):
        mean[a] += gain[a, 0] * u + gain[a, 1] * v + gain[a, 2] * w
        for b in range(a, size):
            p = covariance[a, b] - gain[a, 0] * top[0, b] - gain[a, 1] * top[1, b] - gain[a, 2] * top[2, b]
            covariance[a, b], covariance[b, a] = p, p
    return nis
