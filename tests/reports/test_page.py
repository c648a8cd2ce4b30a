"""The page: complete, self-contained, deterministic, with all names escaped."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from html_checker import checked
from reports_examples import example_evidence, example_record, example_view, without_truth

import reports
from mosca.data.detections import Detections
from mosca.data.tracks import Tracks
from reports.comparison.page import write_comparison_page
from reports.evidence import CameraView, ErrorTable, Evidence, MarkerCounts, true_positions
from reports.page import write_page
from reports.playback.player import SCRIPTS
from reports.plots import pictures
from reports.record import Metric

LIBRARY_BYTES = (Path(reports.__file__).parent / SCRIPTS["library"]).stat().st_size


def without_scripts(text: str) -> str:
    """Return a page's text without the player's library, whose comments name addresses."""
    return re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_page(path, example_record(), example_evidence())
    return path


def test_each_metric_stands_beside_its_limit(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    rows = [re.sub(r"<[^>]+>", " ", row) for row in re.findall(r"<tr.*?</tr>", text, flags=re.DOTALL)]
    for name, parts in {
        "position_rms": ("0.245", "mm", "0.23 … 0.26", "≤ 0.3", "✓", "960", "none"),
        "relative_accuracy": ("0.0122", "%", "0.0115 … 0.013", "≤ 0.01", "✗"),
        "completeness": ("99.17", "%", "98.5 … 99.6", "≥ 98", "✓"),
        "ghosts_per_frame": ("0.025", "≤ 0.1", "✓"),
        "reprojection_rms": ("0.031", "px"),
        "frame_rate": ("412", "1/s"),
        "views_per_marker": ("4.2", "≥ 2", "✓"),
        "blur_px": ("0.8", "≤ 2"),
    }.items():
        (row,) = [r for r in rows if name in r.split()]
        for part in parts:
            assert part in row, (name, part)


@pytest.mark.parametrize(
    ("value", "mark"), [(1.22e-4, "✓ broken, in [0.011, 0.013]"), (2e-4, "✗ outside [0.011, 0.013]")]
)
def test_a_control_shows_where_its_metric_had_to_land(value: float, mark: str, tmp_path: Path) -> None:
    broken = Metric("relative_accuracy", value, "1", 960, limit=1e-4, passed=False, within=(1.1e-4, 1.3e-4))
    write_page(tmp_path / "p.html", example_record(metrics=(broken,), expect="fail"), example_evidence())
    assert mark in (tmp_path / "p.html").read_text(encoding="utf-8")


def test_the_head_says_both_ends_of_a_limit(tmp_path: Path) -> None:
    both = Metric("nees", 2.9, "1", 960, limit=6.0, passed=True, within=(1.5, 6.0))
    write_page(tmp_path / "p.html", example_record(metrics=(both,)), example_evidence())
    assert "Claimed: nees 1.5 to 6" in " ".join("".join(checked(tmp_path / "p.html").text).split())


def test_the_head_says_what_was_claimed_and_found(page: Path) -> None:
    text = " ".join("".join(checked(page).text).split())
    assert "Claimed: position rms ≤ 0.3 mm" in text
    assert (
        "positions are right to 0.245 mm rms, 0.0122 % of the working space, 99.17 % of the visible markers" in text
    )
    assert "Claim holds" in text
    assert "Every limit met." in text


def test_nothing_is_loaded_from_outside(page: Path) -> None:
    text = without_scripts(page.read_text(encoding="utf-8"))
    assert not re.search(r"https?:|url\(\s*['\"]?(?!#)|@import|<link|<iframe", text)
    loads = checked(page).loads
    assert loads
    assert all(load.startswith(("#", "data:image/png;base64,", "data:image/webp;base64,")) for load in loads)


def test_the_browser_is_told_to_load_nothing(page: Path) -> None:
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)"', page.read_text("utf-8"))
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules.pop("default-src") == "'none'"
    assert not [rule for rule in rules.values() if "*" in rule or "http" in rule or "'self'" in rule]


def test_ids_are_unique_and_references_meet_one(page: Path) -> None:
    checker = checked(page)
    assert len(set(checker.ids)) == len(checker.ids)
    references = set(re.findall(r'(?:href="#|url\(#)([^")]+)', without_scripts(page.read_text(encoding="utf-8"))))
    assert references <= set(checker.ids)


def test_pictures_are_read_aloud_and_follow_the_page_colours(page: Path) -> None:
    text = without_scripts(page.read_text(encoding="utf-8"))
    drawings = re.findall(r"<svg[^>]*>", text)
    assert len(drawings) == 7
    assert all('role="img"' in d and re.search(r'aria-label="[^"]{20,}"', d) for d in drawings)
    assert text.count("<figcaption>") == 7
    assert "prefers-color-scheme:dark" in text
    assert "@media print" in text
    assert "var(--blue)" in text


def test_same_input_same_bytes_and_matplotlib_left_as_it_was(page: Path, tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    write_page(tmp_path / "again.html", example_record(), example_evidence())
    assert (tmp_path / "again.html").read_bytes() == page.read_bytes()
    assert dict(matplotlib.rcParams) == before
    assert [p.name for p in tmp_path.iterdir()] == ["again.html"]


def test_names_are_escaped_wherever_they_stand(tmp_path: Path) -> None:
    odd = '<mark>"$x_1$" & \'膝\' id="1"</mark>'
    evidence = example_evidence(markers=3)
    rig = replace(evidence.rig, cameras=(replace(evidence.rig.cameras[0], name=odd), *evidence.rig.cameras[1:]))
    view = replace(evidence.views[0], camera=odd)
    evidence = replace(evidence, rig=rig, views=(view,), truth_names=(odd, "b", "c"))
    record = example_record(
        title=odd, scenario=odd, verdict=odd, source=odd, metrics=(Metric(odd, 1.0, odd, 1, aligned_by=odd),),
        premises={odd: {"value": odd, "holds": False}}, counts={odd: odd}, timings={odd: 1.0}, provenance={odd: odd},
    )  # fmt: skip
    write_page(tmp_path / "page.html", record, evidence)
    checker = checked(tmp_path / "page.html")
    assert "mark" not in checker.tags
    assert checker.tags.count("script") == 4  # the player's data, its library, its own part, sorting
    assert "".join(checker.text).count(odd) >= 8
    for picture in pictures(record, evidence):
        ElementTree.fromstring(picture.svg)


def test_a_recording_without_truth_shows_what_there_is(tmp_path: Path) -> None:
    evidence = without_truth(example_evidence())
    write_page(tmp_path / "page.html", example_record(metrics=()), evidence)
    text = " ".join(checked(tmp_path / "page.html").text)
    assert "Reprojection residuals" in text
    assert "Points over time" in text
    assert "against the truth" not in text
    assert "Nothing claimed" in text


def nothing_found() -> Evidence:
    full = example_evidence()
    counts = MarkerCounts(full.counts.time_s, full.counts.n_true_seen, np.zeros(120), np.zeros(120))  # type: ignore[union-attr]
    empty = ErrorTable(np.empty(0), np.empty(0), np.empty(0), np.empty((0, 3)))
    return replace(full, tracks=Tracks.none(), errors=empty, counts=counts, views=())


def one_sample() -> Evidence:
    full = example_evidence(frames=1, markers=1, views=0)
    return replace(full, counts=None, marker_seen=None)


def dark_camera() -> Evidence:
    image = np.zeros((60, 80), np.uint16)
    return replace(example_evidence(), views=(CameraView("cam0", image, Detections.none("cam0")),))


def large_camera() -> Evidence:
    view = example_view(np.random.default_rng(1))
    big = np.tile((view.image.astype(np.uint16) << 4), (5, 5))
    return replace(example_evidence(), views=(CameraView("cam0", big, view.detections),))


@pytest.mark.parametrize(
    "evidence",
    [
        nothing_found(),
        one_sample(),
        dark_camera(),
        large_camera(),
        example_evidence(frames=30, markers=90),
        without_truth(nothing_found()),
    ],
    ids=["nothing found", "one sample", "dark", "large image", "many markers", "empty recording"],
)
def test_thin_and_large_evidence_still_gives_a_page(evidence: Evidence, tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", example_record(), evidence)
    checked(tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size < 1.6e6 + LIBRARY_BYTES


def test_pictures_state_the_figures_they_show() -> None:
    error = np.zeros((4, 3))
    error[:, 0] = (1e-3, 1e-3, 1e-3, 5e-3)  # rms sqrt((3 + 25) / 4) = 2.646 mm
    base = example_evidence(frames=4, markers=1, views=0)
    errors = ErrorTable(np.arange(4), np.arange(4) / 100, np.zeros(4), error)
    evidence = replace(base, errors=errors, marker_seen=np.array([5]))
    made = {p.name: p for p in pictures(example_record(), evidence)}
    assert "rms 2.65 mm" in made["histogram"].alt
    assert "largest is 5 mm" in made["histogram"].caption
    assert "between 1 and 5 mm" in made["over_time"].alt
    assert "2 mm over all" in made["volume"].caption
    assert "with 80 %" in made["completeness"].caption  # 4 of 5


def test_errors_find_their_true_position() -> None:
    evidence = example_evidence(frames=20, markers=3)
    errors = evidence.errors
    assert errors is not None
    assert evidence.truth_xyz is not None
    np.testing.assert_array_equal(true_positions(evidence), evidence.truth_xyz[errors.frame, errors.marker])


def test_evidence_that_cannot_be_is_refused() -> None:
    evidence = example_evidence()
    with pytest.raises(ValueError, match="without the truth"):
        replace(evidence, truth_time_ns=None, truth_xyz=None, truth_names=(), marker_seen=None)
    with pytest.raises(ValueError, match="belong together"):
        replace(evidence, truth_time_ns=None)
    with pytest.raises(ValueError, match="errors of marker 99"):
        replace(evidence, errors=ErrorTable(np.array([0]), np.array([0.0]), np.array([99]), np.zeros((1, 3))))


@pytest.mark.parametrize(
    ("passed", "expect", "text"),
    [
        (True, "pass", "Claim holds"),
        (False, "pass", "Claim broken"),
        (True, "fail", "Fails as it must"),
        (False, "fail", "Control broken"),
        (False, "caught", "Not caught"),
    ],
)
def test_the_badge_says_the_verdict(passed: bool, expect: str, text: str, tmp_path: Path) -> None:
    write_comparison_page(tmp_path / "c.html", [example_record(passed=passed, expect=expect)])
    assert text in "".join(checked(tmp_path / "c.html").text)


def test_runs_side_by_side_show_metrics_changes_and_regressions(tmp_path: Path) -> None:
    settings = {"parameters": {"seed": 7}}
    first = example_record(provenance=settings)
    worse = tuple(replace(m, value=1.05 * m.value, ci95=None, blocks=None) for m in first.metrics[4:5])
    runs = [first, example_record(metrics=worse, provenance=settings), example_record(scenario="<other>")]
    write_comparison_page(tmp_path / "c.html", runs, ["main", "branch", "<third>"])
    text = (tmp_path / "c.html").read_text(encoding="utf-8")
    visible = " ".join("".join(checked(tmp_path / "c.html").text).split())
    assert "1 figure worse, none better, against" in visible
    assert "↑ worse" in visible
    assert "+5.0 %" in visible
    for part in ("main", "branch", "<third>", "<other>", "limit ≤ 0.3 mm", "0.245 mm", "position_rms"):
        assert part in visible
    assert not re.search(r"https?:", text)


def test_what_could_not_be_judged_is_named_and_does_not_look_like_a_pass(tmp_path: Path) -> None:
    met = example_record().metrics
    record = example_record(passed=False, not_judged=("hota", "completeness"))
    record = replace(
        record, metrics=tuple(m for m in met if m.passed is not False and m.name not in record.not_judged)
    )
    write_page(tmp_path / "page.html", record, without_truth(example_evidence()))
    text = checked(tmp_path / "page.html").text
    assert "hota" in text
    assert text.count("not judged") == 2
    assert any("Not judged" in part for part in text)
    assert not any("Claim holds" in part for part in text)
    # what was judged and broke counts more
    broken = replace(record, metrics=(replace(met[0], passed=False),))
    write_page(tmp_path / "broken.html", broken, without_truth(example_evidence()))
    assert any("Claim broken" in part for part in checked(tmp_path / "broken.html").text)
