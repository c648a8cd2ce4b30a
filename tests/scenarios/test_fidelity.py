"""``mosca twin fidelity``: its quick table holds, sabotage breaks it, its page opens, the documentation fits."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from reports.fidelity import Check, Row, all_met, small, verdict
from reports.fidelity_page import png
from scenarios.cli.main import cli
from scenarios.fidelity import checks, peers, sensor, shutter
from scenarios.fidelity import static_markers as still
from scenarios.fidelity import twin_adapter as door
from scenarios.fidelity.pictures import CROPS, all_crops
from scenarios.spec.catalog import find

DOCS = Path(__file__).resolve().parents[2] / "docs"
MOST_BYTES = 30_000


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The command run once, quick, with a folder."""
    out = tmp_path_factory.mktemp("fidelity") / "deep" / "er"
    done = CliRunner().invoke(cli, ["twin", "fidelity", "--quick", "--out", str(out)])
    return done, out


@pytest.fixture(scope="module")
def crops():
    return all_crops()


def test_the_quick_table_meets_its_bars(made):
    done, out = made
    assert done.exit_code == 0, done.output
    found = json.loads((out / "fidelity.json").read_text())
    assert found["met"] is True
    rows = [row for check in found["checks"] for row in check["rows"]]
    assert all(row["met"] for row in rows)
    assert sum(row["control"] for row in rows) >= 20
    assert {check["title"] for check in found["checks"] if check["absent"]} == {
        "Beside mujoco.Renderer",
        "Beside pyrender",
    }
    # every check that ran has a planted fault of its own, and states its reference's error
    for check in found["checks"]:
        assert check["absent"] or (any(row["control"] for row in check["rows"]) and check["own_error"])
    assert "planted faults caught" in done.output
    assert "BROKEN" not in done.output
    assert found["provenance"]["versions"]["mujoco"]


def half_a_pixel(light):
    """The image half a pixel to the right."""
    return (light + np.roll(light, 1, axis=1)) / 2


def upside_down(light):
    return light[::-1].copy()


@pytest.mark.parametrize("spoil", [half_a_pixel, upside_down])
def test_a_spoiled_kernel_breaks_the_table(monkeypatch, spoil):
    true = door.render_targets

    def spoiled(light, *rest, **more):
        seen = true(light, *rest, **more)
        light[:] = spoil(light)
        return seen

    monkeypatch.setattr(door, "render_targets", spoiled)
    monkeypatch.setattr(checks, "CHECKS", (still.still_markers,))
    done = CliRunner().invoke(cli, ["twin", "fidelity", "--quick"])
    assert done.exit_code == 1, done.output
    assert "BROKEN" in done.output


def test_a_wrong_exposure_centre_breaks_the_table(monkeypatch):
    # the targets are where they will be 20 us later: as if the shutter opened too late
    true = shutter.seen_by_twin

    def late(lens, size, targets, **more):
        ahead = [replace(one, centre_at=lambda t, one=one: one.centre_at(t + 2e-5)) for one in targets]
        return true(lens, size, ahead, **more)

    monkeypatch.setattr(shutter, "seen_by_twin", late)
    monkeypatch.setattr(checks, "CHECKS", (shutter.motion,))
    assert CliRunner().invoke(cli, ["twin", "fidelity", "--quick"]).exit_code == 1


def test_a_noisier_sensor_breaks_the_table(monkeypatch):
    true = sensor.expose

    def noisier(light, told, key, ambient):
        counts = true(light, told, key, ambient).astype(float)
        more = 0.5 * told.read_noise_e * told.gain_dn_per_e * np.random.default_rng(key).normal(size=light.shape)
        return np.clip(np.rint(counts + more), 0, told.top)

    monkeypatch.setattr(sensor, "expose", noisier)
    found = sensor.sensors(True)
    assert {row.name for row in found.rows if not row.met} >= {
        "8 bit: dark noise off by",
        "12 bit: dark noise off by",
    }


def test_an_unnoticed_fault_counts_as_broken():
    blind = Check("x", "a", "b", "c", (Row("fault: y", 0.5, "px", 1.0, control=True),))
    assert not all_met([blind])
    assert verdict([blind]) == "0 of 0 bars met, 0 of 1 planted faults caught."
    assert not Row("x", float("nan"), "px", 1.0).met
    assert not Row("x", float("nan"), "px", 1.0, control=True).met
    assert all_met([Check("x", "a", "b", "", (), absent="no such thing here")])


def test_machines_without_gl_are_told_why(monkeypatch):
    monkeypatch.setattr(peers, "platform", lambda: None)
    found = peers.mujoco_renderer(False)
    assert found.absent == peers.NO_GL
    assert found.met
    monkeypatch.setattr(peers, "platform", lambda: "nothing_like_it")
    found = peers.pyrender_renderer(False)
    assert found.absent.startswith("pyrender does not run here: ")


class Page(HTMLParser):
    """Tags that close, pictures, and what a page would load."""

    def __init__(self):
        super().__init__()
        self.open, self.pictures, self.loads = [], [], []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "img":
            self.pictures.append(given["src"])
        self.loads += [v for k, v in attrs if k in ("src", "href") and not v.startswith("data:")]
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_opens_offline_with_its_pictures(made):
    _done, out = made
    text = (out / "fidelity.html").read_text()
    page = Page()
    page.feed(text)
    assert page.open == []
    assert page.loads == []
    assert len(page.pictures) == len(CROPS)
    for source in page.pictures:
        assert base64.b64decode(source.removeprefix("data:image/png;base64,")).startswith(b"\x89PNG")
    assert "All bars met" in text
    assert "What hides a marker" in text
    assert sorted(p.name for p in out.iterdir()) == ["fidelity.html", "fidelity.json"]


def test_a_file_in_the_way_is_told_before_the_work(tmp_path):
    (tmp_path / "there").write_text("x")
    done = CliRunner().invoke(cli, ["twin", "fidelity", "--out", str(tmp_path / "there")])
    assert "is a file; choose another place" in str(done.exception)


def test_pictures_are_small_the_same_each_time_and_lead_to_scenarios(crops):
    assert len({crop.name for crop in crops}) == len(crops) >= 20
    for crop in crops:
        assert len(png(crop)) < MOST_BYTES, crop.name
        assert find(crop.scenario).is_file()
        panels = len(crop.labels)
        width = (crop.image.shape[1] + 8) // panels - 8
        halves = [crop.image[:, k * (width + 8) : k * (width + 8) + width] for k in range(panels)]
        assert not any(np.array_equal(halves[0], other) for other in halves[1:]), crop.name
        assert all(half.max() > 60 for half in halves), crop.name
    again = [make() for make in CROPS[::5]]
    for crop, other in zip(crops[::5], again, strict=True):
        np.testing.assert_array_equal(crop.image, other.image)


def test_the_documentation_shows_each_picture_with_its_words(crops):
    text = (DOCS / "fidelity.md").read_text()
    for crop in crops:
        assert crop.caption in text, f"{crop.name}: make docs/fidelity.md anew (python -m scenarios.fidelity.command)"
        file = DOCS / "pictures" / "fidelity" / f"{crop.name}.png"
        assert file.stat().st_size < MOST_BYTES
    for link in re.findall(r"\]\(([^)]+)\)", text):
        assert (DOCS / link).is_file(), link
    for check in checks.CHECKS:
        assert check.__doc__


def test_figures_read_well():
    assert [small(x) for x in (0.0, 1.234e-7, 0.00123, 0.71, 27.4)] == ["0", "1.2e-7", "0.0012", "0.71", "27"]
