"""Which images of balls are of whole balls, and which are cut by what is before them.

Where a straight edge cuts off a depth b of a ball's image of radius r, the ellipse that fits best has a minor
semi-axis and a centre that are off by b / 2: an ellipticity e beyond that of a whole ball tells of a shift up to e r.
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
    """Return which sightings (n,) are of whole balls, as far as the shapes of their images tell.

    ``cameras``: rough ones will do, they tell the ellipse that a whole ball makes. Those whose image is another are
    not, unless most of their camera's are (blur by motion or lens), or where no position tells what to expect.
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
        # zero: what was found is not significant
        cut = beyond & found.any(axis=1)
        if cut.sum() < len(mine) / 2:
            whole[row] = ~cut
    return whole
