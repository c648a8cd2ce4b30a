"""The predicted accuracy against Monte Carlo: pixels disturbed for detection, parameters for the calibration."""

import numpy as np
import pytest
from calibration_scenes import field_calibration, good_rig
from changed_rigs import changed_rig

from mosca.calibration.quality.accuracy_map import accuracy_map, triangulated_points
from mosca.calibration.quality.jacobian import sensitivity
from mosca.camera.projection import project
from mosca.triangulation.triangulate import triangulate

TRIALS = 300


@pytest.fixture(scope="module")
def calibration():
    return field_calibration(1, good_rig(np.random.default_rng(1), 3), noise_px=0.2)


@pytest.fixture(scope="module")
def predicted(calibration):
    return accuracy_map(calibration, (-0.6, -0.6, 0.6), (0.6, 0.6, 1.4), (3, 3, 2), 0.1)


def places(grid) -> np.ndarray:
    return np.stack(np.meshgrid(grid.x, grid.y, grid.z, indexing="ij"), axis=-1).reshape(-1, 3)


def pixels(rig, points) -> np.ndarray:
    return np.stack([project(camera, points) for camera in rig.cameras], axis=1)


def ratio(found, sigma_m) -> np.ndarray:
    """Return the trace of the empirical over that of the predicted covariance, per position."""
    return np.einsum("tni,tni->n", found, found) / len(found) / sigma_m.ravel() ** 2


@pytest.mark.slow
def test_detection_is_what_disturbed_pixels_do(calibration, predicted):
    rng = np.random.default_rng(2)
    points = places(predicted)
    exact = pixels(calibration.rig, points)
    noisy = exact[None] + rng.normal(0, 0.1, (TRIALS, *exact.shape))
    found = triangulate(calibration.rig, noisy.reshape(-1, *exact.shape[1:]))[0].reshape(TRIALS, -1, 3) - points
    # 300 trials of 3 unequal axes: a standard deviation of some 7 % each, 2 % over all positions
    share = ratio(found, predicted.detection_m)
    assert np.all((share > 0.7) & (share < 1.35))
    assert share.mean() == pytest.approx(1, abs=0.08)


def test_calibration_is_what_disturbed_parameters_do(calibration, predicted):
    rng = np.random.default_rng(3)
    points = places(predicted)
    exact = pixels(calibration.rig, points)
    changes = rng.multivariate_normal(np.zeros(len(calibration.parameters)), calibration.covariance, TRIALS)
    found = np.array([triangulate(changed_rig(calibration, change), exact)[0] - points for change in changes])
    share = ratio(found, predicted.calibration_m)
    assert np.all((share > 0.7) & (share < 1.35))
    assert share.mean() == pytest.approx(1, abs=0.12)


def test_where_nothing_looks_there_is_no_figure(calibration):
    far = accuracy_map(calibration, (50, 50, 50), (60, 60, 60), (2, 2, 2), 0.1)
    assert np.isnan(far.sigma_m).all()


def test_derivatives_are_those_of_the_changed_rig(calibration):
    points = np.array([[0.1, 0.2, 1.1], [-0.4, 0.3, 0.8]])
    for k, camera in enumerate(calibration.rig.cameras):
        one = sensitivity(calibration.rig, k, calibration.parameters, points)
        for column, parameter in enumerate(one.columns):
            step = 1e-2 * np.sqrt(calibration.covariance[parameter, parameter])
            change = np.zeros(len(calibration.parameters))
            change[parameter] = step
            ahead = project(changed_rig(calibration, change).cameras[k], points)
            behind = project(changed_rig(calibration, -change).cameras[k], points)
            numeric = (ahead - behind) / (2 * step)
            assert np.allclose(one.by_parameter[:, :, column], numeric, rtol=1e-4, atol=1e-6 * np.abs(numeric).max())
        assert camera.name in calibration.parameters[one.columns[0]]


def test_measured_points_are_those_of_the_triangulation(calibration):
    points = np.array([[0.1, 0.2, 1.1], [-0.4, 0.3, 0.8]])
    camera, key = np.repeat(np.arange(3), 2), np.tile([7, 3], 3)
    xy = np.concatenate([project(c, points) for c in calibration.rig.cameras])
    found = triangulated_points(calibration, camera, key, xy, np.tile(0.01 * np.eye(2), (6, 1, 1)))
    assert list(found.key) == [3, 7]
    assert np.allclose(found.xyz, points[::-1], atol=1e-9)
    assert found.by_parameter.shape == (2, 3, len(calibration.parameters))
