"""Rays of one frame set, and where tracks expect their targets: what matching reads."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array

DIRECTION, WHITE, SPREAD, NORMAL = 0, 3, 9, 15
SIGMA, RADIUS, ANGLE, BONUS, FLAGS, SHARE_SIGMA = 24, 25, 26, 27, 28, 29
ELLIPTIC, ELLIPTIC_SIGMA, ROOT, AREA_RADIUS, COLUMNS = 30, 32, 33, 35, 36
"""Columns of ``RayTable.rays``."""
ORIGIN, ROTATION, EDGES, DENSITY, VIEW = 0, 3, 12, 16, 17
"""Columns of ``RayTable.views``."""


@dataclass(frozen=True, eq=False)
class RayTable:
    """The rays of one frame set, all cameras in one table, whitened by their errors."""

    rays: Array
    """(n, COLUMNS); NaN where the lens images nothing at the pixel. Columns:

    - DIRECTION (3): unit vector, world frame.
    - WHITE (2 x 3): derivative of the whitened reprojection error by direction.
    - SPREAD (3 x 2): direction error of one standard deviation [rad] (pseudo-inverse of WHITE).
    - NORMAL (9): contribution to the normal equations, A'A (xx, xy, xz, yy, yz, zz) and A'A O.
    - SIGMA [px]: geometric mean of the error ellipse's axes; converts whitened errors to px.
    - RADIUS [px]: of the target's image, and ANGLE [rad]: what its diameter subtends.
    - BONUS: its log-likelihood ratio, target against clutter (``mosca.correspondence.match``).
    - FLAGS: of the detection, and LONG (``mosca.camera.ray_table``).
    - SHARE_SIGMA: relative standard deviation of the image's area.
    - ELLIPTIC (2), ELLIPTIC_SIGMA: the image's ellipticity (``mosca.data.detections.Detections``).
    - ROOT (2) [px]: first column of the Cholesky factor of the pixel's covariance (its last element is
      SIGMA^2 / ROOT).
    - AREA_RADIUS [px]: of a circle of the image's area; RADIUS of a long image is that of its longer axis.

    Matching corrects the rays of flat round targets to their centres (``mosca.correspondence.disc_centres``).
    """
    views: Array
    """(c, VIEW), one row a camera: ORIGIN (3) centre of projection [m], ROTATION (3 x 3) world_from_camera,
    EDGES (4) left, top, right, bottom of the field of view in stereographic projection
    (``mosca.correspondence.spatial_index``), DENSITY of detections over the image [1/px^2]."""
    pairs: Array
    """(p, 2) pairs of cameras, the best base first."""
    bases: Array
    """(p, 2, 3) two unit vectors perpendicular to each pair's base and to each other; infinite for a zero base."""
    start: Array
    """(c + 1,) first row of each camera's rays."""
    covariance_px2: Array
    """(n, 2, 2) covariance that whitens, together with ``extra_px2``: that of the detections, and that of the
    eccentricity that their ellipses may have."""
    extra_px2: Array
    """(c,) variance that each camera adds to its detections on each axis."""
    xy_px: Array
    """(n, 2) pixels of the detections."""
    detected_px2: Array
    """(n, 2, 2) covariance of the detections alone."""
    cameras: Array
    """``mosca.camera.ray_table.RigTable.cameras``."""
    odd: int
    """Number of images that are long, or UNREFINED and not MERGED."""

    @property
    def direction(self) -> Array:
        """Unit directions (n, 3), world."""
        return self.rays[:, DIRECTION : DIRECTION + 3]


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predicted positions of the tracks' targets."""

    xyz: Array
    """(k, 3) [m], world frame."""
    covariance: Array
    """(k, 3, 3) [m^2]."""

    @classmethod
    def nothing(cls) -> "Predicted":
        """Return no predictions, so that each frame is matched on its own."""
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)))
