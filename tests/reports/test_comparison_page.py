"""Runs compared on a page: what differs first, better and worse only where they compare, plots on one scale."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, BrowserPage, browser
from html_checker import checked
from reports_examples import example_record

from reports.comparison.changes import change, differences, not_comparable
from reports.comparison.page import write_comparison_page
from reports.comparison.plots import errors_over_time
from reports.comparison.series import figures_over
from reports.plot_style import house_style
from reports.record import Metric, MetricBlocks, RunRecord

SETTINGS = {"seed": 7, "capture": {"duration_s": 2.0, "frame_rate_hz": 100}, "limits": {"position_rms": 3e-4}}
MADE_BY = {"platform": "Linux x86_64", "processor": "one", "versions": {"numpy": "2.4"}, "git": "abc"}


def run(
    factor: float = 1.0, parameters: dict | None = None, made_by: dict | None = None, **changes: object
) -> RunRecord:
    squares = 1e-8 * factor**2 * (4 + np.arange(20) % 5)
    rms = Metric(
        "position_rms", float(np.sqrt(squares.mean())), "m", 2000, None, limit=3e-4, passed=True,
        blocks=MetricBlocks(tuple(100 * squares), (100.0,) * 20),
    )  # fmt: skip
    rms = replace(rms, ci95=(0.9 * rms.value, 1.1 * rms.value))
    speed = Metric("frame_rate", 400.0 / factor, "1/s", 100, (390.0 / factor, 410.0 / factor), sense="at_least")
    count = Metric("identity_switches", 10.0 * factor, "1", 9)
    provenance = {**MADE_BY, **(made_by or {}), "parameters": {**SETTINGS, **(parameters or {})}}
    return example_record(metrics=(rms, speed, count), provenance=provenance, **changes)


FIRST = run()


@pytest.mark.parametrize(("factor", "words"), [(1.1, "worse"), (1 / 1.1, "better"), (1.01, "same"), (1.0, "same")])
def test_a_paired_change_is_told_both_ways(factor: float, words: str) -> None:
    for name in ("position_rms", "identity_switches"):
        found = change(run(factor), FIRST, name)
        assert found is not None
        assert found.verdict == words
        assert found.share == pytest.approx(factor - 1, abs=1e-9)


def test_within_the_stated_spread_is_the_same_and_beyond_twice_of_it_is_not() -> None:
    spread = 0.06 * FIRST.metrics[0].value
    stated = replace(FIRST, metrics=(replace(FIRST.metrics[0], spread=spread),))
    for factor, words in ((1.1, "same"), (1.13, "worse"), (0.9, "same"), (0.87, "better")):
        for new, old in (
            (run(factor), stated),
            (replace(run(factor), metrics=(replace(run(factor).metrics[0], spread=spread),)), FIRST),
        ):
            found = change(new, old, "position_rms")
            assert found is not None
            assert found.verdict == words, factor


def test_what_cannot_be_told_is_not_comparable_and_says_why() -> None:
    other = {"processor": "two"}
    for new, name, words in (
        (run(1.3, made_by=other), "frame_rate", "another machine"),
        (run(1.3, made_by=other), "identity_switches", "versions or processors differ"),
        (run(1.3, seed=8), "identity_switches", "seeds differ"),
        (replace(run(), metrics=(replace(FIRST.metrics[0], aligned_by="similarity"),)), "position_rms", "aligned by"),
    ):
        found = change(new, FIRST, name)
        assert found is not None
        assert found.verdict == "not comparable"
        assert words in found.why
    # with an interval another seed compares: +-10 % of both give 14 %
    for factor, words in ((1.1, "same"), (1.3, "worse"), (0.75, "better")):
        found = change(run(factor, seed=8), FIRST, "position_rms")
        assert found is not None
        assert found.verdict == words
    assert change(run(), replace(FIRST, metrics=()), "position_rms") is None


@pytest.mark.parametrize(
    ("new", "words"),
    [
        (run(), ""),
        (run(parameters={"seed": 8}, seed=8), ""),
        (run(parameters={"limits": {"position_rms": 1e-4}}), ""),
        (run(parameters={"title": "a text"}), ""),
        (
            run(parameters={"capture": {"duration_s": 3.0, "frame_rate_hz": 100}}),
            "other settings: capture.duration_s",
        ),
        (run(parameters={"a": 1, "b": 1, "c": 1, "d": 1, "e": 1}), "a, b, c and 2 more"),
        (run(source="recording:x"), "frames of recording:x"),
        (run(expect="fail"), "expected to fail"),
        (run(scenario="x"), "another scenario"),
        (example_record(), "not recorded"),
    ],
)
def test_runs_compare_where_settings_source_and_expectation_are_the_same(new: RunRecord, words: str) -> None:
    said = not_comparable(new, FIRST)
    assert words in said
    assert bool(said) == bool(words)


def test_a_control_is_never_better_or_worse() -> None:
    assert "control" in not_comparable(run(expect="fail"), run(expect="fail"))


def test_what_differs_is_listed_and_what_does_not_is_not() -> None:
    longer = {"capture": {"duration_s": 3.0, "frame_rate_hz": 100}, "limits": {"position_rms": 1e-4}, "title": "x"}
    other = run(parameters=longer, made_by={"processor": "two", "versions": {"numpy": "2.5"}}, seed=8)
    rows = {(row["group"], row["key"]): row["values"] for row in differences((FIRST, other))}
    assert rows == {
        ("Run", "seed"): ["7", "8"],
        ("Run", "duration [s]"): ["2", "3"],
        ("Claim", "limits.position_rms"): ["0.0003", "0.0001"],
        ("Program", "processor"): ["one", "two"],
        ("Program", "numpy"): ["2.4", "2.5"],
    }
    assert differences((FIRST, FIRST)) == []


def test_panels_have_the_same_axes() -> None:
    longer = {"capture": {"duration_s": 4.0, "frame_rate_hz": 100}}
    with house_style():
        svg = errors_over_time((FIRST, run(3.0, longer)), ("a", "b")).svg
    extents = []
    for axes in re.split(r'<g id="errors-axes_', svg)[1:]:
        curve = max(re.findall(r' d="(M[^"]*)"', axes), key=len)
        extents.append(np.ptp(np.array(re.findall(r"[-\d.]+", curve), float).reshape(-1, 2), axis=0))
    # errors three times as large for twice as long are drawn so
    np.testing.assert_allclose(extents[1] / extents[0], [2.0, 3.0], rtol=1e-3)


def test_figures_stand_over_their_values() -> None:
    picture = figures_over("cameras.count", ["2", "3", "6"], [run(3.0), run(2.0), run()])
    assert picture is not None
    assert "position_rms from 0.735 to 0.245 mm" in picture.alt
    panel = re.split(r'<g id="over-axes_', picture.svg)[1]
    curve = next(d for d in re.findall(r' d="(M[^"]*)"', panel.split("over-line2d", 1)[1]) if d.count("L") == 2)
    points = np.array(re.findall(r"[-\d.]+", curve), float).reshape(-1, 2)
    # 6 is three times as far from 3 as 3 is from 2; three, two and one parts of the same error
    np.testing.assert_allclose(np.diff(points[:, 0]) / (points[1, 0] - points[0, 0]), [1.0, 3.0], rtol=1e-3)
    np.testing.assert_allclose(np.diff(points[:, 1])[0], np.diff(points[:, 1])[1], rtol=1e-3)
    # words stand beside each other; one run has nothing to draw
    named = figures_over("rig", ["a.toml", "b.toml"], [FIRST, FIRST])
    assert named is not None
    assert ">b.toml<" in named.svg
    assert figures_over("seed", ["1"], [FIRST]) is None


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("comparison")
    (folder / "report.html").write_text("<!doctype html><title>the run</title>")
    longer = run(parameters={"capture": {"duration_s": 3.0, "frame_rate_hz": 100}})
    runs = [FIRST, run(1.1), longer]
    labels = ["runs/before", "runs/after", "runs/<longer>"]
    write_comparison_page(folder / "c.html", runs, labels, [folder / "report.html", folder / "none.html", None])
    return folder / "c.html"


def test_differences_stand_before_any_figure(file: Path) -> None:
    page = checked(file)
    text = file.read_text(encoding="utf-8")
    assert [one for one in page.loads if not one.startswith("#")] == ["report.html"]
    assert text.index("capture.duration_s") < text.index(">What differs<") < text.index(">duration [s]<")
    assert text.index(">duration [s]<") < text.index("0.245")
    assert "runs/<longer>" in page.text
    assert "3 of 3 runs are as claimed. 3 figures worse, none better" in "".join(page.text)


browsing = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


@pytest.fixture(scope="module")
def opened(file: Path) -> Iterator[BrowserPage]:
    pytest.importorskip("websockets", reason="drives the browser; comes with mujoco")
    with browser() as page:
        page.open(file, 1400)
        yield page
        assert page.errors == []
        assert [one for one in page.requests if not one.startswith(("file:///", "data:"))] == []


@browsing
def test_figures_are_filtered_by_verdict_and_sorted(opened: BrowserPage) -> None:
    rows = "[...document.querySelectorAll('tr[data-verdicts]')].filter(r => r.offsetHeight)"
    names = f"{rows}.map(r => r.cells[0].dataset.key)"
    assert len(opened.js(names)) == 3
    choose = "(s => {{ s.value = '{}'; s.dispatchEvent(new Event('change')); }})(document.getElementById('verdict'))"
    opened.js(choose.format("better"))
    assert opened.js(names) == []
    opened.js(choose.format("not comparable"))
    assert len(opened.js(names)) == 3
    opened.js(choose.format(""))
    opened.js("document.querySelector('.figs thead th:nth-child(2) button').click()")
    assert opened.js(names) == ["position_rms", "identity_switches", "frame_rate"]


@browsing
def test_it_fits_a_telephone(opened: BrowserPage, file: Path) -> None:
    opened.open(file, 400)
    assert opened.js("document.documentElement.scrollWidth") <= 400
    right = "[...document.querySelectorAll('.figs td')].map(e => e.getBoundingClientRect().right)"
    assert opened.js(f"Math.max(...{right})") <= 400
