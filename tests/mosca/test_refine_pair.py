"""Two discs grown together, against images made elsewhere (fine grid, Fourier optics) and bounds of these."""

import numpy as np
import pytest

from mosca.data.detections import MERGED, UNREFINED
from mosca.detection.centroid import DIAMETER, X, Y
from mosca.detection.detect import NO_STATISTICS, DetectionSettings, detect, detect_with_statistics
from mosca.detection.disc_fit.row import N_COLUMNS
from mosca.detection.merged_targets.split import TOUCHING_PX, touching

FINE, SIDE, BLUR = 8, 30, 0.6
GAIN, READ, LEVEL, DARK = 0.0128, 0.13, 4.0, 2.0
BRIGHT = 150.0
TOGETHER = DetectionSettings(split_pairs=True)


def image_of(shapes):
    """Light (SIDE, SIDE) of shapes drawn from far to near: (x, y, radius, brightness, how).

    ``how``: None a disc; (dx, dy) one that moved so far to both sides; ("ellipse", ratio of its axes, angle).
    """
    n = SIDE * FINE
    at = (np.arange(n) + 0.5) / FINE - 0.5
    light = np.zeros((n, n))
    for x0, y0, radius, bright, how in shapes:
        x, y = at[None] - x0, at[:, None] - y0
        if how is None:
            cover = np.clip((radius - np.hypot(x, y)) * FINE + 0.5, 0, 1)
        elif how[0] == "ellipse":
            u, v = x * np.cos(how[2]) + y * np.sin(how[2]), y * np.cos(how[2]) - x * np.sin(how[2])
            cover = np.clip((radius - np.hypot(u, v / how[1])) * FINE * how[1] + 0.5, 0, 1)
        else:
            ways = (2 * np.arange(48) + 1) / 48 - 1
            cover = sum(np.clip((radius - np.hypot(x - w * how[0], y - w * how[1])) * FINE + 0.5, 0, 1) for w in ways)
            cover = cover / 48
        light = light * (1 - cover) + bright * cover
    f = np.fft.fftfreq(n, 1 / FINE)
    one = np.exp(-2 * (np.pi * BLUR * f) ** 2) * np.sinc(f)
    seen = np.fft.ifft2(np.fft.fft2(light) * one[:, None] * one).real
    # a pixel's centre lies between four samples
    h = FINE // 2
    rows = (seen[h - 1 :: FINE] + seen[h::FINE]) / 2
    return (rows[:, h - 1 :: FINE] + rows[:, h::FINE]) / 2


def frame(light, rng):
    electrons = rng.poisson((np.maximum(light, 0) + DARK) / GAIN)
    return np.clip(np.round(electrons * GAIN + rng.normal(0, READ, light.shape) + LEVEL), 0, 255).astype(np.uint8)


def bounds_px2(shapes):
    """Cramer-Rao bound of both positions (2, 2, 2), all ten unknowns unknown: by central differences of images."""
    flat = np.array([value for shape in shapes for value in shape[:4]])

    def light(p):
        return image_of([(*p[4 * k : 4 * k + 4], shape[4]) for k, shape in enumerate(shapes)])

    columns = [np.ones(SIDE * SIDE)]
    for k in range(len(flat)):
        step = np.zeros(len(flat))
        step[k] = 1.0 if k % 4 == 3 else 0.04
        columns.append(((light(flat + step) - light(flat - step)) / (2 * step[k])).ravel())
    change = np.array(columns)
    variance = GAIN * (light(flat) + DARK).ravel() + READ**2 + 1 / 12
    covariance = np.linalg.inv(change / variance @ change.T)
    return np.array([covariance[1 + 4 * k : 3 + 4 * k, 1 + 4 * k : 3 + 4 * k] for k in (0, 1)])


def disc(rng):
    return (*(SIDE / 2 + rng.uniform(-0.5, 0.5, 2)), rng.uniform(2.5, 5), BRIGHT, None)


@pytest.fixture(scope="module")
def learned():
    rng, known = np.random.default_rng(1), NO_STATISTICS
    for _ in range(2):
        rows = [[image_of([disc(rng)]) for _ in range(5)] for _ in range(5)]
        known = known.plus(detect_with_statistics([frame(np.block(rows), rng)], ["a"], statistics=known)[1])
    return known


def pair_of(rng, apart, diameter):
    angle, middle = rng.uniform(0, 2 * np.pi), SIDE / 2 + rng.uniform(-0.5, 0.5, 2)
    half = 0.5 * apart * diameter * np.array([np.cos(angle), np.sin(angle)])
    return [(*(middle + half), diameter / 2, BRIGHT, None), (*(middle - half), diameter / 2, BRIGHT, None)]


