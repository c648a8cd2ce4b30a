"""Stationary intervals of a target: shake, stop and go, slow creep, gaps."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.calibration.targets.stationary_intervals import LEAST_MOVE_PX, stationary_intervals
from mosca.data.sightings import Part, Sightings


def made(shifts, rng, cameras=2, marks=15, noise=0.02, shake=0.0, unseen=()) -> Sightings:
    """Return sightings of marks that all move by ``shifts`` (frames, 2) px, in every camera alike."""
    place = rng.uniform(50, 400, (cameras, marks, 2))
    parts = []
    for frame, shift in enumerate(shifts):
        for c in range(cameras):
            if frame in unseen:
                continue
            xy = place[c] + shift + rng.normal(0, noise, (marks, 2)) + rng.normal(0, shake, 2)
            cov = np.tile(noise**2 * np.eye(2), (marks, 1, 1))
            parts.append(Part(c, frame, np.arange(marks), xy, cov, np.full(marks, 8.0)))
    names = tuple(f"c{k}" for k in range(cameras))
    return Sightings.joined(names, np.full((cameras, 2), 480), len(shifts), parts)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), frames=st.integers(1, 12), shake=st.floats(0, 0.03))
def test_a_standing_target_is_one_stand(seed, frames, shake):
    sightings = made(np.zeros((frames, 2)), np.random.default_rng(seed), shake=shake)
    assert (stationary_intervals(sightings) == 0).all()


def test_stop_and_go():
    places = np.repeat([[0, 0], [12, 3], [11, -4]], [4, 3, 5], axis=0).astype(float)
    sightings = made(places, np.random.default_rng(1), shake=0.03)
    np.testing.assert_array_equal(stationary_intervals(sightings), np.repeat([0, 1, 2], [4, 3, 5]))


def test_a_carried_target_stands_nowhere():
    shifts = np.arange(10)[:, None] * np.array([[3.0, 1.0]])
    np.testing.assert_array_equal(stationary_intervals(made(shifts, np.random.default_rng(2))), np.arange(10))


def test_a_slow_creep_is_a_motion_too():
    """0.05 px a frame is no motion from one frame to the next, but 20 frames are 1 px."""
    shifts = np.column_stack([0.05 * np.arange(21), np.zeros(21)])
    stands = stationary_intervals(made(shifts, np.random.default_rng(3)))
    assert stands.max() >= 2
    for k in range(stands.max() + 1):
        # no interval's motion exceeds the limit plus the noise of its first frame
        assert 0.05 * (np.sum(stands == k) - 1) <= LEAST_MOVE_PX + 0.1


def test_a_turn_about_the_middle_is_a_motion():
    """The mean position stays, the marks' positions do not."""
    rng = np.random.default_rng(4)
    still = made(np.zeros((2, 2)), rng)
    xy, second = still.xy_px.copy(), still.frame == 1
    middle = xy[second].mean(axis=0)
    turn = np.array([[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]])
    xy[second] = (xy[second] - middle) @ turn.T + middle
    moved = replace(still, xy_px=xy)
    np.testing.assert_array_equal(stationary_intervals(moved), [0, 1])


def test_one_camera_that_sees_it_move_is_enough():
    still = made(np.zeros((2, 2)), np.random.default_rng(5), cameras=3)
    xy = still.xy_px.copy()
    xy[(still.frame == 1) & (still.camera == 2)] += [2, 0]
    moved = replace(still, xy_px=xy)
    np.testing.assert_array_equal(stationary_intervals(moved), [0, 1])


def test_frames_without_sightings_belong_to_no_stand():
    sightings = made(np.zeros((5, 2)), np.random.default_rng(6), unseen=(0, 2))
    np.testing.assert_array_equal(stationary_intervals(sightings), [-1, 0, -1, 0, 0])


@pytest.mark.parametrize("blunders", [1, 3])
def test_a_few_blunders_are_no_motion(blunders):
    still = made(np.zeros((3, 2)), np.random.default_rng(7))
    xy = still.xy_px.copy()
    xy[np.flatnonzero(still.frame == 1)[:blunders]] += 30
    bad = replace(still, xy_px=xy)
    assert (stationary_intervals(bad) == 0).all()
