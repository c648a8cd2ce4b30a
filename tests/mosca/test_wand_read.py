"""A wand is found among clutter by its own proportions, and not at all where it could be two ways."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from wand_scenes import rig, seen, waved

from mosca.calibration.targets.find_balls import read_wand
from mosca.data.detections import Detections
from mosca.data.wands import Wand

WAND = Wand((0.0, 0.15, 0.5), 0.02)


def targets(xy, diameter=8.0, peak=200.0) -> Detections:
    n = len(xy)
    return Detections(
        "cam1",
        np.asarray(xy, dtype=float).reshape(n, 2),
        np.tile(np.eye(2) * 0.01, (n, 1, 1)),
        np.broadcast_to(diameter, n),
        np.broadcast_to(peak, n),
        np.ones(n),
    )


def wands_in_images(clutter, seed=0, frames=100, along=(0.0, 0.15, 0.5)):
    """Return (balls in their order (b, 2), order of the targets, targets) of wands seen through a real lens."""
    rng = np.random.default_rng(seed)
    sightings = seen(rig(1, seed), waved(frames, along, seed=seed), blunders=0)
    for frame in np.unique(sightings.frame):
        balls = sightings.xy_px[sightings.frame == frame]
        everything = np.vstack([balls, rng.uniform(0, 1, (clutter, 2)) * (656, 491)])
        order = rng.permutation(len(everything))
        yield balls, targets(everything[order])


def test_the_wand_is_found_with_its_order():
    found = [(balls, read_wand(shown, WAND, 0, 3)) for balls, shown in wands_in_images(0)]
    right = [part is not None and np.array_equal(part.xy_px, balls) for balls, part in found]
    # some wands point at the camera and are as good as points
    assert np.mean(right) > 0.9
    assert not any(part is not None and not ok for (_, part), ok in zip(found, right, strict=True))
    one = next(part for _, part in found if part is not None)
    assert (one.camera, one.frame) == (0, 3)
    assert one.mark.tolist() == [0, 1, 2]


def test_clutter_costs_some_wands_but_hardly_makes_wrong_ones():
    found = [(balls, read_wand(shown, WAND, 0, 0)) for balls, shown in wands_in_images(5, frames=200)]
    given = [(balls, part) for balls, part in found if part is not None]
    assert len(given) > 0.4 * len(found)
    wrong = sum(not np.array_equal(part.xy_px, balls) for balls, part in given)
    assert wrong <= 0.02 * len(found)


def test_four_balls_in_clutter():
    wand = Wand((0.0, 0.1, 0.3, 0.5), 0.02)
    found = [(balls, read_wand(shown, wand, 0, 0)) for balls, shown in wands_in_images(10, along=wand.along_m)]
    right = [part is not None and np.array_equal(part.xy_px, balls) for balls, part in found]
    assert np.mean(right) > 0.8
    assert sum(part is not None for _, part in found) - sum(right) <= 1


def test_two_balls_do_not_tell_their_order():
    part = read_wand(targets([[10, 10], [110, 40]]), Wand((0.0, 0.5), 0.02), 1, 2)
    assert part is not None
    assert part.mark.tolist() == [-1, -1]
    assert read_wand(targets([[10, 10], [110, 40], [300, 200]]), Wand((0.0, 0.5), 0.02), 1, 2) is None
    assert read_wand(targets([[10, 10]]), Wand((0.0, 0.5), 0.02), 1, 2) is None


def test_a_wand_alike_from_both_ends_does_not_tell_them():
    part = read_wand(targets([[0, 0], [100, 0], [50, 0]]), Wand((0.0, 0.25, 0.5), 0.02), 0, 0)
    assert part is not None
    assert part.mark.tolist() == [-1, -1, -1]
    assert part.xy_px[1].tolist() == [50, 0]


def test_two_wands_are_none():
    one = np.array([[0.0, 0], [30, 0], [100, 0]])
    assert read_wand(targets(one), WAND, 0, 0) is not None
    assert read_wand(targets(np.vstack([one, one + [0, 200]])), WAND, 0, 0) is None


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-50, 700, width=32), st.floats(-50, 700, width=32), st.floats(0.5, 50, width=32)),
        max_size=9,
    )
)
def test_any_targets_are_read_without_an_accident(shown):
    xy, diameter = [one[:2] for one in shown], np.array([one[2] for one in shown])
    part = read_wand(targets(np.reshape(xy, (-1, 2)), diameter), WAND, 0, 0)
    assert part is None or part.mark.tolist() == [0, 1, 2]