@pytest.mark.parametrize(
    ("diameter", "most"), [pytest.param(5.0, 2.0, marks=pytest.mark.slow), (6.5, 1.3), (8.0, 1.3)]
)
def test_two_discs_reach_their_joint_bound(diameter, most, learned):
    rng = np.random.default_rng(int(diameter))
    squared, least, stated, left = [], [], [], 0
    for apart in rng.uniform(0.75, 1.35, 10):
        shapes = pair_of(rng, apart, diameter)
        found = detect(frame(image_of(shapes), rng), "a", TOGETHER, statistics=learned)
        assert len(found) == 2, f"{apart:.2f} diameters apart"
        if (found.flags & UNREFINED).any():
            left += 1
            continue
        for shape, bound in zip(shapes, bounds_px2(shapes), strict=True):
            away = found.xy_px - shape[:2]
            k = np.argmin(np.hypot(*away.T))
            squared.append(away[k] @ away[k])
            least.append(np.trace(bound))
            stated.append(away[k] @ np.linalg.solve(found.covariance_px2[k], away[k]))
    # pairs of small discs that two straight edges do not explain keep the places of images that touch
    assert left <= (1 if diameter < 6 else 0)
    # below 6 px what is common to both discs is not quite that of two straight edges; the covariance shows it
    assert np.sqrt(np.mean(squared) / np.mean(least)) < most
    # chi-square of 2 degrees of freedom: 20 of them have a mean of 2 +- 0.45
    assert 0.7 < np.mean(stated) < 3.2


def test_pairs_that_touch_are_all_pairs_with_a_small_gap():
    rng = np.random.default_rng(9)
    table = np.zeros((60, N_COLUMNS))
    (table[:, X], table[:, Y]), table[:, DIAMETER] = rng.uniform(0, 120, (2, 60)), rng.uniform(2, 12, 60)
    table = table[np.argsort(table[:, Y] - table[:, DIAMETER] / 2)]  # as they are found, row by row
    i, j = np.triu_indices(60, 1)
    gap = np.hypot(*(table[i] - table[j])[:, [X, Y]].T) - (table[i, DIAMETER] + table[j, DIAMETER]) / 2
    near = np.column_stack([i, j])[gap < TOUCHING_PX]
    assert len(near) > 20
    both = touching(np.concatenate([table, table]), np.repeat(np.array([0, 1], np.int32), 60))
    assert {tuple(pair) for pair in both.tolist()} == {(p, q) for n in (0, 60) for p, q in (near + n).tolist()}


@pytest.mark.parametrize("how", ["moved", "ellipse"])
def test_what_is_long_but_one_stays_one(how, learned):
    rng = np.random.default_rng(3)
    for k in range(30):
        radius, angle = rng.uniform(2.0, 5.0), rng.uniform(0, np.pi)
        way = rng.uniform(0.2, 1.2) * radius
        # every other ellipse is as long as two discs that can be resolved: of others no two discs explain the pixels
        ellipse = ("ellipse", rng.uniform(0.5, 0.7) if k % 2 else rng.uniform(0.35, 1), angle)
        shape = (way * np.cos(angle), way * np.sin(angle)) if how == "moved" else ellipse
        middle = SIDE / 2 + rng.uniform(-0.5, 0.5, 2)
        found = detect(frame(image_of([(*middle, radius, BRIGHT, shape)]), rng), "a", TOGETHER, statistics=learned)
        assert len(found) == 1


def test_a_middle_without_a_fit_is_as_uncertain_as_its_region_is_long(learned):
    # three in a row: no pair, no disc; their middle lies a diameter off the outer ones
    rng = np.random.default_rng(5)
    shapes = [(SIDE / 2 + 3.5 * k, SIDE / 2, 2.2, BRIGHT, None) for k in (-1, 0, 1)]
    found = detect(frame(image_of(shapes), rng), "a", TOGETHER, statistics=learned)
    lonely = (found.flags & (UNREFINED | MERGED)) == UNREFINED
    for k in np.flatnonzero(lonely):
        nearest = min(np.hypot(*(found.xy_px[k] - shape[:2])) for shape in shapes)
        assert np.sqrt(np.trace(found.covariance_px2[k])) > 0.5 * nearest


def test_a_centroid_that_neighbours_draw_states_how_far(learned):
    """A dot at a grazing angle between two marks of its ring, unlike it: a centroid, which the marks' light draws."""
    rng, squares = np.random.default_rng(5), []
    for _ in range(40):
        x, y = SIDE / 2 + rng.uniform(-0.5, 0.5, 2)
        mark = (x - rng.uniform(2, 3), y + rng.uniform(0, 3), 1.5, 0.6 * BRIGHT, None)
        end = (x + 2.7, y + 5.4, 2.0, BRIGHT, None)
        light = image_of([mark, end, (x, y, 3.6, BRIGHT, ("ellipse", 0.38, 1.2))])
        found = detect(frame(light, rng), "a", TOGETHER, statistics=learned)
        off = found.xy_px - (x, y)
        near = np.argmin(np.hypot(*off.T))
        if found.flags[near] & UNREFINED:
            squares.append(off[near] @ np.linalg.solve(found.covariance_px2[near], off[near]) / 2)
    assert len(squares) >= 30
    assert 0.1 < np.mean(squares) < 1.5
