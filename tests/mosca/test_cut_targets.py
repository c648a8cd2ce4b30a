"""Discs cut by an edge, and two grown together: places against images drawn on a fine grid and blurred by scipy."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mosca.camera.ray_table import make_ray_table
from mosca.data.arrays import read_only_image
from mosca.data.detections import MERGED, UNREFINED, Detections
from mosca.data.frames import Frame, FrameSet
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.tracks import Points
from mosca.detection.cut_targets import cut_pair as of_cut_pairs
from mosca.detection.cut_targets import disc as of_discs
from mosca.detection.cut_targets import pair as of_pairs
from mosca.detection.cut_targets.disc import BLUR, CUT, MISFIT, OTHER_MISFIT, OTHER_X, RADIUS, XX, XY, YY
from mosca.detection.cut_targets.mend import CutTargets, _replaced
from mosca.detection.cut_targets.pair import PAIR_COVARIANCE, PAIR_MISFIT
from mosca.detection.cut_targets.window_fits import (
    DIMMED,
    FIRST,
    FITTED,
    ONE,
    SECOND,
    STATE,
    TWO,
    OfPoints,
    OfTracks,
    _as_expected,
    _told_apart,
    cut_of,
)
from mosca.detection.cut_targets.windows import own_pixels
from mosca.numba_support.decorators import kernel

SIDE, FINE, LIGHT, READ = 15, 10, 12_000.0, 10.0
FOCUS = 0.7
SEEN_BLUR = np.hypot(FOCUS, 12**-0.5)
"""Blur of the lens, and with a pixel's width."""
fit_discs, fit_pairs, fit_cut_pairs = (
    kernel(fit.py_func) for fit in (of_discs.fit_discs, of_pairs.fit_pairs, of_cut_pairs.fit_cut_pairs)
)
"""Callable from here; the pipeline compiles them into one kernel."""


def grid():
    at = (np.arange(SIDE * FINE) + 0.5) / FINE - SIDE / 2
    return np.meshgrid(at, at)


def disc(centre, radius):
    x, y = grid()
    return np.clip((radius - np.hypot(x - centre[0], y - centre[1])) * FINE + 0.5, 0.0, 1.0)


def photographed(shape, rng):
    """Blur a shape on the fine grid, average it over pixels, add the noise of photons and of reading."""
    image = LIGHT * gaussian_filter(shape, FOCUS * FINE, truncate=5.0)
    image = image.reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3))
    return image + rng.normal(size=image.shape) * np.sqrt(READ**2 + np.maximum(image, 0.0))


def centroid(image):
    at = np.arange(SIDE) - SIDE // 2
    return np.array([(image.sum(axis=0) * at).sum(), (image.sum(axis=1) * at).sum()]) / image.sum()


def start_at(place, radius, cut):
    start = np.zeros((1, 8))
    start[0, :2], start[0, RADIUS], start[0, BLUR], start[0, CUT] = place + SIDE // 2, radius, SEEN_BLUR, cut
    return start


def near(place, reach):
    at = np.arange(SIDE) - SIDE // 2
    return ((at - place[0]) ** 2 + (at[:, None] - place[1]) ** 2 <= reach**2)[None]


def cut_views(radius, hidden, count=20):
    """Draw discs cut in any direction: true centres, fits and how far the light's centroids are off."""
    rng = np.random.default_rng(3)
    x, y = grid()
    for _ in range(count):
        centre, turn = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.0, 2 * np.pi)
        edge = radius * cut_of(hidden)
        along = (x - centre[0]) * np.cos(turn) + (y - centre[1]) * np.sin(turn)
        image = photographed(disc(centre, radius) * np.clip((edge - along) * FINE + 0.5, 0.0, 1.0), rng)
        light = centroid(image)
        start = start_at(light, radius, edge)
        fit = fit_discs(image[None], near(light, radius + 3 * SEEN_BLUR), start, False, np.array([1e-5]))[0]
        yield centre + SIDE // 2, fit, np.linalg.norm(light - centre)


def test_share_hidden_of_a_disc_by_the_area_of_its_segment():
    # closed forms: half; a segment of half the radius's height is 1/3 - sqrt(3) / (4 pi) of the disc
    np.testing.assert_allclose([cut_of(share) for share in (0.0, 0.5, 1.0)], [1.0, 0.0, -1.0], atol=1e-3)
    np.testing.assert_allclose(cut_of(1 / 3 - np.sqrt(3) / (4 * np.pi)), 0.5, atol=1e-3)


