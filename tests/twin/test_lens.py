"""The twin's lens against OpenCV, hand numbers, finite differences; its agreement with the pipeline's is plumbing."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mosca.camera.projection import fit_lens, image_grid, lens_directions, lens_pixels
from mosca.data.rig import FisheyeLens, MoscaLens, OpenCVLens
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.lens import GAPS, GapTerms, TwinLens, point_at_distance, project, warmed

W, H = 656, 491
MOSCA = MoscaLens(6.5, 291.45, 255.46, 0.00943, 0.00944, -0.0067, 8.7e-4, -1.8e-5, 3e-7, 2.8e-4, 4.5e-5)
OPENCV = OpenCVLens(700.0, 702.0, 330.0, 240.0, -0.21, 0.08, 6e-4, -4e-4, -0.01, 0.02, 0.01, 0.003)
PRISM = OpenCVLens(
    700.0, 702.0, 330.0, 240.0, -0.21, 0.08, 6e-4, -4e-4, -0.01, 0.02, 0.01, 0.003,
    s1=0.004, s2=-0.003, s3=0.002, s4=0.001, tauX=0.03, tauY=-0.02,
)  # fmt: skip
FISHEYE = FisheyeLens(270.0, 271.0, 320.0, 241.0, -0.02, 0.003, -0.001, 0.0001)
LENSES = {"mosca": MOSCA, "opencv": OPENCV, "prism": PRISM, "fisheye": FISHEYE}
TERMS = {
    "none": GapTerms(),
    "orders": GapTerms(0.25),
    "tilt": GapTerms(tilt_deg=(0.6, -0.4)),
    "pupil": GapTerms(pupil_shift_m=0.003),
    "all": GapTerms(0.25, (0.6, -0.4), -0.003),
}
BY_LENS = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
BY_TERMS = pytest.mark.parametrize("terms", TERMS.values(), ids=TERMS)


def opencv_pixels(lens: OpenCVLens, v: np.ndarray) -> np.ndarray:
    names = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"]
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    distortion = np.array([getattr(lens, name) for name in names])
    return cv2.projectPoints(v, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]


def test_hand_number():
    # measured point 2 mm right, 1 mm up: the correction is worked out in tests/mosca/test_camera.py
    lens = MoscaLens(10.0, 0.0, 0.0, 0.01, 0.01, a=0.01, K1_per_mm2=0.001, P1_per_mm=0.002, P2_per_mm=0.003)
    v = TwinLens.of(lens, W, H).directions(np.array([[200.0, -100.0]]))[0]
    np.testing.assert_allclose(v[:2] / v[2], [0.2058, -0.1054], rtol=1e-13)


@BY_LENS
@BY_TERMS
def test_slopes_against_finite_differences(lens, terms):
    twin = TwinLens.of(lens, W, H, terms)
    for place in twin.directions(np.array([[30.0, 40.0], [600.0, 300.0], [330.0, 250.0]]), 1.7) * 1.7:
        _u, _v, *slopes, ok = project(twin.vector, *place)
        assert ok
        for k in range(3):
            step = 1e-6 * np.eye(3)[k]
            numeric = (twin.pixels(place + step) - twin.pixels(place - step))[0] / 2e-6
            np.testing.assert_allclose([slopes[k], slopes[3 + k]], numeric, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("lens", [OPENCV, PRISM], ids=["opencv", "prism"])
def test_opencv_lands_on_the_same_pixel(lens):
    v = np.column_stack([np.random.default_rng(1).uniform(-0.4, 0.4, (40, 2)), np.ones(40)])
    np.testing.assert_allclose(TwinLens.of(lens, W, H).pixels(v), opencv_pixels(lens, v), atol=1e-9)


@BY_LENS
def test_same_numbers_same_rays_as_the_pipeline(lens):
    grid = image_grid(W, H)
    np.testing.assert_allclose(TwinLens.of(lens, W, H).directions(grid), lens_directions(lens, grid), atol=1e-11)


def test_a_tilted_sensor_is_opencvs():
    # a principal distance in front of the sensor is where OpenCV has its centre, so that the tilts are the same
    v = np.column_stack([np.random.default_rng(2).uniform(-0.4, 0.4, (40, 2)), np.ones(40)])
    tilted = TwinLens.of(OPENCV, W, H, GapTerms(tilt_deg=(1.5, -0.7)))
    tau = np.deg2rad([1.5, -0.7])
    expected = opencv_pixels(OpenCVLens(*(getattr(OPENCV, n) for n in FIELDS), tauX=tau[0], tauY=tau[1]), v)
    np.testing.assert_allclose(tilted.pixels(v), expected, atol=1e-9)


FIELDS = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]


@pytest.mark.parametrize("theta_deg", [0.0, 20.0, 45.0, 70.0])
def test_the_entrance_pupil_shifts_along_the_axis(theta_deg):
    # light that crosses the axis at (0, 0, p) with the slope tan(theta) lands where a pinhole puts that slope;
    # p = shift * 2 sin^2 theta, which is the shift at 45 deg
    shift, theta = 0.004, np.deg2rad(theta_deg)
    lens = OpenCVLens(100.0, 100.0, 328.0, 245.0)
    p = shift * 2 * np.sin(theta) ** 2
    assert theta_deg != 45.0 or p == pytest.approx(shift)
    places = np.array([[0.0, 0.0, p]]) + np.array([[0.3], [1.0], [8.0]]) * [np.sin(theta), 0.0, np.cos(theta)]
    xy = TwinLens.of(lens, W, H, GapTerms(pupil_shift_m=shift)).pixels(places)
    np.testing.assert_allclose(xy, [[328.0 + 100.0 * np.tan(theta), 245.0]] * 3, rtol=0, atol=1e-10)


def test_places_nearer_than_the_pupil_shift_are_not_imaged():
    twin = TwinLens.of(OPENCV, W, H, GapTerms(pupil_shift_m=0.01))
    assert np.isnan(twin.pixels(np.array([[0.01, 0.0, 0.01]]))).all()
    assert np.isfinite(twin.pixels(np.array([[0.1, 0.0, 0.2]]))).all()


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(sorted(LENSES)),
    gap=st.floats(-0.3, 0.3),
    tilt=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    shift=st.floats(-0.005, 0.005),
    distance=st.floats(0.2, 50.0),
    at=st.tuples(st.floats(0, W - 1), st.floats(0, H - 1)),
)
def test_land_inverts_origin(name, gap, tilt, shift, distance, at):
    vector = TwinLens.of(LENSES[name], W, H, GapTerms(gap, tilt, shift)).vector
    place = point_at_distance(vector, *at, distance)
    assert np.linalg.norm(place) == pytest.approx(distance, rel=1e-12)
    u, v, *_slopes, ok = project(vector, *place)
    assert ok
    np.testing.assert_allclose((u, v), at, rtol=0, atol=1e-7)


@settings(max_examples=100, deadline=None)
@given(
    name=st.sampled_from(sorted(LENSES)),
    terms=st.sampled_from(sorted(TERMS)),
    place=st.tuples(*[st.floats(-3, 3)] * 3),
    at=st.tuples(st.floats(-150.0, 800.0), st.floats(-120.0, 610.0)),
)
def test_any_place_and_any_pixel_has_an_answer(name, terms, place, at):
    # nothing is imaged from within the lens: the pupil moves by parts of a millimetre
    assume(np.linalg.norm(place) > 0.02)
    twin = TwinLens.of(LENSES[name], W, H, TERMS[terms])
    xy = twin.pixels(np.array([place]))
    if np.isfinite(xy).all():
        back = twin.directions(xy, np.linalg.norm(place))
        np.testing.assert_allclose(back[0] * np.linalg.norm(place), place, rtol=1e-6, atol=1e-9)
    v = twin.directions(np.array([at]))
    if np.isfinite(v).all():
        np.testing.assert_allclose(twin.pixels(1e9 * v)[0], at, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("theta_deg", [1e-9, 30.0, 89.0, 90.0, 91.0, 95.0, 150.0])
def test_equidistant_in_closed_form_before_and_behind(theta_deg):
    theta, about = np.deg2rad(theta_deg), np.deg2rad(25.0)
    lens = FisheyeLens(120.0, 120.0, 328.0, 245.0)
    v = np.array([np.sin(theta) * np.cos(about), np.sin(theta) * np.sin(about), np.cos(theta)])
    radius = 120.0 * theta
    expected = [328.0 + radius * np.cos(about), 245.0 + radius * np.sin(about)]
    twin = TwinLens.of(lens, W, H)
    np.testing.assert_allclose(twin.pixels(v), [expected], atol=1e-9)
    np.testing.assert_allclose(twin.directions(np.array([expected])), [v], atol=1e-12)
    _u, _v, *slopes, ok = project(twin.vector, *v)
    assert ok
    # along a meridian the image moves f d(theta), across it f theta / sin(theta); along the ray not at all
    along = [np.cos(theta) * np.cos(about), np.cos(theta) * np.sin(about), -np.sin(theta)]
    across = [-np.sin(about), np.cos(about), 0.0]
    slopes = np.array(slopes).reshape(2, 3)
    np.testing.assert_allclose(slopes @ along, 120.0 * np.array([np.cos(about), np.sin(about)]), atol=1e-6)
    stretch = 120.0 * theta / np.sin(theta)
    np.testing.assert_allclose(slopes @ across, stretch * np.array([-np.sin(about), np.cos(about)]), atol=1e-6)
    np.testing.assert_allclose(slopes @ v, 0.0, atol=1e-9)


def test_a_fisheye_images_nothing_beyond_its_circle_nor_straight_behind():
    lens = FisheyeLens(60.0, 60.0, 328.0, 245.0)
    twin = TwinLens.of(lens, W, H)
    edge = 60.0 * np.pi
    xy = 328.0 + np.array([0.999 * edge, 1.001 * edge, 3 * edge])
    seen = twin.directions(np.column_stack([xy, np.full(3, 245.0)]))
    np.testing.assert_array_equal(np.isfinite(seen).all(axis=1), [True, False, False])
    nowhere = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1e-20, 0.0, -1.0]])
    assert np.isnan(twin.pixels(nowhere)).all()
    # with a gap it is a real lens, whose image circle ends at 95 deg
    real = TwinLens.of(lens, W, H, GapTerms(0.05))
    angle = np.deg2rad([94.0, 96.0])
    places = np.column_stack([np.sin(angle), np.zeros(2), np.cos(angle)])
    # the circle of 190 deg, 99.5 px, is about the image's centre, half a pixel from the principal point
    np.testing.assert_array_equal(np.isfinite(real.pixels(places)).all(axis=1), [True, False])


CAMERAS = {
    "mosca_656": (MoscaLens(7.5, 330.5, 243.0, 0.0099, 0.0099, -6e-3, 1e-3, -1.5e-5, 0, 1e-4, 5e-5), W, H),
    "opencv_656": (OpenCVLens(757.0, 757.0, 330.5, 243.0, -0.056, 0.05, 7e-4, 4e-4), W, H),
    "mosca_12mp": (
        MoscaLens(12.0, 2050.0, 1510.0, 0.00345, 0.00345, 0, 5e-4, -2e-6, 0, 3e-5, 2e-5), 4112, 3008,
    ),
    "fisheye_190": (FisheyeLens(250.0, 250.0, 640.0, 480.0, -0.02, 0.001), 1280, 960),
}  # fmt: skip


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize(("gap", "low", "high"), [("none", 0, 1e-9), ("measured", 0.02, 0.05), ("stress", 0.1, 0.3)])
def test_the_gap_is_what_the_pipelines_model_cannot_follow(name, gap, low, high):
    lens, width, height = CAMERAS[name]
    grid, twin = image_grid(width, height, width / 30), TwinLens.of(lens, width, height, GAPS[gap])
    distances = (2.5, 3.5, 5.0, 7.0)
    seen = np.concatenate([twin.directions(grid, distance) for distance in distances])
    fit = fit_lens(lens.model, np.concatenate([grid] * len(distances)), seen, lens)
    assert low <= fit.rms_px <= high


def test_a_lens_of_an_unknown_kind_is_refused():
    lens = SimpleNamespace(fx_px=700.0, fy_px=700.0, cx_px=328.0, cy_px=245.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    with pytest.raises(TypeError, match="lens model SimpleNamespace"):
        TwinLens.of(lens, W, H)


def test_optics_and_their_gap_terms_make_the_same_lens():
    optics = Optics(gap_px=0.1, tilt_deg=(0.1, 0.2), pupil_shift_m=0.001)
    terms = GapTerms(0.1, (0.1, 0.2), 0.001)
    np.testing.assert_array_equal(TwinLens.of(MOSCA, W, H, optics).vector, TwinLens.of(MOSCA, W, H, terms).vector)


WARM = {
    # 50 ppm/s over 100 s: 0.5 % longer; (0.01, -0.02) px/s: 1 px right, 2 px up
    "mosca": MoscaLens(6.5 * 1.005, 292.45, 253.46, *list(vars(MOSCA).values())[3:]),
    "opencv": OpenCVLens(700.0 * 1.005, 702.0 * 1.005, 331.0, 238.0, *(getattr(OPENCV, n) for n in FIELDS[4:])),
    "fisheye": FisheyeLens(270.0 * 1.005, 271.0 * 1.005, 321.0, 239.0, -0.02, 0.003, -0.001, 0.0001),
}  # fmt: skip


@pytest.mark.parametrize("name", WARM)
@BY_TERMS
def test_warming_moves_the_interior_orientation(name, terms):
    optics = Optics(principal_distance_ppm_per_s=50.0, principal_point_px_per_s=(0.01, -0.02))
    cold = TwinLens.of(LENSES[name], W, H, terms).vector
    warm = warmed(cold, optics, 100.0)
    np.testing.assert_allclose(warm, TwinLens.of(WARM[name], W, H, terms).vector, rtol=1e-13)
    assert not warm.flags.writeable
    assert warmed(cold, optics, 0.0) is cold
    assert warmed(cold, Optics(), 100.0) is cold


FOLDING = [
    # r (1 - 0.4 r^2 + 0.06 r^4) has the slope 1 - 1.2 s + 0.3 s^2 in s = r^2: it turns back at r = 1.0879, where
    # its value is 0.66431, and rises again from r = 1.678. The paper's correction runs the other way: the
    # polynomial's argument is the measured radius, so that directions end at a tangent of 0.66431.
    (OpenCVLens(300.0, 300.0, 328.0, 245.0, -0.4, 0.06), 1.0879),
    (MoscaLens(1.0, 328.0, 245.0, 1 / 300, 1 / 300, K1_per_mm2=-0.4, K2_per_mm4=0.06), 0.66431),
    (FisheyeLens(300.0, 300.0, 328.0, 245.0, -0.4, 0.06), np.tan(1.0879)),
]


@pytest.mark.parametrize(("lens", "last"), FOLDING, ids=["opencv", "mosca", "fisheye"])
def test_nothing_is_imaged_beyond_the_fold(lens, last):
    steps = np.array([0.2, 0.9, 0.999, 1.001, 1.1, 1.5, 1.7, 2.0, 2.5, 4.0])
    about = np.deg2rad(20.0)
    v = np.column_stack([last * steps * np.cos(about), last * steps * np.sin(about), np.ones(len(steps))])
    imaged = np.isfinite(TwinLens.of(lens, W, H).pixels(v)).all(axis=1)
    np.testing.assert_array_equal(imaged, steps < 1)
    np.testing.assert_array_equal(np.isfinite(lens_pixels(lens, v)).all(axis=1), steps < 1)


@pytest.mark.parametrize("lens", [lens for lens, _last in FOLDING], ids=["opencv", "mosca", "fisheye"])
def test_no_light_comes_to_pixels_beyond_the_fold(lens):
    # the image ends at a radius of 0.66431 x 300 px (Mosca's, whose argument is the image radius, at 1.0879 x 300)
    edge = 300.0 * (1.0879 if isinstance(lens, MoscaLens) else 0.66431)
    at = np.column_stack([328.0 + edge * np.array([0.3, 0.99, 1.01, 1.6, 4.0]), np.full(5, 245.0)])
    seen = TwinLens.of(lens, W, H).directions(at)
    np.testing.assert_array_equal(np.isfinite(seen).all(axis=1), [True, True, False, False, False])


def test_the_gap_ends_outside_the_image():
    # T9 at twice the half diagonal is 70226: a gap of 0.05 px would move light by 3500 px
    lens = OpenCVLens(700.0, 700.0, (W - 1) / 2, (H - 1) / 2)
    half_diagonal = np.hypot(W, H) / 2 / 700.0
    v = np.array([[half_diagonal * s, 0.0, 1.0] for s in (1.0, 1.49, 1.51, 2.0)])
    np.testing.assert_array_equal(
        np.isfinite(TwinLens.of(lens, W, H, GapTerms(0.05)).pixels(v)).all(axis=1), [True, True, False, False]
    )
    assert np.isfinite(TwinLens.of(lens, W, H).pixels(v)).all()


@pytest.mark.parametrize(("lens", "order"), [(OPENCV, 9), (FISHEYE, 11)], ids=["pinhole", "fisheye"])
def test_the_gap_is_a_chebyshev_polynomial(lens, order):
    grid = image_grid(W, H, 41.0) * 0.99 + 3.0
    away = grid - ((W - 1) / 2, (H - 1) / 2)
    distance = np.linalg.norm(away, axis=1)
    # cos(n arccos s), the polynomial's own definition
    size = 0.2 * np.cos(order * np.arccos(distance / (np.hypot(W, H) / 2)))
    moved = TwinLens.of(lens, W, H, GapTerms(0.2)).pixels(TwinLens.of(lens, W, H).directions(grid))
    np.testing.assert_allclose(moved, grid + away * (size / distance)[:, None], atol=1e-9)
