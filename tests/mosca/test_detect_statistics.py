"""Delayed statistics: when they are used, the same whatever frames are missing, at different sets for each camera."""

from functools import cache
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS, CameraStatistics, joined
from mosca.detection.disc_fit.light_offset import AMPLITUDE_SUMS, N_TALLIES, N_TERMS, StatisticsSums, no_sums
from mosca.detection.disc_fit.priors import AMPLITUDE_SIGMA_2
from mosca.detection.scheduler import DELAY, EARLY_SETS, EARLY_UPDATES, UPDATE_PERIOD, DelayedStatistics


@cache
def lesson(name, k):
    """One whose sum identifies its members."""
    rng = np.random.default_rng(k)
    root = rng.normal(size=(1, N_TERMS, 40))
    tallies = np.full((1, N_TALLIES), 30.0) + rng.random((1, N_TALLIES))
    sums = StatisticsSums(tallies, root @ root.transpose(0, 2, 1), rng.normal(size=(1, N_TERMS, 2)))
    return CameraStatistics((name,), sums)


def summed(name, numbers):
    known = NO_STATISTICS
    for k in numbers:
        known = known.plus(lesson(name, k))
    return known


def summed_by_update(name, last, missing):
    """What is used at update ``last``: the sets that each update adds count as one."""
    known, first = NO_STATISTICS, 0
    for update in (t for t in EARLY_UPDATES if t <= last):
        numbers = [k for k in range(first, update - DELAY + 1) if k not in missing]
        first = max(first, update - DELAY + 1)
        if numbers:
            each = [lesson(name, k).sums for k in numbers]
            sums = StatisticsSums(*(sum(one[1:], one[0]) for one in zip(*each, strict=True)))
            known = known.plus(CameraStatistics((name,), sums))
    return known


def alike(a, b):
    return a.names == b.names and all(one.tobytes() == two.tobytes() for one, two in zip(a.sums, b.sums, strict=True))


@settings(deadline=None, max_examples=30)
@given(name=st.text(max_size=6), missing=st.sets(st.integers(0, 140)))
def test_what_is_known_at_a_set_does_not_depend_on_which_were_asked_about(name, missing):
    lessons, whole, changes = DelayedStatistics(name), DelayedStatistics(name), []
    before = NO_STATISTICS
    for k in range(140):
        known = whole.for_frame_set(k)
        if known is not before and k >= EARLY_SETS:
            changes.append(k)
        before = known
        whole.add(k, lesson(name, k) if k not in missing else NO_STATISTICS)
        if k in missing:
            continue
        assert alike(lessons.for_frame_set(k), known)
        lessons.add(k, lesson(name, k))
        if k < EARLY_SETS:
            turn = max(t for t in EARLY_UPDATES if t <= k)
            assert turn > 0.8 * k - 1
            assert alike(known, summed_by_update(name, turn, missing))
    assert {b - a for a, b in pairwise(changes)} <= {UPDATE_PERIOD * n for n in range(1, 9)}


def test_a_camera_takes_its_own_part_of_what_a_set_adds():
    names, lessons = ("a", "b", "c"), DelayedStatistics("b")
    for k in range(12):
        together = NO_STATISTICS
        for n, name in enumerate(names):
            together = together.plus(lesson(name, 100 * n + k))
        lessons.for_frame_set(k)
        lessons.add(k, together)
    known, own = lessons.for_frame_set(12), DelayedStatistics("b")
    for k in range(12):
        own.add(k, lesson("b", 100 + k))
    assert alike(known, own.for_frame_set(12))
    assert known.names == ("b",)


def test_each_camera_has_its_own_turn():
    turns = []
    for name in ("a1", "a2", "a3", "a4"):
        lessons = DelayedStatistics(name)
        known = []
        for k in range(EARLY_SETS + 2 * UPDATE_PERIOD):
            known.append(lessons.for_frame_set(k))
            lessons.add(k, lesson(name, k))
        turns.append([k for k in range(EARLY_SETS, len(known)) if known[k] is not known[k - 1]])
    assert all(len(t) == 2 and t[1] - t[0] == UPDATE_PERIOD for t in turns)
    assert len({t[0] for t in turns}) == 4


def test_joined_cameras_start_their_fits_as_they_do_together():
    names = ("a", "b", "c")
    apart = {n: summed(n, range(10 * k, 10 * k + 20)) for k, n in enumerate(names)}
    together = NO_STATISTICS
    for one in apart.values():
        together = together.plus(one)
    for asked in (names, ("c", "a"), ("b", "unknown")):
        ours, theirs = joined(apart).priors(asked), together.priors(asked)
        for field in ("blurs", "offsets", "roughness"):
            np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    assert joined({"a": NO_STATISTICS}) is NO_STATISTICS
    assert all(alike(together.by_camera()[n], apart[n]) for n in names)


def test_amplitudes_slope_is_that_of_many_targets_and_the_guess_for_few():
    # ln amplitude = 2 + 0.5 ln flux, known to 5 %; the guess is 0.25 with a standard deviation of as much
    for n, spread, slope, within in ((5000, 0.5, 0.5, 0.01), (6, 0.05, 0.25, 0.2)):
        rng = np.random.default_rng(5)
        flux = 6.0 + spread * rng.normal(size=n)
        log, variance = 2.0 + 0.5 * flux + 0.05 * rng.normal(size=n), np.full(n, 0.0025)
        w = 1.0 / (variance + AMPLITUDE_SIGMA_2)
        sums = no_sums(1)
        for k, part in enumerate((w, w * flux, w * flux**2, w * log, w * flux * log, w * log**2, w * variance)):
            sums.tallies[0, AMPLITUDE_SUMS + k] = part.sum()
        found = CameraStatistics(("a",), sums).priors(("a",)).amplitudes[0]
        assert abs(found[2] - slope) < within
