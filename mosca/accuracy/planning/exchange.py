"""The best n of many candidate cameras, by exchange of one at a time (Fedorov, Theory of Optimal Experiments, 1972).

The information of each candidate on each marker is computed beforehand. A layout with one camera exchanged then needs
only a sum and the inverse of a 3 x 3 matrix for each marker. A step replaces one camera by the best of all
candidates; the search ends where no single exchange improves the layout.
"""

from collections.abc import Callable, Sequence

import numpy as np

from mosca.accuracy.planning.views import MarkerRoom, Softness, gather
from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel

MOST_TRIES = 60
"""Largest number of candidates, best first, for which a step computes the additional cost, which takes long."""
LEAST_GAIN = 1e-6
"""Least decrease of the cost by an exchange: above rounding, so that equal layouts do not alternate for ever."""


def information_of(cameras: Array, room: MarkerRoom) -> Array:
    """Return the information (c, n k, 6) of each camera (c, COLUMNS) on each marker: float32 upper triangles [1/m^2].

    The markers are all points with the first normal, then all with the next; zero where a camera does not see one.
    """
    found = []
    for normals in room.normals[:, None] if len(room.normals) else [room.normals]:
        of_normal = np.zeros((len(cameras), len(room.points), 6), dtype=np.float32)
        for c in range(len(cameras)):
            # hard borders: points that face away get nothing, and their sight lines are not followed
            facing = np.flatnonzero((((cameras[c, :3] - room.points) @ normals.T) > 0.0).all(axis=1))
            of_normal[c, facing] = gather(
                cameras[c : c + 1], room.points[facing], normals, room.obstacles, room.center, room.diameter_m,
                room.tables, Softness().row,
            )[0][:, 0]  # fmt: skip
        found.append(of_normal)
    return np.concatenate(found, axis=1)


@kernel
def variances_with(information, rest, count, allowed):
    """Return the variance (c, n) [m^2] of each marker with each candidate added; infinite below two cameras.

    ``information`` (c, n, 6): of the candidates; ``rest`` (n, 6): of the cameras that stay; ``count`` (n,): number of
    these that see each marker. The variances of candidates that are not ``allowed`` (c,) are infinite.
    """
    candidates, markers = information.shape[:2]
    found = np.full((candidates, markers), np.inf)
    for c in range(candidates):
        if not allowed[c]:
            continue
        for m in range(markers):
            if count[m] + (information[c, m, 0] > 0.0) < 2:
                continue
            xx, xy = rest[m, 0] + information[c, m, 0], rest[m, 1] + information[c, m, 1]
            xz, yy = rest[m, 2] + information[c, m, 2], rest[m, 3] + information[c, m, 3]
            yz, zz = rest[m, 4] + information[c, m, 4], rest[m, 5] + information[c, m, 5]
            a, d, f = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
            determinant = xx * a - xy * (xy * zz - xz * yz) + xz * (xy * yz - xz * yy)
            if determinant > 1e-9 * xx * yy * zz:
                found[c, m] = (a + d + f) / determinant
    return found


def variances_of(information: Array, chosen: Sequence[int]) -> Array:
    """Return the variance (n,) [m^2] of each marker by the ``chosen`` candidates; infinite where not measured."""
    rest, count = _of(information, list(chosen)[:-1])
    last = information[chosen[-1]][None]
    return np.asarray(variances_with(last, rest, count, np.ones(1, bool))[0])


def exchanged(
    information: Array,
    chosen: Sequence[int],
    cost: Callable[[Array], Array],
    allowed: Callable[[list[int]], Array],
    *,
    more: Callable[[list[int]], float] = lambda chosen: 0.0,
    passes: int = 10,
) -> tuple[list[int], float]:
    """Return the candidates chosen after exchanges, and their cost.

    Parameters
    ----------
    information
        (c, n, 6) of the candidates (``information_of``).
    chosen
        Candidates of the first layout.
    cost
        Function of the variances (k, n) of k layouts; returns the costs (k,), which are minimised.
    allowed
        Function of the candidates that stay; returns which candidates (c,) may be added to them.
    more
        Function of the chosen candidates; returns an additional cost, 0 or more, that takes long to compute. It is
        called only for layouts that could be the best.
    passes
        Largest number of passes over all cameras.
    """
    best = list(chosen)
    least = float(cost(variances_of(information, best)[None])[0]) + more(best)
    for _ in range(passes):
        before = least
        for place in range(len(best)):
            others = best[:place] + best[place + 1 :]
            rest, count = _of(information, others)
            free = allowed(others)
            costs = np.where(free, cost(variances_with(information, rest, count, free)), np.inf)
            for c in np.argsort(costs)[:MOST_TRIES]:
                if not costs[c] < least - LEAST_GAIN:
                    break
                tried = [*best[:place], int(c), *best[place + 1 :]]
                whole = float(costs[c]) + more(tried)
                if whole < least - LEAST_GAIN:
                    best, least = tried, whole
        if least > before - LEAST_GAIN:
            break
    return best, least


def _of(information: Array, chosen: list[int]) -> tuple[Array, Array]:
    rows = information[chosen]
    return rows.sum(axis=0, dtype=float), (rows[:, :, 0] > 0).sum(axis=0)
