"""A camera's own poses against a rig's, on the page and in the record."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from html_checker import checked
from reports_examples import example_evidence, example_record

from reports.page import write_page
from reports.record import read_record, write_record
from reports.self_orientation_evidence import SelfOrientationEvidence

TABLE = {
    "paper, Table 4": {"mean": [-0.00526, 0.0081, 0.0272, -0.08392, 0.0232, 0.03281], "rms": None, "frames": None},
    "twin": {"mean": [0.001, -0.002, 0.003, 0.001, 0.0, -0.002], "rms": [0.002] * 3 + [0.01] * 3, "frames": 150},
}
BUDGET = {
    "rolling shutter of the camera": {
        "position_share": 0.75, "angle_share": 0.5, "mean": [0.0012, 0.0, -0.0034, 0.0, 0.0, 0.0], "rms": [0.0] * 6,
    },
}  # fmt: skip


def test_the_table_the_budget_and_their_pictures_are_on_the_page(tmp_path: Path) -> None:
    n = 20
    noise = np.random.default_rng(1).normal(0, 1e-3, (n, 6))
    shown = SelfOrientationEvidence(
        np.arange(n) / 30,
        noise,
        np.full((n, 6), 1e-3),
        2 * noise,
        np.full((n, 6), 2e-3),
        {"lens": 0.6, "clock": -0.1},
    )
    path = tmp_path / "report.html"
    enough = {"lens": {"what": "principal distance", "unit": "%", "depth": 1.5, "height": 40.0}}
    record = example_record(self_orientation=TABLE, error_budget=BUDGET, enough_alone=enough)
    write_page(path, record, replace(example_evidence(), self_orientation=shown))
    text = path.read_text(encoding="utf-8")
    checked(path)
    for cell in ("27.20 mm", "-0.0839", "3.00 mm", "0.0573 deg", "150", "75.0 %", "-3.40 mm", "1.5 %", "40 %"):
        assert f">{cell}<" in text
    assert "Error budget: lens 60.0 %, clock -10.0 %" in text
    own = 1e3 * np.sqrt(np.mean(np.sum(noise[:, :3] ** 2, axis=1)))
    assert (
        f"own poses {own:.2f} mm rms, the rig&#39;s {2 * own:.2f} mm rms" in text or f"own poses {own:.2f} mm" in text
    )
    write_record(record, tmp_path / "record.json")
    back = read_record(tmp_path / "record.json")
    assert back.self_orientation == TABLE
    assert back.error_budget == BUDGET
    without = tmp_path / "without.html"
    write_page(without, example_record(), example_evidence())
    assert "Error budget" not in without.read_text(encoding="utf-8")
