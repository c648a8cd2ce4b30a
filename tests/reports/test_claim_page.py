"""The page of a claim over many runs: verdict, pictures, worst runs with their commands."""

import re

import pytest
from html_checker import checked

from reports.claim.page import write_claim_page
from reports.claim.words import claim_words, value_text

CLAIMED = {
    "metric": "position_rms", "unit": "m", "statistic": "rms", "limit": 5e-4, "sense": "at_most", "quantile": None,
    "failed_share": 0.0, "verdict": "conforming", "runs": 30, "failed": 1, "estimate": 4.2e-4, "low": 3.9e-4,
    "high": 4.56789e-4, "target": 5e-4, "guard_band": 3e-5, "note": "",
    "looks": [
        {"runs": 20, "estimate": 4.3e-4, "conforming": None, "broken": 7e-4},
        {"runs": 30, "estimate": 4.2e-4, "conforming": 4.7e-4, "broken": 5.4e-4},
    ],
}  # fmt: skip
SHARE = CLAIMED | {
    "metric": "completeness", "unit": "1", "statistic": "quantile", "limit": 0.99, "sense": "at_least",
    "quantile": 0.9, "verdict": "undecided", "estimate": 0.93, "low": 0.8, "high": 0.97, "target": 0.9,
    "guard_band": None,
    "looks": [{"runs": 30, "estimate": 0.93, "conforming": None, "broken": 0.7}],
}  # fmt: skip


def document(**changes):
    runs = [
        {
            "run": k,
            "seed": 1 + k,
            "set": {"errors.body_px": 0.03},
            "metrics": {} if k == 7 else {"position_rms": 4e-4 + 1e-6 * k, "completeness": 1.0},
            "failed": "few-views: <too few>" if k == 7 else "",
            "command": f"mosca run a/b --seed {1 + k} --set errors.body_px=0.03",
        }
        for k in range(30)
    ]
    return {
        "title": "Rigs <of a kind>", "verdict": "conforming", "claims": [CLAIMED], "runs": 30, "failed": 1,
        "error_rate": 0.05, "confidence": 0.95, "looks": [20, 30, 60],
        "conditions": {
            "description": "", "scenario": "a/b", "seed": 1, "set": {"capture.duration_s": 0.5},
            "vary": [{"kind": "normal", "key": "cameras.height_m", "by": "add", "mean": 0.0, "sigma": 0.03}],
        },
        "each_run": runs, "provenance": {"git": "abc"},
    } | changes  # fmt: skip


def test_words_are_in_the_unit_of_the_limit():
    words = claim_words(CLAIMED)
    assert words == ("rms of position_rms ≤ 0.5 mm", "0.42 mm", "0.39 mm … 0.457 mm", "0.03 mm")
    assert value_text(CLAIMED, None) == "–"
    words = claim_words(SHARE)
    assert words == ("completeness ≥ 99 % in 90 % of the runs", "93 %", "80 … 97 %", "none yet")


@pytest.mark.parametrize(("verdict", "text"), [("conforming", "Conforming"), ("undecided", "Undecided")])
def test_the_page_says_what_was_found(tmp_path, verdict, text):
    path = tmp_path / "claim.html"
    write_claim_page(path, document(verdict=verdict, claims=[CLAIMED, SHARE]))
    page = checked(path)
    words = " ".join(" ".join(page.text).split())
    assert text in words
    assert "30 of at most 60 runs were made, 1 of them failed" in words
    assert "normal: mean 0.0, sigma 0.03, added to the scenario's" in words
    # those that failed come first, then the worst by the first claim
    rows = re.findall(r"mosca run a/b --seed (\d+)", words)
    assert [int(row) for row in rows] == [8, *range(30, 11, -1)]
    assert "few-views: <too few>" in words
    assert page.loads == [] or all(one.startswith("#") for one in page.loads)
    assert len(page.ids) == len(set(page.ids))
    assert words.count("Found at each look") == 2
    before = path.read_bytes()
    write_claim_page(path, document(verdict=verdict, claims=[CLAIMED, SHARE]))
    assert path.read_bytes() == before


def test_runs_that_all_failed_have_a_page(tmp_path):
    nothing = CLAIMED | {"estimate": None, "low": None, "high": None, "guard_band": None, "looks": [
        {"runs": 20, "estimate": None, "conforming": None, "broken": None}]}  # fmt: skip
    runs = [one | {"metrics": {}, "failed": "planted"} for one in document()["each_run"]]
    write_claim_page(tmp_path / "claim.html", document(claims=[nothing], each_run=runs, verdict="not conforming"))
    assert "Not conforming" in " ".join(checked(tmp_path / "claim.html").text)
