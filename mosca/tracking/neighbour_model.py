"""Neighbour model: learned constant distances between tracks, used while a marker is occluded.

Markers of one rigid segment keep their distances. Which distances are constant is learned from the tracks: for each
track, the mean and the variance of its distances to ``NEIGHBOURS`` others. An occluded marker is predicted from them:
it follows the rigid motion of its neighbours since it was last seen (``mosca.tracking.neighbour_motion``). They also
decide whether a new track is a lost one.
"""

import numpy as np

from mosca.numba_support.decorators import bare_step, kernel, short_kernel, step
from mosca.tracking.neighbour_motion import OBSERVED_HALF_S, carried_along, distance_variance, observed_now
from mosca.tracking.state import (
    BY_MOTION,
    BY_NEIGHBOURS,
    CONFIRMED,
    FREE,
    INSTANT,
    NEIGHBOURS,
    SLOTS_USED,
    Bank,
    Neighbours,
)

REPLACED_FROM, USED_UP_TO = 0.05, 0.15
"""Standard deviation of a distance over its length from which another neighbour is tried, and up to which a distance
is evidence for a track."""
RELAXED_S = 0.5
"""Correlation time of a distance's deviation from its mean [s]."""
RATE_WINDOW_S = 2.0
"""Time over which the rate of change of a distance is averaged [s]: movements differ from one to the next."""
WINDOW_S = 20.0
"""Time over which distances are averaged [s]."""
UPDATE_EVERY, SEARCH_EVERY, EXCHANGED = 1, 16, 3
"""Instants from one update of a track's distances to the next; updates from one search for better neighbours to the
next; how many of the worst neighbours a search exchanges at most."""
FOREIGN = 0.05
"""Prior probability that a distance does not fit for another reason (a neighbour exchanged, clutter)."""
OUTLIER_CHI2, OUTLIER_RATE = 16.0, 0.2
"""Squared deviation of a distance, in variances, from which it is taken for an outlier, and the factor on the
learning rate of outliers."""
LARGEST_RATIO = 1e6
"""Largest likelihood ratio that one distance contributes."""
SECOND_BEHIND = 3.0
"""Log-likelihood ratio by which the second best lost track must be behind."""


