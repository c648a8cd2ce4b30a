"""mosca accept and mosca certificate through the command line, on tracks of known artefacts."""

import hashlib
import json
import re
import sys

import numpy as np
import pytest
from acceptance_folders import write_take
from command_line import mosca, refusal

from reports.acceptance.page import write_acceptance_page
from reports.acceptance.words import figure_rows
from scenarios.studies.acceptance.document import inputs, sha256_of
from scenarios.studies.acceptance.record import InputFile, read_acceptance_result
from scenarios.studies.certificate.document import input_states
from scenarios.studies.certificate.results import read_result

BUDGET = {
    "kind": "mosca error budget", "scenario": "a/b", "metric": "position_rms", "unit": "mm^2", "by": "source",
    "content": "c", "commit": "abc", "seeds": [1, 2], "duration_s": 1.0, "blocks": 4, "total": 0.04,
    "total_ci95": [0.03, 0.05],
    "remainder": 0.01, "remainder_ci95": [0.0, 0.02],
    "contributions": [
        {"name": "mount", "told": "shaking", "square": 0.03, "ci95": [0.02, 0.04], "alone": None, "last": None}
    ],
    "predicted": [], "method": "exact", "runs": 8, "seconds": 1.0,
}  # fmt: skip
CLAIM = {
    "title": "rigs of a kind", "verdict": "conforming", "runs": 30, "failed": 1, "confidence": 0.95,
    "looks": [20, 30],
    "claims": [
        {
            "metric": "position_rms", "unit": "m", "statistic": "rms", "limit": 5e-4, "sense": "at_most",
            "quantile": None, "verdict": "conforming", "runs": 30, "estimate": 4.2e-4, "low": 3.9e-4, "high": 4.5e-4,
            "guard_band": 3e-5,
        }
    ],
    "conditions": {
        "scenario": "a/b", "set": {"seed": 3}, "vary": [{"key": "errors.body_px", "kind": "normal", "mean": 0}],
    },
    "provenance": {"git": "abc", "versions": {"numpy": "2"}},
}  # fmt: skip


@pytest.fixture
def accepted(tmp_path):
    """A function that writes a take and accepts it into a folder."""

    def make(name, scale=1.00002, code=0, **rest):
        tracks, artefact = write_take(tmp_path / name, "take", scale, **rest)
        done = mosca("accept", tracks, "--artefact", artefact, "--out", tmp_path / f"{name}_out", cwd=tmp_path)
        assert done.returncode == code, done.stderr
        return tmp_path / f"{name}_out", done

    return make


@pytest.mark.parametrize(
    ("scale", "code", "verdict"),
    [(1.00002, 0, "conforming"), (1.0005, 1, "not conforming"), (1.00017, 3, "undecided")],
)
def test_a_take_is_accepted_by_its_artefact(accepted, scale, code, verdict):
    out, done = accepted("a", scale, code)
    assert f"take.npz: {verdict}" in done.stdout
    document = json.loads((out / "acceptance.json").read_text())
    assert document["verdict"] == verdict
    errors = [one["error_m"] for one in document["lengths"]["errors"]]
    assert errors == pytest.approx(
        [(scale - 1) * one["calibrated_m"] for one in document["lengths"]["errors"]], abs=1e-9
    )
    assert {one["file"] for one in document["inputs"]} == {"../a/take.npz", "../a/bar.acceptance"}
    page = (out / "acceptance.html").read_text()
    assert "in the manner of VDI/VDE 2634 part 1" in page
    assert "were not at hand" in page
    assert not re.search(r"\bper (VDI|ASTM)", page)


