"""A suite's page in a browser: sorted, filtered, opened, narrow, silent; its words, and its history in a file."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from browser import CHROMIUM, BrowserPage, browser
from html_checker import checked
from reports_examples import example_evidence, example_record

from mosca.errors import InputError
from reports.glossary import SUITE_COLUMNS
from reports.margins import share_used
from reports.record import Metric, RunRecord
from reports.suite.history import append_history, past_result, read_history
from reports.suite.page import write_suite_page
from reports.suite.rows import SuiteResult, headline, nearest, verdict
from reports.suite.thumbnail import thumbnail

GOOD = Metric("position_rms", 0.5e-4, "m", 9, limit=1e-4, passed=True)
TIGHT = replace(GOOD, value=0.93e-4)
BROKEN = replace(GOOD, value=1.17e-4, passed=False)
CONTROL = replace(GOOD, value=5e-4, passed=False, within=(4e-4, 8e-4))
MISSED = replace(GOOD, value=0.6e-4, within=(4e-4, 8e-4))


def run(name: str, metric: Metric, expect: str = "pass", passed: bool = True, **more: object) -> SuiteResult:
    record = example_record(scenario=name, metrics=(metric,), expect=expect, passed=passed, verdict="its verdict")
    record = replace(record, provenance={**record.provenance, "parameters": {"seed": 7, "rate": 100}})
    return SuiteResult(name, f"Title of {name}", "quick", expect, record, **more)  # type: ignore[arg-type]


RESULTS = (
    run("spaces/b", GOOD, seconds=20.0, picture=thumbnail(example_evidence())),
    run("controls/c", CONTROL, "fail", seconds=3.0),
    run("spaces/a", BROKEN, passed=False, seconds=100.0),
    run("lenses/d", TIGHT, seconds=4.0),
    SuiteResult("lenses/<e>", "No run", "full", "pass", None, "x.toml: nothing"),
    run("spaces/f", GOOD, complaints=("position_rms 0.05 mm, baseline 0.04: worse by 25 %",), seconds=5.0),
)


def record_of(result: SuiteResult) -> RunRecord:
    assert result.record is not None
    return result.record


def past_of(result: SuiteResult, values: tuple[float, ...]) -> list:
    record = record_of(result)
    return [
        past_result(replace(record, metrics=(replace(record.metrics[0], value=value),)), True, 1.0, day)
        for day, value in zip(
            ("2026-01-01T00:00:00Z", "2026-01-02T00:00:00Z", "2026-01-03T00:00:00Z"), values, strict=False
        )
    ]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suite")
    (folder / "spaces" / "b").mkdir(parents=True)
    (folder / "spaces" / "b" / "report.html").write_text("<!doctype html><title>the run</title>")
    past = past_of(RESULTS[0], (0.4e-4, 1.2e-4, 0.5e-4))
    other = replace(record_of(RESULTS[0]), provenance={"parameters": {"seed": 8}})
    past.insert(0, past_result(other, True, 1.0, "2026-01-01T00:00:00Z"))
    write_suite_page(folder / "suite.html", RESULTS, past, folder)
    return folder / "suite.html"


def test_expectation_and_verdict_are_told_apart() -> None:
    said = [verdict(result) for result in RESULTS]
    assert said[0] == ("passed", "")
    assert said[1] == ("failed", "")
    assert said[2] == ("FAILED", "position_rms 0.117 > 0.1 mm")
    assert said[4] == ("DID NOT RUN", "x.toml: nothing")
    assert said[5][0] == "WORSE"
    assert verdict(run("x", MISSED, "fail", False)) == ("PASSED", "position_rms 0.06 outside 0.4 to 0.8 mm")
    beyond = replace(CONTROL, value=9e-4)
    assert verdict(run("x", beyond, "fail", False))[0] == "FAILED OTHERWISE"
    assert verdict(run("x", GOOD, "caught", False)) == ("NOT CAUGHT", "its verdict")
    assert [result.as_it_must for result in RESULTS] == [True, True, False, True, False, False]


def test_the_nearest_limit_is_the_one_of_which_most_is_used() -> None:
    # of completeness 0.995 >= 0.99 half of what may be missing is missing; 5e-4 is 0.5 of the way from 6e-4 to 4e-4
    complete = Metric("completeness", 0.995, "1", 9, limit=0.99, sense="at_least", passed=True)
    for metric, share in ((TIGHT, 0.93), (complete, 0.5), (CONTROL, 0.5)):
        assert share_used(metric) == pytest.approx(share)
    found = nearest(example_record(metrics=(complete, TIGHT, replace(GOOD, name="hota", limit=None))))
    assert found is not None
    assert found[0] is TIGHT
    assert nearest(example_record(metrics=())) is None
    main = headline(example_record(metrics=(complete, TIGHT)))
    assert main is TIGHT


def test_a_history_grows_line_by_line_and_names_the_line_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "kept" / "history.jsonl"
    assert read_history(path) == []
    append_history(path, past_of(RESULTS[0], (1e-4,)))
    append_history(path, past_of(RESULTS[2], (2e-4, float("nan"))))
    found = read_history(path)
    assert [one.scenario for one in found] == ["spaces/b", "spaces/a", "spaces/a"]
    assert [one.values for one in found] == [{"position_rms": 1e-4}, {"position_rms": 2e-4}, {}]
    assert found[0].content == found[1].content
    with path.open("a") as end:
        end.write(json.dumps({**vars(found[0]), "seconds": "long"}) + "\n")
    with pytest.raises(InputError, match=r"history.jsonl: line 4: not a result"):
        read_history(path)


def test_the_page_is_well_formed_and_loads_nothing(file: Path) -> None:
    page = checked(file)
    assert page.loads == ["spaces/b/report.html"]
    assert "lenses/<e>" in page.text
    for name in SUITE_COLUMNS:
        assert sum(name in text for text in page.text) >= 2  # in the head, and among what columns mean


browsing = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


@pytest.fixture(scope="module")
def opened(file: Path) -> Iterator[BrowserPage]:
    pytest.importorskip("websockets", reason="drives the browser; comes with mujoco")
    with browser() as page:
        page.open(file, 1400)
        yield page
        assert page.errors == []
        assert [one for one in page.requests if not one.startswith(("file:///", "data:"))] == []


NAMES = "[...document.querySelectorAll('tr[data-name]')].filter(r => r.offsetHeight).map(r => r.dataset.name)"


def choose(page: BrowserPage, key: str, value: str) -> list[str]:
    page.js(
        f"(s => {{ s.value = {json.dumps(value)}; s.dispatchEvent(new Event('change')); }})"
        f"(document.querySelector('[data-filter={key}]'))"
    )
    names: list[str] = page.js(NAMES)
    return names


@browsing
def test_rows_are_sorted_and_their_figures_go_with_them(opened: BrowserPage) -> None:
    head = "[aria-label=Scenarios] thead th:nth-child({}) button"
    given = [result.name for result in RESULTS]
    assert opened.js(NAMES) == given
    opened.js(f"document.querySelector('{head.format(7)}').click()")
    by_time = sorted((r for r in RESULTS if r.seconds), key=lambda r: r.seconds)
    assert opened.js(NAMES) == [*(r.name for r in by_time), "lenses/<e>"]
    opened.js(f"document.querySelector('{head.format(4)}').click()")
    opened.js(f"document.querySelector('{head.format(4)}').click()")
    assert opened.js(NAMES)[:2] == ["spaces/a", "lenses/d"]  # 117 % and 93 % of the limit
    follows = "[...document.querySelectorAll('tr[data-name]')].every(r => r.nextElementSibling.id ==="
    assert opened.js(follows + " r.querySelector('.open').getAttribute('aria-controls'))")
    opened.js(f"document.querySelector('{head.format(1)}').click()")
    assert opened.js(NAMES) == sorted(given)


@browsing
def test_filters_leave_what_is_asked_and_the_address_keeps_them(opened: BrowserPage, file: Path) -> None:
    assert sorted(choose(opened, "family", "spaces")) == ["spaces/a", "spaces/b", "spaces/f"]
    assert sorted(choose(opened, "state", "bad")) == ["spaces/a", "spaces/f"]
    assert opened.js("document.getElementById('count').textContent") == "2 of 6 shown"
    assert opened.js("location.hash") == "#family=spaces&state=bad"
    opened.js("window.stale = true; location.reload()")
    opened.until("!window.stale && document.readyState === 'complete'")
    assert opened.js("document.getElementById('count').textContent") == "2 of 6 shown"
    opened.js("document.getElementById('all').click()")
    assert len(opened.js(NAMES)) == 6
    assert choose(opened, "state", "near") == ["lenses/d"]
    assert choose(opened, "tier", "full") == []
    assert opened.js("document.getElementById('none').offsetHeight") > 0
    opened.js("document.getElementById('all').click()")
    opened.js(
        "(f => { f.value = 'TITLE lenses'; f.dispatchEvent(new Event('input')); })(document.getElementById('find'))"
    )
    assert opened.js(NAMES) == ["lenses/d"]
    opened.js("document.getElementById('all').click()")


@browsing
def test_a_row_opens_to_its_limits_and_its_history(opened: BrowserPage) -> None:
    row = 'tr[data-name="spaces/b"]'
    detail = f"document.querySelector('{row}').nextElementSibling"
    assert opened.js(f"{detail}.offsetHeight") == 0
    opened.click(f"{row} .open")
    assert opened.js(f"{detail}.offsetHeight") > 100
    assert opened.js(f"document.querySelector('{row} .open').getAttribute('aria-expanded')") == "true"
    text = opened.js(f"{detail}.textContent")
    assert "3 results of 1 commit; 1 of other settings or seeds are not drawn" in text
    # 0.4, 1.2 and 0.5 of a limit of 1: the second alone is red, and above the dashed line
    places = opened.js(
        f"[...{detail}.querySelectorAll('.large circle')].map(c => [c.getAttribute('fill'), +c.getAttribute('cy')])"
    )
    assert [fill for fill, _ in places] == ["var(--blue)", "var(--vermilion)", "var(--blue)"]
    limit = opened.js(f"+{detail}.querySelector('[stroke-dasharray]').getAttribute('d').match(/ ([\\d.]+)H/)[1]")
    (first, second, third) = (y for _, y in places)
    assert (first - limit) / (third - limit) == pytest.approx(0.6 / 0.5, rel=0.02)
    assert second < limit
    opened.click(f"{row} .open")
    assert opened.js(f"{detail}.offsetHeight") == 0


@browsing
def test_everything_has_a_name_and_fits_a_telephone(opened: BrowserPage, file: Path) -> None:
    nameless = opened.js(
        "[...document.querySelectorAll('button, input, select, a, form, [role=img], [role=region]')]"
        ".filter(e => !(e.getAttribute('aria-label') || e.textContent.trim() || e.closest('label')))"
        ".map(e => e.outerHTML)"
    )
    assert nameless == []
    opened.open(file, 400)
    opened.js("document.querySelector('button.open').click()")
    assert opened.js("document.documentElement.scrollWidth") <= 400
    wide = "[...document.querySelectorAll('.suite tr[data-name] > *')].filter(e => e.offsetHeight)"
    assert opened.js(f"Math.max(...{wide}.map(e => e.getBoundingClientRect().right))") <= 400
    assert opened.js("document.querySelector('.suite thead th button').offsetHeight") > 0


@browsing
def test_a_link_leads_to_the_runs_page(opened: BrowserPage, file: Path) -> None:
    opened.open(file, 1000)
    # later, since a click leaves the page, before or after it answers
    opened.js("setTimeout(() => document.querySelector('tr[data-name=\"spaces/b\"] a').click(), 0), 0")
    opened.until("document.title === 'the run'")
