"""Balls that the wand's own bar hides in part: their shift is learned and stretches neither wand nor rig."""

import numpy as np
import pytest
from wand_scenes import behind_bars, rig, seen, similarity, waved

from mosca.calibration.uncalibrated.wand import calibrate_wand
from mosca.data.wands import Wand

NOISE_PX = 0.005
SHIFT_M = 5e-4
"""As far as Mitsuba's images have it: a hundredth of a ball's diameter."""


def scale_error(along, most_m, frames=200):
    cameras = rig(4, seed=4)
    world = waved(frames, along=along, seed=4)
    sightings = seen(cameras, world, NOISE_PX, blunders=0.0, seed=4)
    found = calibrate_wand(
        behind_bars(cameras, world, sightings, most_m),
        # the sightings are those of centres, not of outlines
        Wand(along, 1e-6),
        np.random.default_rng(0),
        [camera.lens for camera in cameras],
    )
    used = found.used
    points = found.points_in_world()[used]
    return similarity(points, world.reshape(-1, 3)[found.sightings.mark[used]])[0] - 1, found


@pytest.mark.parametrize("along", [(0.0, 0.15, 0.5), (0.0, 0.5), (0.0, 0.12, 0.31, 0.5)])
def test_what_a_bar_hides_does_not_stretch_the_rig(along):
    scale, found = scale_error(along, SHIFT_M)
    # half a millimetre at half of the outer balls' views is 500 ppm of 0.5 m or so where nothing is done
    assert abs(scale) < 5e-5
    # and none of it is taken for shake of the cameras, nor for noise of all image points
    assert found.body_px < NOISE_PX
    assert 0.8 < found.sigma0 < 1.2


def test_a_wand_that_hides_nothing_keeps_its_image_points():
    scale, found = scale_error((0.0, 0.15, 0.5), 0.0)
    assert abs(scale) < 3e-5
    cameras = rig(4, seed=4)
    sightings = seen(cameras, waved(200, seed=4), NOISE_PX, blunders=0.0, seed=4)
    assert np.allclose(found.sightings.xy_px, sightings.xy_px, atol=1e-9)
