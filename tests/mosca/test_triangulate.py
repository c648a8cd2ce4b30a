"""Triangulation: hand geometry, OpenCV, and predicted errors that match the real ones."""

import cv2
import numpy as np
import pytest
from rigs import PINHOLE, ring
from scipy.stats import chi2

from mosca.camera.projection import project
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from mosca.triangulation.triangulate import triangulate

MOSCA = MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01, -0.006, 1e-3, -1.5e-5, 0, 1e-4, 5e-5)


def images(rig, points):
    return np.stack([project(camera, points) for camera in rig.cameras], axis=1)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_exact_images_give_exact_points(count):
    rig = ring(count, MOSCA)
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    xyz, _, residual = triangulate(rig, images(rig, points))
    np.testing.assert_allclose(xyz, points, atol=1e-9)
    assert residual.max() < 1e-6


def test_two_cameras_depth_error_by_hand():
    # parallel cameras 1 m apart, f 800 px, point at 4 m: sigma_Z = sqrt(2) sigma Z^2 / (f B) = 1.414 * 0.1 * 16 / 800
    rig = Rig(tuple(Camera(f"c{k}", 656, 491, PINHOLE, Pose(np.eye(3), [k, 0, 0])) for k in (0, 1)))
    point = np.array([[0.5, 0.0, 4.0]])
    _, covariance, _ = triangulate(rig, images(rig, point), sigma_px=0.1)
    assert np.sqrt(covariance[0, 2, 2]) == pytest.approx(np.sqrt(2) * 0.1 * 16 / 800, rel=0.02)
    # across: two measurements of Z / f each, sigma_X = sigma Z / f / sqrt(2)
    assert np.sqrt(covariance[0, 1, 1]) == pytest.approx(0.1 * 4 / 800 / np.sqrt(2), rel=0.02)


def test_opencv_finds_the_same_point_from_exact_pinhole_images():
    rig = ring(2)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (10, 3))
    matrix = np.array([[800.0, 0, 327.5], [0, 800.0, 245.0], [0, 0, 1]])
    projections = []
    for camera in rig.cameras:
        back = camera.world_from_camera.inverse()
        projections.append(matrix @ np.column_stack([back.rotation, back.translation]))
    xy = images(rig, points)
    h = cv2.triangulatePoints(projections[0], projections[1], xy[:, 0].T.copy(), xy[:, 1].T.copy())
    np.testing.assert_allclose(triangulate(rig, xy)[0], (h[:3] / h[3]).T, atol=1e-8)


def test_predicted_covariance_is_honest():
    rig, rng, sigma = ring(4, MOSCA), np.random.default_rng(2), 0.2
    points = rng.uniform(-0.4, 0.4, (2000, 3))
    xyz, covariance, residual = triangulate(rig, images(rig, points) + rng.normal(0, sigma, (2000, 4, 2)), sigma)
    error = xyz - points
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    # the sum of 2000 chi-squares with 3 degrees of freedom, both ways
    assert chi2.ppf(0.001, 6000) < nees.sum() < chi2.ppf(0.999, 6000)
    # 8 observations, 3 unknowns
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(sigma * np.sqrt(5 / 8), rel=0.03)


def test_a_point_seen_once_is_nan():
    rig = ring(3, MOSCA)
    xy = images(rig, np.zeros((1, 3)))
    xy[0, 1:] = np.nan
    assert np.isnan(triangulate(rig, xy)[0]).all()


def test_all_of_the_covariance_is_that_of_least_squares():
    rig, sigma, step = ring(3, MOSCA), 0.15, 1e-5
    points = np.array([[0.3, -0.2, 0.1], [-0.35, 0.3, -0.3]])
    _, covariance, _ = triangulate(rig, images(rig, points), sigma)
    slopes = [
        (images(rig, points + step * axis) - images(rig, points - step * axis)) / (2 * step) for axis in np.eye(3)
    ]
    design = np.stack(slopes, axis=-1).reshape(len(points), -1, 3)
    expected = sigma**2 * np.linalg.inv(np.swapaxes(design, 1, 2) @ design)
    np.testing.assert_allclose(covariance, expected, atol=1e-6 * np.abs(expected).max())
