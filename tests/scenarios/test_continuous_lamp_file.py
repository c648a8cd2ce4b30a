"""The file of worn cameras' lamps: what it gives, and one line for what it lacks."""

import numpy as np
import pytest

from mosca.data.rig import Camera, FisheyeLens, Pose, Rig
from mosca.errors import InputError
from scenarios.commands.lamp_file import read_lamps

RIG = Rig(
    tuple(
        Camera(name, 656, 491, FisheyeLens(235.0, 235.0, 327.5, 245.0), Pose(np.eye(3), np.zeros(3)))
        for name in ("left", "right", "arm")
    )
)
GOOD = """
bit_s = 0.02
known = ["left", "right"]
[[lamp]]
camera = "arm"
number = 7
at_m = [0.0, 0.03, -0.02]
[[lamp]]
camera = "left"
number = 3
at_m = [0.01, 0.0, 0.0]
[[lamp]]
camera = "right"
number = 4
at_m = [0.0, 0.0, 0.0]
"""


def written(folder, text: str):
    path = folder / "lamps.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_lamps_come_in_the_order_of_the_rig(tmp_path):
    known, lamps = read_lamps(written(tmp_path, GOOD), RIG)
    assert known == ("left", "right")
    assert lamps.numbers == (3, 4, 7)
    assert lamps.bit_s == 0.02
    np.testing.assert_array_equal(lamps.at_m, [[0.01, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.03, -0.02]])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('camera = "arm"', 'camera = "leg"', "camera 'leg' given; the rig has left, right, arm"),
        ('camera = "arm"', 'camera = "left"', "camera 'left' needs one"),
        ("number = 7", "number = 3", "each needs one of its own"),
        ("number = 7", "number = 75", "lamp"),
        ("bit_s = 0.02", "bit_s = 0.0", "bit_s"),
        ("bit_s = 0.02", "", "bit_s"),
        ('["left", "right"]', '["left"]', "two cameras or more are wanted"),
    ],
)
def test_what_a_file_lacks_is_told_in_one_line_with_its_name(tmp_path, old, new, told):
    with pytest.raises(InputError) as refused:
        read_lamps(written(tmp_path, GOOD.replace(old, new, 1)), RIG)
    line = str(refused.value)
    assert "lamps.toml" in line
    assert told in line
    assert "\n" not in line
