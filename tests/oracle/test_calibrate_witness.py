"""Another solver's optimum: ``cv2.calibrateCamera`` on the same noisy points and the same parameters."""

import cv2
import numpy as np
import pytest

from mosca.calibration.single_camera.adjust import AdjustmentSettings, adjust_camera

W, H = 1280, 1024
K = np.array([[900.0, 0.0, 650.0], [0.0, 905.0, 500.0], [0.0, 0.0, 1.0]])
FREE = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_same_optimum_as_opencv(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.7, 0.7, (150, 3))
    rotation, translation = rng.normal(0, 0.3, 3), np.array([0.05, 0.02, 2.2])
    distortion = np.array([-0.2, 0.06, 8e-4, -5e-4])
    xy = cv2.projectPoints(points, rotation, translation, K, distortion)[0].reshape(-1, 2)
    xy += rng.normal(0, 0.2, xy.shape)
    settings = AdjustmentSettings(parameters=FREE, blunder_significance=1e-9)
    done = adjust_camera("c", (W, H), "opencv", xy, points, rng, settings)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    rms, matrix, d, turns, shifts, sigma_interior, _, _ = cv2.calibrateCameraExtended(
        [points.astype(np.float32)],
        [xy.astype(np.float32)],
        (W, H),
        K.copy(),
        np.zeros(5),
        flags=flags,
        criteria=stop,
    )
    lens = done.camera.lens
    sigma = done.standard_deviations
    ours = np.array([getattr(lens, name) for name in FREE])
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *d.ravel()[:4]])
    scale = np.array([sigma[name] for name in FREE])
    # OpenCV takes its points as float32 (6e-5 px here): a hundredth of a standard deviation
    assert np.max(np.abs(ours - theirs) / scale) < 0.01
    assert np.sqrt(np.mean(np.sum(done.residuals_px**2, axis=1))) == pytest.approx(rms, rel=1e-5)
    place = -cv2.Rodrigues(turns[0])[0].T @ shifts[0].ravel()
    np.testing.assert_allclose(done.camera.world_from_camera.translation, place, atol=1e-5)
    # its standard deviations use the same redundancy
    np.testing.assert_allclose(scale, sigma_interior.ravel()[[0, 1, 2, 3, 4, 5, 6, 7]], rtol=0.02)
