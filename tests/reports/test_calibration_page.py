"""The report of a calibration: complete, offline, deterministic, and with the right verdict."""

import re
from dataclasses import replace

import numpy as np
import pytest
from html_checker import checked

from mosca.data.calibration import Calibration, Finding
from mosca.data.calibration_evidence import AccuracyGrid, CalibrationEvidence, HeldOutLengths
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.data.sightings import Sightings
from reports.calibration_page import verdict, with_sigma, write_calibration_page

FACING = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def calibration(lenses, findings=(), points=40, parameters=True) -> Calibration:
    rng = np.random.default_rng(1)
    c, n = len(lenses), points * len(lenses)
    cameras = tuple(
        Camera(f"cam {k} <&>", 640, 480, lens, Pose(FACING, [0.5 * k, -3.0, 1.0])) for k, lens in enumerate(lenses)
    )
    names = [f"{one.name}.{what}" for one in cameras for what in ("turn_x_rad", "X_m", "Y_m", _focal(one.lens))]
    names = tuple(names if parameters else ())
    used = rng.random(n) > 0.05
    sightings = Sightings(
        tuple(one.name for one in cameras), np.tile([640, 480], (c, 1)), 3, np.repeat(np.arange(c), points),
        np.arange(n) % 3, np.tile(np.arange(points), c), rng.uniform(0, 1, (n, 2)) * (639, 479),
        np.tile(0.01 * np.eye(2), (n, 1, 1)), np.full(n, np.nan),
    )  # fmt: skip
    root = rng.normal(size=(len(names), len(names) + 5)) * 1e-3
    return Calibration(
        Rig(cameras), "field.toml", sightings, names, root @ root.T, rng.normal(0, 0.1, (n, 2)), used,
        rng.uniform(-1, 1, (points, 3)), np.full(n, -1), np.zeros((0, 3, 3)), np.zeros((0, 3)), 1.02,
        np.full((c, 2), 0.0512), np.full((c, 2), 0.000141), (), (), 0.03, "field.toml", findings,
    )  # fmt: skip


def _focal(lens) -> str:
    return "c_mm" if isinstance(lens, MoscaLens) else "f_px"


LENSES = (MoscaLens(8.0, 320, 240, 0.01, 0.01, K1_per_mm2=-1e-4), OpenCVLens(800, 801, 320, 240, k1=-0.1),
          FisheyeLens(300, 300, 320, 240))  # fmt: skip


def evidence(count, accuracy=True, lengths=True, missing=()) -> CalibrationEvidence:
    rng = np.random.default_rng(2)
    covered = np.ones((count, 6, 8), dtype=bool)
    covered[:, 0, :3] = False
    links = np.full((count, count), 30) * (1 - np.eye(count, dtype=int))
    sigma = rng.uniform(1e-4, 2e-4, (5, 5, 3))
    sigma[0, 0] = np.nan
    grid = AccuracyGrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5), np.linspace(0, 1, 3), sigma, sigma / 3, 0.05)
    held = HeldOutLengths(1 + rng.normal(0, 1e-4, 20), np.full(20, 1e-4), 1.0, 2.5e-5, 3e-5)
    return CalibrationEvidence(
        covered, links, np.arange(count) if missing else np.zeros(count), np.array(missing),
        grid if accuracy else None, held if lengths else None, "session <3>",
    )  # fmt: skip


def page(tmp_path, *args) -> str:
    write_calibration_page(tmp_path / "page.html", *args)
    return (tmp_path / "page.html").read_text(encoding="utf-8")


def test_everything_stands_on_the_page(tmp_path):
    text = page(tmp_path, calibration(LENSES), evidence(3))
    for words in ("Nothing speaks against it", "Precision by camera", "Interior orientation", "Residual vectors",
                  "Where the target was seen", "The rig and its links", "How well it measures where",
                  "Held-out lengths",
                  "What looks alike to the images", "K1_per_mm2", "0.0512", "0.141",
                  "session &lt;3&gt;", "cam 0 &lt;&amp;&gt;"):  # fmt: skip
        assert words in text, words
    assert "cam 0 <&>" not in text


def test_a_table_of_lenses_has_four_cameras_at_most(tmp_path):
    text = page(tmp_path, calibration(LENSES[:1] * 9), evidence(9))
    section = text[text.index("<h2>Interior orientation</h2>") : text.index("Exterior orientation")]
    tables = section.split("<table>")[1:]
    columns = [re.findall(r'<th scope="col" class="n">(cam \d)', one) for one in tables]
    assert [len(one) for one in columns] == [4, 4, 1]
    assert [name for one in columns for name in one] == [f"cam {k}" for k in range(9)]
    assert all("K1_per_mm2" in one for one in tables)


def test_the_page_is_one_offline_file_in_order(tmp_path):
    text = page(tmp_path, calibration(LENSES), evidence(3))
    assert not re.search(r'(src|href)="(https?:)?//', text)
    assert "<script" not in text
    ids = checked(tmp_path / "page.html").ids
    assert len(ids) == len(set(ids))
    assert page(tmp_path, calibration(LENSES), evidence(3)) == text


@pytest.mark.parametrize(
    ("severities", "text", "tone"),
    [
        ((), "Nothing speaks against it", "good"),
        (("note",), "Nothing speaks against it", "good"),
        (("warn", "note"), "Use with care", "warn"),
        (("warn", "refuse"), "Do not use", "bad"),
    ],
)
def test_the_verdict_is_that_of_the_gravest_finding(tmp_path, severities, text, tone):
    findings = tuple(Finding("little-depth", s, f"camera 'a': something {s}", "a") for s in severities)
    assert verdict(findings)["tone"] == tone
    shown = page(tmp_path, calibration(LENSES, findings), evidence(3))
    assert text in shown
    assert shown.count('class="card finding') == len(severities)
    for s in severities:
        assert f"Camera &#39;a&#39;: something {s}." in shown


def test_missing_links_are_explained(tmp_path):
    text = page(tmp_path, calibration(LENSES), evidence(3, missing=[(0, 1), (0, 2)]))
    assert "3 groups see nothing in common" in text


@pytest.mark.parametrize("count", [1, 2, 7, 14])
def test_any_number_of_cameras(tmp_path, count):
    lenses = tuple(LENSES[k % 3] for k in range(count))
    text = page(tmp_path, calibration(lenses, parameters=count != 2), evidence(count, count > 1, False))
    assert f"Calibration of {count} camera" in text
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL).lower()


def test_a_calibration_without_points_has_a_page(tmp_path):
    empty = calibration(LENSES[:1])
    none = replace(empty, used=np.zeros(len(empty.sightings), dtype=bool))
    assert "Residual vectors" in page(tmp_path, none, evidence(1, False, False))


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (1234.5678, 0.0123, "1234.568 ± 0.012"),
        (-0.12345, 0.0012, "−0.1235 ± 0.0012"),
        (1.5e-4, 2e-6, "(1.500 ± 0.020)·10⁻⁴"),
        (12.0, None, "12"),
        (-3.2e-5, None, "−3.2·10⁻⁵"),
        (640.0, 15.0, "640 ± 15"),
        (0.0, None, "0"),
    ],
)
def test_values_with_their_standard_deviation(value, sigma, text):
    assert with_sigma(value, sigma) == text
