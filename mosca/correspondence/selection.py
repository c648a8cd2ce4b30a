"""Selection of the hypotheses that are targets: compiled steps of ``mosca.correspondence.match``.

It follows ``mosca.correspondence.candidates``. Hypotheses are selected greedily by likelihood ratio against clutter,
best first; each image is used once. A hypothesis that loses images to a better one is tried again with those that
remain: at once or, if only two remain, after all others. Pairs that are ambiguous in two cameras are left open.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.correspondence.hypothesis import (
    CHI2,
    COVARIANCE,
    DIAMETER,
    GAIN,
    NONE,
    TWICE,
    VALUES,
    XYZ,
    acceptable,
    new_hypothesis,
    solve,
    store,
    too_large,
    wholeness,
)
from mosca.correspondence.spatial_index import buckets, within
from mosca.data.rays import EDGES, SIGMA
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.linalg3 import Symmetric3, mahalanobis3
from mosca.numba_support.order import stable_order
from mosca.triangulation.triangulate import TRUST, WHOLE

CLEARLY_WORSE = 9.0
"""Chi-square, 3 standard deviations, by which competing pairs must be worse for a pair to be unambiguous: larger
leaves more pairs open, smaller accepts more wrong ones."""
PRIOR_SEEN = 5.0
"""Prior of the detection probability, as so many images detected and as many missed (Laplace smoothing)."""
OPEN, TAKEN, GONE = 0, 1, 2
ONE_OF_TWO, USED_UP = 1, 2
"""How a hypothesis uses an image: another one may use it, too, or none."""


class TrackPredictions(NamedTuple):
    """Predictions of tracks."""

    xyz: Any
    covariance: Any
    line: Any
    """Their intervals along x (``mosca.correspondence.spatial_index``)."""
    assigned: Any
    """(k,) whether an accepted hypothesis is assigned to the track."""


class LogPrior(NamedTuple):
    """Logarithms of the density of hypotheses [1/m^3], of the shares of cameras that miss and that see a target."""

    density: float
    missed: float
    seen: float


@step
def choose(kept, data, xyz, covariance):
    """Return the state (n,) of each hypothesis: OPEN (a pair that others contest), TAKEN or GONE.

    Changes hypotheses that lose rays in place. ``xyz`` (k, 3), ``covariance`` (k, 3, 3): predictions of the tracks.
    """
    values, members = kept.values, kept.members
    n, cameras = members.shape
    used = np.zeros(data.rays.shape[0], dtype=np.int64)
    assigned = np.zeros(xyz.shape[0], dtype=np.bool_)
    state, hypothesis = np.zeros(n, dtype=np.int8), new_hypothesis(cameras)
    half = data.rules[0].support_sigma * np.sqrt(covariance[:, 0, 0])
    tracks = TrackPredictions(xyz, covariance, buckets(xyz[:, 0].copy(), half), assigned)
    prior = LogPrior(_log_density(values, xyz), *_log_detection_shares(values, members, data.views))
    track, worth = np.full(n, -1, dtype=np.int64), np.zeros(n)
    found = np.empty(xyz.shape[0], dtype=np.int64)
    for last in (False, True):
        for g in range(n):
            if state[g] == OPEN:
                track[g], worth[g] = _worth(g, kept, tracks, prior, data, found)
        order = np.flatnonzero(state == OPEN)
        order = order[stable_order(-worth[order])]
        at = NONE
        while at < order.shape[0]:
            g = order[at]
            if track[g] >= 0 and assigned[track[g]]:
                track[g], worth[g] = _worth(g, kept, tracks, prior, data, found)
                if _put_back(order, at, worth):
                    continue
            # clutter explains it better, and no track predicts it
            if worth[g] < 0.0 and track[g] < 0:
                state[g] = GONE
            elif _rivalled(g, order, state, members, track, worth):
                pass  # two images for one: the next frame set tells which
            elif _take(g, kept, track, used, assigned, data):
                state[g] = TAKEN
            elif _has_used(g, members, used):
                left = _shrink(g, kept, used, hypothesis, data)
                if left == 0:
                    state[g] = GONE
                elif last or left > 2:
                    # at once: the reduced hypothesis may be better than the next one with the same rays
                    track[g], worth[g] = _worth(g, kept, tracks, prior, data, found)
                    _put_back(order, at, worth)
                    continue
                # a pair that remains of more rays waits for hypotheses that were found as pairs
            at += 1
    for g in range(n):
        if state[g] == OPEN and _has_used(g, members, used):
            state[g] = GONE
    _take_uncontested(values, members, state, used)
    return state


@bare_step
def _worth(g, kept, tracks, prior, data, found):
    """Return the track that best predicts a hypothesis, or -1, and the hypothesis's log-likelihood ratio."""
    values = kept.values[g]
    support = data.rules[0].support_sigma
    near = within(tracks.line, values[XYZ], support * np.sqrt(values[COVARIANCE]), found)
    track, gained = _best_track(
        values, tracks.xyz, tracks.covariance, tracks.assigned, support, prior.density, found, near
    )
    seen, missing = _seen_and_missing(g, kept.values, kept.members, data.views)
    return track, values[GAIN] + prior.density + gained + missing * prior.missed + seen * prior.seen


