"""Errors that a camera's images share, in a body's position, against drawn images fitted with scipy and OpenCV."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rigs import ring
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.data.rig import Rig
from mosca.rigid_bodies.shared_errors import position_errors

MARKERS = np.array([[0.15, 0.02, 0.05], [-0.11, 0.12, 0.06], [0.03, -0.14, 0.0], [-0.12, -0.1, -0.03]])
POINT = np.array([0.02, -0.03, -0.08])
PLACE = np.array([0.1, -0.2, 0.15])
NOISE_PX, SHAKE_PX, LENS_PX = 0.02, np.array([0.03, 0.04, 0.02, 0.03]), np.array([0.03, 0.01, 0.02, 0.0])


def made_rig() -> Rig:
    rig = ring(4)
    return Rig(tuple(replace(one, residual_px=float(px)) for one, px in zip(rig.cameras, LENS_PX, strict=True)))


def opencv(camera):
    """Return what cv2.projectPoints takes of a camera: rotation vector, translation, matrix."""
    pose = camera.world_from_camera
    turn = pose.rotation.T
    lens = camera.lens
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    return cv2.Rodrigues(turn)[0], -turn @ pose.translation, matrix


def images(cameras, x):
    """Return the markers' images (c, m, 2) of a body whose ``POINT`` is at PLACE + x[:3], turned by x[3:]."""
    there = (MARKERS - POINT) @ Rotation.from_rotvec(x[3:]).as_matrix().T + PLACE + x[:3]
    return np.stack([cv2.projectPoints(there, *one, None)[0][:, 0] for one in cameras])


def fitted(cameras, seen, weight):
    """Return the position's error (3,) of the weighted least-squares pose; ``weight`` (c,) 1/px."""
    scale = np.array([1e-3] * 3 + [1e-2] * 3)
    found = least_squares(
        lambda y: ((images(cameras, y * scale) - seen) * weight[:, None, None]).ravel(), np.zeros(6), method="lm"
    )
    return found.x[:3] * scale[:3]


def test_shake_and_misfit_move_a_body_as_drawn_ones_do():
    rig = made_rig()
    cameras = [opencv(one) for one in rig.cameras]
    true = images(cameras, np.zeros(6))
    np.testing.assert_allclose(true[0], project(rig.cameras[0], MARKERS - POINT + PLACE), atol=1e-6)
    total = np.sqrt(SHAKE_PX**2 + LENS_PX**2)
    weight = 1 / np.sqrt(total**2 + NOISE_PX**2)
    rng = np.random.default_rng(4)
    drawn = {"passing": [], "lasting": []}
    for _ in range(400):
        noise = rng.normal(0, NOISE_PX, true.shape)
        shake = rng.normal(0, 1, (4, 1, 2)) * SHAKE_PX[:, None, None]
        bent = rng.normal(0, 1, (4, 1, 2)) * LENS_PX[:, None, None]
        drawn["passing"].append(fitted(cameras, true + noise + shake, weight))
        drawn["lasting"].append(fitted(cameras, true + bent, weight))
    own = np.broadcast_to(NOISE_PX**2 * np.eye(2), (4, 4, 2, 2))
    found = position_errors(rig, MARKERS - POINT + PLACE, PLACE, own, total)
    for name in drawn:
        stated = getattr(found, name)
        nees = np.einsum("ni,ij,nj->n", np.array(drawn[name]), np.linalg.inv(stated), np.array(drawn[name]))
        # chi squared of 400 x 3 degrees: 3 +- 0.12 an instant; four of these
        assert nees.mean() == pytest.approx(3.0, abs=0.5), name
    # four markers average independent errors to a quarter of the variance, and those of four fifths alone not at all
    assert np.trace(found.passing + found.lasting) > 2.0 * np.trace(found.independent)


def test_without_shared_errors_it_is_the_poses_own_covariance():
    rig = Rig(tuple(replace(one, residual_px=0.0) for one in made_rig().cameras))
    own = np.broadcast_to(NOISE_PX**2 * np.eye(2), (4, 4, 2, 2))
    found = position_errors(rig, MARKERS - POINT + PLACE, PLACE, own, np.zeros(4))
    np.testing.assert_allclose(found.passing, found.independent, rtol=1e-9)
    np.testing.assert_array_equal(found.lasting, np.zeros((3, 3)))


def test_images_that_leave_the_pose_open_give_nothing():
    rig = made_rig()
    own = np.full((4, 4, 2, 2), np.nan)
    own[:2, 0] = np.eye(2) * NOISE_PX**2
    assert position_errors(rig, MARKERS - POINT + PLACE, PLACE, own, np.full(4, 0.03)) is None
