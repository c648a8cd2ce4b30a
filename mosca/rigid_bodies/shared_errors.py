"""Errors of a body's position that are common to a camera's images and do not average out over the markers.

A camera that shakes shifts all images of a body together, anew in each frame. The misfit of a lens model shifts them
together as well, and the shift lasts while the body stays in that part of the image. A pose's covariance takes the
errors of images as independent. Here an image's error is the detection's own error plus a shift of its camera. The
pose is the least-squares fit that weights images by their whole variance. Its error is the sum of the errors that
each part causes (error propagation; Luhmann et al., Close-Range Photogrammetry, 3rd ed., section 2.4).
"""

from typing import NamedTuple

import numpy as np

from mosca.camera.projection import cross_matrices, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Rig


class PositionErrors(NamedTuple):
    """Covariances (3, 3) [m^2] of the position of a body's point, world axes."""

    passing: Array
    """From errors that are new in each frame: noise of the images and shake of the cameras."""
    lasting: Array
    """From errors that stay while the body moves little: the misfit of the lens models."""
    independent: Array
    """From both, if the errors of all images were independent."""


def position_errors(
    rig: Rig, markers: Array, point: Array, covariance_px2: Array, sigma_px: Array
) -> PositionErrors | None:
    """Return the covariances of a body's ``point`` from images of ``markers``; None where it is undetermined.

    Parameters
    ----------
    rig
        c calibrated cameras; ``residual_px`` of each is the misfit of its lens model.
    markers, point
        (m, 3) and (3,) [m, world].
    covariance_px2
        (m, c, 2, 2) of the detection noise of a marker's image [px^2], NaN where there is no image.
    sigma_px
        (c,) further error of each camera's images, an axis, including the misfit of its lens model [px].
    """
    arms = cross_matrices(markers - point)
    lens = np.minimum([camera.residual_px for camera in rig.cameras], sigma_px)
    normal, noise, spread = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    pulls = np.zeros((len(rig.cameras), 6, 2))
    for c, camera in enumerate(rig.cameras):
        slopes = project_with_jacobians(camera, markers).by_point
        for arm, slope, own in zip(arms, slopes, covariance_px2[:, c], strict=True):
            if not (np.isfinite(own).all() and np.isfinite(slope).all()):
                continue
            rows = np.hstack([slope, -slope @ arm])
            pull = rows.T @ np.linalg.inv(own + sigma_px[c] ** 2 * np.eye(2))
            normal += pull @ rows
            noise += pull @ own @ pull.T
            spread += sigma_px[c] ** 2 * pull @ pull.T
            pulls[c] += pull
    if np.linalg.matrix_rank(normal, hermitian=True) < len(normal):
        return None
    moves = np.linalg.inv(normal)[:3]
    shifts = np.einsum("ij,cjk->cik", moves, pulls)
    shaken, bent = (np.einsum("c,cik,cjk->ij", part, shifts, shifts) for part in (sigma_px**2 - lens**2, lens**2))
    return PositionErrors(moves @ noise @ moves.T + shaken, bent, moves @ (noise + spread) @ moves.T)
