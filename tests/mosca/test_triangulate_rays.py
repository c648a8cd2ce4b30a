"""Compiled rays against the lens models and OpenCV; the calibration's share against disturbed parameters."""

from dataclasses import astuple, replace

import cv2
import numpy as np
import pytest
from calibration_scenes import field_calibration, good_rig
from changed_rigs import changed_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.calibration.quality.point_covariance import calibration_covariance
from mosca.camera.projection import project, rays
from mosca.camera.ray_table import LONG, make_ray_table
from mosca.data.detections import Detections
from mosca.data.rays import ANGLE, FLAGS, SIGMA, SPREAD, WHITE
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.triangulation.triangulate import triangulate

POSE = Pose(Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix(), np.array([0.4, -1.2, 2.0]))
LENSES = {
    "mosca": MoscaLens(8.0, 330.0, 240.0, 0.01, 0.0099, -0.006, 1e-3, -1.5e-5, 1e-8, 1e-4, 5e-5),
    "opencv": OpenCVLens(800.0, 790.0, 330.0, 240.0, -0.2, 0.05, 1e-3, -5e-4, 0.01, 0.01, 0.02, 0.003),
    "prism": OpenCVLens(
        800.0, 790.0, 330.0, 240.0, -0.2, 0.05, 1e-3, -5e-4, 0.01, s1=1e-3, s2=1e-4, s3=-1e-3, s4=2e-4,
        tauX=0.03, tauY=-0.05,
    ),
    "fisheye": FisheyeLens(210.0, 208.0, 330.0, 240.0, 0.02, -0.01, 2e-3, -3e-4),
}  # fmt: skip
COVARIANCE = np.array([[0.01, 0.004], [0.004, 0.02]])


def detected(xy):
    n = len(xy)
    return Detections("c", xy, np.tile(COVARIANCE, (n, 1, 1)), np.full(n, 6.0), np.ones(n), np.ones(n))


def bundled(lens, xy, sigma=0.0):
    rig = Rig((Camera("c", 656, 491, lens, POSE),))
    return make_ray_table(rig, {"c": detected(xy)}, sigma), rays(rig.cameras[0], xy)


@pytest.mark.parametrize("name", list(LENSES))
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_rays_and_their_errors_are_those_of_the_lens_model(name, seed):
    xy = np.random.default_rng(seed).uniform((-5, -5), (660, 495), (20, 2))
    bundle, true = bundled(LENSES[name], xy, 0.05)
    np.testing.assert_allclose(bundle.direction, true.direction, atol=1e-11)
    root = np.linalg.cholesky(COVARIANCE + 0.05**2 * np.eye(2))
    white = np.linalg.solve(root, true.pixel_by_direction)
    np.testing.assert_allclose(bundle.rays[:, WHITE : WHITE + 6].reshape(-1, 2, 3), white, rtol=1e-8, atol=1e-5)
    spread = np.linalg.pinv(white)
    np.testing.assert_allclose(bundle.rays[:, SPREAD : SPREAD + 6].reshape(-1, 3, 2), spread, rtol=1e-7, atol=1e-11)
    assert bundle.rays[:, SIGMA] == pytest.approx(np.linalg.det(root @ root.T) ** 0.25)


