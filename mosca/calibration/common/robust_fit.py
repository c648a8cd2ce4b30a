"""Standard deviations from medians, which outliers hardly move, and similarity transforms between point sets."""

from math import log, sqrt

from mosca.data.arrays import Array
from mosca.data.rig import Pose
from mosca.data.rotations import nearest_rotation

SIGMA_BY_MEDIAN_1D = 1.4826
"""Standard deviation over the median of the absolute error in one dimension: 1 / (upper quartile of N(0, 1))."""
SIGMA_BY_MEDIAN_2D = 1 / sqrt(2 * log(2))
"""Standard deviation of one coordinate over the median length of the error in two dimensions (Rayleigh), 0.849."""


def similarity(source: Array, target: Array, with_scale: bool = True) -> tuple[float, Pose]:
    """Return scale s and motion (R, t) with target ~ s R source + t, points (n, 3) (Umeyama 1991).

    R is never a reflection; s is 1 without ``with_scale``.
    """
    middle, other = source.mean(axis=0), target.mean(axis=0)
    spread = (target - other).T @ (source - middle)
    rotation = nearest_rotation(spread)[0]
    scale = float((rotation * spread).sum() / ((source - middle) ** 2).sum()) if with_scale else 1.0
    return scale, Pose(rotation, other - scale * rotation @ middle)


def rigid(source: Array, target: Array) -> Pose:
    """Return the motion (never a reflection) that brings points (n, 3) nearest to others (Kabsch 1976)."""
    return similarity(source, target, with_scale=False)[1]
