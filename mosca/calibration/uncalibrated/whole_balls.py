"""Distinction of images of whole balls from those that are cut by an object before the ball.

Where a straight edge cuts off a depth b of a ball's image of radius r, the best-fitting ellipse has a minor semi-axis
and a centre that are off by b / 2: an ellipticity e beyond that of a whole ball indicates a shift of up to e r.
"""

from collections.abc import Mapping

import numpy as np

from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.partial_adjustment import intersected
from mosca.camera.projection import project_with_jacobians
from mosca.camera.ray_table import IMAGE_NOISE, ROUND_SIGMAS
from mosca.data.arrays import Array
from mosca.data.rig import Camera
from mosca.data.sightings import Sightings


def whole_balls(sightings: Sightings, tracks: PointViews, cameras: Mapping[int, Camera]) -> Array:
    """Return which sightings (n,) are of whole balls, as far as the shapes of their images show.

    ``cameras``: rough ones are sufficient to predict the ellipse of a whole ball. Sightings with another ellipse are
    not of whole balls, unless this holds for most of their camera's (blur by motion or lens), or where no position
    gives a prediction.
    """
    points, whole = intersected(tracks, cameras), np.ones(len(sightings), dtype=bool)
    for k, camera in cameras.items():
        mine = np.flatnonzero((tracks.camera == k) & np.isfinite(points[tracks.point]).all(axis=1))
        row = tracks.row[mine]
        slope = project_with_jacobians(camera, points[tracks.point[mine]]).by_point
        # the outline of a small ball: the image of a disc across the line of sight
        outline = slope @ slope.transpose(0, 2, 1)
        ball = np.column_stack([0.5 * (outline[:, 0, 0] - outline[:, 1, 1]), outline[:, 0, 1]])
        ball /= np.sqrt(np.linalg.det(outline))[:, None]
        found, sigma = sightings.ellipticity[row], sightings.ellipticity_sigma[row]
        beyond = np.square(found - ball).sum(axis=1) > ROUND_SIGMAS**2 * (sigma**2 + IMAGE_NOISE**2)
        # an ellipticity of zero means that it is not significant
        cut = beyond & found.any(axis=1)
        if cut.sum() < len(mine) / 2:
            whole[row] = ~cut
    return whole
