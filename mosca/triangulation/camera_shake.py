"""Effect of camera shake on points: neighbouring points of a frame set have a shift in common.

The shake of a camera's body shifts all image points of an exposure alike (Luhmann et al., Close-Range Photogrammetry,
3rd ed., section 2.4, error propagation). A point's covariance treats this shift as an error of its own. The mean of
many points has the whole shift, as has a joint's centre found from all of a person's markers; distances hardly have
it.
"""

from collections.abc import Callable

import numpy as np

from mosca.camera.projection import inside_image, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Rig

LEAST_OWN = 0.1
"""Least share of a point's variance that is left as its own, so that its covariance stays positive definite; 0.05 and
0.2 give the joints of two takes the same nees to 0.001."""
WORST_CONDITION = 1e12
"""Condition number of a normal matrix beyond which cameras stand in one place: double precision does not resolve a
distance."""


def shake_covariance(rig: Rig, xyz: Array) -> tuple[Array, Array]:
    """Return the covariances (n, 3, 3) [m^2] that the shake of a rig's cameras gives to points ``xyz`` (n, 3) [m].

    Also returns in how many cameras' images each point lies (n,).

    It is assumed that all cameras whose images contain a point see it, and that points are triangulated with weights
    by the cameras' own errors (``shake_px``, ``residual_px``). A body that hides a point from a camera is not
    considered: there the shift is larger. Covariances are 0 where no camera is known to shake, and for points in
    fewer than two images.
    """
    shake2 = np.array([camera.shake_px**2 for camera in rig.cameras])
    variance = shake2 + np.array([camera.residual_px**2 for camera in rig.cameras])
    covariance, images = np.zeros((len(xyz), 3, 3)), np.zeros(len(xyz))
    if not len(xyz) or not shake2.any():
        return covariance, images
    variance = np.where(variance > 0.0, variance, variance[variance > 0.0].min())
    normal, moved = np.zeros_like(covariance), np.zeros_like(covariance)
    for camera, own, shaken in zip(rig.cameras, variance, shake2, strict=True):
        found = project_with_jacobians(camera, xyz)
        inside = inside_image(camera, found.xy_px)
        slopes = np.where(inside[:, None, None], found.by_point, 0.0)
        square = slopes.transpose(0, 2, 1) @ slopes
        normal += square / own
        moved += square * (shaken / own**2)
        images += inside
    seen = (images >= 2) & (np.linalg.cond(normal) < WORST_CONDITION)
    inverse = np.linalg.inv(normal[seen])
    covariance[seen] = inverse @ moved[seen] @ inverse
    return covariance, images


def without(covariance: Array, shared: Array) -> Array:
    """Return covariances (..., 3, 3) minus a ``shared`` part (..., 3, 3), at least LEAST_OWN of each direction.

    Covariances that are not positive definite, 0 where unknown, are returned as they are.
    """
    return _by_shares(covariance, shared, lambda share: np.maximum(1.0 - share, LEAST_OWN))


def no_more_than(shared: Array, covariance: Array) -> Array:
    """Return a ``shared`` part (..., 3, 3) of errors cut to ``covariance`` (..., 3, 3) in each direction.

    Where the covariance is not positive definite, or 0, it is returned in place of the part.
    """
    return _by_shares(covariance, shared, lambda share: np.minimum(share, 1.0))


def _by_shares(covariance: Array, part: Array, left: Callable[[Array], Array]) -> Array:
    """Return covariances (..., 3, 3) scaled along the directions in which ``part`` is a share of them.

    ``left``: by how much, given the shares; those that are not positive definite are returned as they are.
    """
    found, known = np.array(covariance), np.linalg.eigvalsh(covariance)[..., 0] > 0
    root = np.linalg.cholesky(found[known])
    inverse = np.linalg.inv(root)
    share, axes = np.linalg.eigh(inverse @ np.broadcast_to(part, found.shape)[known] @ inverse.swapaxes(1, 2))
    found[known] = root @ (axes * left(share)[:, None, :]) @ axes.swapaxes(1, 2) @ root.swapaxes(1, 2)
    return found
