"""The warming run reaches every stage."""

from mosca.precompile import POINTS, PULSES, look, look_twice, points, warm_up


def test_it_finds_its_points_in_every_frame_set():
    assert warm_up() == PULSES * len(POINTS)


def test_its_parts_reach_their_stages():
    assert look() == 3 * len(POINTS)
    assert look_twice() == 2 * 3 * len(POINTS)
    assert points() == PULSES * len(POINTS)