@pytest.mark.parametrize("suffix", [".c3d", ".csv", ".trc"])
def test_other_formats_of_tracks_give_the_same_errors(accepted, tmp_path, suffix):
    out, _ = accepted("npz")
    tracks, artefact = write_take(tmp_path / "other", "take", suffix=suffix)
    mosca("accept", tracks, "--artefact", artefact, "--out", tmp_path / "o", cwd=tmp_path)
    one, two = (json.loads((folder / "acceptance.json").read_text()) for folder in (out, tmp_path / "o"))
    # C3D and TRC hold mm in single precision and few decimals
    assert [e["error_m"] for e in two["lengths"]["errors"]] == pytest.approx(
        [e["error_m"] for e in one["lengths"]["errors"]], abs=2e-6
    )
    told = any(note.startswith("covariances: not told") for note in two["notes"])
    assert told == (suffix != ".csv")


def test_a_run_folder_with_arrivals_has_a_latency(accepted, tmp_path):
    tracks, artefact = write_take(tmp_path / "run", "tracks")
    rows = [f"{k},{k * 10_000_000 + 7_000_000}" for k in range(140)]
    (tmp_path / "run" / "arrivals.csv").write_text("\n".join(["frame,available_ns", *rows]) + "\n")
    done = mosca("accept", tmp_path / "run", "--artefact", artefact, "--out", tmp_path / "o", cwd=tmp_path)
    assert done.returncode == 0
    document = json.loads((tmp_path / "o" / "acceptance.json").read_text())
    assert document["latency"]["p99_s"] == pytest.approx(0.007)
    assert "latency, 99th percentile" in done.stdout
    assert tracks.name == "tracks.npz"


def test_the_same_take_gives_the_same_bytes_and_is_read_back(accepted, tmp_path):
    out, _ = accepted("a")
    before = [(out / name).read_bytes() for name in ("acceptance.json", "acceptance.html")]
    accepted("a")
    assert [(out / name).read_bytes() for name in ("acceptance.json", "acceptance.html")] == before
    read = read_acceptance_result(out / "acceptance.json").model_dump()
    assert figure_rows(read) == figure_rows(json.loads(before[0]))
    document = json.loads(before[0]) | {"title": "<b> & co"}
    write_acceptance_page(tmp_path / "x.html", document)
    assert "&lt;b&gt; &amp; co" in (tmp_path / "x.html").read_text()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("accept take/take.npz", "give the acceptance file: --artefact BAR.acceptance"),
        ("accept take/take.npz --artefact none.acceptance", "none.acceptance: no such file"),
        ("accept take/take.npz --artefact take/bar.acceptance --seed 3", "--seed 3: take/take.npz: is no scenario"),
        ("accept take/take.npz --artefact take/bar.acceptance --rig r.toml", "holds tracks already; leave it out"),
        ("accept take/take.npz --artefact take/bar.acceptance --out take", "take: holds other files"),
        ("accept take --artefact take/bar.acceptance", "take: holds no tracks and no rig.toml; give the rig"),
        ("accept nothing", "nothing: no such scenario or file"),
        ("accept actor", "no [acceptance] in it; add one with the acceptance file"),
        (
            "accept acceptance/ball_bar --artefact take/bar.acceptance",
            "names its own artefact and cameras; leave it out",
        ),
        ("accept take/take.npz --artefact take/bar.acceptance --arrivals no.csv", "no.csv"),
        ("certificate", "no result given; give the folders of acceptance tests, claims, budgets or runs"),
        ("certificate take", "take: holds none of acceptance.json, result.json, budget.json, record.json"),
        ("certificate take/bar.acceptance", "take/bar.acceptance: is no JSON"),
        ("certificate none", "none: no such file"),
        ("certificate list.json", "list.json: holds no result"),
        ("certificate empty.json", "empty.json: is no result of mosca accept, claim, budget or run"),
        ("certificate acceptance.json", "acceptance.json: key 'title' is missing"),
        ("certificate --check empty.json", "empty.json: key 'kind' is missing"),
        ("certificate take --check empty.json", "--check empty.json: checks a certificate that there is"),
        ("certificate take --issued tomorrow", "--issued tomorrow: a day as YYYY-MM-DD is wanted"),
        ("run take/bar.acceptance", "bar.acceptance"),
    ],
)
def test_wrong_inputs_are_told_in_one_line(tmp_path, words, told):
    write_take(tmp_path / "take")
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "empty.json").write_text("{}")
    (tmp_path / "acceptance.json").write_text('{"kind": "acceptance"}')
    assert told in refusal(*words.split(), cwd=tmp_path)