@pytest.mark.parametrize("hidden", [0.1, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("radius", [1.45, 2.5])
def test_centre_of_a_cut_disc(radius, hidden):
    errors, forms, before = [], [], []
    for centre, fit, off in cut_views(radius, hidden):
        error = fit[:2] - centre
        errors.append(np.linalg.norm(error))
        forms.append(error @ np.linalg.solve([[fit[XX], fit[XY]], [fit[XY], fit[YY]]], error))
        before.append(off)
    # the light's centroid is off by about the hidden share times the radius
    assert np.mean(before) > 0.8 * hidden * radius
    assert np.sqrt(np.mean(np.square(errors))) < 0.04 * np.mean(before) + 0.012
    # two degrees of freedom; pixels' noise is taken for the same everywhere, which states 1.6 times too little
    assert np.mean(forms) < 8.0


def test_a_sliver_may_be_of_either_side():
    chosen = []
    for centre, fit, _ in cut_views(1.45, 0.85):
        own, other = np.linalg.norm(fit[:2] - centre), np.linalg.norm(fit[OTHER_X : OTHER_X + 2] - centre)
        assert min(own, other) < 0.15
        assert max(own, other) > 1.0
        chosen.append(fit[OTHER_MISFIT] / fit[MISFIT])
    # where half is seen no other side comes near
    clear = [fit[OTHER_MISFIT] / fit[MISFIT] for _, fit, _ in cut_views(1.45, 0.5)]
    assert np.median(clear) > 3 * np.median(chosen)


def test_radius_and_blur_of_a_whole_disc():
    rng = np.random.default_rng(5)
    image = photographed(disc((0.2, -0.3), 2.1), rng)
    start = start_at(np.array([0.3, -0.2]), 1.9, 0.0)
    start[0, BLUR] = 0.9
    fit = fit_discs(image[None], near((0.2, -0.3), 5.0), start, True, np.zeros(1))[0]
    np.testing.assert_allclose(fit[:2] - SIDE // 2, [0.2, -0.3], atol=0.02)
    np.testing.assert_allclose([fit[RADIUS], fit[BLUR]], [2.1, SEEN_BLUR], rtol=0.02)


@pytest.mark.parametrize("apart", [0.5, 1.0, 1.6, 2.1])
@pytest.mark.parametrize("radius", [1.45, 2.1])
def test_centres_of_two_discs_grown_together(radius, apart):
    rng = np.random.default_rng(4)
    for _ in range(15):
        middle, turn = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.0, 2 * np.pi)
        half = 0.5 * apart * radius * np.array([np.cos(turn), np.sin(turn)])
        image = photographed(np.maximum(disc(middle - half, radius), disc(middle + half, radius)), rng)
        light = centroid(image)
        there = near(light, 2 * radius + 3 * SEEN_BLUR)
        fit = fit_pairs(image[None], there, start_at(light, radius, 0.0), np.array([1e-5]))[0]
        found = fit[:4].reshape(2, 2) - SIDE // 2
        if np.linalg.norm(found[0] - middle + half) > np.linalg.norm(found[1] - middle + half):
            found = found[::-1]
        np.testing.assert_allclose(found, [middle - half, middle + half], atol=0.04)
        assert (fit[PAIR_COVARIANCE : PAIR_COVARIANCE + 6 : 3] > 0).all()


@pytest.mark.parametrize("towards", [0.0, 1.6, 3.1])
@pytest.mark.parametrize("hidden", [0.3, 0.6])
@pytest.mark.parametrize("apart", [2.3, 2.9, 4.0])
def test_centres_of_a_whole_disc_and_of_one_beside_it_that_an_edge_cuts(apart, hidden, towards):
    """``towards``: direction of what is hidden, from that away from the whole disc."""
    rng, radius = np.random.default_rng(6), 1.45
    x, y = grid()
    off = []
    for _ in range(12):
        middle, turn = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.0, 2 * np.pi)
        half = 0.5 * apart * np.array([np.cos(turn), np.sin(turn)])
        edge = radius * cut_of(hidden)
        away = (x - (middle + half)[0]) * np.cos(turn + towards) + (y - (middle + half)[1]) * np.sin(turn + towards)
        cut = disc(middle + half, radius) * np.clip((edge - away) * FINE + 0.5, 0.0, 1.0)
        light = np.array([(cut * x).sum(), (cut * y).sum()]) / cut.sum()
        given = np.concatenate([middle - half, light]) + rng.normal(0.0, 0.15, 4) + SIDE // 2
        image = photographed(np.maximum(disc(middle - half, radius), cut), rng)
        there = near(middle, 0.5 * apart + radius + 3 * SEEN_BLUR)
        start = np.concatenate([given, [radius, radius, SEEN_BLUR, 1.0]])[None]
        fits = fit_cut_pairs(image[None], there, start, np.array([1e-5]))[0]
        best = fits[fits[:, PAIR_MISFIT].argmin()]
        found = best[:4].reshape(2, 2) - SIDE // 2
        off.append(np.linalg.norm(found - [middle - half, middle + half], axis=1))
        assert np.linalg.norm(light - middle - half) > 0.8 * hidden * radius
        assert (best[PAIR_COVARIANCE : PAIR_COVARIANCE + 6 : 3] > 0).all()
    # an edge that nearly touches the overlap, or hides most of a disc, lets two in a dozen end elsewhere
    assert np.median(off, axis=0).max() < 0.08
    assert (np.max(off, axis=1) < 0.2).sum() >= 10


def test_what_else_is_known_of_two_targets_is_as_of_the_image_that_they_made():
    seen = Detections(
        "a", np.zeros((3, 2)), np.ones((3, 2, 2)), np.ones(3), np.array([50.0, 90.0, 200.0]), np.ones(3),
        diameter_sigma_px=np.array([0.1, 0.2, 0.3]),
    )  # fmt: skip
    fits = np.zeros((3, FITTED))
    fits[:, STATE] = TWO, DIMMED, TWO
    fits[:, [FIRST + 5, SECOND + 5]] = [[3.0, 4.0], [5.0, 0.0], [6.0, 7.0]]
    fits[0, [FIRST, FIRST + 1, SECOND, SECOND + 1]] = 0.0, 1.0, 4.0, 5.0
    fits[2, [FIRST, FIRST + 1, SECOND, SECOND + 1]] = 2.0, 3.0, 6.0, 7.0
    rows = np.array([[0, 0], [1, 1], [2, 2]])
    new = _replaced(seen, rows, np.array([True, False, True]), fits)
    np.testing.assert_array_equal(new.peak, [50.0, 90.0, 200.0, 50.0, 200.0])
    np.testing.assert_array_equal(new.diameter_sigma_px, [0.1, 0.2, 0.3, 0.1, 0.3])
    np.testing.assert_array_equal(new.xy_px, [[0, 1], [0, 0], [2, 3], [4, 5], [6, 7]])
    np.testing.assert_array_equal(new.diameter_px, [3.0, 5.0, 6.0, 4.0, 7.0])
    # one beside the other: both are there already
    fits[1, STATE] = ONE
    new = _replaced(seen, np.array([[0, 1], [1, 1], [2, 2]])[:1], np.array([False]), fits[:1])
    np.testing.assert_array_equal(new.xy_px, [[0, 1], [4, 5], [0, 0]])
    np.testing.assert_array_equal(new.covariance_px2[2], np.ones((2, 2)))


def test_too_few_pixels_are_no_fit():
    patch, there = np.ones((1, SIDE, SIDE)), np.zeros((1, SIDE, SIDE), bool)
    start = start_at(np.zeros(2), 2.0, 1.0)
    assert np.isinf(fit_discs(patch, there, start, False, np.zeros(1))[0, MISFIT])
    assert np.isinf(fit_pairs(patch, there, start, np.zeros(1))).all()
    assert np.isinf(fit_cut_pairs(patch, there, start, np.zeros(1))).all()


WIDE, HIGH, STEP = 200, 160, 20
RADIUS_PX, AWAY_M, TARGET_M = 2.5, 2.0, 0.01


def drawn(shapes, rng):
    """Draw (centre, radius, edge along x) into an image of uint16, with the light's centroids."""
    fine = np.zeros((HIGH * FINE, WIDE * FINE), np.float32)
    half = 8
    for x, y, radius, edge in shapes:
        left, up = round(x) - half, round(y) - half
        at = (np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5
        gx, gy = np.meshgrid(at + left, at + up)
        one = np.clip((radius - np.hypot(gx - x, gy - y)) * FINE + 0.5, 0.0, 1.0)
        one *= np.clip((edge - (gx - x)) * FINE + 0.5, 0.0, 1.0)
        part = fine[up * FINE : (up + 2 * half + 1) * FINE, left * FINE : (left + 2 * half + 1) * FINE]
        np.maximum(part, one, out=part)
    image = LIGHT * gaussian_filter(fine, FOCUS * FINE, truncate=5.0)
    image = image.reshape(HIGH, FINE, WIDE, FINE).mean(axis=(1, 3))
    image += rng.normal(size=image.shape) * np.sqrt(READ**2 + image) + 100.0
    return np.rint(image).astype(np.uint16)


LENS = OpenCVLens(RADIUS_PX * 2 * AWAY_M / TARGET_M, RADIUS_PX * 2 * AWAY_M / TARGET_M, WIDE / 2, HIGH / 2)
RIG = Rig((Camera("a", WIDE, HIGH, LENS, Pose(np.eye(3), np.zeros(3))),))
PLACES = np.array([(x, y) for y in range(20, 140, STEP) for x in range(20, 180, STEP)], dtype=float)


def in_space(xy):
    """Return where targets of images (n, 2) are, AWAY_M before the camera."""
    at = (xy - [WIDE / 2, HIGH / 2]) * AWAY_M / LENS.fx_px
    return np.column_stack([at, np.full(len(xy), AWAY_M)])


def after_mending(image, seen, diameter, flags=None):
    """Return the detections of one camera after their points are known; None where none was changed.

    ``seen`` (n, 2) and ``diameter`` (n,), as detection gives them [px].
    """
    n = len(seen)
    found = Detections(
        "a", seen, np.tile(1e-4 * np.eye(2), (n, 1, 1)), diameter, 1000.0 + np.arange(n), np.ones(n),
        np.zeros(n, np.uint8) if flags is None else flags,
    )  # fmt: skip
    rays = make_ray_table(RIG, {"a": found}, 0.03)
    points = Points(
        in_space(seen), np.tile(1e-8 * np.eye(3), (n, 1, 1)), np.ones(n), np.zeros(n), np.arange(n)[:, None],
        np.full(n, TARGET_M), np.ones(n),
    )  # fmt: skip
    frames = FrameSet(0, 0, {"a": Frame("a", 0, 0, 1, read_only_image(image))})
    mending, mended = CutTargets(), None
    for _ in range(4):
        mended = mending.mended(frames, {"a": found}, RIG, rays, points, Predicted.nothing(), TARGET_M)
    return None if mended is None else mended["a"]


def test_images_are_mended_by_their_points():
    """One camera, forty-five whole targets, one half hidden, two images of two each: as detection gives them."""
    rng = np.random.default_rng(2)
    places = PLACES + rng.uniform(-0.5, 0.5, PLACES.shape)
    cut, ones, others = places[10], places[[20, 30]], places[[20, 30]] + [(3.2, 1.1), (-1.0, 3.0)]
    shapes = [(*xy, RADIUS_PX, 9.0) for xy in (*places, *others)]
    shapes[10] = (*cut, RADIUS_PX, 0.0)
    image = drawn(shapes, rng)
    # half a disc's centroid lies 4 r / (3 pi) from its middle; the covered area of both is 1.75 of one's
    seen, diameter = places.copy(), np.full(len(places), 2 * RADIUS_PX)
    seen[10] += (-4 * RADIUS_PX / (3 * np.pi), 0.0)
    seen[[20, 30]] = 0.5 * (ones + others)
    diameter[10], diameter[[20, 30]] = 2 * RADIUS_PX * np.sqrt(0.5), 2 * RADIUS_PX * np.sqrt(1.75)
    new, n = after_mending(image, seen, diameter), len(places)
    assert new is not None
    assert len(new) == n + 2
    np.testing.assert_allclose(new.xy_px[10], cut, atol=0.06)
    for k, row in enumerate((20, 30)):
        pair = new.xy_px[[row, n + k]]
        pair = pair if np.linalg.norm(pair[0] - ones[k]) < 1.0 else pair[::-1]
        np.testing.assert_allclose(pair, [ones[k], others[k]], atol=0.06)
        # what was added is of the image that it was part of
        assert new.peak[n + k] == new.peak[row] == 1000.0 + row
    kept = np.setdiff1d(np.arange(n), [10, 20, 30])
    np.testing.assert_array_equal(new.xy_px[kept], seen[kept])


def segment(edge, radius):
    """Return the share of a disc on the near side of an edge, and the mean distance of that part from the centre."""
    x = np.linspace(-radius, min(edge, radius), 4001)
    high = 2 * np.sqrt(np.maximum(radius**2 - x**2, 0.0))
    return np.trapezoid(high, x) / (np.pi * radius**2), np.trapezoid(x * high, x) / np.trapezoid(high, x)


@pytest.mark.parametrize("flags", [0, MERGED | UNREFINED])
def test_a_sliver_is_judged_by_its_light(flags):
    """Beside another target, where no fit holds, too: detection's region has it two thirds as wide as a whole one."""
    rng = np.random.default_rng(5)
    edge = -0.85 * RADIUS_PX
    shown, along = segment(edge, RADIUS_PX)
    others = np.vstack([PLACES, PLACES[10] + (-7.5, 0.5)])
    shapes = [(*xy, RADIUS_PX, 9.0) for xy in others]
    shapes[10] = (*PLACES[10], RADIUS_PX, edge)
    seen, diameter = others.copy(), np.full(len(others), 2 * RADIUS_PX)
    seen[10, 0] += along
    diameter[10] *= 2 / 3
    every = np.zeros(len(others), np.uint8)
    every[10] = flags
    new = after_mending(drawn(shapes, rng), seen, diameter, every)
    assert new is not None
    np.testing.assert_array_equal(new.xy_px[10], seen[10])
    assert (new.diameter_px[10] / (2 * RADIUS_PX)) ** 2 == pytest.approx(shown, abs=0.05)


@kernel
def side_of(fit, points, expected):
    """Return whether a disc's side is told, and its centre along x."""
    told = _told_apart(fit, 30, np.zeros(2, np.int64), 0, 0, points, expected)
    return told, fit[0]


@pytest.mark.parametrize(("expected_px", "told"), [(4.2, 4.0), (0.3, 0.0), (2.0, None), (9.0, None), (-5.0, None)])
def test_a_track_that_expects_neither_side_does_not_tell_which(expected_px, told):
    """Both sides fit as well, at 0 and 4 px; the track's standard deviation is 0.3 px."""
    fit = np.zeros(FITTED + 10)
    fit[[MISFIT, OTHER_MISFIT]] = 1e-4
    fit[OTHER_X] = 4.0
    points = OfPoints(np.zeros((1, 3)), np.zeros((1, 1), np.int64), np.ones((1, 1)))
    place = np.array([[[expected_px, 0.0]]])
    expected = OfTracks(np.zeros((1, 3)), place, np.full((1, 1), 0.3), np.ones((1, 1)), 0.02)
    is_told, x = side_of(fit, points, expected)
    assert is_told == (told is not None)
    assert x == (told or 0.0)


@kernel
def expects(fit, expected):
    """Return whether a track expects its image where a fit of two has one, or far from both."""
    return _as_expected(fit, np.zeros(2, np.int64), 0, 3.0, expected)


@pytest.mark.parametrize(
    ("place", "sigma_px", "wanted"),
    [((0.3, 0.0), 0.2, True), ((4.0, 0.7), 0.2, True), ((2.0, 0.0), 0.2, False), ((2.0, 0.0), 0.6, True),
     ((7.5, 0.0), 0.2, True)],
)  # fmt: skip
def test_two_whole_targets_are_where_tracks_expect_them(place, sigma_px, wanted):
    """At 0 and 4 px; what is expected beyond 3 px is of another image, to 4 standard deviations it agrees."""
    fit = np.array([0.0, 0.0, 4.0, 0.0])
    expected = OfTracks(np.zeros((1, 3)), np.array([[place]]), np.full((1, 1), sigma_px), np.ones((1, 1)), 0.02)
    assert expects(fit, expected) == wanted


def test_pixels_of_a_disc_and_not_of_its_neighbour():
    side, reach, beyond = 11, 4.0, 0.5
    seen = np.array([[5.2, 5.1, 3.0], [9.0, 6.0, 2.0], [38.0, 38.0, 3.0]])
    y, x = np.mgrid[:side, :side]
    image, there, own = np.zeros((side, side)), np.empty((side, side), bool), np.array([0, 0])
    place = np.array([5.2, 5.1, reach])
    wanted = (np.hypot(x - 5.2, y - 5.1) <= reach) & (np.hypot(x - 9.0, y - 6.0) > 2.5)
    assert own_pixels(image, there, place, own, seen, beyond) == wanted.sum()
    np.testing.assert_array_equal(there, wanted)
    # none are left out, or those that the pair's second has, or the image ends there
    own_pixels(image, there, place, own, seen, -1.0)
    np.testing.assert_array_equal(there, np.hypot(x - 5.2, y - 5.1) <= reach)
    own_pixels(image, there, place, np.array([0, 1]), seen, beyond)
    np.testing.assert_array_equal(there, np.hypot(x - 5.2, y - 5.1) <= reach)
    image[:, :4] = np.nan
    own_pixels(image, there, place, own, seen, beyond)
    np.testing.assert_array_equal(there, wanted & (x >= 4))
