"""The warming run reaches every stage."""

from mosca.warm import POINTS, PULSES, warm_up


def test_it_finds_its_points_in_every_frame_set():
    assert warm_up() == PULSES * len(POINTS)
