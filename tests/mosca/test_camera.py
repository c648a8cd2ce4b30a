"""Camera maths against numbers done by hand, OpenCV and finite differences."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.camera.projection import (
    convert_lens,
    fit_lens,
    image_grid,
    lens_directions,
    lens_pixels,
    project,
    project_with_jacobians,
    rays,
)
from mosca.data.frames import Frame, mid_exposure_ns
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose
from mosca.errors import InputError

# Table 2 of the Mosca paper, camera 1; the table prints no principal distance: 6.5 mm is chosen here
TABLE_2 = MoscaLens(
    6.5, 291.4501, 255.45588, 0.00943414, 0.00944242, -0.00668, 0.0008712, -0.0000182, 0.00000032, 0.0002827,
    0.00004459,
)  # fmt: skip
OPENCV = OpenCVLens(700.0, 702.0, 330.0, 240.0, -0.21, 0.08, 6e-4, -4e-4, -0.01)
RATIONAL = OpenCVLens(700.0, 702.0, 330.0, 240.0, 0.11, 0.03, 6e-4, -4e-4, 0.01, 0.2, 0.05, 0.01)
FISHEYE = FisheyeLens(210.0, 211.0, 320.0, 241.0, -0.02, 0.003, -0.001, 0.0001)
LENSES = [TABLE_2, OPENCV, RATIONAL, FISHEYE]
W, H = 656, 491


def rotation(rng: np.random.Generator) -> np.ndarray:
    return cv2.Rodrigues(rng.normal(size=3))[0]


def camera(lens, rng: np.random.Generator) -> Camera:
    return Camera("c", W, H, lens, Pose(rotation(rng), rng.normal(size=3)))


def test_first_principles_a_point_one_pixel_right_and_down():
    lens = MoscaLens(c_mm=8.0, xp_px=100.0, yp_px=50.0, mx_mm_per_px=0.01, my_mm_per_px=0.02)
    # 8 mm principal distance, 0.01 mm pitch: one metre aside at 8 m is 1 mm = 100 px
    pixel = lens_pixels(lens, np.array([[1.0, 0.0, 8.0], [0.0, 1.0, 8.0], [0.0, 0.0, 3.0]]))
    np.testing.assert_allclose(pixel, [[200.0, 50.0], [100.0, 100.0], [100.0, 50.0]], atol=1e-12)


def test_mosca_correction_by_hand():
    # measured point xb = 2 mm, yb = 1 mm (up), r2 = 5; a = .01, K1 = .001, P1 = .002, P2 = .003
    lens = MoscaLens(10.0, 0.0, 0.0, 0.01, 0.01, a=0.01, K1_per_mm2=0.001, P1_per_mm=0.002, P2_per_mm=0.003)
    # dx = .01*1 + 2*.001*5 + (5 + 8)*.002 + 2*2*1*.003 = .01 + .01 + .026 + .012 = .058
    # dy = .01*2 + 1*.001*5 + 2*2*1*.002 + (5 + 2)*.003 = .02 + .005 + .008 + .021 = .054
    v = lens_directions(lens, np.array([[200.0, -100.0]]))[0]
    np.testing.assert_allclose(v[:2] / v[2], [2.058 / 10, -1.054 / 10], rtol=1e-14)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: type(lens).__name__)
def test_pixel_to_ray_to_pixel(lens):
    grid = image_grid(W, H)
    np.testing.assert_allclose(lens_pixels(lens, lens_directions(lens, grid)), grid, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: type(lens).__name__)
def test_jacobians_against_finite_differences(lens):
    rng = np.random.default_rng(3)
    cam = camera(lens, rng)
    v = lens_directions(lens, rng.uniform((5, 5), (W - 5, H - 5), (20, 2))) * rng.uniform(1, 4, (20, 1))
    points = cam.world_from_camera.transform(v)
    p = project_with_jacobians(cam, points)
    pose, h = cam.world_from_camera, 1e-6

    def difference(seen, h):
        return (seen(h) - seen(-h)) / (2 * h)

    for k, axis in enumerate(np.eye(3)):
        numeric = difference(lambda s, axis=axis: project(cam, points + s * axis), h)
        np.testing.assert_allclose(p.by_point[:, :, k], numeric, rtol=1e-5, atol=1e-4)

        def turned(s, axis=axis):
            rotation = pose.rotation @ cv2.Rodrigues(s * axis)[0]
            return project(replace(cam, world_from_camera=Pose(rotation, pose.translation)), points)

        def shifted(s, axis=axis):
            return project(replace(cam, world_from_camera=Pose(pose.rotation, pose.translation + s * axis)), points)

        np.testing.assert_allclose(p.by_pose[:, :, k], difference(turned, h), rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(p.by_pose[:, :, 3 + k], difference(shifted, h), rtol=1e-5, atol=1e-4)
    for k, name in enumerate(f.name for f in fields(lens)):
        value = getattr(lens, name)
        numeric = difference(
            lambda s, name=name, value=value: lens_pixels(replace(lens, **{name: value + s}), v),
            1e-6 * max(abs(value), 1e-3),
        )
        np.testing.assert_allclose(p.by_lens[:, :, k], numeric, rtol=2e-4, atol=1e-3 * np.abs(numeric).max() + 1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: type(lens).__name__)
def test_rays_give_the_reprojection_error(lens):
    rng = np.random.default_rng(4)
    cam = camera(lens, rng)
    xy = rng.uniform((20, 20), (W - 20, H - 20), (30, 2))
    bundle = rays(cam, xy)
    points = bundle.origin + bundle.direction * rng.uniform(1, 4, (30, 1)) + rng.normal(0, 2e-4, (30, 3))
    along = points - bundle.origin
    error = (
        np.einsum("nij,nj->ni", bundle.pixel_by_direction, along)
        / np.einsum("nj,nj->n", bundle.direction, along)[:, None]
    )
    np.testing.assert_allclose(error, project(cam, points) - xy, atol=2e-3)


def test_points_behind_and_folded_back_are_nan():
    assert np.isnan(lens_pixels(TABLE_2, np.array([[0.0, 0.0, -1.0]]))).all()
    barrel = OpenCVLens(700, 700, 320, 240, k1=-0.5)  # r (1 - r2/2) turns back at r = 0.816
    assert np.isnan(lens_pixels(barrel, np.array([[1.5, 0.0, 1.0]]))).all()


def test_a_polynomial_that_rises_again_images_nothing_there():
    # r (1 - 0.4 r^2 + 0.06 r^4) turns back at r = 1.0879, at a value of 0.6643, and passes it again at r = 2.0
    lens = OpenCVLens(300, 300, 160, 110, k1=-0.4, k2=0.06)
    xy = lens_pixels(lens, np.array([[1.08, 0.0, 1.0], [1.8, 0.0, 1.0], [2.5, 0.0, 1.0]]))
    np.testing.assert_array_equal(np.isfinite(xy).all(axis=1), [True, False, False])
    # nor does a pixel farther out than 0.6643 x 300 px have a ray
    v = lens_directions(lens, np.array([[160 + 190.0, 110.0], [160 + 210.0, 110.0], [160 + 400.0, 110.0]]))
    np.testing.assert_array_equal(np.isfinite(v[:, 0]), [True, False, False])


def test_a_rational_lens_ends_at_its_pole():
    # r / (1 - r^2 / 4): the pole is at r = 2
    lens = OpenCVLens(300, 300, 160, 110, k4=-0.25)
    xy = lens_pixels(lens, np.array([[1.9, 0.0, 1.0], [2.1, 0.0, 1.0], [9.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(np.isfinite(xy).all(axis=1), [True, False, False])


def test_middle_of_a_rolling_shutter_frame_without_its_image():
    # 10 rows, 100 ns apart: the middle row's window opens 450 ns after the first's
    image = np.zeros((10, 4), dtype=np.uint8)
    ok = Frame("c", 0, 1000, 200, image, row_time_ns=100)
    lost = Frame("c", 0, 1000, 200, None, "dropped", row_time_ns=100, rows=10)
    assert mid_exposure_ns(ok) == mid_exposure_ns(lost) == 1000 + 100 + 450
    assert mid_exposure_ns(Frame("c", 0, 1000, 200, None, "dropped", row_time_ns=100)) == 1100


@pytest.mark.parametrize(
    ("source", "model", "at_most"), [(OPENCV, "mosca", 0.05), (replace(TABLE_2, a=0.0), "opencv", 0.2)]
)
def test_conversion_states_its_residual(source, model, at_most):
    made = convert_lens(source, model, W, H)
    grid = image_grid(W, H, 7.0)
    distance = np.linalg.norm(lens_pixels(made.lens, lens_directions(source, grid)) - grid, axis=1)
    assert np.sqrt(np.mean(distance**2)) == pytest.approx(made.rms_px, rel=0.2)
    assert made.rms_px < at_most


def test_conversion_says_what_it_cannot_express():
    # OpenCV has no shear: a = -0.00668 over 330 px leaves up to about 2 px at the corners
    made = convert_lens(TABLE_2, "opencv", W, H)
    assert made.rms_px > 1.0
    assert made.max_px > 2.0


def test_conversion_to_itself_is_exact():
    made = fit_lens("mosca", image_grid(W, H), lens_directions(TABLE_2, image_grid(W, H)), TABLE_2)
    assert made.max_px < 1e-9


def test_conversion_refuses_what_it_cannot_do():
    with pytest.raises(InputError, match="there are mosca, opencv, fisheye"):
        fit_lens("pinhole", np.zeros((20, 2)), np.ones((20, 3)))
    with pytest.raises(InputError, match="at least 10"):
        fit_lens("opencv", np.zeros((5, 2)), np.ones((5, 3)))


@settings(max_examples=50, deadline=None)
@given(st.floats(-0.02, 0.02), st.floats(-2e-3, 2e-3), st.floats(-1e-4, 1e-4), st.integers(0, 2**31))
def test_projection_inverts_the_closed_form(a, k1, k2, seed):
    lens = MoscaLens(7.0, 320.0, 245.0, 0.0098, 0.0099, a, k1, k2)
    xy = np.random.default_rng(seed).uniform((0, 0), (W, H), (20, 2))
    np.testing.assert_allclose(lens_pixels(lens, lens_directions(lens, xy)), xy, atol=1e-8)
