"""The study of claims on rigs through images: kinds of rigs that run, and verdicts counted as false."""

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenarios.spec.claim import ClaimFile
from scenarios.studies.campaign.tasks import run_tasks
from scenarios.studies.campaign.worker import RunOutcome
from tests.studies.claims_images import Judged, claim_document, judged, rig_kind, summary, truth_of

ONE = Judged(4, 1.1e-3, 1.0e-3, 1.2e-3, 1.0e-3, "conforming", (0.9e-3, 0.85e-3, 0.95e-3), 89)


class AtOnce:
    """An engine that makes each run when it is asked for."""

    slots, chunk_s, lost = 1, 0.0, False

    def submit(self, work, tasks, contents):
        done = Future()
        done.set_result([work(task, contents) for task in tasks])
        return done


def alternating(task, contents):
    """Errors of 3 and 4 mm in turn: their mean square is 12.5 mm^2."""
    return RunOutcome(task.number, {"position_rms": 3e-3 + 1e-3 * (task.number % 2)})


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_each_kind_of_rig_is_a_valid_claim():
    rng = np.random.default_rng(3)
    kinds = [rig_kind(rng) for _ in range(20)]
    for kind in kinds:
        claim = ClaimFile.model_validate(claim_document(kind, 1e-3, 1, 3))
        assert len(run_tasks(claim, Path("x.toml"))) == 3
    assert len({str(kind) for kind in kinds}) == 20


def test_the_truth_is_the_rms_of_all_runs_with_its_interval():
    kind = rig_kind(np.random.default_rng(3))
    middle, low, high = truth_of(kind, 100, AtOnce(), alternating)
    assert middle == pytest.approx(12.5e-6**0.5)
    # squares of 9 and 16 mm^2: standard deviation 3.5 mm^2 (with n - 1: 3.518), of the mean of 100 a tenth
    assert [low, high] == pytest.approx([(12.5e-6 - 0.6895e-6) ** 0.5, (12.5e-6 + 0.6895e-6) ** 0.5], rel=1e-4)


@pytest.mark.parametrize(("ratio", "verdict"), [(0.6, "conforming"), (1.4, "not conforming"), (1.0, "undecided")])
def test_a_limit_beside_the_truth_is_judged_as_it_is(tmp_path, ratio, verdict):
    kind = rig_kind(np.random.default_rng(3))
    found = judged(kind, ratio, 1, 100, AtOnce(), tmp_path / "rig.toml", alternating)
    assert found.limit == pytest.approx(found.truth / ratio)
    assert found.verdict == verdict
    assert not found.false_accept
    assert not found.false_reject
    assert found.intervals_meet
    assert (tmp_path / "rig.toml").is_file()


def test_false_verdicts_are_counted():
    assert ONE.false_accept
    assert not ONE.intervals_meet
    other = replace(ONE, truth=0.9e-3, low=0.8e-3, verdict="not conforming")
    assert other.false_reject
    assert other.intervals_meet
    third = replace(ONE, verdict="undecided")
    assert summary([ONE, other, third]) == (
        "false accept: 1 of 3, false reject: 1 of 3, undecided: 1 of 3, intervals of campaign and truth meet: 1 of 3"
    )
    assert ONE.row(7).startswith("| 7 | 4 | 1.1000 (1.0000 .. 1.2000) | 1.100 | conforming | 0.9000 (0.8500 .. 0.95")