def test_an_acceptance_file_in_a_scenarios_place_is_told(tmp_path):
    _, artefact = write_take(tmp_path / "take")
    (tmp_path / "bar.toml").write_text(artefact.read_text())
    assert "bar.toml: is an acceptance file, not a scenario" in refusal("run", "bar.toml", cwd=tmp_path)


def write_results(folder):
    (folder / "claim").mkdir()
    (folder / "claim" / "result.json").write_text(json.dumps(CLAIM))
    (folder / "budget").mkdir()
    (folder / "budget" / "budget.json").write_text(json.dumps(BUDGET))


def test_a_certificate_holds_all_evidence(accepted, tmp_path):
    out, _ = accepted("a")
    write_results(tmp_path)
    given = (
        "certificate",
        out,
        "claim",
        "budget",
        "--out",
        "cert",
        "--customer",
        "A <lab>",
        "--issued",
        "2026-11-28",
    )
    done = mosca(*given, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "cert" / "certificate.json").read_text())
    assert document["verdict"] == "conforming"
    assert [one["kind"] for one in document["results"]] == ["acceptance", "claim", "budget"]
    page = (tmp_path / "cert" / "certificate.html").read_text()
    for text in (
        "For A &lt;lab&gt;. Issued on 2026-11-28", "position_rms ≤ 0.5 mm", "0.39 mm … 0.45 mm", "shaking", "75.0 %",
        "Not covered", "probing error of a sphere", "commit abc; numpy 2", document["digest"],
        *(one["sha256"] for one in document["results"]),
    ):  # fmt: skip
        assert text in page
    before = page
    mosca(*given, cwd=tmp_path)
    assert (tmp_path / "cert" / "certificate.html").read_text() == before


def test_one_result_that_does_not_conform_decides(accepted, tmp_path):
    good, _ = accepted("a")
    bad, _ = accepted("b", 1.001, 1)
    unsure, _ = accepted("c", 1.00017, 3)
    codes = [
        mosca("certificate", *given, "--out", "cert", cwd=tmp_path).returncode
        for given in ((good, unsure), (good, bad))
    ]
    assert codes == [3, 1]


def test_two_rigs_stand_side_by_side_and_one_has_a_history(accepted, tmp_path):
    one, _ = accepted("rig_a")
    two, _ = accepted("rig_b", 1.00003)
    old = tmp_path / "old"
    old.mkdir()
    before = json.loads((one / "acceptance.json").read_text())
    before["provenance"]["git"], before["verdict"] = "an older commit", "not conforming"
    (old / "acceptance.json").write_text(json.dumps(before))
    done = mosca("certificate", old, one, two, "--out", "cert", cwd=tmp_path)
    # what an older commit gave is history: the newest counts
    assert done.returncode == 0
    document = json.loads((tmp_path / "cert" / "certificate.json").read_text())
    (table,) = document["beside"]
    assert len(table["names"]) == 2
    by_name = {row["what"]: row["cells"] for row in table["rows"]}
    cells = by_name["line 0: b0 to b5, 1 200 mm"]
    assert [cell.split()[0] for cell in cells] == ["0.024", "0.036"]
    (history,) = document["history"]
    assert [row["verdict"] for row in history["rows"]] == ["not conforming", "conforming"]
    assert history["rows"][0]["commit"] == "an older commit"
    assert "36" in history["rows"][1]["worst"] or "0.024 mm" in history["rows"][1]["worst"]


