"""A wand calibrates cameras of unknown focal length, and sessions that are not of this wand are refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from wand_scenes import HEIGHT, WIDTH, outward_ring, rig, seen, similarity, waved, waved_around

from mosca.calibration.initial.projective import fundamental
from mosca.calibration.uncalibrated.end_order import ordered
from mosca.calibration.uncalibrated.wand import calibrate_wand
from mosca.camera.projection import project
from mosca.data.calibration import Calibration
from mosca.data.rig import OpenCVLens
from mosca.data.wands import Wand
from mosca.errors import CalibrationError, InputError

WAND = Wand((0.0, 0.15, 0.5), 0.02)
TWO_BALLS = Wand((0.0, 0.5), 0.02)
LENS = ("c_mm", "xp_px", "yp_px", "K1_per_mm2")


def unknown(cameras):
    """Return lenses with the right pixel size only; the principal distance is off by a factor of two."""
    return [replace(c.lens, c_mm=2 * c.lens.c_mm, xp_px=0.0, yp_px=0.0, K1_per_mm2=0.0) for c in cameras]


def calibrated(cameras, sightings, wand=WAND) -> Calibration:
    return calibrate_wand(sightings, wand, np.random.default_rng(0), unknown(cameras))


def normalised_errors(calibration, cameras, world):
    """Return errors over standard deviations of all lens parameters and positions, and the scale's error.

    The points carry the comparison; of those that two cameras see, a blunder along their rays cannot be noticed.
    """
    used = calibration.used
    points = calibration.points_in_world()[used]
    true = world.reshape(-1, 3)[calibration.sightings.mark[used]]
    for _ in range(5):
        scale, turn, shift = similarity(points, true)
        off = np.linalg.norm(scale * points @ turn.T + shift - true, axis=1)
        good = off < 6 * np.median(off)
        points, true = points[good], true[good]
    scale, turn, shift = similarity(points, true, False)
    sigma, out = calibration.standard_deviations, []
    for found, is_ in zip(calibration.rig.cameras, cameras, strict=True):
        for name in LENS:
            out.append((getattr(found.lens, name) - getattr(is_.lens, name)) / sigma[f"{found.name}.{name}"])
        centre = turn.T @ (is_.world_from_camera.translation - shift) / scale
        away = found.world_from_camera.translation - centre
        out += [x / sigma[f"{found.name}.{axis}_m"] for x, axis in zip(away, "XYZ", strict=True)]
    return np.array(out), similarity(points, true)[0] - 1


@pytest.mark.parametrize(("cameras", "frames"), [(4, 300), (6, 300)])
def test_a_waved_wand_gives_the_rig_within_its_own_bounds(cameras, frames):
    true, world = rig(cameras, seed=cameras), waved(frames, seed=cameras)
    found = calibrated(true, seen(true, world, seed=cameras))
    z, scale = normalised_errors(found, true, world)
    assert np.abs(z).max() < 4.5
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5
    assert abs(scale) < 1e-4
    assert 0.9 < found.sigma0 < 1.1
    assert found.refused == ()


def test_cameras_of_quite_different_focal_lengths():
    true, world = rig(3, seed=1, focals=(5.5, 12.0, 8.0)), waved(300, size=(0.7, 0.7, 0.7))
    found = calibrated(true, seen(true, world))
    z, scale = normalised_errors(found, true, world)
    assert np.abs(z).max() < 4.5
    assert abs(scale) < 1e-4


def test_two_cameras_will_do():
    true, world = rig(4, seed=3)[:2], waved(300)
    found = calibrated(true, seen(true, world))
    z, scale = normalised_errors(found, true, world)
    assert np.abs(z).max() < 4.5
    assert abs(scale) < 2e-4


def test_zones_of_neighbours_are_chained():
    true, world = outward_ring(8), waved_around(1000)
    sightings = seen(true, world)
    together = np.zeros((8, 1000), dtype=bool)
    together[sightings.camera, sightings.frame] = True
    assert together.sum(axis=0).max() <= 2
    found = calibrated(true, sightings)
    z, scale = normalised_errors(found, true, world)
    assert np.abs(z).max() < 4.5
    assert abs(scale) < 5e-4


def test_two_balls_whose_order_nobody_knows():
    true, world = rig(4, seed=2), waved(300, along=(0.0, 0.5))
    sightings = seen(true, world)
    rng = np.random.default_rng(5)
    pairs = np.arange(len(sightings)).reshape(-1, 2)
    pairs = np.where(rng.random(len(pairs))[:, None] < 0.5, pairs[:, ::-1], pairs)
    shuffled = sightings.only(pairs.ravel())
    number = shuffled.mark.copy()
    shuffled = replace(shuffled, mark=np.full(len(shuffled), -1))
    known = ordered(shuffled, 2, unknown(true), rng)
    assert np.mean(known.mark >= 0) > 0.9
    # all cameras of a frame agree, up to which end is called 0
    alike = np.where(known.mark >= 0, (known.mark == number).astype(float), np.nan)
    wrong = sum(min(np.nansum(one), np.nansum(1 - one)) for one in (alike[known.frame == f] for f in range(300)))
    assert wrong / np.isfinite(alike).sum() < 0.01
    found = calibrated(true, shuffled, TWO_BALLS)
    middle = world.mean(axis=1)
    both = np.asarray(found.marks_m[:600]).reshape(-1, 2, 3).mean(axis=1)
    good = np.isfinite(both).all(axis=1)
    scale, turn, shift = similarity(both[good], middle[good])
    assert abs(scale - 1) < 1e-4
    assert np.median(np.linalg.norm(scale * both[good] @ turn.T + shift - middle[good], axis=1)) < 1e-3


def test_a_wrong_wand_length_shows_only_in_the_scale():
    true, world = rig(4, seed=3), waved(200)
    found = calibrated(true, seen(true, world), Wand((0.0, 0.153, 0.51), 0.02))
    _, scale = normalised_errors(found, true, world)
    assert scale == pytest.approx(0.5 / 0.51 - 1, abs=2e-4)
    assert found.sigma0 < 1.1


def test_the_wands_own_uncertainty_is_in_the_covariance():
    true, world = rig(4, seed=3), waved(150)
    sightings = seen(true, world)
    sure = calibrated(true, sightings).standard_deviations
    doubtful = calibrated(true, sightings, Wand((0.0, 0.15, 0.5), 0.02, sigma_m=0.002)).standard_deviations
    # 0.002 sqrt 2 / 0.5 of about 4 m
    assert doubtful["cam1.X_m"] > 5 * sure["cam1.X_m"]


def broken(how, sightings):
    """Return the sightings of a session that went wrong."""
    if how == "swapped half-way":
        late = (sightings.frame >= 100) & (sightings.camera < 2)
        return replace(sightings, camera=np.where(late, 1 - sightings.camera, sightings.camera))
    if how == "one camera late":
        return replace(sightings, frame=np.where(sightings.camera == 1, (sightings.frame + 7) % 200, sightings.frame))
    if how == "two groups":
        return sightings.only(np.where(sightings.camera < 2, sightings.frame < 100, sightings.frame >= 100))
    if how == "few":
        return sightings.only((sightings.camera != 2) | (sightings.frame < 8))
    raise ValueError(how)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("swapped half-way", "its own"),
        ("one camera late", "same instants"),
        ("two groups", "no-link: no common view joins cameras cam1, cam2 with cam3, cam4|cam3, cam4 with cam1, cam2"),
        ("few", "camera 'cam3' shares"),
    ],
)
def test_a_session_that_went_wrong_is_refused(how, says):
    true, world = rig(4, seed=3), waved(200)
    with pytest.raises(CalibrationError, match=says):
        calibrated(true, broken(how, seen(true, world)))


def test_another_wand_is_refused():
    true, world = rig(4, seed=3), waved(200)
    with pytest.raises(CalibrationError, match="wrong-size"):
        calibrated(true, seen(true, world), Wand((0.0, 0.2, 0.5), 0.02))


def test_a_wand_moved_in_a_plane_is_refused():
    true, world = rig(4, seed=3), waved(200)
    world[..., 2] = 1.0
    with pytest.raises(CalibrationError, match="little-depth"):
        calibrated(true, seen(true, world))


def test_bad_sightings_are_named():
    true, world = rig(3, seed=3), waved(60)
    sightings = seen(true, world)
    with pytest.raises(InputError, match="twice"):
        calibrated(true, replace(sightings, mark=np.zeros(len(sightings))))
    half = np.where(np.arange(len(sightings)) % 2, -1, sightings.mark)
    with pytest.raises(InputError, match="either all or none"):
        calibrated(true, replace(sightings, mark=half))
    with pytest.raises(InputError, match="lenses: 2 given for 3"):
        calibrate_wand(sightings, WAND, np.random.default_rng(0), unknown(true)[:2])


@pytest.mark.parametrize("seed", range(4))
def test_points_by_chance_are_refused(seed):
    rng = np.random.default_rng(seed)
    true = rig(4, seed=seed)
    sightings = seen(true, waved(150, seed=seed))
    chance = rng.uniform(0, 1, (len(sightings), 2)) * (WIDTH, HEIGHT)
    with pytest.raises(CalibrationError):
        calibrated(true, replace(sightings, xy_px=chance))


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


def test_pixels_that_are_not_square_are_found_in_opencvs_model():
    # by 0.1 % as sensors' data sheets allow: a third of a pixel at the image's edge if it were not found
    true = tuple(
        replace(c, lens=OpenCVLens(640.0 + 5 * k, (640.0 + 5 * k) * 1.001, 327.0 + k, 246.0, -0.1, 0.05))
        for k, c in enumerate(rig(4, seed=6))
    )
    sightings = seen(true, waved(250, seed=6), 0.01, blunders=0.0, seed=6)
    found = calibrate_wand(sightings, WAND, np.random.default_rng(0), [OpenCVLens(1.0, 1.0, 0.0, 0.0)] * 4)
    for camera in found.rig.cameras:
        assert camera.lens.fy_px / camera.lens.fx_px == pytest.approx(1.001, abs=2e-4)
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)


def outlined(cameras, world, sightings, radius_m):
    """Return sightings of the middles of the balls' outlines: polygons of the rims that the rays touch."""
    turn = np.arange(60) * 2 * np.pi / 60
    xy = np.array(sightings.xy_px)
    for k, camera in enumerate(cameras):
        mine = np.flatnonzero(sightings.camera == k)
        at = world[sightings.frame[mine], sightings.mark[mine]]
        away = at - camera.world_from_camera.translation
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        side = np.cross(away, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        up = np.cross(side, away / distance)
        rim = (at - away * (radius_m / distance) ** 2)[:, None] + (
            radius_m
            * np.sqrt(1 - (radius_m / distance) ** 2)[:, None]
            * (np.cos(turn)[:, None] * side[:, None] + np.sin(turn)[:, None] * up[:, None])
        )
        corners = project(camera, rim.reshape(-1, 3)).reshape(len(at), len(turn), 2)
        centre = project(camera, at)
        a, b = corners - centre[:, None], np.roll(corners, -1, axis=1) - centre[:, None]
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        xy[mine] += ((a + b) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1)[:, None])
    return replace(sightings, xy_px=xy)


def test_large_balls_are_seen_eccentrically():
    along = (0.0, 0.3, 0.8)
    true, world = rig(4, seed=8), waved(250, along, seed=8)
    sightings = outlined(true, world, seen(true, world, 0.01, blunders=0.0, seed=8), 0.1)
    found = calibrated(true, sightings, Wand(along, 0.2))
    # (r / R)^2 = 600 ppm, which would go into the principal distances: 45 standard deviations
    assert np.abs(normalised_errors(found, true, world)[0]).max() < 4.5
