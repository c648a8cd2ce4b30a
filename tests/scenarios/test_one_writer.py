"""Two runs in one folder: the second is told who holds it; what a killed one left is taken over."""

import json
import logging
import os
import subprocess
import sys

import pytest
from command_line import mosca, refusal
from tiny_scenario import write_tiny

from mosca.errors import InputError
from scenarios.run.one_writer import one_writer

pytest.importorskip("fcntl", reason="without flock there is no lock")

HOLDS = """
import sys
from pathlib import Path
from scenarios.run.one_writer import one_writer
with one_writer(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock of ``x``."""
    command = [sys.executable, "-c", HOLDS, str(tmp_path / "x")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_run_in_the_same_folder_is_told_who_writes_there(tmp_path, holder):
    path = write_tiny(tmp_path)
    for verb in (["run", path], ["suite", path, "--tier", "full"]):
        line = refusal(*verb, "--out", "x", cwd=tmp_path)
        assert f"x: process {holder.pid} on " in line
        assert "writes there now; wait until it has ended, or choose another folder" in line
    assert not (tmp_path / "x").exists()
    holder.communicate("")
    assert mosca("run", path, "--out", "x", cwd=tmp_path).returncode == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tiny.toml", "x"]


def test_what_a_killed_run_left_is_taken_over_with_a_note(tmp_path, holder, caplog):
    holder.kill()
    holder.wait()
    lock = tmp_path / ".x.lock"
    assert json.loads(lock.read_text())["pid"] == holder.pid
    with caplog.at_level(logging.WARNING), one_writer(tmp_path / "x"):
        assert json.loads(lock.read_text())["pid"] == os.getpid()
    assert f"taken over from process {holder.pid} on " in caplog.text
    assert list(tmp_path.iterdir()) == []


def test_a_lock_leaves_no_folders_but_those_in_use(tmp_path):
    with one_writer(tmp_path / "a/b/x"):
        with pytest.raises(InputError, match="writes there now"), one_writer(tmp_path / "a/b/x"):
            pass
        with one_writer(tmp_path / "a/b/y"):
            pass
    assert list(tmp_path.iterdir()) == []
    with one_writer(tmp_path / "a/b/x"):
        (tmp_path / "a/kept").mkdir()
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["kept"]