def test_files_that_changed_are_found(accepted, tmp_path):
    out, _ = accepted("a")
    assert mosca("certificate", out, "--out", "cert", cwd=tmp_path).returncode == 0
    done = mosca("certificate", "--check", "cert", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "4 files are as they were\n")
    # what the result rests on
    tracks = tmp_path / "a" / "take.npz"
    sound = tracks.read_bytes()
    tracks.write_bytes(sound + b" ")
    done = mosca("certificate", "--check", "cert", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "changed: ../a/take.npz\n")
    again = mosca("certificate", out, "--out", "cert2", cwd=tmp_path)
    assert again.returncode == 3
    assert "Changed since their hash was taken: ../a/take.npz" in again.stdout
    tracks.write_bytes(sound)
    # the result, and the certificate itself
    result = out / "acceptance.json"
    result.write_text(result.read_text().replace('"conforming"', '"undecided"', 1))
    assert "changed: ../a_out/acceptance.json" in mosca("certificate", "--check", "cert", cwd=tmp_path).stdout
    own = tmp_path / "cert" / "certificate.json"
    own.write_text(own.read_text().replace("performance", "Performance", 1))
    assert "changed: cert/certificate.json" in mosca("certificate", "--check", "cert", cwd=tmp_path).stdout
    tracks.unlink()
    done = mosca("certificate", "--check", "cert2", cwd=tmp_path)
    assert done.returncode == 1
    assert "not found: ../a/take.npz" in done.stdout


def test_the_hash_of_a_folder_is_that_of_its_files_hashes(tmp_path):
    (tmp_path / "a").mkdir()
    for name, content in (("b.png", b"two"), ("a/0.png", b"one")):
        (tmp_path / name).write_bytes(content)
    lines = "".join(f"{hashlib.sha256(c).hexdigest()}  {n}\n" for n, c in (("a/0.png", b"one"), ("b.png", b"two")))
    assert sha256_of(tmp_path) == hashlib.sha256(lines.encode()).hexdigest()
    (given,) = inputs((("recording", tmp_path),), tmp_path.parent)
    listed = (InputFile(**given),)
    assert [one.state for one in input_states(listed, tmp_path.parent)] == ["same"]
    (tmp_path / "a" / "0.png").write_bytes(b"One")
    assert [one.state for one in input_states(listed, tmp_path.parent)] == ["changed"]


def test_a_certificate_as_pdf(accepted, tmp_path):
    pytest.importorskip("fpdf", reason="fpdf2 is not installed")
    out, _ = accepted("a")
    write_results(tmp_path)
    given = ("certificate", out, "claim", "budget", "--out", "cert", "--pdf", "--issued", "2026-11-28")
    assert mosca(*given, cwd=tmp_path).returncode == 0
    made = (tmp_path / "cert" / "certificate.pdf").read_bytes()
    assert made.startswith(b"%PDF-")
    assert made.rstrip().endswith(b"%%EOF")
    pages = re.search(rb"/Count (\d+)", made)
    assert int(pages[1]) >= 2
    mosca(*given, cwd=tmp_path)
    assert (tmp_path / "cert" / "certificate.pdf").read_bytes() == made


def test_a_pdf_without_its_library_is_told_before_the_work(accepted, tmp_path, monkeypatch):
    out, _ = accepted("a")
    monkeypatch.setitem(sys.modules, "fpdf", None)
    told = refusal("certificate", out, "--out", "cert", "--pdf", cwd=tmp_path)
    assert "needs fpdf2, which is not installed; run pip install 'mosca-testbench[certificate]'" in told
    assert not (tmp_path / "cert").exists()


def test_budget_and_claim_in_words(tmp_path):
    write_results(tmp_path)
    budget, claim = read_result(tmp_path / "budget"), read_result(tmp_path / "claim")
    assert budget.verdict is None
    assert (budget.rows[0].found, budget.conditions[0]) == ("75.0 %", ("figure", "position_rms: 0.2 mm"))
    assert claim.rows[0].decision == "conforming"
    assert ("errors.body_px", "drawn: normal: mean 0") in claim.conditions
    assert np.isfinite(claim.rows[0].share)
