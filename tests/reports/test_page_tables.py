"""Tables, glossary, near misses, changed settings and gaps of a run's page."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from html_checker import checked
from reports_examples import example_evidence, example_record

import reports
from reports.error_tables import camera_table, marker_table
from reports.evidence import ErrorTable
from reports.glossary import GLOSSARY, term
from reports.margins import near_limits, share_of_limit
from reports.metrics import METRICS
from reports.page import write_page
from reports.plot_style import broken, pieces_between_gaps
from reports.plots import pictures
from reports.record import Metric, read_record

BASELINES = sorted((Path(reports.__file__).parent / "baselines").rglob("*.json"))


def test_every_metric_has_an_entry_and_every_entry_a_metric() -> None:
    assert set(GLOSSARY) == set(METRICS)
    for name, entry in GLOSSARY.items():
        assert entry.sentence.endswith("."), name
        assert len(entry.sentence) > 20, name


def test_every_metric_of_every_baseline_has_an_entry() -> None:
    names = {metric.name for path in BASELINES for metric in read_record(path).metrics}
    assert len(names) > 20
    assert [name for name in names if term(name) is None] == []
    assert term("efficiency_match") == GLOSSARY["efficiency"]
    assert term("views") is None


def test_a_marker_s_row_is_of_its_own_samples() -> None:
    base = example_evidence(frames=10, markers=2, views=0)
    frames = np.array([0, 1, 2, 6, 7])
    error = np.zeros((5, 3))
    error[:, 1] = (1e-3, 1e-3, 1e-3, 1e-3, 6e-3)
    errors = ErrorTable(frames, frames / 100, np.ones(5, int), error)
    could = np.zeros((10, 2, 6), bool)
    could[:4, 0, :2] = True
    could[2:, 1, :3] = True  # marker 1 was measured in frames 0 and 1 too, where half of its disc was not seen
    rows = marker_table(replace(base, errors=errors, could_see=could))
    assert [cell.text for cell in rows[0]["cells"]] == ["–", "–", "–", "0 %", "0", "4", "0", "0 s"]
    rms, p95, largest, found, samples, could, gaps, longest = rows[1]["cells"]
    assert rms.key == pytest.approx(np.sqrt(40 / 5))
    assert p95.key == pytest.approx(5.0)  # numpy's linear rule: 0.8 of the way from 1 to 6
    assert (largest.key, found.key, samples.key, could.key, gaps.key) == (6.0, 37.5, 5.0, 8.0, 1.0)
    assert longest.key == pytest.approx(0.03)  # frames 3, 4 and 5


def test_a_camera_s_row_is_of_the_points_that_it_measured() -> None:
    base = example_evidence(frames=2, markers=2, views=0)
    at = np.array([0, 0, 1]), np.array([0, 1, 0])
    error = np.zeros((3, 3))
    error[:, 0] = (1e-3, 7e-3, 3e-3)
    could = np.zeros((2, 2, 6), bool)
    could[:, :, :2] = True
    evidence = replace(base, errors=ErrorTable(at[0], at[0] / 100, at[1], error), could_see=could)
    used = np.zeros((3, 6), bool)
    used[[0, 2], 0] = True
    used[1, 1] = True
    table = camera_table(evidence, at[1], at[0], used)
    rms, points, views, share = table["cam0"]
    assert rms.key == pytest.approx(np.sqrt((1 + 9) / 2))
    assert (points.key, views.key, share.key) == (2.0, 4.0, 50.0)
    assert table["cam1"][0].key == pytest.approx(7.0)
    assert table["cam2"][0].text == "–"


@pytest.mark.parametrize(
    ("metric", "share"),
    [
        (Metric("position_rms", 0.9e-3, "m", 5, limit=1e-3, passed=True), 0.9),
        (Metric("completeness", 0.97, "1", 5, limit=0.95, sense="at_least", passed=True), 0.6),
        (Metric("frame_rate", 200.0, "1/s", 5, limit=100.0, sense="at_least", passed=True), 0.5),
        (Metric("sets_complete", 1.0, "1", 5, limit=1.0, sense="at_least", passed=True), None),
        (Metric("ghosts_per_frame", 0.0, "1", 5, limit=0.0, passed=True), None),
        (Metric("nees", 5.9, "1", 5, limit=6.0, passed=True, within=(1.5, 6.0)), None),
        (Metric("position_rms", 1e-3, "m", 5), None),
    ],
)
def test_the_share_of_a_limit(metric: Metric, share: float | None) -> None:
    assert share_of_limit(metric) == (None if share is None else pytest.approx(share))


def test_a_near_miss_names_what_made_most_of_it() -> None:
    base = example_evidence(frames=300, markers=2, views=0)
    error = np.zeros((600, 3))
    frame, marker = np.repeat(np.arange(300), 2), np.tile([0, 1], 300)
    error[:, 2] = np.where((marker == 1) & (frame >= 200), 3e-3, 1e-3)
    evidence = replace(base, errors=ErrorTable(frame, frame / 100, marker, error))
    near = Metric("position_rms", 0.9e-3, "m", 600, limit=1e-3, passed=True)
    far = Metric("position_p95", 0.1e-3, "m", 600, limit=1e-3, passed=True)
    (found,) = near_limits(example_record(metrics=(near, far)), evidence)
    assert found["share"] == "90 %"
    # marker 1: 200 + 9 x 100 of 300 + 1100; the last second: 100 + 900 of 1400
    assert "marker 01 has 78.6 %" in found["why"]
    assert "the second from 2 s has 71.4 %" in found["why"]


def test_changed_settings_stand_at_the_top(tmp_path: Path) -> None:
    provenance = {"changed": {"capture.duration_s": [10.0, 2.0], "scene.action": ["walk", "<run>"]}}
    write_page(tmp_path / "p.html", example_record(provenance=provenance), example_evidence(views=0))
    text = " ".join("".join(checked(tmp_path / "p.html").text).split())
    assert "capture.duration_s = 2 instead of 10" in text
    assert "scene.action = <run> instead of walk" in text
    assert text.index("capture.duration_s") < text.index("Figures and limits")
    write_page(tmp_path / "p.html", example_record(), example_evidence(views=0))
    assert "instead of" not in "".join(checked(tmp_path / "p.html").text)


def test_cards_say_their_verdict_in_words_and_colour(tmp_path: Path) -> None:
    metrics = (
        Metric("position_rms", 2.0e-4, "m", 9, limit=3e-4, passed=True),
        Metric("relative_accuracy", 2e-4, "1", 9, limit=1e-4, passed=False),
        Metric("completeness", 0.981, "1", 9, limit=0.98, sense="at_least", passed=True),
        Metric("ghosts_per_frame", 0.1, "1", 9),
    )
    write_page(tmp_path / "p.html", example_record(metrics=metrics), example_evidence(views=0))
    cards = re.findall(r'<div class="card tile ?(\w*)">(.*?)</div>', (tmp_path / "p.html").read_text("utf-8"))
    assert [tone for tone, _ in cards] == ["good", "bad", "near", ""]
    verdicts = [re.findall(r'class="verdict">([^<]*)', inside) for _, inside in cards]
    assert verdicts == [["✓ limit met"], ["✗ limit broken"], ["✓ limit met, nearly missed"], []]


def test_cards_show_what_is_judged_first(tmp_path: Path) -> None:
    metrics = (
        Metric("position_rms", 2.0e-4, "m", 9),
        Metric("completeness", 0.99, "1", 9, limit=0.98, sense="at_least", passed=True),
        Metric("sets_complete", 1.0, "1", 9, limit=0.98, sense="at_least", passed=True),
        Metric("joint_center_rms", 1e-3, "m", 9, limit=2e-3, passed=True),
        Metric("joint_angle_rms", 1e-3, "rad", 9, limit=2e-3, passed=True),
    )
    write_page(tmp_path / "p.html", example_record(metrics=metrics), example_evidence(views=0))
    cards = re.findall(r'<div class="card tile ?\w*">(.*?)</div>', (tmp_path / "p.html").read_text("utf-8"))
    names = [re.sub("<[^>]*>", " ", inside).split("  ")[0].strip() for inside in cards]
    wanted = ["Joint center rms", "Joint angle rms", "Completeness", "Position error, rms"]
    assert [name.startswith(one) for name, one in zip(names, wanted, strict=True)] == [True] * 4


def test_a_curve_ends_where_a_frame_is_missing() -> None:
    frames = np.array([0, 2, 4, 10, 12, 14])
    pieces = pieces_between_gaps(frames)
    assert pieces.tolist() == [0, 0, 0, 1, 1, 1]
    time, values = broken(frames / 100, np.arange(6.0), pieces)
    assert np.flatnonzero(np.isnan(time)).tolist() == np.flatnonzero(np.isnan(values)).tolist() == [3]
    assert pieces_between_gaps(np.empty(0, int)).tolist() == []


def strokes(svg: str) -> int:
    """Return how many times a pen is put down in the curves of a drawing."""
    return sum(path.count("M ") for path in re.findall(r'<path d="([^"]*)" clip-path', svg))


def test_static_plots_draw_no_line_across_a_gap() -> None:
    base = example_evidence(frames=60, markers=1, views=0)
    assert base.errors is not None
    drawn = {}
    for name, lost in (("whole", []), ("gap", range(20, 40))):
        rows = np.flatnonzero(~np.isin(base.errors.frame, lost))
        columns = (getattr(base.errors, field)[rows] for field in ("frame", "time_s", "marker", "error_xyz_m"))
        made = pictures(example_record(), replace(base, errors=ErrorTable(*columns), counts=None))
        drawn[name] = {picture.name: strokes(picture.svg) for picture in made}
    # best, median and worst are one marker here: 3 columns, 3 axes, position and difference
    assert drawn["gap"]["trajectories"] - drawn["whole"]["trajectories"] == 18
    assert drawn["gap"]["over_time"] - drawn["whole"]["over_time"] == 2
