"""Discs cut by the body that wears the marker, against rasters of discs, rays through balls, and repeated draws."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from mosca.accuracy.planning.cut_discs import WornMarkers, cut_disc, measured, taken_variance
from mosca.detection.detect import detect

BALL, BODY = 0.007, 0.15


@pytest.mark.parametrize("cut", [0.97, 0.8, 0.3, 0.0, -0.4, -0.9])
def test_share_and_shift_are_those_of_a_raster(cut):
    step = 1 / 1500
    x, y = np.meshgrid(np.arange(-1, 1, step) + step / 2, np.arange(-1, 1, step) + step / 2)
    disc = x**2 + y**2 <= 1
    left = disc & (x <= cut)
    hidden, shift = cut_disc(np.array([cut]))
    assert hidden[0] == pytest.approx(1 - left.sum() / disc.sum(), abs=2e-5)
    assert shift[0] == pytest.approx(-x[left].mean(), abs=5e-5)


def test_whole_and_hidden_discs():
    hidden, shift = cut_disc(np.array([5.0, 1.0, -1.0, -3.0]))
    np.testing.assert_allclose(hidden, [0, 0, 1, 1], atol=1e-12)
    np.testing.assert_allclose(shift, 0, atol=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 89.0, 94.0, 100.0, 106.0, 112.0, 150.0, -104.0])
def test_what_a_body_hides_is_what_parallel_rays_find(degrees):
    """A far camera looks along parallel rays: each of a ball's disc is followed to the body, in the plane."""
    worn = WornMarkers(BALL, BODY, 0.0, 2.0)
    center = np.array([0.3 + BODY + BALL, -0.2, 1.0])
    angle = np.deg2rad(degrees)
    ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
    hidden, shift, edge = worn.images(center[None], np.array([1.0, 0.0, 0.0]), (center + 5e3 * ahead)[None])
    across = np.array([-ahead[1], ahead[0]])
    offsets = BALL * (np.arange(4000) + 0.5) / 2000 - BALL
    chord = np.sqrt(BALL**2 - offsets**2)
    starts = center[:2] - [0.3, -0.2] + offsets[:, None] * across
    closest = -starts @ ahead[:2]
    gap2 = (starts**2).sum(axis=1) - closest**2
    blocked = (closest > 0) & (gap2 < BODY**2)
    assert hidden[0, 0] == pytest.approx((chord * blocked).sum() / chord.sum(), abs=1e-3)
    if 0.01 < hidden[0, 0] < 0.99:
        mean = (offsets * chord * ~blocked).sum() / (chord * ~blocked).sum()
        np.testing.assert_allclose(BALL * shift[0, 0] * edge[0, 0, :2], mean * across, atol=BALL * 3e-3)


def test_a_marker_before_its_tangent_plane_is_whole_from_anywhere():
    draw = np.random.default_rng(3)
    worn = WornMarkers(BALL, BODY, 0.0, 2.0)
    normal = np.array([np.cos(1.0), np.sin(1.0), 0.0])
    points = draw.uniform([-1, -1, 0.2], [1, 1, 1.8], (40, 3))
    places = draw.uniform([-4, -4, 0.5], [4, 4, 3.0], (30, 3))
    hidden, _, _ = worn.images(points, normal, places)
    toward = places[:, None] - points
    # the ball's middle lies its radius before the tangent plane of the body
    before = toward @ normal + BALL > BALL
    assert hidden[before].max() < 1e-6
    assert hidden[~before].max() > 0.99


def test_small_shares_count_in_full_and_larger_ones_less():
    radius, variance = np.full(3, 4.0), np.full(3, 0.03**2)
    taken = taken_variance(np.array([0.0, 0.05, 0.3]), radius, variance)
    np.testing.assert_allclose(taken[:2], variance[:2])
    # the shift of 0.3 of the radius, spread over both axes
    assert np.sqrt(taken[2]) == pytest.approx(1.05 * 0.3 * 4.0 / np.sqrt(2), rel=1e-3)
    # of a small disc the size tells less
    assert taken_variance(np.array([0.1]), np.array([1.0]), np.array([0.05**2]))[0] == pytest.approx(0.05**2)


