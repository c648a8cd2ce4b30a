"""Thin prism, tilted sensor and the fisheye beyond 90 degrees: against OpenCV, closed forms, finite differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.camera.lens_models.arrays import FOLD, radial_slope, ray_row
from mosca.camera.projection import (
    HELD,
    convert_lens,
    fit_lens,
    image_grid,
    lens_directions,
    lens_pixels,
    project,
    rays,
)
from mosca.camera.projection import project_with_jacobians as projected
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.errors import InputError
from mosca.numba_support.decorators import kernel
from mosca.triangulation.triangulate import triangulate

W, H = 656, 491
AXIS = Pose(np.eye(3), np.zeros(3))
NAMES = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"]
BENT = (700.0, 702.0, 330.0, 240.0, -0.21, 0.08, 6e-4, -4e-4, -0.01, 0.02, 0.01, 0.003)
PRISM = OpenCVLens(*BENT, s1=0.004, s2=-0.003, s3=0.002, s4=0.001)
TILTED = OpenCVLens(*BENT, s1=0.004, s2=-0.003, s3=0.002, s4=0.001, tauX=0.08, tauY=-0.05)
UPRIGHT = OpenCVLens(*BENT)
PLAIN = OpenCVLens(*BENT[:9])
WIDE = FisheyeLens(120.0, 121.0, 320.0, 241.0, -0.02, 0.003, -0.001, 0.0001)


def by_opencv(lens: OpenCVLens, v: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    distortion = np.array([getattr(lens, name) for name in NAMES[:count]])
    xy, jacobian = cv2.projectPoints(v, np.zeros(3), np.zeros(3), matrix, distortion)
    return xy[:, 0], jacobian.reshape(len(v), 2, -1)


def in_front(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.4, 0.4, (n, 2)), np.ones(n)]) * rng.uniform(1, 5, (n, 1))


@pytest.mark.parametrize(("lens", "count"), [(PLAIN, 5), (UPRIGHT, 12), (PRISM, 12), (PRISM, 14), (TILTED, 14)])
def test_opencv_projects_the_same_and_has_the_same_slopes(lens, count):
    v = in_front(60, 1)
    expected, jacobian = by_opencv(lens, v, count)
    p = projected(Camera("c", W, H, lens, AXIS), v)
    np.testing.assert_allclose(p.xy_px, expected, rtol=0, atol=1e-9)
    # OpenCV's columns: rotation, translation (moves the points against the camera), focal lengths, centre, distortion
    np.testing.assert_allclose(p.by_point, jacobian[:, :, 3:6], rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(p.by_lens[:, :, : 4 + count], jacobian[:, :, 6:], rtol=1e-9, atol=1e-7)


def test_slopes_by_the_tilt_where_there_is_none():
    v, h = in_front(20, 2), 1e-6
    slopes = projected(Camera("c", W, H, UPRIGHT, AXIS), v).by_lens
    for column, name in ((16, "tauX"), (17, "tauY")):
        plus, minus = (lens_pixels(OpenCVLens(*BENT, **{name: s * h}), v) for s in (1, -1))
        np.testing.assert_allclose(slopes[:, :, column], (plus - minus) / (2 * h), rtol=1e-6, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(
    prism=st.tuples(*[st.floats(-0.01, 0.01)] * 4),
    tau=st.tuples(*[st.floats(-0.3, 0.3)] * 2),
    seed=st.integers(0, 2**31),
)
def test_pixel_to_ray_to_pixel_with_prism_and_tilt(prism, tau, seed):
    lens = OpenCVLens(*BENT, *prism, *tau)
    xy = lens_pixels(lens, in_front(20, seed))
    v = lens_directions(lens, xy)
    assert np.isfinite(v).all()
    np.testing.assert_allclose(lens_pixels(lens, v), xy, atol=1e-8)
    np.testing.assert_allclose(v / v[:, 2:], in_front(20, seed) / in_front(20, seed)[:, 2:], atol=1e-9)


def test_a_sensor_tilted_beyond_the_light_sees_nothing():
    # rotated by 1.2 rad about y, the sensor's plane is parallel to rays of slope tan(pi/2 - 1.2) = 0.389 towards
    # -x: r31 x + r33 = sin(1.2) x + cos(1.2)
    lens = OpenCVLens(100.0, 100.0, 320.0, 240.0, tauY=1.2)
    seen = np.isfinite(lens_pixels(lens, np.array([[0.0, 0, 1], [-0.38, 0, 1], [-0.40, 0, 1]]))).all(axis=1)
    np.testing.assert_array_equal(seen, [True, True, False])


def test_a_fit_keeps_prism_and_tilt():
    grid = image_grid(W, H)
    seen = lens_directions(TILTED, grid)
    assert fit_lens("opencv", grid, seen, TILTED).max_px < 1e-9
    free = fit_lens("opencv", grid, seen).lens
    assert isinstance(free, OpenCVLens)
    assert [getattr(free, name) for name in sorted(HELD["opencv"])] == [0.0] * 9
    assert free.k1 != 0.0


@pytest.mark.parametrize("theta_deg", [0.0, 30.0, 89.999, 90.0, 90.001, 95.0, 140.0])
def test_equidistant_in_closed_form_before_and_behind(theta_deg):
    theta, about = np.deg2rad(theta_deg), np.deg2rad(25.0)
    lens = FisheyeLens(100.0, 100.0, 320.0, 240.0)
    v = np.array([[np.sin(theta) * np.cos(about), np.sin(theta) * np.sin(about), np.cos(theta)]])
    expected = [[320.0 + 100.0 * theta * np.cos(about), 240.0 + 100.0 * theta * np.sin(about)]]
    np.testing.assert_allclose(lens_pixels(lens, 3.0 * v), expected, atol=1e-10)
    np.testing.assert_allclose(lens_directions(lens, np.array(expected)), v, atol=1e-12)


def test_opencv_fisheye_inside_its_range():
    v = np.column_stack([np.random.default_rng(2).uniform(-6.0, 6.0, (80, 2)), np.ones(80)])  # up to 83 deg
    matrix = np.array([[WIDE.fx_px, 0, WIDE.cx_px], [0, WIDE.fy_px, WIDE.cy_px], [0, 0, 1.0]])
    k = np.array([WIDE.k1, WIDE.k2, WIDE.k3, WIDE.k4])
    expected, jacobian = cv2.fisheye.projectPoints(v[None], np.zeros(3), np.zeros(3), matrix, k)
    p = projected(Camera("c", W, H, WIDE, AXIS), v)
    np.testing.assert_allclose(p.xy_px, expected.reshape(-1, 2), atol=1e-9)
    # OpenCV's columns: focal lengths, centre, k1-k4, ...
    np.testing.assert_allclose(p.by_lens, jacobian[:, :8].reshape(-1, 2, 8), rtol=1e-9, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(theta=st.floats(1e-3, np.deg2rad(120.0)), about=st.floats(0, 6.3), length=st.floats(0.1, 10.0))
def test_fisheye_slopes_before_and_behind(theta, about, length):
    v = length * np.array([[np.sin(theta) * np.cos(about), np.sin(theta) * np.sin(about), np.cos(theta)]])
    slopes = projected(Camera("c", W, H, WIDE, AXIS), v).by_point[0]
    h = 1e-6 * length
    for k in range(3):
        step = h * np.eye(3)[k]
        numeric = (lens_pixels(WIDE, v + step) - lens_pixels(WIDE, v - step))[0] / (2 * h)
        np.testing.assert_allclose(slopes[:, k], numeric, rtol=1e-5, atol=1e-4 / length)


@kernel
def slope_at(row, square):
    return radial_slope(row, square)


@pytest.mark.parametrize(
    "lens",
    [
        MoscaLens(7.0, 327.5, 245.0, 0.0099, 0.0099, K1_per_mm2=-0.02),
        OpenCVLens(700.0, 702.0, 330.0, 240.0, k1=-0.2),
        FisheyeLens(300.0, 300.0, 330.0, 240.0, k1=-0.1),
    ],
    ids=lambda lens: type(lens).__name__,
)
def test_the_radial_slope_of_one_term(lens):
    # r (1 + k r^2) rises with 1 + 3 k r^2, and folds where that is 0
    row, k = ray_row(lens), getattr(lens, "k1", None) or lens.K1_per_mm2
    for square in (0.0, 0.3, 1.0, 1.4):
        assert slope_at(row, square) == pytest.approx(1.0 + 3.0 * k * square, rel=1e-12)
    assert row[FOLD] == pytest.approx(-1.0 / (3.0 * k), rel=1e-9)


def test_slopes_on_the_axis_are_a_pinholes():
    v = np.array([[0.0, 0.0, 2.0], [1e-10, 2e-10, 2.0]])
    slopes = projected(Camera("c", W, H, WIDE, AXIS), v).by_point
    expected = np.array([[60.0, 0.0, 0.0], [0.0, 60.5, 0.0]])
    np.testing.assert_allclose(slopes, [expected, expected], atol=1e-7)


def test_nothing_comes_from_outside_the_image_circle():
    # without distortion the circle is 100 pi px; with theta (1 - 0.1 theta^2) it ends at theta^2 = 1 / 0.3, where the
    # radius is 100 x 1.82574 x 2 / 3 px
    steps = np.array([0.01, 0.5, 0.999999, 1.000001, 1.5, 30.0])
    for lens, circle in (
        (FisheyeLens(100.0, 100.0, 320.0, 240.0), 100.0 * np.pi),
        (FisheyeLens(100.0, 100.0, 320.0, 240.0, -0.1), 100.0 * np.sqrt(1 / 0.3) * 2 / 3),
        (FisheyeLens(100.0, 100.0, 320.0, 240.0, -0.1, 0.01), None),  # monotonic: 1 - 0.3 s + 0.05 s^2 > 0
    ):
        edge = circle or 100.0 * np.pi * (1 - 0.1 * np.pi**2 + 0.01 * np.pi**4)
        at = np.column_stack([320.0 + edge * steps, np.full(len(steps), 240.0)])
        v = lens_directions(lens, at)
        np.testing.assert_array_equal(np.isfinite(v).all(axis=1), steps < 1)
        np.testing.assert_allclose(lens_pixels(lens, v[:3]), at[:3], atol=1e-8)
    nowhere = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [np.nan, 0.0, 1.0]])
    assert np.isnan(lens_pixels(WIDE, nowhere)).all()


def test_a_fisheye_of_190_degrees_is_fitted_from_its_rays():
    grid = image_grid(W, H)
    seen = lens_directions(WIDE, grid)
    usable = seen[:, 2] > np.cos(np.deg2rad(95.0))
    assert (seen[usable, 2] < 0).any()
    fit = fit_lens("fisheye", grid[usable], seen[usable])
    assert fit.max_px < 1e-7
    np.testing.assert_allclose([fit.lens.k1, fit.lens.k2, fit.lens.fx_px], [-0.02, 0.003, 120.0], rtol=1e-6)


def test_a_pinhole_model_refuses_rays_from_beside_the_camera():
    with pytest.raises(InputError, match="rays stand 90 deg or more off the axis, which model 'mosca' cannot image"):
        convert_lens(WIDE, "mosca", W, H)


def test_rays_behind_the_camera_meet_in_their_point():
    # a body-worn fisheye sees a point 5 deg behind its own plane; the ray's reprojection error is that of the lens
    point = np.array([np.sin(np.deg2rad(95.0)), 0.2, np.cos(np.deg2rad(95.0))]) * 1.5
    camera = Camera("chest", W, H, WIDE, AXIS)
    xy = lens_pixels(WIDE, point)
    bundle = rays(camera, xy)
    np.testing.assert_allclose(bundle.direction[0], point / np.linalg.norm(point), atol=1e-12)
    moved = point + [2e-4, -1e-4, 3e-4]
    error = bundle.pixel_by_direction[0] @ moved / (bundle.direction[0] @ moved)
    np.testing.assert_allclose(error, (lens_pixels(WIDE, moved) - xy)[0], atol=1e-4)


def test_two_fisheyes_triangulate_what_stands_behind_them():
    cameras = tuple(
        Camera(name, W, H, WIDE, Pose(np.eye(3), np.array(place)))
        for name, place in (("chest", [0.0, 0.0, 0.0]), ("head", [0.0, 1.0, 0.0]))
    )
    points = np.array([[1.0, 0.4, -0.05], [1.0, 0.4, -0.3], [0.0, 0.5, 2.0]])
    xy = np.stack([project(camera, points) for camera in cameras], axis=1)
    xyz, _covariance, residual = triangulate(Rig(cameras), xy, 0.1)
    np.testing.assert_allclose(xyz, points, atol=1e-9)
    assert residual.max() < 1e-9


def test_mosca_has_no_such_terms():
    assert HELD["mosca"] == {"mx_mm_per_px"}
    assert HELD["fisheye"] == set()
    fit = fit_lens("mosca", image_grid(W, H), lens_directions(PRISM, image_grid(W, H)))
    assert isinstance(fit.lens, MoscaLens)
    assert fit.rms_px > 0.01
