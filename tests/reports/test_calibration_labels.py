"""Names in a drawing cover neither each other nor the points, however the points lie."""

import numpy as np
import pytest

from reports.calibration_labels import DOT_PT, HEIGHT_PT, label_offsets

LOW, HIGH = np.zeros(2), np.array([290.0, 250.0])


def boxes(points, widths):
    left = points + label_offsets(points, widths, LOW, HIGH)
    return np.column_stack([left[:, 0], left[:, 1] - HEIGHT_PT / 2, left[:, 0] + widths, left[:, 1] + HEIGHT_PT / 2])


def apart(one, other) -> bool:
    return bool((one[2:] <= other[:2] + 1e-9).any() or (other[2:] <= one[:2] + 1e-9).any())


SCENES = {
    "two behind each other": np.array([[100.0, 100.0], [100.0, 100.0]]),
    "a ring of eight from the side": np.column_stack(
        [145 + 130 * np.cos(np.arange(8) * np.pi / 4), np.full(8, 120.0)]
    ),
    "twelve on a wall": np.column_stack([np.full(12, 280.0), np.repeat(np.linspace(60, 200, 6), 2)]),
    "in a corner": np.array([[288.0, 248.0], [287.0, 247.0], [286.0, 248.0]]),
}


@pytest.mark.parametrize("points", SCENES.values(), ids=SCENES.keys())
def test_labels_stand_clear_of_each_other_and_inside(points):
    widths = np.full(len(points), 27.0)
    found = boxes(points, widths)
    for k, one in enumerate(found):
        assert (one[:2] >= LOW).all()
        assert (one[2:] <= HIGH).all()
        for other in found[:k]:
            assert apart(one, other)
        for point in points:
            assert apart(one, np.concatenate([point - DOT_PT, point + DOT_PT]))


def test_a_lone_label_stands_beside_its_point():
    points = np.array([[100.0, 100.0]])
    (offset,) = label_offsets(points, [27.0], LOW, HIGH)
    assert 0 < np.abs(offset).max() <= 5