def test_two_cameras_make_no_point_with_an_image_that_is_mostly_hidden():
    seen = np.ones((3, 4), bool)
    hidden = np.array([[0.0, 0.0, 0.0, 1.0], [0.5, 0.8, 0.8, 1.0], [1.0, 1.0, 0.9, 0.0]])
    np.testing.assert_array_equal(measured(seen, hidden), [True, False, True, False])


def test_half_of_a_ball_is_hidden_where_its_middle_is_level_with_the_edge():
    worn = WornMarkers(BALL, BODY, 0.0, 2.0)

    def more_than_half(degrees):
        place = 1e4 * np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), 0.0]) + [0, 0, 1.0]
        return worn.images(np.array([[BODY + BALL, 0, 1.0]]), np.array([1.0, 0, 0]), place[None])[0][0, 0] - 0.5

    # sin = R / (R + r), beyond 90 degrees
    expected = 180 - np.degrees(np.arcsin(BODY / (BODY + BALL)))
    assert brentq(more_than_half, 91, 113) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("cut", [0.9, 0.7, 0.3, -0.2])
def test_detection_errs_by_the_shift_of_a_cut_disc(cut):
    fine, apart, across, radius = 8, 26, 7, 3.5
    draw = np.random.default_rng(5)
    centers = apart * (np.argwhere(np.ones((across, across))) + 0.5) + draw.uniform(-0.5, 0.5, (across**2, 2))
    y, x = np.mgrid[: across * apart * fine, : across * apart * fine] / fine + 0.5 / fine
    light = np.zeros(x.shape)
    for k, (cx, cy) in enumerate(centers):
        # one in three is cut, so that detection knows what whole discs are like
        light += (np.hypot(x - cx, y - cy) <= radius) & (x - cx <= (cut if k % 3 == 0 else 1.0) * radius)
    light = gaussian_filter(light, 0.6 * fine).reshape(across * apart, fine, -1, fine).mean(axis=(1, 3))
    image = 2.0 + 200.0 * light
    image += draw.normal(size=image.shape) * np.sqrt(0.09 + 0.02 * image)
    found = detect(np.clip(image.round(), 0, 255).astype(np.uint8), "a")
    off = centers[:, None] - 0.5 - found.xy_px
    nearest = np.linalg.norm(off, axis=2).argmin(axis=1)
    shift = off[np.arange(len(centers)), nearest][::3, 0].mean() / radius
    assert shift == pytest.approx(cut_disc(np.array([cut]))[1][0], rel=0.08)


@pytest.mark.parametrize("count", [6, 8, 20])
def test_overlapping_discs_are_those_whose_middles_are_nearer_than_a_diameter(count):
    """A far camera looks along parallel rays: offsets across the sight line tell of discs, plane trigonometry."""
    worn, reach = WornMarkers(BALL, BODY, 0.0, 2.0), BODY + BALL
    facing = 2 * np.pi * np.arange(count) / count
    normals = np.column_stack([np.cos(facing), np.sin(facing), np.zeros(count)])
    for degrees in np.arange(0.5, 180, 3.0):
        angle = np.deg2rad(degrees)
        center = reach * normals[0] + [0.3, -0.2, 1.0]
        place = [0.3, -0.2, 1.0] + 1e4 * np.array([np.cos(angle), np.sin(angle), 0.0])
        across, ahead = reach * np.sin(facing - angle), reach * np.cos(facing - angle)
        shown = (ahead > 0) | (np.abs(across) + BALL > BODY)
        expected = (shown & (np.abs(across - across[0]) < 2 * BALL))[1:].any()
        found = worn.overlapping(center[None], normals[0], normals, place[None])[0, 0]
        assert found == expected, degrees
