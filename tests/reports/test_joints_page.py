"""A person's joints on the page and in the record."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from html_checker import checked
from reports_examples import example_evidence, example_record

from mosca.data.joint_angles import JointAngles
from reports.page import write_page
from reports.record import Metric, read_record, write_record

JOINTS = {
    "l_knee": {
        "center_completeness": 1.0, "center_rms_m": 0.00123, "center_nees": 3.25, "center_coverage95": 0.94,
        "angle_completeness": 0.5, "angle_rms_rad": [np.pi / 180, np.pi / 90, np.pi / 60], "angle_nees": None,
        "angle_coverage95": 0.9,
    },
    "neck": {"angle_completeness": 0.0},
}  # fmt: skip


def test_joints_have_a_table_and_their_angles_a_picture(tmp_path: Path) -> None:
    frame = np.arange(5)
    angles = JointAngles(frame, frame * 10_000_000, ("l_knee_flexion",), np.full((5, 1), 0.5), np.full((5, 1), 0.1))
    truth = replace(angles, angles=angles.angles + 0.1)
    metric = Metric("joint_angle_rms", np.pi / 360, "rad", 15, None, "none", np.pi / 180, "at_most", True)
    record = example_record(joints=JOINTS, metrics=(metric,))
    path = tmp_path / "report.html"
    write_page(path, record, replace(example_evidence(), angles=angles, true_angles=truth))
    text = path.read_text(encoding="utf-8")
    checked(path)
    section = text[text.index("Joints against the truth") :]
    cells = section[section.index("<tbody>") : section.index("</tbody>")]
    for cell in ("1.23 mm", "3.25", "1.00, 2.00, 3.00 deg", "100.0 %", "50.0 %", "0.0 %"):
        assert f">{cell}<" in cells
    assert "5.73 deg rms from the truth" in text  # 0.1 rad
    assert "<b>0.5</b></td><td>deg</td>" in text
    without = tmp_path / "without.html"
    write_page(without, example_record(), example_evidence())
    assert "Joints against the truth" not in without.read_text(encoding="utf-8")


def test_a_record_keeps_its_joints(tmp_path: Path) -> None:
    record = example_record(joints=JOINTS)
    write_record(record, tmp_path / "record.json")
    assert read_record(tmp_path / "record.json").joints == JOINTS
