"""A lower bound of the rms sigma of any layout, for ``bench_plan``, by convex relaxation of the choice of cameras.

Shares of cameras add up to their number (Boyd and Vandenberghe, Convex Optimization, 7.5); the bound is that of the
Frank-Wolfe method: the convex function's tangent, minimised over all shares.
"""

from typing import Any

import numpy as np
from scipy.optimize import linprog, minimize_scalar
from scipy.sparse import csr_matrix


def bound(search: Any, steps: int) -> float:
    """Return a lower bound of the rms sigma [m] of what ``search.theirs`` has, over all layouts of the candidates.

    ``search``: a ``bench_plan.Search``.
    """
    weight = search.ours.weight * search.theirs
    weight = (weight / weight.sum())[:, None, None]
    places, of = np.unique(search.places.round(4), axis=0, return_inverse=True)
    of, spacing = of.ravel(), search.there.cameras.min_spacing
    pairs = np.argwhere(np.linalg.norm(places[:, None] - places, axis=2) < spacing - 1e-9)
    # places within a circle of the spacing's diameter: one camera at most
    middles = (places[pairs[:, 0]] + places[pairs[:, 1]]) / 2
    crowds = np.unique(np.linalg.norm(middles[:, None] - places, axis=2) < spacing / 2 - 1e-9, axis=0)
    limits = csr_matrix(crowds.astype(float))

    def value(total: np.ndarray) -> tuple[float, np.ndarray]:
        matrix = np.empty((len(total), 3, 3))
        upper = np.triu_indices(3)
        matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = total
        matrix[weight[:, 0, 0] == 0] = np.eye(3)
        inverse = np.linalg.inv(matrix)
        slope = -(weight * inverse @ inverse)[:, upper[0], upper[1]] * [1, 2, 2, 1, 2, 1]
        return float((weight * inverse).trace(axis1=1, axis2=2).sum()), slope

    def least(slopes: np.ndarray) -> tuple[np.ndarray, float]:
        best = np.full(len(places), np.inf)
        np.minimum.at(best, of, slopes)
        which = np.empty(len(places), int)
        order = np.argsort(-slopes)
        which[of[order]] = order
        # HiGHS's tolerances are absolute
        scale = float(np.abs(best).max())
        found = linprog(
            best / scale, A_ub=limits, b_ub=np.ones(limits.shape[0]), A_eq=np.ones((1, len(places))),
            b_eq=[search.count], bounds=(0, 1),
        )  # fmt: skip
        share = np.zeros(len(slopes))
        share[which] = found.x
        return share, float(found.fun * scale)

    share = np.full(len(of), search.count / len(of))
    total = np.tensordot(share, search.information, 1)
    found = -np.inf
    for _ in range(steps):
        now, slope = value(total)
        slopes = np.tensordot(search.information, slope, 2)
        corner, lowest = least(slopes)
        found = max(found, now + lowest - float(slopes @ share))
        other = np.tensordot(corner, search.information, 1)

        def along(step: float, total: np.ndarray = total, other: np.ndarray = other) -> float:
            return value((1 - step) * total + step * other)[0]

        step = minimize_scalar(along, bounds=(0.0, 0.9), method="bounded", options={"xatol": 1e-4}).x
        share, total = (1 - step) * share + step * corner, (1 - step) * total + step * other
    return float(np.sqrt(max(found, 0.0)))