@kernel
def learn_distances(bank, neighbours, step_s, reach_m):
    """Update the distances of all tracks just seen and keep the positions; search for better neighbours at times.

    ``reach_m``: largest distance [m] of a neighbour.
    """
    bank.counters[INSTANT] += 1
    instant = bank.counters[INSTANT]
    update_s = UPDATE_EVERY * max(step_s, 1e-6)
    for i in range(bank.counters[SLOTS_USED]):
        if bank.state[i] != CONFIRMED or bank.missed[i] != 0:
            continue
        due = (i + instant) % UPDATE_EVERY == 0
        if neighbours.slot[i, 0] < 0 or (due and (i + instant) // UPDATE_EVERY % SEARCH_EVERY == 0):
            _search(bank, neighbours, i, reach_m, instant // (UPDATE_EVERY * SEARCH_EVERY))
        if not bank.reliable[i]:
            continue
        for k in range(NEIGHBOURS):
            if due and neighbours.valid[i, k] and observed_now(bank, neighbours, i, k):
                _learn_rate(bank, neighbours, i, k, update_s)
        # index scalars; slicing costs a reference-count update
        for a in range(3):
            neighbours.own_xyz_last_seen[i, a] = bank.mean[i, a]
            for b in range(3):
                neighbours.rotation[i, a, b] = 1.0 if a == b else 0.0
        for k in range(NEIGHBOURS):
            j = neighbours.slot[i, k]
            valid = observed_now(bank, neighbours, i, k) and bank.reliable[j]
            neighbours.valid[i, k] = valid
            if not valid:
                continue
            for a in range(3):
                neighbours.xyz_last_seen[i, k, a] = bank.mean[j, a]
            if due:
                _learn_one(neighbours, i, k, _track_distance(bank, i, j), update_s)


@bare_step
def _learn_one(neighbours: Neighbours, i: int, k: int, measured: float, update_s: float) -> None:
    """Update mean and variance of a distance with the ``measured`` one [m], by exponential averages."""
    mean, variance, observed_s = (neighbours.distance[i, k], neighbours.variance[i, k], neighbours.observed_s[i, k])
    away = measured - mean
    rate = min(update_s / min(observed_s + update_s, WINDOW_S), 1.0)
    # a sudden change is more likely a wrong point than a changed segment
    if observed_s > 2 * OBSERVED_HALF_S and away * away > OUTLIER_CHI2 * distance_variance(
        mean, variance, observed_s
    ):
        rate *= OUTLIER_RATE
    neighbours.variance[i, k] = (1.0 - rate) * (variance + rate * away * away)
    neighbours.distance[i, k] = mean + rate * away
    neighbours.observed_s[i, k] = observed_s + update_s


@bare_step
def _learn_rate(bank, neighbours, i, k, update_s):
    """Update the rate of change of a distance, by its value when both tracks were last seen."""
    before = _distance(neighbours.own_xyz_last_seen[i], neighbours.xyz_last_seen[i, k])
    change = (_track_distance(bank, i, neighbours.slot[i, k]) - before) / update_s
    rate = min(update_s / min(neighbours.observed_s[i, k] + update_s, RATE_WINDOW_S), 1.0)
    neighbours.rate2[i, k] += rate * (change * change - neighbours.rate2[i, k])


@step
def predict_hidden(bank, neighbours, time_s, step_s, widest_m):
    """Predict each hidden track from its neighbours where that is more certain than its own motion.

    Predictions whose standard deviation exceeds ``widest_m`` [m, of the 3D distance] are not used.
    """
    xyz, covariance = np.empty(3), np.empty((3, 3))
    for i in range(bank.counters[SLOTS_USED]):
        if bank.state[i] != CONFIRMED or bank.missed[i] == 0:
            continue
        trace = carried_along(bank, neighbours, i, time_s - bank.seen_s[i], step_s, xyz, covariance)
        if not trace < widest_m * widest_m:
            continue
        p = bank.predicted_covariance[i]
        if bank.source[i] == BY_MOTION and p[0, 0] + p[1, 1] + p[2, 2] < trace:
            continue
        bank.source[i] = BY_NEIGHBOURS
        for a in range(3):
            bank.predicted[i, a] = xyz[a]
            for b in range(3):
                bank.predicted_covariance[i, a, b] = covariance[a, b]


@short_kernel
def reidentified(bank, neighbours, i, time_s, least, range_m, speed_mps):
    """Return the lost track whose distances the unnamed slot ``i`` fits, or -1, and whether any is possible.

    ``least`` is the log-likelihood ratio required. A lost track is possible if its distances are known and if it
    could have moved here from where it was lost.
    """
    best, second, found, possible = -np.inf, -np.inf, -1, False
    for j in range(bank.counters[SLOTS_USED]):
        if bank.state[j] != CONFIRMED or bank.identity[j] < 0 or bank.missed[j] == 0:
            continue
        hidden_s = time_s - bank.seen_s[j]
        moved = _distance(bank.mean[i], neighbours.own_xyz_last_seen[j])
        if moved > range_m + speed_mps * hidden_s or bank.born_s[i] < bank.seen_s[j]:
            continue
        possible |= _has_distances(neighbours, j)
        fits = distance_evidence(bank, neighbours, j, bank.mean[i], bank.covariance[i], hidden_s, range_m)
        if fits > best:
            best, second, found = fits, best, j
        elif fits > second:
            second = fits
    return (found if best >= least and best > second + SECOND_BEHIND else -1), possible


@short_kernel
def reacquired_nearby(bank, i, time_s, near_m):
    """Return the track that was reacquired at this instant at the unnamed slot ``i``'s prediction, or -1.

    Only a track that was lost before ``i`` began: then ``i`` was the same target all the time.
    """
    for j in range(bank.counters[SLOTS_USED]):
        known = bank.state[j] == CONFIRMED and bank.identity[j] >= 0
        back = bank.reacquired_s[j] == time_s and bank.born_s[i] > bank.lost_s[j]
        if known and back and _distance(bank.mean[i], bank.mean[j]) < near_m:
            return j
    return -1


@short_kernel
def take_over(bank, old, new):
    """Continue slot ``old`` with the filter of slot ``new``, which becomes free."""
    for a in range(9):
        bank.mean[old, a] = bank.mean[new, a]
        for b in range(9):
            bank.covariance[old, a, b] = bank.covariance[new, a, b]
    bank.seen_s[old], bank.missed[old], bank.reliable[old] = (bank.seen_s[new], bank.missed[new], bank.reliable[new])
    bank.variance[old] = bank.variance[new]
    bank.state[new], bank.serial[new], bank.identity[new] = FREE, -1, -1


@bare_step
def distance_evidence(bank, neighbours, i, point, noise, hidden_s, range_m):
    """Return the log-likelihood ratio that ``point`` (3,) is of track ``i``, by its distances to neighbours seen now.

    ``noise`` (3, 3): covariance of the point; ``hidden_s``: time since the track was last seen; ``range_m``: other
    targets have a density of one in this range.
    """
    own = (noise[0, 0] + noise[1, 1] + noise[2, 2]) / 3.0
    kept = np.exp(-hidden_s / RELAXED_S)
    total = 0.0
    for k in range(NEIGHBOURS):
        # a distance seen together with the track may be used at once: its variance shows how uncertain it is
        known = neighbours.observed_s[i, k] > OBSERVED_HALF_S or neighbours.valid[i, k]
        if known and observed_now(bank, neighbours, i, k):
            expected, variance = neighbours.distance[i, k], neighbours.variance[i, k]
            spread2 = distance_variance(expected, variance, neighbours.observed_s[i, k])
            if neighbours.valid[i, k]:
                # a distance returns from its last value to its mean, and its variance grows (Ornstein-Uhlenbeck), at
                # first at the observed rate of change
                last = _distance(neighbours.own_xyz_last_seen[i], neighbours.xyz_last_seen[i, k])
                away = last - expected
                grown = min(neighbours.rate2[i, k] * hidden_s * hidden_s, max(variance, away * away))
                spread2 += max(grown, (1.0 - kept * kept) * variance) - variance
                expected += kept * away
            spread2 += own
            if spread2 > (USED_UP_TO * expected) ** 2:
                continue
            away = _distance(point, bank.mean[neighbours.slot[i, k]]) - expected
            # Student's t with one degree of freedom per posture: few of them hardly predict the next one
            freedom = max(neighbours.observed_s[i, k] / RELAXED_S, 1.0)
            ratio = (1.0 + away * away / (freedom * spread2)) ** (-0.5 * (freedom + 1.0))
            ratio *= range_m / np.sqrt(2.0 * np.pi * spread2)
            total += np.log((1.0 - FOREIGN) * min(ratio, LARGEST_RATIO) + FOREIGN)
    return total


@bare_step
def _has_distances(neighbours: Neighbours, i: int) -> bool:
    """Whether at least two distances of a track are known to stay the same."""
    known = 0
    for k in range(NEIGHBOURS):
        distance, observed_s = neighbours.distance[i, k], neighbours.observed_s[i, k]
        spread2 = distance_variance(distance, neighbours.variance[i, k], observed_s)
        seen = observed_s > OBSERVED_HALF_S or neighbours.valid[i, k]
        known += seen and spread2 < (USED_UP_TO * distance) ** 2
    return known >= 2


@bare_step
def _search(bank, neighbours, i, reach_m, round_number):
    """Fill empty entries with the nearest other tracks, and exchange the worst for the nearest new ones."""
    empty = neighbours.slot[i, 0] < 0
    for k in range(NEIGHBOURS):
        j = neighbours.slot[i, k]
        if j >= 0 and bank.serial[j] != neighbours.serial[i, k]:
            neighbours.slot[i, k] = -1
    for _ in range(NEIGHBOURS if empty else EXCHANGED):
        worst, at = -1.0, -1
        for k in range(NEIGHBOURS):
            if neighbours.slot[i, k] < 0:
                worst, at = np.inf, k
            elif neighbours.observed_s[i, k] > 2 * OBSERVED_HALF_S and neighbours.variance[i, k] > worst:
                worst, at = neighbours.variance[i, k], k
        if at < 0:
            return
        if neighbours.slot[i, at] >= 0 and worst < (REPLACED_FROM * neighbours.distance[i, at]) ** 2:
            return
        found, nearest2 = _nearest_other(bank, neighbours, i, reach_m, empty, round_number)
        if found < 0:
            return
        neighbours.slot[i, at], neighbours.serial[i, at] = found, bank.serial[found]
        neighbours.distance[i, at], neighbours.variance[i, at] = np.sqrt(nearest2), 0.0
        neighbours.rate2[i, at] = neighbours.observed_s[i, at] = 0.0
        neighbours.valid[i, at] = False


@bare_step
def _nearest_other(bank, neighbours, i, reach_m, every, round_number):
    """Return the nearest track within reach that is no neighbour of ``i`` yet, or -1, and its squared distance.

    Unless ``every``, a third of the tracks is searched at a time, so that a dropped neighbour does not return at
    once.
    """
    nearest2, found = reach_m * reach_m, -1
    for j in range(0 if every else -round_number % 3, bank.counters[SLOTS_USED], 1 if every else 3):
        if j == i or bank.state[j] != CONFIRMED or bank.missed[j] != 0:
            continue
        x = bank.mean[j, 0] - bank.mean[i, 0]
        y = bank.mean[j, 1] - bank.mean[i, 1]
        z = bank.mean[j, 2] - bank.mean[i, 2]
        away2 = x * x + y * y + z * z
        if away2 < nearest2:
            is_neighbour = False
            for k in range(NEIGHBOURS):
                is_neighbour |= neighbours.slot[i, k] == j
            if not is_neighbour:
                nearest2, found = away2, j
    return found, nearest2


@bare_step
def _track_distance(bank: Bank, i: int, j: int) -> float:
    x, y, z = bank.mean[i, 0], bank.mean[i, 1], bank.mean[i, 2]
    u, v, w = bank.mean[j, 0], bank.mean[j, 1], bank.mean[j, 2]
    result: float = np.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2)
    return result


@bare_step
def _distance(a, b):
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
