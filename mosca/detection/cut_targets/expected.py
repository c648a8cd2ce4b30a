"""Where tracks expect the images of targets: compiled."""

import math

import numpy as np

from mosca.camera.lens_models.arrays import image_of
from mosca.camera.lens_models.row import IMAGED
from mosca.data.arrays import Array
from mosca.data.rays import ORIGIN, ROTATION
from mosca.numba_support.decorators import kernel


@kernel
def expected_images(
    xyz: Array, covariance: Array, cameras: Array, views: Array, focal_px: Array, least_px: float
) -> tuple[Array, Array, Array]:
    """Return the images (c, k, 2) of k predicted points, infinite where there is none, their errors and distances.

    Errors (c, k) are standard deviations, at least ``least_px`` [px]; distances (c, k) are from the cameras [m].
    ``covariance`` (k, 3, 3) [m^2]; ``cameras``, ``views``: of the ``RayTable``; ``focal_px`` (c,): principal
    distances.
    """
    many, points = len(views), len(xyz)
    place, sigma, away = np.full((many, points, 2), np.inf), np.empty((many, points)), np.empty((many, points))
    out, off, local = np.zeros((2, IMAGED)), np.empty(3), np.empty(3)
    for c in range(many):
        for k in range(points):
            for a in range(3):
                off[a] = xyz[k, a] - views[c, ORIGIN + a]
            for a in range(3):
                local[a] = 0.0
                for b in range(3):
                    local[a] += views[c, ROTATION + 3 * b + a] * off[b]
            away[c, k] = math.sqrt(off[0] ** 2 + off[1] ** 2 + off[2] ** 2)
            spread = math.sqrt(covariance[k, 0, 0] + covariance[k, 1, 1] + covariance[k, 2, 2])
            sigma[c, k] = math.hypot(spread / away[c, k] * focal_px[c], least_px)
            if image_of(cameras[c], local[0], local[1], local[2], out):
                place[c, k, 0], place[c, k, 1] = out[0, 0], out[1, 0]
    return place, sigma, away