@pytest.mark.parametrize("name", ["opencv", "prism"])
def test_opencv_images_the_rays_at_their_pixels(name):
    lens = LENSES[name]
    xy = np.random.default_rng(0).uniform((0, 0), (655, 490), (50, 2))
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    distortion = np.array(astuple(lens)[4:])
    local = bundled(lens, xy)[0].direction @ POSE.rotation
    again = cv2.projectPoints(np.ascontiguousarray(local), np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
    np.testing.assert_allclose(again, xy, atol=1e-8)


def test_a_fisheye_looks_behind_itself_and_ends_at_its_image_circle():
    lens = FisheyeLens(150.0, 150.0, 330.0, 240.0)
    xy = np.array([[330.0 + 150.0 * 2.0, 240.0], [330.0, 240.0], [330.0 + 150.0 * 3.2, 240.0]])
    direction = bundled(lens, xy)[0].direction @ POSE.rotation
    np.testing.assert_allclose(direction[0], [np.sin(2.0), 0, np.cos(2.0)], atol=1e-12)
    np.testing.assert_allclose(direction[1], [0, 0, 1], atol=1e-12)
    assert np.isnan(direction[2]).all()


def test_the_angle_of_an_image_is_its_size_over_the_focal_length():
    lens = OpenCVLens(800.0, 800.0, 330.0, 240.0)
    assert bundled(lens, np.array([[330.0, 240.0]]))[0].rays[0, ANGLE] == pytest.approx(6.0 / 800.0)


def test_long_regions_are_told_from_round_ones():
    rig = Rig((Camera("c", 656, 491, LENSES["mosca"], POSE),))

    def long_at(sides, diameter_px):
        found = replace(
            detected(np.array([[330.0, 240.0]])),
            elongation=np.array([sides[0] / sides[1]]),
            diameter_px=np.array([diameter_px]),
        )
        return int(make_ray_table(rig, {found.camera: found}, 0.0).rays[0, FLAGS]) & LONG > 0

    # boxes of regions [px] and the diameter of the disc with their light, as images of small markers have them
    for sides, diameter_px in (((4, 4), 2.8), ((4, 3), 2.3), ((5, 4), 2.9), ((6, 5), 3.7), ((11, 10), 9.4)):
        assert not long_at(sides, diameter_px)
    for sides, diameter_px in (((5, 3), 2.8), ((6, 4), 3.7), ((12, 9), 9.4)):
        assert long_at(sides, diameter_px)


def test_no_ray_beyond_the_fold_and_none_without_a_covariance():
    lens = replace(LENSES["mosca"], K1_per_mm2=-0.1)  # folds back at 1.8 mm, 180 px
    bundle, _ = bundled(lens, np.array([[340.0, 240.0], [600.0, 240.0]]))
    assert np.isfinite(bundle.rays[0]).all()
    assert np.isnan(bundle.rays[1]).all()


@pytest.fixture(scope="module")
def calibration():
    return field_calibration(1, good_rig(np.random.default_rng(1), 3), noise_px=0.2)


def test_the_calibrations_share_is_what_disturbed_parameters_do(calibration):
    rng = np.random.default_rng(3)
    points = rng.uniform((-0.4, -0.4, 0.7), (0.4, 0.4, 1.3), (8, 3))
    seen = np.ones((8, 3), dtype=bool)
    seen[:3, 1] = False
    exact = np.stack([project(camera, points) for camera in calibration.rig.cameras], axis=1)
    exact[~seen] = np.nan
    share = calibration_covariance(calibration, points, seen)
    changes = rng.multivariate_normal(np.zeros(len(calibration.parameters)), calibration.covariance, 300)
    moved = np.array([triangulate(changed_rig(calibration, change), exact)[0] for change in changes]) - points
    ratio = np.einsum("tni,tni->n", moved, moved) / 300 / np.trace(share, axis1=1, axis2=2)
    # a variance from 300 trials of three unequal axes is good to some 8 %; every point within 4 of those
    assert np.all((ratio > 0.7) & (ratio < 1.35))
    # fewer cameras: the calibration moves the point more
    all_three = calibration_covariance(calibration, points[:3], np.ones((3, 3), dtype=bool))
    assert np.all(np.trace(share[:3], axis1=1, axis2=2) > np.trace(all_three, axis1=1, axis2=2))


def test_the_calibrations_share_of_what_one_camera_saw_is_unknown(calibration):
    share = calibration_covariance(calibration, np.array([[0.0, 0.0, 1.0]]), np.array([[True, False, False]]))
    assert np.isnan(share).all()
