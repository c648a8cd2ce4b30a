"""The tracker's filters, compiled: carry all targets to an instant, correct them by their points, begin new ones.

Kalman filters of 6 or 9 states, all axes coupled, because points are far less certain along the cameras' view.
The acceleration's variance is learned for each target from its normalised innovations squared.
"""

import numpy as np

from mosca.numba_support.decorators import bare_step, step
from mosca.tracking.state import BY_LIMB, BY_MOTION, CONFIRMED, FREE, NOWHERE, SERIAL, TENTATIVE, TOP

LEARNING = 0.12
"""How fast the variance of acceleration follows the innovations (its logarithm, an instant)."""
LOUDEST = 4.0
"""A normalised innovation counts up to this many times what is expected."""
OUTBURST = 16.0
"""Normalised innovation squared from which the filter believed in itself too much (chance of 0.1 %)."""
TENTATIVE_MISSES = 2
"""A tentative target that is so often not seen where it should be was none."""


@bare_step
def carry(bank, motion, time_s, coast_s, memory_s):  # type: ignore[no-untyped-def]
    """Carry all targets by one step; who has not been seen for ``coast_s`` is expected nowhere."""
    for i in range(bank.numbers[TOP]):
        if bank.state[i] == FREE:
            continue
        away = time_s - bank.seen_s[i]
        bank.source[i] = NOWHERE
        if away > memory_s or (bank.state[i] == TENTATIVE and away > coast_s):
            _forget(bank, i)
        elif away <= coast_s:
            _carry_one(bank.mean[i], bank.covariance[i], motion, bank.variance[i])
            bank.source[i] = BY_MOTION
            for a in range(3):
                bank.place[i, a] = bank.mean[i, a]
                for b in range(3):
                    bank.place_covariance[i, a, b] = bank.covariance[i, a, b]


@step
def expected(bank):  # type: ignore[no-untyped-def]
    """Return places (k, 3) and covariances (k, 3, 3) of the confirmed targets expected somewhere."""
    top = bank.numbers[TOP]
    place, covariance = np.empty((top, 3)), np.empty((top, 3, 3))
    n = 0
    for i in range(top):
        if bank.state[i] == CONFIRMED and bank.source[i] != NOWHERE:
            for a in range(3):
                place[n, a] = bank.place[i, a]
                for b in range(3):
                    covariance[n, a, b] = bank.place_covariance[i, a, b]
            n += 1
    return place[:n], covariance[:n]


@bare_step
def correct(  # type: ignore[no-untyped-def]
    bank, slot_of, xyz, covariance, cameras, trusted, jitter_s, time_s, order, lowest, highest, speed,
    confirm_weight, sure_from, gain, top
):  # fmt: skip
    """Give each point to its target, ``slot_of`` (m,); a point without one (-1) begins a new target.

    ``slot_of`` is completed. ``covariance`` (m, 3, 3): of points that stand still; ``jitter_s`` of the triggers
    of their ``cameras`` (m,) spreads moving ones along their paths, and is added. ``lowest``, ``highest``: limits of
    the variance of acceleration. ``gain`` (9, 3), ``top`` (3, 9): scratch. Returns how many confirmed targets have no
    identity yet.
    """
    for row in range(slot_of.shape[0]):
        i = slot_of[row]
        if i >= 0:
            share = jitter_s * jitter_s / max(cameras[row], 1)
            for a in range(3):
                for b in range(3):
                    covariance[row, a, b] += share * bank.mean[i, 3 + a] * bank.mean[i, 3 + b]
        if i < 0:
            i = _begin(bank, xyz[row], covariance[row], speed, np.sqrt(lowest * highest))
            bank.born_s[i], bank.back_s[i], bank.missed[i] = time_s, -1.0, 0
            slot_of[row] = i
        elif bank.source[i] == BY_LIMB:
            _begin_again(bank, i, xyz[row], covariance[row], speed)
        else:
            nis = _correct_one(
                bank.mean[i], bank.covariance[i], xyz[row], covariance[row], 3 * order, gain, top
            )
            if nis > OUTBURST:
                _loosen(bank.covariance[i], nis / OUTBURST, 3 * order)
            if bank.missed[i] == 0:
                louder = min(nis / 3.0, LOUDEST) - 1.0
                bank.variance[i] = min(max(bank.variance[i] * np.exp(LEARNING * louder), lowest), highest)
        if bank.missed[i] > 0:
            bank.back_s[i], bank.gone_s[i] = time_s, bank.seen_s[i]
        bank.seen_s[i] = time_s
        bank.missed[i] = -1
        bank.sure[i] = trusted[row] >= sure_from
        bank.weight[i] += max(0.0, trusted[row] - 1.0)
        if bank.state[i] == TENTATIVE and bank.weight[i] >= confirm_weight - 1e-9:
            bank.state[i] = CONFIRMED
    nameless = 0
    for i in range(bank.numbers[TOP]):
        if bank.state[i] != FREE:
            bank.missed[i] += 1
            nameless += bank.state[i] == CONFIRMED and bank.identity[i] < 0
            if bank.state[i] == TENTATIVE and bank.missed[i] >= TENTATIVE_MISSES:
                _forget(bank, i)
    return nameless


