"""A panel's modes on the page and in the record."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from html_checker import checked
from reports_examples import example_evidence, example_record

from reports.page import write_page
from reports.record import read_record, write_record
from reports.vibration_evidence import VibrationEvidence

MODES = {
    "mode 1": {
        "true_hz": 19.976, "true_damping": 0.002, "frequency_bound": 0.00036, "damping_bound": 0.182,
        "frequency_hz": 19.986, "frequency_sigma_hz": 0.008, "damping": 0.0021, "damping_sigma": 0.0004,
        "frequency_error": 0.0005, "damping_error": 0.05, "mac": 0.9987,
    },
    "mode 2": {"true_hz": 38.4, "true_damping": 0.002, "frequency_bound": 0.0003, "damping_bound": 0.13},
}  # fmt: skip


def test_modes_have_a_table_and_pictures(tmp_path: Path) -> None:
    f = np.linspace(0, 100, 101)
    density = 1e-12 * (1 + 100 / (1 + (f - 20) ** 2))
    place = np.column_stack([np.repeat(np.arange(3.0), 2), np.tile([0.0, 1.0], 3), np.zeros(6)])
    shown = VibrationEvidence(
        f, density, np.column_stack([6 * density, density]), (0.8, 1.3), 1e-12, 1.1e-12, np.array([19.986]), (False,),
        place, np.array([[1.0, -1.0, 0.5, -0.5, 0.2, 0.0]]), 200.0,
    )  # fmt: skip
    path = tmp_path / "report.html"
    write_page(path, example_record(modes=MODES), replace(example_evidence(), vibration=shown))
    text = path.read_text(encoding="utf-8")
    checked(path)
    section = text[text.index("Modes against the truth") :]
    cells = section[section.index("<tbody>") : section.index("</tbody>")]
    for cell in ("19.976 Hz", "+0.0500 %", "0.0360 %", "0.200 %", "+5.0 %", "18.2 %", "0.9987", "not found"):
        assert f">{cell}<" in cells
    assert "with modes at 19.99 Hz" in text
    assert "Shapes of 1 modes" in text
    without = tmp_path / "without.html"
    write_page(without, example_record(), example_evidence())
    assert "Modes against the truth" not in without.read_text(encoding="utf-8")


def test_a_record_keeps_its_modes(tmp_path: Path) -> None:
    write_record(example_record(modes=MODES), tmp_path / "record.json")
    assert read_record(tmp_path / "record.json").modes == MODES
