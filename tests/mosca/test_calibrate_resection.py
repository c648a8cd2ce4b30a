"""Resection from known points: cameras made with OpenCV come back; what cannot be a camera is refused."""

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mosca.calibration.initial.resection import aim, resect, resect_fisheye
from mosca.errors import CalibrationError

K = np.array([[1200.0, 0.0, 655.0], [0.0, 1210.0, 500.0], [0.0, 0.0, 1.0]])
W, H = 1280, 1024


def scene(rng: np.random.Generator, n: int = 40, angle: float = 0.4):
    """Points in a 1 m cube, 3 m before a camera of any orientation."""
    turn = cv2.Rodrigues(rng.normal(size=3) * angle)[0]
    points = rng.uniform(-0.5, 0.5, (n, 3))
    origin = turn.T @ np.array([0.1, -0.05, -3.0])
    return points, turn, origin


def pixels(points, turn, origin):
    # turned here: OpenCV's rotation vector of a matrix is zero below 1e-5 rad
    in_camera = (points - origin) @ turn.T
    return cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), K, None)[0].reshape(-1, 2)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(6, 60), angle=st.floats(0, 3))
@example(seed=0, n=12, angle=1e-5)
def test_an_exact_camera_comes_back(seed, n, angle):
    rng = np.random.default_rng(seed)
    points, turn, origin = scene(rng, n, angle)
    found = resect("camera 'c'", pixels(points, turn, origin), points, rng)
    lens = (found.lens.fx_px, found.lens.fy_px, found.lens.cx_px, found.lens.cy_px)
    # six random points may be nearly degenerate: the tolerance is on the rays, the figures on 1 px
    np.testing.assert_allclose(lens, (1200, 1210, 655, 500), atol=0.5 if n < 12 else 1e-3)
    np.testing.assert_allclose(found.world_from_camera.translation, origin, atol=2e-3 if n < 12 else 1e-6)
    np.testing.assert_allclose(found.world_from_camera.rotation, turn.T, atol=2e-3 if n < 12 else 1e-6)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_blunders_stay_out(share):
    rng = np.random.default_rng(5)
    points, turn, origin = scene(rng, 100)
    xy = pixels(points, turn, origin) + rng.normal(0, 0.2, (100, 2))
    bad = np.arange(int(100 * share))
    xy[bad] += rng.choice([-1, 1], (len(bad), 2)) * rng.uniform(20, 300, (len(bad), 2))
    found = resect("camera 'c'", xy, points, rng)
    assert not found.inliers[bad].any()
    assert found.inliers[len(bad) :].mean() > 0.95
    # the DLT of 70 points at 0.2 px: principal distance to about 1 %, centre to about 1 % of the distance
    assert abs(found.lens.fx_px - 1200) < 30
    assert np.linalg.norm(found.world_from_camera.translation - origin) < 0.06


def test_aim_keeps_the_ray_of_the_middle_pixel():
    rng = np.random.default_rng(6)
    points, turn, origin = scene(rng)
    found = resect("c", pixels(points, turn, origin), points, rng)
    ray = turn.T @ np.linalg.solve(K, [639.5, 511.5, 1.0])
    np.testing.assert_allclose(aim(found, (639.5, 511.5)).rotation[:, 2], ray / np.linalg.norm(ray), atol=1e-9)


def test_a_wide_fisheye_comes_back():
    rng = np.random.default_rng(7)
    # directions up to 100 degrees from the axis, at distances of 0.5 to 2 m
    theta, phi = rng.uniform(0.05, np.deg2rad(100), 80), rng.uniform(0, 2 * np.pi, 80)
    directions = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    turn, origin = cv2.Rodrigues(rng.normal(size=3))[0], np.array([0.3, 0.2, 1.0])
    points = origin + (directions * rng.uniform(0.5, 2.0, (80, 1))) @ turn
    # equidistant by definition: the image radius is f theta
    xy = np.array([639.5, 511.5]) + 300.0 * theta[:, None] * directions[:, :2] / np.sin(theta)[:, None]
    found = resect_fisheye("camera 'c'", (W, H), xy, points, rng)
    # the grid of field angles is coarse: a start, not a result
    assert abs(found.lens.fx_px - 300) < 25
    assert np.linalg.norm(found.world_from_camera.translation - origin) < 0.15


def refused(xy, points) -> str:
    with pytest.raises(CalibrationError) as error:
        resect("camera 'left'", xy, points, np.random.default_rng(0))
    text = str(error.value)
    assert text.removeprefix(f"{error.value.code}: ").startswith("camera 'left': ")
    assert "\n" not in text
    return text


def test_refusals_say_what_to_do():
    rng = np.random.default_rng(8)
    points, turn, origin = scene(rng)
    xy = pixels(points, turn, origin)
    assert "5 different points given, at least 6" in refused(xy[:5], points[:5])
    assert "5 different points" in refused(np.tile(xy[:5], (3, 1)), np.tile(points[:5], (3, 1)))
    flat = points * (1, 1, 0)
    assert "one plane" in refused(pixels(flat, turn, origin), flat)
    line = points[:, :1] * (1.0, 2.0, 3.0)
    assert "one line" in refused(pixels(line, turn, origin), line)
    assert "mirrored" in refused(xy, points * (1, -1, 1))
    assert "mirrored" in refused(xy[:, ::-1], points)
    assert "mirrored" in refused((0, H) + xy * (1, -1), points)
    shuffled = refused(xy[rng.permutation(len(xy))], points)
    assert any(word in shuffled for word in ("no camera fits", "behind the camera", "mirrored"))
    xy[3, 0] = np.nan
    assert "not a finite number" in refused(xy, points)


def test_a_plane_with_measuring_noise_is_still_a_plane():
    rng = np.random.default_rng(9)
    points, turn, origin = scene(rng)
    points[:, 2] = rng.normal(0, 0.0003, len(points))
    assert "one plane" in refused(pixels(points, turn, origin), points)