@bare_step
def _forget(bank, i):  # type: ignore[no-untyped-def]
    bank.state[i] = FREE
    bank.serial[i] = -1
    bank.identity[i] = -1
    bank.source[i] = NOWHERE


@bare_step
def _begin(bank, xyz, covariance, speed, variance):  # type: ignore[no-untyped-def]
    """Open a slot for a new target at a point; its velocity is unknown to ``speed``."""
    i = 0
    while i < bank.numbers[TOP] and bank.state[i] != FREE:
        i += 1
    if i == bank.numbers[TOP]:
        bank.numbers[TOP] += 1
    bank.state[i], bank.identity[i], bank.weight[i], bank.variance[i] = TENTATIVE, -1, 0.0, variance
    bank.serial[i] = bank.numbers[SERIAL]
    bank.numbers[SERIAL] += 1
    bank.source[i] = NOWHERE
    for a in range(9):
        bank.mean[i, a] = 0.0
    _begin_again(bank, i, xyz, covariance, speed)
    return i


@bare_step
def _begin_again(bank, i, xyz, covariance, speed):  # type: ignore[no-untyped-def]
    """Put a target at a point anew; its velocity, unknown to ``speed``, is kept as the best guess."""
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
def _loosen(covariance, factor, size):  # type: ignore[no-untyped-def]
    """Widen what is known of velocity and acceleration; the measured position stays what it is."""
    root = np.sqrt(factor)
    for a in range(size):
        for b in range(size):
            covariance[a, b] *= (root if a >= 3 else 1.0) * (root if b >= 3 else 1.0)


@bare_step
def _carry_one(mean, covariance, m, variance):  # type: ignore[no-untyped-def]
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
def _correct_one(mean, covariance, xyz, noise, size, gain, top):  # type: ignore[no-untyped-def]
    """Kalman update by a measured position; returns the normalised innovation squared (3 degrees of freedom).

    ``gain`` (9, 3), ``top`` (3, 9): scratch.
    """
    s00, s01, s02 = (
        covariance[0, 0] + noise[0, 0],
        covariance[0, 1] + noise[0, 1],
        covariance[0, 2] + noise[0, 2],
    )
    s11, s12, s22 = (
        covariance[1, 1] + noise[1, 1],
        covariance[1, 2] + noise[1, 2],
        covariance[2, 2] + noise[2, 2],
    )
    c00, c01, c02 = s11 * s22 - s12 * s12, s02 * s12 - s01 * s22, s01 * s12 - s02 * s11
    det = s00 * c00 + s01 * c01 + s02 * c02
    i00, i01, i02 = c00 / det, c01 / det, c02 / det
    i11, i12, i22 = (
        (s00 * s22 - s02 * s02) / det,
        (s01 * s02 - s00 * s12) / det,
        (s00 * s11 - s01 * s01) / det,
    )
    u, v, w = xyz[0] - mean[0], xyz[1] - mean[1], xyz[2] - mean[2]
    nis = (
        u * (i00 * u + i01 * v + i02 * w)
        + v * (i01 * u + i11 * v + i12 * w)
        + w * (i02 * u + i12 * v + i22 * w)
    )
    for a in range(size):
        x, y, z = covariance[a, 0], covariance[a, 1], covariance[a, 2]
        top[0, a], top[1, a], top[2, a] = x, y, z
        gain[a, 0] = x * i00 + y * i01 + z * i02
        gain[a, 1] = x * i01 + y * i11 + z * i12
        gain[a, 2] = x * i02 + y * i12 + z * i22
    for a in range(size):
        mean[a] += gain[a, 0] * u + gain[a, 1] * v + gain[a, 2] * w
        for b in range(a, size):
            p = covariance[a, b] - gain[a, 0] * top[0, b] - gain[a, 1] * top[1, b] - gain[a, 2] * top[2, b]
            covariance[a, b], covariance[b, a] = p, p
    return nis
