"""Rigid motion of an occluded marker's neighbours since it was last seen: predicts where the marker is now.

The translation is that of the neighbours' weighted centroid. The rotation is filtered: Gauss-Newton steps start from
the rotation at the previous instant, with a prior that limits the spin where the neighbours do not determine it.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.linalg3 import inverse3, plus_identity3, store3, symmetric3, times3
from mosca.tracking.state import NEIGHBOURS, Bank, Neighbours

RIGID, UNOBSERVED, OBSERVED_HALF_S = 0.005, 0.15, 0.2
"""Standard deviation of a distance over its length: the least, and that before any observation; and the time of
observation [s] that halves the variance of the latter."""
SPIN_RADPS = 4.0
"""How fast a rigid segment may rotate about an axis that its visible markers do not determine."""
LARGEST_SPIN_RAD2 = 3.0
"""Largest variance of such a rotation: any orientation."""
ITERATIONS = 3


@bare_step
def observed_now(bank: Bank, neighbours: Neighbours, i: int, k: int) -> bool:
    """Whether the neighbour ``k`` of track ``i`` has a measurement at this instant."""
    j = neighbours.slot[i, k]
    result: bool = j >= 0 and bank.serial[j] == neighbours.serial[i, k] and bank.missed[j] == 0
    return result


@bare_step
def distance_variance(distance: float, variance: float, observed_s: float) -> float:
    """Return the variance [m^2] of a distance that is assumed to stay the same."""
    observed = observed_s / OBSERVED_HALF_S
    return variance + (RIGID**2 + UNOBSERVED**2 / (1.0 + observed * observed)) * distance * distance


@step
def carried_along(bank, neighbours, i, hidden_s, step_s, xyz, covariance):
    """Predict track ``i`` from the rigid motion of its neighbours since it was last seen, ``hidden_s`` ago.

    Fills ``xyz`` (3,) and ``covariance`` (3, 3). The latter sums those of the segment's translation, of its rotation
    times the lever arm, and of the marker's own rigidity. It is inflated where the neighbours do not move as one
    body. Returns the covariance's trace; ``inf`` where no neighbour is seen.
    """
    then, now = np.zeros(3), np.zeros(3)
    total, seen = _centroids(bank, neighbours, i, then, now)
    if seen == 0:
        return np.inf
    mean_weight = total / seen
    rotation, normal, right = neighbours.rotation[i], np.empty((3, 3)), np.empty(3)
    prior = 1.0 / (SPIN_RADPS * max(step_s, 1e-4)) ** 2
    misfit = 0.0
    for _ in range(ITERATIONS):
        misfit = _normal_equations(bank, neighbours, i, then, now, normal, right)
        spin = inverse3(plus_identity3(symmetric3(normal), prior))
        _rotate_by(rotation, *times3(spin, right[0], right[1], right[2]))
    lever = _rotated(rotation, neighbours.own_xyz_last_seen[i], then)
    for a in range(3):
        xyz[a] = now[a] + lever[a]
    inflation = max(1.0, misfit / max(3.0 * seen - 6.0, 1.0)) if seen > 2 else 1.0
    prior = 1.0 / min((SPIN_RADPS * hidden_s) ** 2, LARGEST_SPIN_RAD2)
    store3(inverse3(plus_identity3(symmetric3(normal), prior)), normal)
    _fill_covariance(normal, lever, 1.0 / total + 1.0 / mean_weight, inflation, covariance)
    return covariance[0, 0] + covariance[1, 1] + covariance[2, 2]


@bare_step
def _weight(neighbours: Neighbours, i: int, k: int) -> float:
    result: float = 1.0 / distance_variance(
        neighbours.distance[i, k], neighbours.variance[i, k], neighbours.observed_s[i, k]
    )
    return result


@bare_step
def _centroids(bank: Bank, neighbours: Neighbours, i: int, then: Array, now: Array) -> tuple[float, int]:
    """Fill the weighted centroids (3,) of the neighbours at the last sighting and now; returns weight and number."""
    total, seen = 0.0, 0
    for k in range(NEIGHBOURS):
        if neighbours.valid[i, k] and observed_now(bank, neighbours, i, k):
            w = _weight(neighbours, i, k)
            total += w
            seen += 1
            for a in range(3):
                then[a] += w * neighbours.xyz_last_seen[i, k, a]
                now[a] += w * bank.mean[neighbours.slot[i, k], a]
    if seen > 0:
        for a in range(3):
            then[a] /= total
            now[a] /= total
    return total, seen


@bare_step
def _normal_equations(
    bank: Bank, neighbours: Neighbours, i: int, then: Array, now: Array, normal: Array, right: Array
) -> float:
    """Fill J'WJ (3, 3) and J'Wr (3,) of a small rotation of the neighbours; returns r'Wr."""
    for a in range(3):
        right[a] = 0.0
        for b in range(3):
            normal[a, b] = 0.0
    misfit = 0.0
    for k in range(NEIGHBOURS):
        if neighbours.valid[i, k] and observed_now(bank, neighbours, i, k):
            w, j = _weight(neighbours, i, k), neighbours.slot[i, k]
            r = _rotated(neighbours.rotation[i], neighbours.xyz_last_seen[i, k], then)
            x = bank.mean[j, 0] - now[0] - r[0]
            y = bank.mean[j, 1] - now[1] - r[1]
            z = bank.mean[j, 2] - now[2] - r[2]
            misfit += w * (x * x + y * y + z * z)
            right[0] += w * (r[1] * z - r[2] * y)
            right[1] += w * (r[2] * x - r[0] * z)
            right[2] += w * (r[0] * y - r[1] * x)
            square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
            for a in range(3):
                normal[a, a] += w * square
                for b in range(3):
                    normal[a, b] -= w * r[a] * r[b]
    return misfit


@bare_step
def _fill_covariance(spin, lever, position_variance, inflation, covariance):
    """Fill [lever]x spin [lever]x' + position variance, inflated: a rotation w moves the marker by w x the lever."""
    for a in range(3):
        # rows of the lever's cross-product matrix
        p, q = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            r, s = (b + 1) % 3, (b + 2) % 3
            value = lever[q] * (spin[p, r] * lever[s] - spin[p, s] * lever[r])
            value -= lever[p] * (spin[q, r] * lever[s] - spin[q, s] * lever[r])
            covariance[a, b] = inflation * (value + (position_variance if a == b else 0.0))


@bare_step
def _rotated(rotation, point, centre):
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@bare_step
def _rotate_by(rotation: Array, x: float, y: float, z: float) -> None:
    """Rotate a matrix (3, 3) further by the rotation vector (x, y, z) (Rodrigues, column by column)."""
    angle = np.sqrt(x * x + y * y + z * z)
    if angle > 0.0:
        s, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
        for b in range(3):
            u, v, w = rotation[0, b], rotation[1, b], rotation[2, b]
            k, m, n = y * w - z * v, z * u - x * w, x * v - y * u
            rotation[0, b] = u + s * k + c * (y * n - z * m)
            rotation[1, b] = v + s * m + c * (z * k - x * n)
            rotation[2, b] = w + s * n + c * (x * m - y * k)
