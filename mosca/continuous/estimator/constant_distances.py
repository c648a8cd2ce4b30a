"""Constant distances between points of one limb: found from curves with covariance, and used as observations.

A pair is accepted where the distance varies no more than the curves' own uncertainty explains, and where this is
informative: the vector between the points must itself vary ``TELLING`` times more than the distance. The variance of
a distance (soft tissue) is estimated along with the curves: the mean square of distances in sampled curves about
their mean. So a wrong pair gets a small weight, and is dropped once it is not informative.
"""

from dataclasses import dataclass

import numpy as np

from mosca.continuous.estimator.banded_normals import Rows
from mosca.continuous.model.bspline import Knots, values
from mosca.data.arrays import Array

TELLING = 12.0
"""Least ratio of the variation of a pair's vector to that of its length."""
EXPLAINED = 2.0
"""Ratio of a distance's variance over time to its predicted one up to which it counts as constant: errors of curves
are correlated over several instants, so that few are independent, and many pairs are tested."""
JUMPS = 0.05
"""Share of instants, with the worst fit, left out of the test whether a distance is constant. Where points jump
between exposures, errors of curves exceed their covariance, and one such instant would reject the most rigid
pair."""
SMALLEST_SLACK_M = 1e-4
"""Least standard deviation assumed for a constant distance [m]."""
MOST_LOOSENED = 10.0
"""Largest ratio of a slack to the observed variation of its distance."""
FEWEST_INSTANTS = 8
LONGEST_M = 0.8
"""Largest distance between two points of one limb [m]."""
AT_ONCE = 64
"""Number of pairs that are examined together, to limit memory."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """m pairs of point indices ``pair`` (m, 2) with ``distance`` (m,) and ``slack`` (m,) [m]."""

    pair: Array
    distance: Array
    slack: Array

    def __len__(self) -> int:
        return len(self.pair)

    def only(self, keep: Array) -> "Pairs":
        """Return the pairs ``keep``."""
        return Pairs(self.pair[keep], self.distance[keep], self.slack[keep])


NO_PAIRS = Pairs(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))


def find_pairs(knots: Knots, xyz: Array, drawn: Array, known: Array, spans: Array) -> Pairs:
    """Return the pairs that stay a constant distance apart.

    ``xyz`` (count, p, 3): coefficients of the maximum-likelihood curves; ``drawn`` (draws, count, p, 3): samples of
    the posterior; ``known`` (p,): which points may be used; ``spans`` (p, 2): first and last instant at which each
    was seen [s].
    """
    time = knots.breaks_s
    best = values(knots, xyz, time)
    others = np.stack([values(knots, one, time) for one in drawn])
    i, j = np.triu_indices(len(known), 1)
    may = known[i] & known[j]
    i, j = i[may], j[may]
    seen = (time[:, None] >= spans[:, 0] - 1e-9) & (time[:, None] <= spans[:, 1] + 1e-9)
    found = [NO_PAIRS]
    for some in np.array_split(np.arange(len(i)), max(1, len(i) // AT_ONCE)):
        a, b = i[some], j[some]
        inside = seen[:, a] & seen[:, b]
        vector = best[:, a] - best[:, b]
        length = np.linalg.norm(vector, axis=2)
        spread = np.linalg.norm(others[:, :, a] - others[:, :, b], axis=3) - length
        # inverse-variance weights
        variance = np.maximum((spread**2).mean(axis=0), 1e-12)
        weight = inside / (variance + np.median(variance, axis=0))
        weight /= np.maximum(weight.sum(axis=0), 1e-300)
        mean = (weight * length).sum(axis=0)
        worst = weight * (length - mean) ** 2
        weight = np.where(worst > np.quantile(worst, 1 - JUMPS, axis=0), 0.0, weight)
        weight /= np.maximum(weight.sum(axis=0), 1e-300)
        mean = (weight * length).sum(axis=0)
        varied = (weight * (length - mean) ** 2).sum(axis=0)
        explained = (weight * variance).sum(axis=0)
        middle = (weight[:, :, None] * vector).sum(axis=0)
        moved = (weight * ((vector - middle) ** 2).sum(axis=2)).sum(axis=0)
        take = (varied <= EXPLAINED * explained) & (moved > TELLING**2 * varied)
        take &= (inside.sum(axis=0) >= FEWEST_INSTANTS) & (mean < LONGEST_M)
        slack = np.maximum(np.sqrt(varied), SMALLEST_SLACK_M)
        found.append(Pairs(np.column_stack([a, b])[take], mean[take], slack[take]))
    return joined(found)


def joined(parts: list[Pairs]) -> Pairs:
    """Return pairs of several lists in one."""
    return Pairs(*(np.concatenate([getattr(part, n) for part in parts]) for n in ("pair", "distance", "slack")))


def learned(pairs: Pairs, knots: Knots, drawn: Array) -> tuple[Pairs, Array]:
    """Return pairs with distances and slacks from curves drawn from the posterior (draws, count, p, 3), and which of
    them (m,) are still informative.
    """
    if not len(pairs):
        return pairs, np.zeros(0, dtype=bool)
    time = knots.breaks_s
    i, j = pairs.pair.T
    lengths, moved = [], np.zeros(len(pairs))
    for one in drawn:
        at = values(knots, one, time)
        vector = at[:, i] - at[:, j]
        lengths.append(np.linalg.norm(vector, axis=2))
        moved += vector.var(axis=0).sum(axis=1) / len(drawn)
    length = np.stack(lengths)
    distance = np.median(length.mean(axis=0), axis=0)
    varied = np.sqrt(((length - distance) ** 2).mean(axis=(0, 1)))
    # over-relaxed EM: a step of twice its length in log scale in both directions, never below the floor
    slack = np.maximum(varied * np.minimum(MOST_LOOSENED, varied / pairs.slack), SMALLEST_SLACK_M)
    return Pairs(pairs.pair, distance, slack), moved > TELLING**2 * slack**2


def limb_rows(pairs: Pairs, column: Array, knots: Knots, xyz: Array, shared: int) -> Rows:
    """Return the equations of constant distances at all knots, linearised at curves ``xyz`` (count, p, 3).

    ``column`` (p,): first column of each point's unknowns in the group, -1 for points of other groups; pairs across
    groups are left out.
    """
    mine = np.asarray((column[pairs.pair] >= 0).all(axis=1))
    pairs = pairs.only(mine)
    time = knots.breaks_s
    at = values(knots, xyz, time)
    i, j = pairs.pair.T
    vector = at[:, i] - at[:, j]
    length = np.maximum(np.linalg.norm(vector, axis=2), 1e-9)
    direction = vector / length[:, :, None]
    by = np.concatenate([direction, -direction], axis=2) / pairs.slack[:, None]
    n = len(time) * len(pairs)
    columns = np.concatenate([column[i][:, None] + np.arange(3), column[j][:, None] + np.arange(3)], axis=1)
    first, weight = knots.weights(time)
    return Rows(
        np.repeat(first, len(pairs)), np.repeat(weight, len(pairs), axis=0), np.tile(columns, (len(time), 1)),
        by.reshape(n, 6), np.zeros((n, shared)), ((pairs.distance - length) / pairs.slack).ravel()
    )  # fmt: skip
