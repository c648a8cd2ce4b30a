"""Claims: their files, their runs, engines that lose workers, the verb and its page."""

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from claim_work import dying_work, slow_work, value_of, work
from command_line import mosca, refusal
from tiny_scenario import write_tiny

from mosca.errors import InputError
from scenarios.spec.claim import load_claim
from scenarios.spec.scenario import load_scenario
from scenarios.studies.campaign.campaign import CLAIMS, find_claim, overall, run_claim
from scenarios.studies.campaign.collect import DIED, KeptRuns
from scenarios.studies.campaign.engine import LocalEngine
from scenarios.studies.campaign.files import gathered, laid_out
from scenarios.studies.campaign.result import write_result
from scenarios.studies.campaign.statistics.questions import Judgement
from scenarios.studies.campaign.tasks import run_tasks

CLAIM = """
title = "tiny"
scenario = "tiny.toml"
runs = {runs}
seed = 3
{top}
[[vary]]
kind = "uniform"
key = "errors.body_px"
low = 0.03
high = 0.06
{more}
[[claim]]
metric = "position_rms"
limit = "{limit}"
statistic = "rms"
{claim}
"""


def write_claim(folder, runs=200, top="", more="", limit="0.1 mm", claim="failed_share = 0.1"):
    write_tiny(folder)
    path = folder / "claim.toml"
    path.write_text(CLAIM.format(runs=runs, top=top, more=more, limit=limit, claim=claim))
    return path


@pytest.fixture
def made(tmp_path):
    """A function that makes the runs of a claim with so many processes and returns result and bytes."""
    engines = []

    def make(path, jobs=1, of=work, kept="kept", **rest):
        engine = LocalEngine(jobs)
        engines.append(engine)
        result = run_claim(path, engine, work=of, kept=KeptRuns(of, tmp_path / kept), **rest)
        write_result(result.document, tmp_path / kept / "out")
        return result, (tmp_path / kept / "out" / "result.json").read_bytes()

    yield make
    for engine in engines:
        engine.close()


def test_the_built_in_claims_are_claims():
    paths = sorted(CLAIMS.glob("*.toml"))
    assert len(paths) >= 3
    for path in paths:
        tasks = run_tasks(load_claim(path), path)
        assert find_claim(path.stem) == find_claim(f"claims/{path.stem}") == path
        assert len({task.seed for task in tasks}) == len(tasks)


def test_each_run_is_drawn_by_itself(tmp_path):
    path = write_claim(tmp_path, runs=30)
    before = run_tasks(load_claim(path), path)
    more = '[[vary]]\nkind = "normal"\nkey = "cameras.height_m"\nby = "add"\nsigma = 0.01\n'
    after_path = write_claim(tmp_path, runs=40, more=more)
    after = run_tasks(load_claim(after_path), after_path)
    for one, other in zip(before, after, strict=False):
        assert one.seed == other.seed == 3 + one.number
        assert one.drawn["errors.body_px"] == other.drawn["errors.body_px"]
        assert other.document["cameras"]["height_m"] == other.drawn["cameras.height_m"]
    values = np.array([one.drawn["errors.body_px"] for one in after])
    assert values.min() >= 0.03
    assert values.max() <= 0.06
    heights = np.array([one.drawn["cameras.height_m"] for one in after])
    assert heights.mean() == pytest.approx(0.6, abs=0.01)
    assert 0.005 < heights.std() < 0.02


def test_lists_have_a_draw_for_each_number(tmp_path):
    more = (
        '[[vary]]\nkind = "normal"\nkey = "cameras.azimuth_deg"\nby = "add"\nsigma = 1.0\n'
        '[[vary]]\nkind = "whole"\nkey = "scene.markers"\nlow = 4\nhigh = 9\n'
        '[[vary]]\nkind = "choice"\nkey = "errors.bits"\nvalues = [8, 10]\n'
        '[[vary]]\nkind = "lognormal"\nkey = "errors.read_noise_e"\nby = "scale"\nfactor = 1.5\n'
    )
    top = '[set]\n"cameras.azimuth_deg" = [0.0, 90.0, 180.0, 270.0]\n'
    path = write_claim(tmp_path, runs=20, top=top, more=more)
    tasks = run_tasks(load_claim(path), path)
    moved = np.array([task.drawn["cameras.azimuth_deg"] for task in tasks]) - [0.0, 90.0, 180.0, 270.0]
    assert moved.shape == (20, 4)
    assert len(np.unique(moved)) == 80
    assert {task.drawn["scene.markers"] for task in tasks} <= set(range(4, 10))
    assert {task.drawn["errors.bits"] for task in tasks} == {8, 10}
    noise = np.log([task.drawn["errors.read_noise_e"] / 10 for task in tasks])
    assert 0.2 < noise.std() < 0.7


