"""The command line as a user meets it: exit codes, one-line errors, nothing half written, quick answers."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.shell_completion import ShellComplete
from command_line import mosca, mosca_alone, refusal
from tiny_scenario import write_tiny

from scenarios.cli.grouped import SECTIONS
from scenarios.cli.main import cli
from scenarios.spec.catalog import built_in, entries, scenario_name


def scenario(tmp_path, top="", cameras="", limits="position_rms = 0.01"):
    return write_tiny(tmp_path, top=top, cameras=cameras, limits=limits)


def test_run_writes_the_whole_folder_and_repeats_itself(tmp_path):
    path = scenario(tmp_path)
    records = []
    for out, workers, program in (("a", 1, mosca), ("b", 2, mosca_alone)):
        done = program("run", path, "--out", out, "--workers", workers, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert {p.name for p in (tmp_path / out).iterdir()} == {
            "record.json",
            "report.html",
            "tracks.csv",
            "tracks.npz",
        }
        record = json.loads((tmp_path / out / "record.json").read_text())
        record.pop("timings")
        records.append(record)
    assert records[0] == records[1]
    assert (tmp_path / "a/tracks.csv").read_bytes() == (tmp_path / "b/tracks.csv").read_bytes()
    assert "position_rms" in done.stdout


def test_verbosity(tmp_path):
    path = scenario(tmp_path)
    shown = {words: mosca(*words, "run", path, cwd=tmp_path).stderr for words in ((), ("-v",), ("-q",))}
    assert shown[()] == shown[("-q",)] == ""
    assert "INFO scenarios.run.scenario: frames_to_tracks: " in shown[("-v",)]
    assert "exclude each other" in refusal("-q", "-v", "list", cwd=tmp_path)


def test_a_broken_limit_exits_1_and_a_caught_control_0(tmp_path):
    path = scenario(tmp_path, limits="position_rms = 1e-9")
    assert mosca("run", path, cwd=tmp_path).returncode == 1
    limits = "position_rms = 1e-9\ncompleteness = 0.9\n[breaks]\nposition_rms_mm = [{}, {}]"
    path = scenario(tmp_path, 'expect = "fail"', limits=limits.format(0.05, 5))
    done = mosca("run", path, cwd=tmp_path)
    assert done.returncode == 0
    assert "fails as it must: position_rms 0.000" in done.stdout
    done = mosca("run", scenario(tmp_path, 'expect = "fail"', limits=limits.format(20, 30)), cwd=tmp_path)
    assert done.returncode == 1
    assert "control broken: position_rms 0.000" in done.stdout
    assert "outside [0.02, 0.03]" in done.stdout


def test_recorded_frames_give_the_same_tracks(tmp_path):
    path = scenario(tmp_path)
    assert mosca("run", path, "--out", "a", "--record", "rec", cwd=tmp_path).returncode == 0
    done = mosca("run", path, "--out", "b", "--source", "recording:rec", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a/tracks.csv").read_bytes() == (tmp_path / "b/tracks.csv").read_bytes()
    # the same positions as a user's own reference judge the same errors; without any, nothing passes unjudged
    with np.load(tmp_path / "rec/truth.npz") as truth:
        rows = [
            f"{name},{time_ns},{x!r},{y!r},{z!r}"
            for time_ns, places in zip(truth["time_ns"].tolist(), truth["xyz"].tolist(), strict=True)
            for name, (x, y, z) in zip(truth["names"].tolist(), places, strict=True)
        ]
    (tmp_path / "rec/truth.npz").unlink()
    (tmp_path / "rec/truth.csv").write_text("\n".join(["label,time_ns,x,y,z", *rows]))
    done = mosca("run", path, "--out", "c", "--source", "recording:rec", cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    ours, told = (metrics_of(tmp_path / run) for run in "ac")
    assert told["position_rms"]["value"] == pytest.approx(ours["position_rms"]["value"], rel=1e-6)
    assert "completeness" in ours
    assert "completeness" not in told
    (tmp_path / "rec/truth.csv").unlink()
    done = mosca("run", path, "--out", "d", "--source", "recording:rec", cwd=tmp_path)
    assert done.returncode == 1
    assert "not judged, for want of a truth: position_rms" in done.stdout
    assert set(metrics_of(tmp_path / "d")) == {"reprojection_rms", "sets_complete"}
    assert "Not judged" in (tmp_path / "d/report.html").read_text()


def metrics_of(folder):
    return {metric["name"]: metric for metric in json.loads((folder / "record.json").read_text())["metrics"]}


@pytest.mark.parametrize(
    ("cameras", "says"),
    [
        ("azimuth_deg = [10.0, 10.0, 90.0, 180.0]", "same place"),
        ("look_at_m = [0.0, 0.0, 50.0]", "seen by two cameras"),
        ("c_mm = -1.0", "c_mm"),
        ('rig = "nowhere.toml"', "nowhere.toml"),
    ],
)
def test_impossible_rigs(tmp_path, cameras, says):
    line = refusal("run", scenario(tmp_path, cameras=cameras), "--out", "x", cwd=tmp_path)
    assert says in line
    assert not (tmp_path / "x").exists()
    assert not list(tmp_path.glob(".x*"))


def test_other_bad_input(tmp_path):
    path = scenario(tmp_path)
    assert "unknown key" in refusal("run", path, "--set", "capture.speed=1", cwd=tmp_path)
    assert "no such" in refusal("run", "nothing.toml", cwd=tmp_path)
    assert "did you mean" in refusal("run", "acter", cwd=tmp_path)
    assert "no such file" in refusal("run", path, "--source", "hardware:rig.toml", cwd=tmp_path)
    assert "recording:DIR" in refusal("run", path, "--source", "tape", cwd=tmp_path)
    assert "marker_px" in refusal("run", path, "--set", "premises.marker_px=50", cwd=tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("all I have")
    assert "record.json" in refusal("run", path, "--out", "mine", cwd=tmp_path)
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "all I have"


@pytest.mark.parametrize(
    "verb",
    [
        "run", "suite", "list", "new", "reconstruct", "calibrate", "report", "view", "schema", "rig check",
        "live", "zones", "labels learn", "labels apply", "labels auto", "capture", "twin serve", "station detect",
        "station reconstruct", "bodies learn", "bodies find", "edit",
    ],
)  # fmt: skip
def test_every_verb_has_help_with_an_example(verb, tmp_path):
    done = mosca(*verb.split(), "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert "Example:  mosca" in done.stdout


def test_help_and_errors_import_nothing_heavy(tmp_path):
    # seconds are noisy; what makes them is what is imported
    code = (
        "import sys, scenarios.cli.main as c\n"
        "sys.argv = ['mosca'] + {args}\n"
        "try: c.main()\n"
        "except SystemExit: pass\n"
        "heavy = [m for m in ('mujoco','numba','scipy','cv2','matplotlib','rerun','trimesh') if m in sys.modules]\n"
        "assert not heavy, heavy\n"
    )
    scenario(tmp_path).write_text("title = 3")
    for args in (["--help"], ["--version"], ["run", "--help"], ["run", "no.toml"], ["run", "tiny.toml"], ["list"]):
        subprocess.run([sys.executable, "-c", code.format(args=args)], cwd=tmp_path, check=True, capture_output=True)


def test_new_list_and_schema(tmp_path):
    assert mosca("new", "my.toml", cwd=tmp_path).returncode == 0
    assert "exists already" in refusal("new", "my.toml", cwd=tmp_path)
    listed = mosca("list", cwd=tmp_path)
    assert "subjects/actor" in listed.stdout
    assert json.loads(mosca("schema", "scenario", cwd=tmp_path).stdout)["title"] == "Scenario"
    assert os.path.getsize(Path(tmp_path, "my.toml")) > 0


def test_help_lists_each_command_in_one_section():
    sections = [name for names in SECTIONS.values() for name in names]
    assert sorted(sections) == sorted(cli.commands)
    shown = mosca("--help", cwd=".").stdout
    assert not re.search(r"[\w,]\.\.\.", shown)  # nothing is cut
    for title, names in SECTIONS.items():
        part = shown.split(f"\n{title}:\n", 1)[1].split("\n\n", 1)[0]
        assert re.findall(r"^  (\S+) ", part, re.MULTILINE) == list(names)


@pytest.mark.parametrize(
    ("typed", "offered"), [("subjects/ro", "subjects/robot"), ("rob", "subjects/robot"), ("flight/h", "flight/hover")]
)
def test_a_shell_completes_names_of_scenarios(typed, offered):
    completion = ShellComplete(cli, {}, "mosca", "_MOSCA_COMPLETE")
    assert offered in [item.value for item in completion.get_completions(["run"], typed)]
    assert "--seed" in [item.value for item in completion.get_completions(["run", "x"], "--s")]
    assert "calibrate" in [item.value for item in completion.get_completions([], "cal")]


def test_a_folder_of_the_project_is_named_as_it_is_listed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = [one.name for one in entries((Path("subjects"),), "full")]
    assert found == sorted(name for name in map(scenario_name, built_in()) if name.startswith("subjects/"))
    (tmp_path / "subjects").mkdir()
    assert entries((Path("subjects"),), "full") == []  # one's own comes first
