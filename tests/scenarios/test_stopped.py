"""Ctrl-C to the whole process group, as a terminal sends it: what is done is summed up, nothing is left."""

import os
import signal
import subprocess
import time

import pytest
from capture_rig import QUARTER, Line, ctrl_c, openers, write_rig
from command_line import MOSCA, mosca
from tiny_scenario import write_tiny

from mosca.recording import open_recording
from scenarios.lab import capture as capture_module
from scenarios.run.one_writer import one_writer


def begun(words, cwd):
    return subprocess.Popen(
        [*MOSCA, *map(str, words)], cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def until(there, process):
    deadline = time.monotonic() + 600  # a cold machine compiles kernels first
    while not there() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert process.poll() is None, process.communicate()


@pytest.fixture
def suite(tmp_path):
    """A suite of a short and a long scenario, after the short one has ended and the long one has begun."""
    for name, seconds in (("short", 0.3), ("long", 3000)):
        (tmp_path / name).mkdir()
        write_tiny(tmp_path / name, duration_s=seconds).rename(tmp_path / f"{name}.toml")
    words = ("suite", "short.toml", "long.toml", "--tier", "full", "--jobs", "2", "--out", "x", "--junit", "j.xml")
    process = begun(words, tmp_path)
    until(lambda: (tmp_path / "x/short/record.json").exists() and (tmp_path / "x/.long.lock").exists(), process)
    yield process
    process.kill()
    process.communicate()


@pytest.mark.slow
def test_a_suite_sums_up_what_is_done(tmp_path, suite):
    os.killpg(suite.pid, signal.SIGINT)
    told, errors = suite.communicate(timeout=600)
    assert suite.returncode == 130, errors
    assert "1 of 2 scenarios as they should be; x/suite.html" in told
    assert "stopped by hand: 1 scenarios did not end: long" in errors
    assert "Traceback" not in errors
    assert 'name="long"' in (tmp_path / "j.xml").read_text()
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == ["history.jsonl", "short", "suite.html"]


@pytest.mark.slow
def test_a_suite_ends_without_tracebacks_however_often_it_is_told(tmp_path, suite):
    while suite.poll() is None:
        try:
            os.killpg(suite.pid, signal.SIGINT)
            suite.wait(0.05)
        except (subprocess.TimeoutExpired, ProcessLookupError):
            continue
    _, errors = suite.communicate(timeout=600)
    assert suite.returncode == 130, errors
    assert "Traceback" not in errors
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == ["history.jsonl", "short", "suite.html"]


@pytest.mark.slow
def test_no_worker_outlives_a_killed_suite(tmp_path, suite):
    suite.kill()
    suite.communicate(timeout=600)  # until the workers have closed its output, too
    with one_writer(tmp_path / "x/long"):
        pass


@pytest.mark.parametrize("send", [os.killpg, pytest.param(os.kill, marks=pytest.mark.slow)])
def test_a_run_says_how_far_it_was_and_leaves_a_readable_recording(tmp_path, send):
    """Told to all processes, as a terminal does, or to the one that was started."""
    write_tiny(tmp_path, duration_s=60)
    process = begun(("run", "tiny.toml", "--out", "x", "--record", "rec"), tmp_path)
    try:
        until(lambda: any(p.stat().st_size > 10_000 for p in tmp_path.glob("rec/*.part")), process)
        send(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 130, errors
    assert "tiny: stopped at " in errors
    assert " of 6000" in errors
    assert "Traceback" not in errors
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rec", "tiny.toml"]
    with open_recording(tmp_path / "rec") as recording:
        assert len(list(recording)) > 0


@pytest.mark.parametrize(("end", "code"), [((), 0), (("--frames", 10_000), 130)])
def test_a_take_that_was_to_be_longer_does_not_pass(tmp_path, monkeypatch, end, code):
    rig = write_rig(tmp_path / "rig.toml", "ab", QUARTER)
    capture = capture_module.capture

    def stopped(request, progress):
        line = Line()
        return capture(request, ctrl_c(lambda: line.made > 60), *openers(line, size=QUARTER))

    monkeypatch.setattr(capture_module, "capture", stopped)
    done = mosca("capture", "--rig", rig, "--out", "take", *end, cwd=tmp_path)
    assert "ended by hand; take" in done.stdout
    assert done.returncode == code, done.stderr