@bare_step
def _put_back(order, at, worth):
    """Move the hypothesis ``order[at]`` behind all that are worth more now; return whether there were any."""
    g, k = order[at], at
    while k + 1 < order.shape[0] and worth[order[k + 1]] > worth[g]:
        order[k] = order[k + 1]
        k += 1
    order[k] = g
    return k > at


@bare_step
def _has_used(g, members, used):
    """Whether another hypothesis has taken a ray of this one."""
    count = 0
    for c in range(members.shape[1]):
        count += members[g, c] >= 0 and used[members[g, c]] > 0
    return count > 0


@bare_step
def _rivalled(g, order, state, members, track, worth):
    """Whether another pair that shares a ray and a track with this one is about as likely."""
    pair = 0
    for c in range(members.shape[1] if track[g] >= 0 else 0):
        pair += members[g, c] >= 0
    if pair != 2:
        return False
    for other in order:
        if other == g or state[other] != OPEN or track[other] != track[g]:
            continue
        if abs(worth[other] - worth[g]) > 0.5 * CLEARLY_WORSE:
            continue
        rays = shared = 0
        for c in range(members.shape[1]):
            rays += members[other, c] >= 0
            shared += members[other, c] >= 0 and members[other, c] == members[g, c]
        if rays == 2 and shared == 1:
            return True
    return False


