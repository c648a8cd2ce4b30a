"""Predicted covariance of a point measured with a calibrated rig: from detection, and from the calibration.

A point X seen at pixels with covariances S_c has the normal matrix N = sum J_c^T S_c^-1 J_c and thus the covariance
N^-1 from detection. The calibration's parameters p move it by G = -N^-1 sum J_c^T S_c^-1 dx_c/dp, which gives the
covariance G C_pp G^T. This part is common to all points and frames and does not average out: it is kept apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.calibration.quality.jacobian import sensitivity
from mosca.camera.projection import inside_image
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.calibration_evidence import AccuracyGrid
from mosca.data.rig import Rig
from mosca.triangulation.triangulate import triangulate

SEEN_FROM = 1e-9
"""Least ratio of eigenvalues of N: below it the rays do not meet."""


def accuracy_map(
    calibration: Calibration,
    low: Sequence[float],
    high: Sequence[float],
    n: tuple[int, int, int],
    detection_sigma_px: float,
) -> AccuracyGrid:
    """Return the predicted accuracy on ``n`` (nx, ny, nz) points of the box ``low`` (3,) to ``high`` (3,) [m].

    ``detection_sigma_px``: standard deviation of an image coordinate, an axis. Occlusion is not considered: a camera
    sees what lies in its image.
    """
    axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, n, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    rig = calibration.rig
    total, pull = np.zeros((len(grid), 3, 3)), np.zeros((len(grid), 3, len(calibration.parameters)))
    count = np.zeros(len(grid), dtype=np.int64)
    for k, camera in enumerate(rig.cameras):
        one = sensitivity(rig, k, calibration.parameters, grid)
        seen = inside_image(camera, one.xy_px)
        by_point = one.by_point[seen] / detection_sigma_px
        total[seen] += np.swapaxes(by_point, 1, 2) @ by_point
        moved = np.swapaxes(by_point, 1, 2) @ one.by_parameter[seen] / detection_sigma_px
        pull[np.ix_(np.flatnonzero(seen), np.arange(3), one.columns)] += moved
        count[seen] += 1
    good = (count >= 2) & _solvable(total)
    detection, common = (np.full((len(grid), 3, 3), np.nan) for _ in range(2))
    detection[good] = np.linalg.inv(total[good])
    by_parameter = -detection[good] @ pull[good]
    common[good] = by_parameter @ calibration.covariance @ np.swapaxes(by_parameter, 1, 2)
    of_detection, of_calibration = (
        np.sqrt(np.trace(one, axis1=1, axis2=2)).reshape(n) for one in (detection, common)
    )
    return AccuracyGrid(axes[0], axes[1], axes[2], of_detection, of_calibration, detection_sigma_px)


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Points measured with a rig.

    ``key`` (p,) rising; ``xyz`` (p, 3) [m]; ``covariance`` (p, 3, 3) from detection [m^2]; ``by_parameter``
    (p, 3, u) how the calibration's parameters move them.
    """

    key: Array
    xyz: Array
    covariance: Array
    by_parameter: Array


def triangulated_points(
    calibration: Calibration | Rig, camera: Array, key: Array, xy_px: Array, covariance_px2: Array
) -> TriangulatedPoints:
    """Measure points from n image points: ``camera`` (n,) of the rig saw point ``key`` (n,) at ``xy_px`` (n, 2).

    Points that fewer than two cameras see, or whose rays do not meet, are left out.
    """
    rig = calibration if isinstance(calibration, Rig) else calibration.rig
    parameters = () if isinstance(calibration, Rig) else calibration.parameters
    names, index = np.unique(key, return_inverse=True)
    table = np.full((len(names), len(rig.cameras), 2), np.nan)
    table[index, camera] = xy_px
    xyz = triangulate(rig, table)[0]
    met: Array = np.asarray(np.isfinite(xyz).all(axis=1))
    # two Gauss-Newton steps with each image point's own covariance
    for _ in range(2):
        total, pull, slope = _normals(rig, parameters, camera, index, xy_px, covariance_px2, xyz, met)
        met &= _solvable(total)
        inverse = np.full_like(total, np.nan)
        inverse[met] = np.linalg.inv(total[met])
        xyz = xyz + np.einsum("nij,nj->ni", inverse, slope)
    return TriangulatedPoints(names[met], xyz[met], inverse[met], -inverse[met] @ pull[met])


def _normals(
    rig: Rig,
    parameters: Sequence[str],
    camera: Array,
    index: Array,
    xy_px: Array,
    covariance_px2: Array,
    xyz: Array,
    met: Array,
) -> tuple[Array, Array, Array]:
    """Return N (p, 3, 3), sum J^T S^-1 dx/dp (p, 3, u) and sum J^T S^-1 (observed - projected) (p, 3)."""
    total, slope = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3))
    pull = np.zeros((len(xyz), 3, len(parameters)))
    for k in range(len(rig.cameras)):
        rows = np.flatnonzero((camera == k) & met[index])
        point = index[rows]
        one = sensitivity(rig, k, parameters, xyz[point])
        weighted = np.swapaxes(one.by_point, 1, 2) @ np.linalg.inv(covariance_px2[rows])
        np.add.at(total, point, weighted @ one.by_point)
        np.add.at(slope, point, np.einsum("nij,nj->ni", weighted, xy_px[rows] - one.xy_px))
        if len(one.columns):
            np.add.at(pull, np.ix_(point, np.arange(3), one.columns), weighted @ one.by_parameter)
    return total, pull, slope


def _solvable(total: Array) -> Array:
    """Return which normal matrices (n, 3, 3) determine their point."""
    values = np.linalg.eigvalsh(np.nan_to_num(total))
    return np.asarray((values[:, 0] > SEEN_FROM * values[:, 2]) & np.isfinite(total).all(axis=(1, 2)))
