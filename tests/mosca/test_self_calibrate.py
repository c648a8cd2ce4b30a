"""Self-calibration needs neither lengths nor focal lengths, and never returns a mirrored or impossible rig."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_wand import normalised_errors, unknown
from wand_scenes import HEIGHT, PITCH, WIDTH, rig, seen, waved

from mosca.calibration.initial.projective import fundamental, intersect, projection
from mosca.calibration.uncalibrated.self_calibration import self_calibrate
from mosca.errors import CalibrationError


def light(frames, seed=1, **more):
    return waved(frames, along=(0.0,), seed=seed, **more)


@pytest.mark.parametrize(("cameras", "focals"), [(4, (7.5,)), (5, (6.0, 12.0, 8.5)), (7, (7.5,))])
def test_a_waved_light_gives_the_rig_up_to_its_size(cameras, focals):
    true, world = rig(cameras, seed=cameras, focals=focals), light(300, cameras)
    found = self_calibrate(seen(true, world), np.random.default_rng(0), unknown(true))
    z, _ = normalised_errors(found, true, world, stretch=True)
    assert np.abs(z).max() < 4.5
    # the errors of all focal lengths go together, so that one rig's rms is of little use (0.74 over eight rigs)
    assert np.sqrt(np.mean(z**2)) < 1.9
    # a similarity has no reflection, so a mirrored rig would miss by metres
    assert found.scaled_by.startswith("nothing")


def test_without_lenses_the_model_is_opencvs():
    true, world = rig(4, seed=9), light(250)
    found = self_calibrate(seen(true, world), np.random.default_rng(0))
    sigma = found.standard_deviations
    for one, is_ in zip(found.rig.cameras, true, strict=True):
        assert one.lens.model == "opencv"
        off_f, off_x = one.lens.fx_px - is_.lens.c_mm / PITCH, one.lens.cx_px - is_.lens.xp_px
        assert abs(off_f) < min(4 * sigma[f"{one.name}.f_px"], 3)
        assert abs(off_x) < min(4 * sigma[f"{one.name}.cx_px"], 5)
    assert found.sigma0 < 1.1


def test_zones_of_three_are_chained():
    true, world = rig(8, seed=5), light(900, 6)
    sightings = seen(true, world)
    sector = np.arange(900) % 8
    sightings = sightings.only((sightings.camera - sector[sightings.frame]) % 8 < 3)
    found = self_calibrate(sightings, np.random.default_rng(0), unknown(true))
    z, _ = normalised_errors(found, true, world, stretch=True)
    assert np.abs(z).max() < 5
    assert np.sqrt(np.mean(z**2)) < 1.6


def test_two_cameras_are_too_few():
    true, world = rig(4, seed=3)[:2], light(200)
    with pytest.raises(CalibrationError, match="third camera"):
        self_calibrate(seen(true, world), np.random.default_rng(0), unknown(true))


def test_pairs_that_share_nothing_with_a_third_are_refused():
    true, world = rig(4, seed=3), light(400)
    sightings = seen(true, world)
    sector = np.arange(400) % 4
    sightings = sightings.only((sightings.camera - sector[sightings.frame]) % 4 < 2)
    with pytest.raises(CalibrationError, match="three cameras see it at the same time"):
        self_calibrate(sightings, np.random.default_rng(0), unknown(true))


def test_a_plane_is_refused():
    true, world = rig(4, seed=3), light(200)
    world[..., 2] = 1.0
    with pytest.raises(CalibrationError, match="little-depth"):
        self_calibrate(seen(true, world), np.random.default_rng(0), unknown(true))


@pytest.mark.parametrize("seed", range(4))
def test_points_by_chance_are_refused(seed):
    rng = np.random.default_rng(seed)
    true = rig(4, seed=seed)
    sightings = seen(true, light(150, seed))
    chance = rng.uniform(0, 1, (len(sightings), 2)) * (WIDTH, HEIGHT)
    with pytest.raises(CalibrationError):
        self_calibrate(replace(sightings, xy_px=chance), rng, unknown(true))


def test_fundamental_matrix_is_opencvs_in_spite_of_blunders():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (200, 3)) + [0, 0, 5]
    turn = cv2.Rodrigues(np.array([0.1, 0.4, -0.05]))[0]
    x = points[:, :2] / points[:, 2:]
    moved = points @ turn.T + [1.0, 0.2, 0.1]
    y = moved[:, :2] / moved[:, 2:]
    clean = cv2.findFundamentalMat(x, y, cv2.FM_8POINT)[0]
    dirty = y.copy()
    dirty[:50] += rng.normal(0, 0.2, (50, 2))
    found = fundamental(x, dirty, rng)
    assert not found.inliers[:50].all()
    assert found.inliers[50:].mean() > 0.95
    clean = clean / np.linalg.norm(clean)
    assert np.abs(found.matrix * np.sign((found.matrix * clean).sum()) - clean).max() < 1e-6


def test_projection_and_intersection_return_what_was_projected():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.normal(size=(60, 3)), np.ones(60)])
    matrices = rng.normal(size=(3, 3, 4))
    image = points @ np.swapaxes(matrices, 1, 2)
    xy = image[..., :2] / image[..., 2:]
    found = projection(points, xy[0], rng).matrix
    assert np.allclose(found / found[2, 3], matrices[0] / matrices[0, 2, 3], rtol=1e-5, atol=1e-5)
    xy[2, :30] = np.nan
    xy[1, 0] = np.nan
    back = intersect(matrices, xy)
    assert np.isnan(back[0]).all()
    assert np.allclose(back[1:] / back[1:, 3:], points[1:], atol=1e-6)
