"""The warming run reaches every stage."""

from mosca.correspondence.match import match_rays
from mosca.correspondence.shared_turns import remove_turns
from mosca.detection.cut_targets.expected import expected_images
from mosca.detection.cut_targets.kinds import kinds_of
from mosca.detection.cut_targets.window_fits import fit_windows
from mosca.detection.cut_targets.windows import windows_of
from mosca.precompile import POINTS, PULSES, look, look_twice, points, warm_up, windows


def test_it_finds_its_points_in_every_frame_set():
    assert warm_up() == PULSES * len(POINTS)


def test_its_parts_reach_their_stages():
    assert look() == 3 * len(POINTS)
    assert look_twice() == 2 * 3 * len(POINTS)
    assert points() == PULSES * len(POINTS)


def test_windows_of_nothing_are_compiled_for_the_types_that_the_pipeline_has():
    of_cut_targets = (kinds_of, windows_of, expected_images, fit_windows)
    warm_up()
    before = [set(one.signatures) for one in of_cut_targets]
    assert windows() == 0
    assert [set(one.signatures) for one in of_cut_targets] == before


def test_points_are_matched_and_moved_with_the_types_that_the_pipeline_has():
    warm_up()
    before = [set(one.signatures) for one in (match_rays, remove_turns)]
    points()
    assert [set(one.signatures) for one in (match_rays, remove_turns)] == before