def test_the_command_of_a_run_repeats_it(tmp_path, made):
    more = '[[vary]]\nkind = "choice"\nkey = "cameras.size_px"\nvalues = [[320.0, 240.0], [300.0, 240.0]]\n'
    path = write_claim(tmp_path, runs=4, more=more, top="looks = [4]")
    result, _ = made(path)
    tasks = run_tasks(load_claim(path), path)
    for task, run in zip(tasks, result.document["each_run"], strict=True):
        words = shlex.split(run["command"])
        changes = [words[k + 1] for k, word in enumerate(words) if word == "--set"]
        spec = load_scenario(tmp_path / "tiny.toml", (*changes, f"seed={words[words.index('--seed') + 1]}"))
        assert spec.errors.body_px == task.drawn["errors.body_px"]
        assert list(spec.cameras.size_px) == task.drawn["cameras.size_px"]
        assert spec.seed == task.seed == run["seed"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"claim": 'quantil = 0.9'}, "unknown key 'claim[0].quantil'; did you mean 'quantile'?"),
        ({"claim": "quantile = 0.9"}, "quantile belongs to statistic = 'quantile', not 'rms'"),
        ({"limit": "0.1 px"}, "a text with a unit of m, cm, mm"),
        ({"top": "looks = [10, 5]"}, "ascending numbers from 3 on are wanted, the last one 200"),
        ({"more": '[[vary]]\nkind = "normal"\nkey = "errors.body_px"\nsigma = 1'}, "'errors.body_px' stands twice"),
        ({"more": '[[vary]]\nkind = "uniform"\nkey = "seed"\nlow = 1\nhigh = 2'}, "'seed' is varied as it is"),
        ({"more": '[[vary]]\nkind = "uniform"\nkey = "errors.bdy_px"\nlow = 1\nhigh = 2'}, "did you mean 'body_px'?"),
        ({"more": '[[vary]]\nkind = "uniform"\nkey = "errors.body_px.x"\nlow = 1\nhigh = 2'}, "is a value, not"),
        ({"more": '[[vary]]\nkind = "uniform"\nkey = "glow.x"\nby = "add"\nlow = 1\nhigh = 2'}, "needs a number"),
        ({"more": '[[vary]]\nkind = "normal"\nkey = "errors.psf_sigma_px"\nsigma = 1'}, "or equal to 0.1 is wanted"),
        ({"top": "error_rate = 0.0"}, "a number greater than 0.0 is wanted"),
    ],
)  # fmt: skip
def test_wrong_claims_are_told_in_one_line(tmp_path, change, told):
    path = write_claim(tmp_path, **change)
    with pytest.raises(InputError) as error:
        run_tasks(load_claim(path), path)
    assert told in str(error.value)
    assert str(error.value).startswith(str(path))


def test_figures_of_speed_are_claimed_of_one_run(tmp_path):
    path = write_claim(tmp_path)
    path.write_text(path.read_text().replace("position_rms", "frame_rate").replace("0.1 mm", "100 Hz"))
    with pytest.raises(InputError, match="depends on the machine"):
        load_claim(path)


def test_the_verb_refuses_what_is_no_claim(tmp_path):
    write_tiny(tmp_path)
    assert "is a scenario, not a claim file" in refusal("claim", "tiny.toml", cwd=tmp_path)
    assert "did you mean 'space_1m'" in refusal("claim", "space_2m", cwd=tmp_path)
    write_claim(tmp_path)
    assert "is a claim file, not a scenario" in refusal("run", "claim.toml", cwd=tmp_path)
    line = refusal("claim", "claim.toml", "--jobs", 2, "--scheduler", "tcp://127.0.0.1:1", cwd=tmp_path)
    assert "exclude each other" in line


def test_equal_bytes_for_any_number_of_processes(tmp_path, made):
    path = write_claim(tmp_path, limit="0.104 mm")
    one, first = made(path, 1, kept="one")
    two, second = made(path, 2, kept="two")
    assert first == second
    assert one.verdict == two.verdict == "undecided"  # the rms of such values is the limit
    assert one.document["runs"] == 200
    assert one.document["failed"] == 5
    values = [value_of(task) for task in run_tasks(load_claim(path), path) if task.number % 40 != 39]
    assert one.document["claims"][0]["estimate"] == pytest.approx(np.sqrt(np.mean(np.square(values))), rel=1e-12)


