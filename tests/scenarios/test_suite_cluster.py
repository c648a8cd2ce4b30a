"""A suite whose scenarios are run elsewhere: the same records and files as on this computer, whatever dies."""

import json
import os
import pickle
from concurrent.futures import Future
from pathlib import Path

import pytest
from click.testing import CliRunner
from test_claim_cluster import Cluster
from tiny_scenario import write_tiny

from reports.record import read_record
from scenarios.cli.main import cli
from scenarios.spec.catalog import entries
from scenarios.studies.campaign.engine import LocalEngine
from scenarios.studies.campaign.worker import code_stamp, run_chunk
from scenarios.suite import on_cluster
from scenarios.suite.on_cluster import run_suite_on
from scenarios.suite.suite import _run_one


def three(folder: Path):
    """Return the entries of three small scenarios; the last names a model, in which its markers are not."""
    names = {"small": "", "marked": "", "lost": ""}
    for name in names:
        (folder / name).mkdir(parents=True)
        path = write_tiny(folder / name, duration_s=0.1)
        path.rename(folder / f"{name}.toml")
    model = '<mujoco><worldbody><body name="b"><site name="s" pos="0 0 1"/></body></worldbody></mujoco>'
    (folder / "own.xml").write_text(model)
    text = (folder / "lost.toml").read_text().replace('kind = "cloud"', 'kind = "own"\nmodel = "own.xml"')
    (folder / "lost.toml").write_text(
        text.replace("markers = 8", 'markers = "sites:none*"').replace("marker_diameter_m = 0.02\n", "")
    )
    return entries(tuple(folder / f"{name}.toml" for name in names), None, ("seed=5",))


def figures(outcomes):
    return {
        one.name: None if one.record is None else {m.name: m.value for m in one.record.metrics} for one in outcomes
    }


class Here:
    """An engine without processes; what travels is pickled all the same."""

    slots, chunk_s, lost = 1, 0.0, False

    def submit(self, work, tasks, contents):
        chunk = Future()
        sent = pickle.loads(pickle.dumps((tasks, dict(contents))))
        chunk.set_result(pickle.loads(pickle.dumps(run_chunk(work, *sent, code_stamp()))))
        return chunk


def test_scenarios_that_travel_give_what_they_give_here(tmp_path):
    given = three(tmp_path / "s")
    here = [_run_one(str(e.path), e.name, str(tmp_path / "here" / e.name), e.overrides) for e in given]
    told = []
    there = run_suite_on(Here(), given, tmp_path / "there", told.append)
    assert [one.name for one in there] == ["small", "marked", "lost"]
    assert sorted(one.name for one in told) == ["lost", "marked", "small"]
    assert figures(there) == figures(here)
    assert there[0].passed
    assert there[2].record is None
    assert there[2].error.split(": ", 1)[1] == here[2].error.split(": ", 1)[1] != ""
    for name in ("small", "marked"):
        assert {p.name for p in (tmp_path / "there" / name).iterdir()} == {
            p.name for p in (tmp_path / "here" / name).iterdir()
        }
        assert read_record(tmp_path / "there" / name / "record.json").seed == 5


def killed(task, contents):
    """Stands for the work: its process dies each time."""
    os._exit(1)


def crashing(*given):
    raise RuntimeError("planted")


@pytest.mark.slow
def test_a_scenario_whose_process_dies_and_a_bug_are_told(tmp_path, monkeypatch):
    given = three(tmp_path / "s")[:1]
    monkeypatch.setattr(on_cluster, "made", crashing)
    assert "RuntimeError: planted" in on_cluster._work(on_cluster._task(0, given[0]), {}).failed
    monkeypatch.setattr(on_cluster, "_work", killed)
    engine = LocalEngine(1)
    try:
        (found,) = run_suite_on(engine, given, tmp_path / "out", lambda one: None)
    finally:
        engine.close()
    assert "its process died three times" in found.error
    assert not (tmp_path / "out" / "small").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_verb_on_a_cluster(tmp_path):
    pytest.importorskip("distributed", reason="distributed is not installed (pip install 'mosca-testbench[cluster]')")
    three(tmp_path / "s")
    cluster = Cluster(tmp_path)
    try:
        cluster.start_worker()
        cluster.wait_for_workers(1)
        words = ["suite", str(tmp_path / "s"), "--out", str(tmp_path / "out"), "--tier", "full"]
        found = CliRunner().invoke(cli, [*words, "--scheduler", cluster.address])
    finally:
        cluster.close()
    assert "2 of 3 scenarios as they should be" in found.output
    assert json.loads((tmp_path / "out" / "small" / "record.json").read_text())["passed"]


def test_jobs_and_a_scheduler_exclude_each_other(tmp_path):
    found = CliRunner().invoke(cli, ["suite", "--jobs", "2", "--scheduler", "tcp://127.0.0.1:9"])
    assert "--jobs and --scheduler exclude each other" in str(found.exception)
