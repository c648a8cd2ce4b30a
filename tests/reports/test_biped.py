"""A person as a stick figure: lines where joints are, the truth beside them, words that say how far off."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from html_checker import checked
from reports_examples import example_evidence, example_record

from mosca.data.joint_motion import JOINTS, JointMotion
from reports.biped_plots import INSTANTS, biped_picture
from reports.bones import strips
from reports.page import write_page

STANDING = {
    "pelvis": (0, 0, 0.9), "l_hip": (0, 0.09, 0.9), "r_hip": (0, -0.09, 0.9), "l_knee": (0.1, 0.09, 0.5),
    "r_knee": (0, -0.09, 0.5), "l_ankle": (0, 0.09, 0.1), "r_ankle": (0, -0.09, 0.1), "l_shoulder": (0, 0.18, 1.4),
    "r_shoulder": (0, -0.18, 1.4), "l_elbow": (0, 0.2, 1.1), "r_elbow": (0, -0.2, 1.1), "l_wrist": (0.2, 0.2, 1.0),
    "r_wrist": (0.2, -0.2, 1.0),
}  # fmt: skip


def standing(n: int = 20, off_m: float = 0.0) -> JointMotion:
    """Return somebody who slides along x, each joint ``off_m`` too high."""
    centre = np.array([STANDING.get(joint, (np.nan,) * 3) for joint in JOINTS], dtype=float)
    places = centre + 0.05 * np.arange(n)[:, None, None] * [1, 0, 0] + [0, 0, off_m]
    nothing = np.zeros((n, len(JOINTS), 3, 3))
    turns = np.tile([1.0, 0, 0, 0], (n, len(JOINTS), 1))
    return JointMotion(np.arange(n), 10_000_000 * np.arange(n), JOINTS, places, nothing, turns, nothing)


def paths(svg: str) -> list[np.ndarray]:
    """Return the points of the open lines with three points or more, as they are drawn."""
    root = ElementTree.fromstring(re.sub(r"<!--.*?-->", "", svg))
    found = []
    for element in root.iter():
        d = element.get("d", "")
        if element.tag.endswith("path") and re.fullmatch(r"(\s*[ML]\s+\S+\s+\S+)+\s*", d) and d.count("L") >= 2:
            found.append(np.array(re.findall(r"[ML]\s+(\S+)\s+(\S+)", d), dtype=float))
    return found


def test_lines_go_from_joint_to_joint_and_end_at_unknown_ones() -> None:
    motion = standing(1)
    lines = strips(motion.joints, motion.centre[0])
    assert sorted(map(len, lines)) == [2, 4, 4, 4, 4]
    np.testing.assert_array_equal(lines[0], [STANDING[j] for j in ("pelvis", "l_hip", "l_knee", "l_ankle")])
    np.testing.assert_allclose(lines[2], [STANDING["pelvis"], (0, 0, 1.4)])
    gone = motion.centre[0].copy()
    gone[JOINTS.index("l_knee")] = np.nan
    np.testing.assert_array_equal(strips(motion.joints, gone)[0], [STANDING["pelvis"], STANDING["l_hip"]])
    assert len(strips(motion.joints, gone)) == 5
    assert strips((), np.empty((0, 3))) == []


def test_a_picture_says_and_draws_the_person_beside_the_truth() -> None:
    picture = biped_picture(standing(off_m=0.01), standing())
    assert picture.alt == "A person's joints at 6 instants, 10 mm rms from the truth."
    assert "truth" in picture.caption
    drawn = paths(picture.svg)
    # a leg and an arm of both sides, of the estimate and of the truth, at each instant
    assert len(drawn) == 2 * 4 * INSTANTS
    alone = biped_picture(standing())
    assert "truth" not in alone.alt + alone.caption
    assert len(paths(alone.svg)) == 4 * INSTANTS
    # the thigh is as long as the shank in the upright leg, and both go downwards
    leg = next(line for line in paths(alone.svg) if len(line) == 4 and abs(line[3, 0] - line[2, 0]) < 1e-6)
    thigh, shank = leg[2] - leg[1], leg[3] - leg[2]
    np.testing.assert_allclose(thigh, shank, atol=1e-3)
    assert thigh[1] > 0
    assert picture == biped_picture(standing(off_m=0.01), standing())


def test_a_take_without_a_pose_has_no_picture() -> None:
    motion = standing(3)
    nobody = replace(motion, centre=np.full_like(motion.centre, np.nan))
    with pytest.raises(ValueError, match="no instant"):
        biped_picture(nobody)


def test_the_page_shows_the_person_where_there_is_one(tmp_path: Path) -> None:
    nobody = replace(standing(3), centre=np.full((3, len(JOINTS), 3), np.nan))
    for name, joints, shown in (("a", standing(), True), ("b", None, False), ("c", nobody, False)):
        path = tmp_path / f"{name}.html"
        evidence = replace(example_evidence(), joints=joints, true_joints=None if joints is None else standing())
        write_page(path, example_record(), evidence)
        checked(path)
        assert ("The person" in path.read_text(encoding="utf-8")) == shown
