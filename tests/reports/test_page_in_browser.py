"""A run's page in a real browser: turned, played, sorted, narrow, and silent on the console and the network."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, BrowserPage, browser
from reports_examples import example_evidence, example_record, example_view
from test_playback import with_rows

from reports.evidence import ErrorTable, Evidence, KeptSet
from reports.page import write_page
from reports.playback.keeper import kept_image

pytest.importorskip("websockets", reason="drives the browser; comes with mujoco")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")

GAP = range(50, 70)
CHOSEN = 2


def evidence_with_a_gap() -> Evidence:
    """Return the example with images of three cameras at five pulses; marker 2 has no sample in frames 50 to 69."""
    base = with_rows(example_evidence(frames=120, markers=8, views=0))
    assert base.errors is not None
    kept = ~((base.errors.marker == CHOSEN) & np.isin(base.errors.frame, GAP))
    errors = ErrorTable(*(getattr(base.errors, name)[kept] for name in base.errors.__dataclass_fields__))
    rng = np.random.default_rng(9)
    sets = []
    for pulse in (0, 30, 60, 90, 119):
        views = [example_view(rng, f"cam{c}", n=5 + c + pulse // 30) for c in range(3)]
        sets.append(KeptSet(pulse, tuple(kept_image(view.image, view.detections) for view in views)))
    return replace(base, errors=errors, kept_sets=tuple(sets))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("browser") / "report.html"
    write_page(path, example_record(), evidence_with_a_gap())
    return path


@pytest.fixture(scope="module")
def opened(file: Path) -> Iterator[BrowserPage]:
    with browser() as page:
        page.open(file, 1400)
        page.until("!!window.moscaPlayer && moscaPlayer.shownSet !== null")
        yield page
        assert page.errors == []
        assert page.requests
        assert [one for one in page.requests if not one.startswith(("file:///", "data:"))] == []


def eye(page: BrowserPage) -> list[float]:
    found: list[float] = page.js("(e => [e.x, e.y, e.z])(document.getElementById('space').layout.scene.camera.eye)")
    return found


def test_space_is_turned_with_the_mouse(opened: BrowserPage) -> None:
    before = eye(opened)
    x, y, width, height = opened.box("#space")
    turned = f"Math.abs(document.getElementById('space').layout.scene.camera.eye.x - {before[0]}) > 0.05"
    for _ in range(10):  # a page that draws slowly drops the mouse's moves
        opened.drag(x + 0.5 * width, y + 0.6 * height, 150, 0)
        if opened.js(turned):
            break
    opened.until(turned)
    after = eye(opened)
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before), rel=1e-3)  # turned, not moved nearer
    # a new instant leaves the view as it was turned
    opened.js("moscaPlayer.show(10)")
    np.testing.assert_allclose(eye(opened), after, atol=1e-6)


def test_the_slider_moves_space_images_and_plots_together(opened: BrowserPage) -> None:
    evidence = evidence_with_a_gap()
    for frame, pulse in ((0, 0), (44, 30), (46, 60), (119, 119)):
        opened.js(
            f"(s => {{ s.value = {frame}; s.dispatchEvent(new Event('input')); }})(document.getElementById('time'))"
        )
        shown = opened.js(
            "({x: document.getElementById('space').data[6].x, clock: document.getElementById('clock').textContent,"
            " cursors: ['of_marker', 'of_all'].map(id => document.getElementById(id).layout.shapes[0].x0),"
            " rings: [...document.querySelectorAll('.view svg')].map(s => s.childElementCount),"
            " when: document.querySelector('.view .when').textContent})"
        )
        rows = evidence.tracks.frame == frame
        expected = np.full(8, np.nan)
        expected[evidence.tracks.track[rows]] = evidence.tracks.xyz[rows, 0]
        np.testing.assert_allclose(np.array(shown["x"], float), expected, atol=1e-4)
        assert shown["clock"] == f"{frame / 100:.3f} s"
        np.testing.assert_allclose(shown["cursors"], frame / 100, atol=1e-6)
        assert shown["rings"] == [5 + c + pulse // 30 for c in range(3)]
        assert shown["when"].startswith(f"{pulse / 100:.2f} s")


def test_a_chosen_marker_shows_its_gap_its_rays_and_its_row(opened: BrowserPage) -> None:
    opened.js(f"moscaPlayer.show(40); document.querySelector('[data-marker=\"{CHOSEN}\"]').click()")
    opened.until(f"moscaPlayer.now.marker === {CHOSEN}")
    plot = opened.js(
        "(p => ({gaps: p.data.filter(t => t.name === 'x')[0].y.map(v => v === null),"
        " joins: p.data.map(t => t.connectgaps), spans: p.layout.shapes.slice(1)"
        ".map(s => [s.x0, s.x1])}))(document.getElementById('of_marker'))"
    )
    evidence = evidence_with_a_gap()
    assert evidence.errors is not None
    there = evidence.errors.frame[evidence.errors.marker == CHOSEN]
    assert np.flatnonzero(plot["gaps"]).tolist() == sorted(set(range(120)) - set(there.tolist()))
    assert set(GAP) <= set(np.flatnonzero(plot["gaps"]).tolist())
    assert plot["joins"] == [False] * len(plot["joins"])
    assert any(a == pytest.approx(0.495) and b == pytest.approx(0.695) for a, b in plot["spans"])
    assert opened.js("document.querySelector('tr.chosen th').textContent") == f"marker 0{CHOSEN}"

    opened.click("[data-layer=rays]")
    assert evidence.measured_by is not None
    (row,) = np.flatnonzero((evidence.tracks.frame == 40) & (evidence.tracks.track == CHOSEN))
    cameras = int(evidence.measured_by.cameras[row].sum())
    rays = opened.js("(t => [t.visible, t.x.length])(document.getElementById('space').data[8])")
    assert rays == [True, 3 * cameras]  # each from its camera to the marker, and a break
    assert f"measured by {cameras} of 6 cameras" in opened.js("document.getElementById('readout').textContent")
    opened.js("moscaPlayer.show(60)")
    assert "was not measured" in opened.js("document.getElementById('readout').textContent")
    assert opened.js("document.getElementById('space').data[8].x.length") == 0


def test_the_run_plays_to_its_end(opened: BrowserPage) -> None:
    opened.js("moscaPlayer.show(100)")
    opened.click("#play")
    opened.until("moscaPlayer.now.frame === 119 && !moscaPlayer.now.playing")
    assert opened.js("document.getElementById('play').textContent") == "Play"


def test_tables_are_sorted_by_their_headers(opened: BrowserPage) -> None:
    column = "[...document.querySelectorAll('[aria-label=Markers] tbody tr')].map(r => +r.cells[1].dataset.key)"
    before = opened.js(column)
    head = "[aria-label=Markers] thead th:nth-child(2)"
    for direction, wanted in (("ascending", sorted(before)), ("descending", sorted(before)[::-1])):
        opened.js(f"document.querySelector('{head} button').click()")
        assert opened.js(column) == wanted
        assert opened.js(f"document.querySelector('{head}').getAttribute('aria-sort')") == direction
    opened.js("document.querySelector('[aria-label=Markers] thead th:nth-child(1) button').click()")
    assert opened.js(f"document.querySelector('{head}').getAttribute('aria-sort')") is None
    assert opened.js(column) == before


def test_what_can_be_pressed_has_a_name(opened: BrowserPage) -> None:
    nameless = opened.js(
        "[...document.querySelectorAll('button, input, select, [role=button], [role=img], [role=region]')]"
        ".filter(e => !(e.getAttribute('aria-label') || e.textContent.trim() || e.closest('label')))"
        ".map(e => e.outerHTML)"
    )
    assert nameless == []


def test_nothing_is_wider_than_a_telephone(opened: BrowserPage, file: Path) -> None:
    opened.open(file, 400)
    opened.until("!!window.moscaPlayer && moscaPlayer.shownSet !== null")
    assert opened.js("document.documentElement.scrollWidth") <= 400
    wide = opened.js(
        "['space', 'of_marker', 'of_all', 'time'].map(id =>"
        " document.getElementById(id).getBoundingClientRect().right)"
    )
    assert max(wide) <= 400
    opened.js("moscaPlayer.show(60)")
    assert opened.js("document.getElementById('space').data[6].x.filter(v => v !== null).length") > 0


def test_without_scripts_tables_pictures_and_all_cameras_are_there(opened: BrowserPage, file: Path) -> None:
    opened.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        opened.open(file, 1000)
        state = opened.js(
            "({bars: [...document.querySelectorAll('[data-needs-js]')].filter(e => e.offsetHeight).length,"
            " images: [...document.querySelectorAll('.view img')].map(i => i.complete && i.naturalWidth > 0),"
            " drawings: document.querySelectorAll('.drawing svg').length,"
            " rows: document.querySelectorAll('tbody tr').length})"
        )
    finally:
        opened.call("Emulation.setScriptExecutionDisabled", value=False)
    assert state["bars"] == 0
    assert state["images"] == [True] * 3
    assert state["drawings"] >= 6
    assert state["rows"] >= 14
    assert json.loads(file.read_text("utf-8").split('id="playback-data">')[1].split("</script>")[0])["frames"] == 120