@step
def _log_density(values, xyz):
    """Return the logarithm of the density of hypotheses [1/m^3] in the box that they and the tracks fill."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(3):
        for g in range(values.shape[0]):
            low[k], high[k] = min(low[k], values[g, XYZ + k]), max(high[k], values[g, XYZ + k])
        for t in range(xyz.shape[0]):
            low[k], high[k] = min(low[k], xyz[t, k]), max(high[k], xyz[t, k])
    side = high - low
    if values.shape[0] == 0:
        return 0.0
    longest = max(side[0], side[1], side[2])
    return np.log(values.shape[0] / max(side[0] * side[1] * side[2], 1e-9 * longest**3, 1e-18))


@bare_step
def _log_detection_shares(values, members, views):
    """Return the logarithms of the shares of cameras that miss, and that see, a target in their field of view.

    They are estimated from this frame set's hypotheses of three or more rays, as far as there are enough.
    """
    seen, missed = PRIOR_SEEN, PRIOR_SEEN
    for g in range(members.shape[0]):
        count, missing = _seen_and_missing(g, values, members, views)
        if count > 2:
            seen += count
            missed += missing
    return np.log(missed / (seen + missed)), np.log(seen / (seen + missed))


@bare_step
def _seen_and_missing(g, values, members, views):
    """Return how many cameras have a ray in a hypothesis, and how many have its point in view but no ray."""
    seen = count = 0
    for c in range(members.shape[1]):
        if members[g, c] >= 0:
            seen += 1
            continue
        x, y, z = (values[g, XYZ] - views[c, 0], values[g, XYZ + 1] - views[c, 1], values[g, XYZ + 2] - views[c, 2])
        w = np.sqrt(x * x + y * y + z * z) + views[c, 5] * x + views[c, 8] * y + views[c, 11] * z
        if not w > 0.0:
            continue
        u = (views[c, 3] * x + views[c, 6] * y + views[c, 9] * z) / w
        v = (views[c, 4] * x + views[c, 7] * y + views[c, 10] * z) / w
        count += views[c, EDGES] < u < views[c, EDGES + 2] and views[c, EDGES + 1] < v < views[c, EDGES + 3]
    return seen, count


@bare_step
def _best_track(values, xyz, covariance, assigned, gate, density, found, near):
    """Return the track among ``found[:near]`` that best predicts a hypothesis, or -1, and its score.

    The score is the log-likelihood ratio of "this track's target" against "a hypothesis anywhere": small for a track
    that has not been seen for long, since its prediction is uncertain.
    """
    best, worth, gate2 = -1, 0.0, gate * gate
    for k in range(near):
        t = found[k]
        if assigned[t]:
            continue
        x, y, z = (values[XYZ] - xyz[t, 0], values[XYZ + 1] - xyz[t, 1], values[XYZ + 2] - xyz[t, 2])
        innovation = Symmetric3(
            covariance[t, 0, 0] + values[COVARIANCE],
            covariance[t, 0, 1] + values[COVARIANCE + 1],
            covariance[t, 0, 2] + values[COVARIANCE + 2],
            covariance[t, 1, 1] + values[COVARIANCE + 4],
            covariance[t, 1, 2] + values[COVARIANCE + 5],
            covariance[t, 2, 2] + values[COVARIANCE + 8],
        )
        if x * x > gate2 * innovation.xx or y * y > gate2 * innovation.yy or z * z > gate2 * innovation.zz:
            continue
        away2, det = mahalanobis3(innovation, x, y, z)
        if not away2 < gate2:
            continue
        ratio = -density - 0.5 * np.log(det * (2.0 * np.pi) ** 3) - 0.5 * away2
        if ratio > worth:
            best, worth = t, ratio
    return best, worth


@bare_step
def _take(g, kept, track, used, assigned, data):
    """Accept a hypothesis if its rays are unused; a pair only if a track, not yet assigned, predicts it.

    An image that is too large for each of two targets is used a second time if a track predicts that hypothesis.
    """
    values, members = kept.values, kept.members
    alone = track[g] < 0 or assigned[track[g]]
    count = 0
    for c in range(members.shape[1]):
        k = members[g, c]
        if k >= 0:
            count += 1
            if used[k] > ONE_OF_TWO or (used[k] > 0 and alone):
                return False
            if used[k] > 0 and not too_large(k, c, values[g, XYZ : XYZ + 3], data):
                return False
    if alone and count == 2:
        return False
    if track[g] >= 0:
        assigned[track[g]] = True
    for c in range(members.shape[1]):
        k = members[g, c]
        if k >= 0:
            used[k] += ONE_OF_TWO if too_large(k, c, values[g, XYZ : XYZ + 3], data) else USED_UP
    return True


@bare_step
def _shrink(g, kept, used, hypothesis, data):
    """Remove the used rays from a hypothesis and solve it again; return how many remain, 0 if it is rejected."""
    values, members = kept.values, kept.members
    mates, ranks, solved, _ = hypothesis
    count = NONE
    for c in range(members.shape[1]):
        k = members[g, c]
        if k >= 0 and used[k] > 0:
            members[g, c] = -1
        count += members[g, c] >= 0
    if count < data.rules[0].minimum_cameras:
        return NONE
    typical_m = data.rules[0].typical_m
    for c in range(members.shape[1]):
        mates[c], ranks[c, TRUST] = members[g, c], kept.trusts[g, c]
        ranks[c, WHOLE] = typical_m if typical_m > 0.0 else values[g, DIAMETER]
    for k in range(VALUES):
        solved[k] = values[g, k]
    error, diameter = solve(hypothesis, TWICE, data), values[g, DIAMETER]
    if not acceptable(hypothesis, count, error, data):
        return NONE
    store(hypothesis, error, diameter, data.rays, g, kept)
    return count


@step
def _take_uncontested(values, members, state, used):
    """Accept the hypotheses that share no ray with another open one of about the same residual."""
    # for each ray the best hypothesis that has it, and the best of those with another set of rays
    first = np.full(used.shape[0], -1, dtype=np.int64)
    second = np.full(used.shape[0], -1, dtype=np.int64)
    waiting = np.flatnonzero(state == OPEN)
    for g in waiting:
        for k in members[g]:
            if k < 0:
                continue
            if first[k] < 0:
                first[k] = g
            elif _same(g, first[k], members):
                continue
            elif values[g, CHI2] < values[first[k], CHI2]:
                first[k], second[k] = g, first[k]
            elif second[k] < 0 or values[g, CHI2] < values[second[k], CHI2]:
                second[k] = g
    for g in waiting:
        if not _contested(g, values, members, used, first, second):
            state[g] = TAKEN
            for k in members[g]:
                if k >= 0:
                    used[k] += 1


@bare_step
def _contested(g, values, members, used, first, second):
    """Whether a ray of a hypothesis is used, or belongs to another hypothesis of about the same residual."""
    for c in range(members.shape[1]):
        k = members[g, c]
        if k >= 0:
            rival = second[k] if _same(g, first[k], members) else first[k]
            if used[k] > 0 or (rival >= 0 and values[rival, CHI2] < values[g, CHI2] + CLEARLY_WORSE):
                return True
    return False


@bare_step
def _same(g, other, members):
    """Whether two hypotheses have the same rays."""
    other_rays = 0
    for c in range(members.shape[1]):
        other_rays += members[g, c] != members[other, c]
    return other_rays == 0


@step
def columns(kept, state, rays, start):
    """Return the columns of ``Points`` of the hypotheses that were taken, and their images' trusts (n, c)."""
    values, members, trusts = kept
    n, cameras = 0, members.shape[1]
    for g in range(values.shape[0]):
        n += state[g] == TAKEN
    xyz, covariance, count = np.empty((n, 3)), np.empty((n, 3, 3)), np.zeros(n, dtype=np.int64)
    residual, index = np.zeros(n), np.full((n, cameras), -1, dtype=np.int64)
    diameter, trusted, taken_trusts = np.empty(n), np.zeros(n), np.ones((n, cameras))
    n = 0
    for g in range(values.shape[0]):
        if state[g] != TAKEN:
            continue
        weight = 0.0
        for c in range(cameras):
            k = members[g, c]
            if k >= 0:
                count[n] += 1
                index[n, c], taken_trusts[n, c] = k - start[c], trusts[g, c]
                weight += (trusts[g, c] / rays[k, SIGMA]) ** 2
                trusted[n] += wholeness(k, trusts[g, c], rays)
        for p in range(3):
            xyz[n, p] = values[g, XYZ + p]
            for q in range(3):
                covariance[n, p, q] = values[g, COVARIANCE + 3 * p + q]
        # the variance at its images' mean weight converts whitened errors to px: poor images add little
        residual[n] = np.sqrt(count[n] / weight * values[g, CHI2] / (2.0 * count[n]))
        diameter[n] = values[g, DIAMETER]
        n += 1
    return (xyz, covariance, count, residual, index, diameter, trusted), taken_trusts
