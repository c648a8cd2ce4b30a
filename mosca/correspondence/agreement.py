"""Final weights of a point's images: those that agree count in full. Compiled steps of matching.

During the search for hypotheses, an image of odd shape is treated as partly hidden or merged with a neighbour
(``mosca.correspondence.hypothesis.trust2_of``): its error may be a good part of the target's radius. A target in
motion, or a box of whole pixels, also makes such images, which err by their detection's noise alone. If all images of
a point are doubted, a merged one counts as much as the others. Once all images of a point are known, their residuals
show which agree to within their noise. Each doubted image has two possible variances; the likelihood of all images
with the point integrated out (with equal prior probabilities; ``evidence``) chooses between them. The prior
probability that an image of regular shape is hidden or merged is that of ``LN_UNSEEN``.

An image contradicts the others if it exceeds ``MatchSettings.outlier_sigma`` of the chi-square of those that count in
full. It is then treated as one of a target that is mostly hidden or merged, though its size does not show it.
"""

import numpy as np

from mosca.correspondence.candidates import worst_ray
from mosca.correspondence.hypothesis import (
    AREAS,
    CHI2,
    MOST_ODD,
    ODD_SHIFT,
    TWICE,
    MatchData,
    judge_sizes,
    limit,
    new_hypothesis,
    solve,
)
from mosca.correspondence.selection import TAKEN
from mosca.data.rays import RADIUS, SIGMA
from mosca.numba_support.copying import copy_row
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.linalg3 import Symmetric3, cofactors3, determinant3
from mosca.triangulation.triangulate import TRUST

FEWEST_IMAGES = 3
"""Fewest images of a point that show which of them agree: two have one residual, across the epipolar line."""
LN_UNSEEN = float(np.log(0.01))
"""Logarithm of the prior probability that a target is mostly hidden, or merged, and its image does not show it."""


@step
def weigh_by_agreement(kept, state, data):
    """Weight the images of the accepted hypotheses by how well they agree, and solve these hypotheses again."""
    rules = data.rules.copy()
    rules[0].judge = min(rules[0].judge, AREAS)
    by_area = MatchData(data.rays, data.views, rules)
    cameras = kept.members.shape[1]
    hypothesis = new_hypothesis(cameras)
    members, ranks, values, _ = hypothesis
    for g in range(kept.members.shape[0]):
        if state[g] != TAKEN or not _is_doubtful(g, kept, data.rules[0]):
            continue
        for c in range(cameras):
            members[c], ranks[c, TRUST] = kept.members[g, c], kept.trusts[g, c]
        copy_row(kept.values[g], values)
        if judge_sizes(hypothesis, by_area)[1]:
            continue  # a disc's images are judged by their sizes; its uncertainty is in the covariance
        error = _settle(hypothesis, kept.trusts[g], data)
        rarer = 0.0
        for c in range(cameras):
            if members[c] >= 0 and ranks[c, TRUST] < 1.0 and kept.trusts[g, c] >= 1.0:
                rarer += LN_UNSEEN
        if error >= 0.0 and rarer + evidence(values, error, members, ranks[:, TRUST]) > evidence(
            kept.values[g], kept.values[g, CHI2], members, kept.trusts[g]
        ):
            values[CHI2] = error
            copy_row(values, kept.values[g])
            copy_row(ranks[:, TRUST], kept.trusts[g])


@bare_step
def _is_doubtful(g, kept, rules):
    """Whether a point of three or more images has one that does not count in full or contradicts the others."""
    count = in_full = 0
    for c in range(kept.members.shape[1]):
        if kept.members[g, c] >= 0:
            count += 1
            in_full += kept.trusts[g, c] >= 1.0
    if count < FEWEST_IMAGES:
        return False
    return in_full < count or kept.values[g, CHI2] > limit(2 * count - 3, rules.outlier_sigma)


@bare_step
def evidence(values, error, members, trusts):
    """Return the log-likelihood of a hypothesis's images, target position integrated out, up to a constant.

    As in ``mosca.correspondence.hypothesis.store``.
    """
    covariance = Symmetric3(values[3], values[4], values[5], values[7], values[8], values[11])
    total = 0.5 * np.log(max(determinant3(covariance, cofactors3(covariance)), 1e-300)) - 0.5 * error
    for c in range(members.shape[0]):
        if members[c] >= 0:
            total += 2.0 * np.log(trusts[c])
    return total


@bare_step
def _settle(hypothesis, doubted, data):
    """Lower the trusts of images that contradict the others, until those that count in full agree.

    ``doubted`` (c,): trusts to fall back to. Returns the squared error, or -1 where nothing agrees.
    """
    members, ranks, _, _ = hypothesis
    rays, rules = data.rays, data.rules[0]
    count = 0
    for c in range(members.shape[0]):
        count += members[c] >= 0 and ranks[c, TRUST] >= 1.0
    error = solve(hypothesis, TWICE, data)
    while count >= 2 and error > limit(2 * count - 3, rules.outlier_sigma):
        at = worst_ray(hypothesis, data)
        if at < 0 or ranks[at, TRUST] < 1.0:
            break
        k, trust = members[at], doubted[at]
        if trust >= 1.0:
            trust = 1.0 / np.sqrt(1.0 + 0.5 * (ODD_SHIFT * MOST_ODD * rays[k, RADIUS] / rays[k, SIGMA]) ** 2)
        ranks[at, TRUST] = trust
        count -= 1
        error = solve(hypothesis, TWICE, data)
    return error
