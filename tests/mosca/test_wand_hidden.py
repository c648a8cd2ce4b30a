"""Balls that the wand's own bar hides in part: their shift is learned and stretches neither wand nor rig."""

from dataclasses import replace

import numpy as np
import pytest
from wand_scenes import behind_bars, rig, seen, similarity, waved

from mosca.calibration.uncalibrated.image_points import point_views
from mosca.calibration.uncalibrated.partial_adjustment import rods_between
from mosca.calibration.uncalibrated.wand import calibrate_wand, rods_of
from mosca.data.wands import Wand

NOISE_PX = 0.005
SHIFT_M = 5e-4
"""As far as Mitsuba's images have it: a hundredth of a ball's diameter."""


def scale_error(along, most_m, frames=200, alike_from_m=None):
    cameras = rig(4, seed=4)
    world = waved(frames, along=along, seed=4)
    sightings = seen(cameras, world, NOISE_PX, blunders=0.0, seed=4)
    found = calibrate_wand(
        behind_bars(cameras, world, sightings, most_m, alike_from_m),
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


def test_a_shift_by_as_many_pixels_in_small_images_as_in_large_ones_is_none_of_the_cameras():
    scale, found = scale_error((0.0, 0.15, 0.5), SHIFT_M, alike_from_m=4.0)
    assert abs(scale) < 5e-5
    # 0.0036 px where the shift is taken to be in proportion to the images' size
    assert found.body_px < NOISE_PX / 5


def test_a_wand_that_hides_nothing_keeps_its_image_points():
    scale, found = scale_error((0.0, 0.15, 0.5), 0.0)
    assert abs(scale) < 3e-5
    cameras = rig(4, seed=4)
    sightings = seen(cameras, waved(200, seed=4), NOISE_PX, blunders=0.0, seed=4)
    assert np.allclose(found.sightings.xy_px, sightings.xy_px, atol=1e-9)


def test_distances_that_others_imply_on_a_line_count_once():
    cameras, along, frames = rig(4, seed=4), (0.0, 0.12, 0.31, 0.5), 3
    sightings = seen(cameras, waved(frames, along=along, seed=4), NOISE_PX, blunders=0.0, share=1.0)
    lenses = tuple(camera.lens for camera in cameras)
    tracks = point_views(sightings, len(along), lenses, rods_of(Wand(along, 1e-6), frames))
    # three distances place four points on a line; the other three are their sums
    assert len(rods_between(tracks, 1.0).first) == 3 * frames
    # without the first ball of the first wand two place the three that are left
    left = rods_between(tracks.only(tracks.point != 0), 1.0)
    assert len(left.first) == 3 * frames - 1
    assert 0 not in left.first


def test_images_that_are_cut_are_left_out_and_told():
    along, frames = (0.0, 0.15, 0.5), 200
    cameras, world = rig(4, seed=4), waved(frames, along=along, seed=4)
    sightings = seen(cameras, world, NOISE_PX, blunders=0.0, seed=4)
    rng = np.random.default_rng(1)
    cut = rng.random(len(sightings)) < 0.15
    # a chord across a disc of 4 px: depth b, minor axis and centre off by b / 2, at any angle
    half, angle = rng.uniform(0.7, 1.2, len(sightings)), rng.uniform(0, 2 * np.pi, len(sightings))
    at = np.column_stack([np.cos(angle), np.sin(angle)])
    stretch = -np.log(1 - half / 4)[:, None] * -np.column_stack([np.cos(2 * angle), np.sin(2 * angle)])
    shifted = replace(
        sightings,
        xy_px=sightings.xy_px + np.where(cut, half, 0.0)[:, None] * at,
        ellipticity=np.where(cut[:, None], stretch, 0.0),
        ellipticity_sigma=np.full(len(sightings), 0.005),
    )
    lenses = [camera.lens for camera in cameras]
    found = calibrate_wand(shifted, Wand(along, 1e-6), np.random.default_rng(0), lenses)
    told = [one.message for one in found.findings if one.code == "hidden-balls"]
    # a ball that one camera alone sees has no position that tells what its image should be
    ball = sightings.frame * len(along) + sightings.mark
    judged = cut & (np.bincount(ball)[ball] > 1)
    wanted = f"{judged.sum()} of {len(sightings)} images of balls are cut by what is before them, and left out"
    assert told == [wanted]
    assert found.body_px < NOISE_PX
    assert 0.8 < found.sigma0 < 1.2
    # blurred by motion or by a lens: all are ellipses, and none is left out
    blurred = replace(sightings, ellipticity=np.tile([0.3, 0.0], (len(sightings), 1)))
    found = calibrate_wand(blurred, Wand(along, 1e-6), np.random.default_rng(0), lenses)
    assert len(found.sightings) == len(sightings)
    assert "hidden-balls" not in {one.code for one in found.findings}