def test_what_was_done_is_not_done_again(tmp_path, made):
    path = write_claim(tmp_path, runs=30, top="looks = [30]")
    count = []

    def stopped():
        return len(count) > 2

    with pytest.raises(KeyboardInterrupt):
        made(path, 2, slow_work, told=lambda done, most: count.append(done), stopped=stopped)
    kept = len(list((tmp_path / "kept").glob("*.run")))
    assert 0 < kept < 30
    # a process that could make runs is there, and all that are kept are found before it makes any
    first = []
    _, resumed = made(path, 2, slow_work, told=lambda done, most: first.append(done))
    assert first[0] >= min(kept, 1)
    _, whole = made(path, 1, work, kept="whole")
    assert resumed == whole


def test_one_changed_key_is_another_run(tmp_path):
    path = write_claim(tmp_path, runs=3, top="looks = [3]")
    kept = KeptRuns(work, tmp_path / "kept")
    tasks = run_tasks(load_claim(path), path)
    kept.keep(tasks[0], work(tasks[0], {}))
    assert kept.find(tasks[0]) == work(tasks[0], {})
    assert kept.find(tasks[1]) is None
    other = write_claim(tmp_path, runs=3, top='looks = [3]\n[set]\n"capture.duration_s" = 0.2')
    assert kept.find(run_tasks(load_claim(other), other)[0]) is None
    assert KeptRuns(slow_work, tmp_path / "kept").find(tasks[0]) is None


def test_a_process_that_dies_loses_nothing(tmp_path, made, monkeypatch):
    monkeypatch.setenv("CLAIM_TEST_FOLDER", str(tmp_path))
    path = write_claim(tmp_path, runs=20, top="looks = [20]")
    result, _ = made(path, 2, dying_work)
    failed = {run["run"]: run["failed"] for run in result.document["each_run"] if run["failed"]}
    assert failed == {5: DIED}
    whole, _ = made(path, 1, work, kept="whole")
    assert [one["metrics"] for one in result.document["each_run"] if one["run"] != 5] == [
        one["metrics"] for one in whole.document["each_run"] if one["run"] != 5
    ]


def test_a_planted_bug_is_seen(tmp_path, made):
    """Values in another run's place, as of an engine that mixes up what ends: the comparison of bytes shows it."""
    path = write_claim(tmp_path, runs=20, top="looks = [20]")
    _, first = made(path, 1, kept="one")
    _, second = made(path, 1, renumbered, kept="two")
    assert first != second


def renumbered(task, contents):
    """The value of the next run in this one's place."""
    return replace(work(replace(task, seed=task.seed + 1), contents), number=task.number)


def test_files_travel_with_the_scenario(tmp_path):
    lab = tmp_path / "lab"
    (lab / "meshes").mkdir(parents=True)
    (lab / "meshes" / "part.obj").write_text("v 0 0 0\n")
    (lab / "model.xml").write_text('<mesh file="meshes/part.obj"/>')
    (lab / "scenario").mkdir()
    document = {"scene": {"model": "../model.xml", "kind": "own", "motion": str(lab / "model.xml")}}
    files = gathered(document, lab / "scenario")
    assert sorted(files.digests) == ["meshes/part.obj", "model.xml"]
    assert document["scene"]["motion"] == "../model.xml"
    folder = laid_out(files, files.contents, tmp_path / "there")
    assert (folder / document["scene"]["model"]).read_text() == (lab / "model.xml").read_text()
    before = files.digests
    (lab / "meshes" / "part.obj").write_text("v 0 0 1\n")
    assert gathered(document, lab / "scenario").digests != before


def test_a_verdict_on_several_claims():
    def found(verdict):
        return Judgement(verdict, True, 1, 0, None, None, None, 1.0, None, ())

    assert overall([found("conforming"), found("conforming")]) == "conforming"
    assert overall([found("conforming"), found("undecided")]) == "undecided"
    assert overall([found("not conforming"), found("undecided")]) == "not conforming"


def test_the_verb_with_a_real_scenario(tmp_path):
    """Two runs of three fail: a ball that is too small to be seen; its page and its commands."""
    more = '[[vary]]\nkind = "choice"\nkey = "scene.marker_diameter_m"\nvalues = [0.02, 0.0004]\n'
    write_claim(tmp_path, runs=4, top="looks = [4]", more=more, limit="5 mm", claim="")
    done = mosca("claim", "claim.toml", "--jobs", 1, "--out", "out", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert "not conforming" in done.stdout
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    failed = [run for run in result["each_run"] if run["failed"]]
    assert failed
    assert all(run["set"]["scene.marker_diameter_m"] == 0.0004 for run in failed)
    assert result["claims"][0]["failed"] == len(failed)
    assert (tmp_path / "out" / "claim.html").is_file()
