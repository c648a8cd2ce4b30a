"""Gating: which points may belong to which tracks, and the score of each pair for data association."""

from typing import NamedTuple

import numpy as np

from mosca.numba_support.decorators import bare_step, inlined_step, step
from mosca.numba_support.linalg3 import mahalanobis3, plus_identity3, sum3, symmetric3
from mosca.numba_support.order import stable_order
from mosca.tracking.neighbour_model import distance_evidence
from mosca.tracking.state import BY_MOTION, CONFIRMED, SLOTS_USED, UNPREDICTED

SEEN_BONUS = 16.0
"""-2 log of the probability that a track seen at the last instant is not seen now."""
MANOEUVRE_COST = 9.0
"""-2 log of the probability that a target accelerates far beyond what it has shown."""
CONTRADICTED = -2.0
"""Log-likelihood ratio of inter-marker distances below which an unreliable point is not taken by a hidden track."""
LEAST_GATE = 0.25
"""Share of the largest gate in which a confirmed track takes a point of the least weight."""


class Gate(NamedTuple):
    """Gate of one track."""

    reach: float
    """Euclidean radius [m]."""
    manoeuvre: float
    """Variance [m^2] that a sudden manoeuvre adds to the prediction; 0 for a track predicted by its neighbours."""
    offset: float
    """Score of a point at the prediction whose innovation has a covariance of determinant 1."""


@step
def gated_pairs(bank, neighbours, points, used, state, rules, time_s):
    """Return the pairs of tracks in ``state`` and unused points within the gates: slots, rows and scores (k,).

    Score: twice the log-likelihood ratio of "this track's point" against "a new target's", where new targets have a
    density of one in a gate; greater than 0. For each track that its own motion predicts, a sudden manoeuvre
    (``rules.manoeuvre_mps2``) is the alternative hypothesis; the likelier of the two counts. A point that a hidden
    track reaches by a manoeuvre must also fit the track's distances.
    """
    xyz, covariance = points.xyz, points.covariance
    top, m = bank.counters[SLOTS_USED], xyz.shape[0]
    capacity, n = 4 * (m + top) + 16, 0
    slots, rows, scores = np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity)
    if m == 0:
        return slots[:0], rows[:0], scores[:0]
    axis = _widest_axis(xyz)
    along = np.ascontiguousarray(xyz[:, axis])
    order = stable_order(along)
    along = along[order]
    loosest = 0.0
    for r in range(m):
        loosest = max(loosest, covariance[r, 0, 0] + covariance[r, 1, 1] + covariance[r, 2, 2])
    offset = rules.gate_sigma**2 + 3.0 * np.log(rules.gate_m**2)
    for i in range(top):
        if bank.state[i] != state or bank.source[i] == UNPREDICTED:
            continue
        p, expected = bank.predicted_covariance[i], bank.predicted[i]
        manoeuvre = 0.0
        if bank.source[i] == BY_MOTION:
            manoeuvre = min(0.5 * rules.manoeuvre_mps2 * (time_s - bank.seen_s[i]) ** 2, rules.gate_m) ** 2
        spread = np.sqrt(p[0, 0] + p[1, 1] + p[2, 2] + 3.0 * manoeuvre + loosest)
        gate = Gate(min(rules.gate_m, rules.gate_sigma * spread), manoeuvre, offset)
        for k in range(np.searchsorted(along, expected[axis] - gate.reach), m):
            if along[k] > expected[axis] + gate.reach:
                break
            r = order[k]
            if used[r] >= 0:
                continue
            score = _score(bank, neighbours, i, points, r, gate, rules, time_s)
            if score <= 0.0:
                continue
            if n == capacity:
                capacity *= 2
                slots, rows, scores = _longer(slots, rows, scores)
            slots[n], rows[n], scores[n] = i, r, score
            n += 1
    return slots[:n], rows[:n], scores[:n]


@bare_step
def _widest_axis(xyz):
    """Return the axis along which the points (m, 3) spread farthest."""
    axis, widest = 0, -1.0
    for a in range(3):
        low, high = xyz[0, a], xyz[0, a]
        for r in range(xyz.shape[0]):
            low, high = min(low, xyz[r, a]), max(high, xyz[r, a])
        if high - low > widest:
            axis, widest = a, high - low
    return axis


@inlined_step
def _score(bank, neighbours, i, points, r, gate, rules, time_s):
    """Return the score of track ``i`` with point ``r``, 0 or below where it lies outside a gate."""
    x = points.xyz[r, 0] - bank.predicted[i, 0]
    y = points.xyz[r, 1] - bank.predicted[i, 1]
    z = points.xyz[r, 2] - bank.predicted[i, 2]
    p, covariance, trusted = bank.predicted_covariance[i], points.covariance[r], points.trusted[r]
    away2 = x * x + y * y + z * z
    if away2 > gate.reach * gate.reach:
        return -1.0
    evidence = min(max((trusted - 1.0) / 2.0, LEAST_GATE), 1.0) if bank.state[i] == CONFIRMED else 1.0
    if away2 > (rules.gate_m * evidence) ** 2:
        return -1.0
    score = -1.0
    innovation_covariance = sum3(symmetric3(p), symmetric3(covariance))
    away, determinant = mahalanobis3(innovation_covariance, x, y, z)
    if away <= rules.gate_sigma**2:
        score = gate.offset - away - np.log(determinant)
    if gate.manoeuvre > 0.0 and away > MANOEUVRE_COST:
        wider = plus_identity3(innovation_covariance, gate.manoeuvre)
        farther, determinant = mahalanobis3(wider, x, y, z)
        if farther <= rules.gate_sigma**2:
            score = max(score, gate.offset - farther - np.log(determinant) - MANOEUVRE_COST)
    if score <= 0.0:
        return score
    if bank.missed[i] == 0 and away <= rules.gate_sigma**2:
        # a track without an identity yields to one that was lost here
        score += SEEN_BONUS if bank.state[i] != CONFIRMED or bank.identity[i] >= 0 else 0.0
    elif bank.missed[i] > 0:
        # add the log-likelihood ratio of the distances to that of the position; an unreliable point is too often
        # clutter
        hidden_s = time_s - bank.seen_s[i]
        fits = distance_evidence(bank, neighbours, i, points.xyz[r], covariance, hidden_s, rules.gate_m)
        score += min(2.0 * fits, 0.0)
        if fits < CONTRADICTED and trusted < rules.reliable_from:
            return -1.0
        if away > rules.gate_sigma**2 and fits <= 0.0:
            return -1.0
    return score


@step
def _longer(slots, rows, scores):
    """Return the columns of the pairs with twice the capacity."""
    n = slots.shape[0]
    more = np.empty(2 * n, np.int64), np.empty(2 * n, np.int64), np.empty(2 * n)
    for k in range(n):
        more[0][k], more[1][k], more[2][k] = slots[k], rows[k], scores[k]
    return more
