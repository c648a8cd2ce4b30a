"""Places to write: tried before the work, and a disk that is full in the end loses no figures."""

import json
import os
import resource
import shutil
import subprocess
import sys
from collections import namedtuple
from contextlib import contextmanager
from pathlib import Path

import click
import pytest
from command_line import mosca, refusal
from tiny_scenario import write_tiny

from mosca.data.files import whole_file as files
from mosca.errors import InputError
from scenarios.cli.main import cli
from scenarios.cli.options import OutFile, OutFolder
from scenarios.run import folder as run_folder
from scenarios.run import scenario as run_module
from scenarios.suite.suite import Outcome, _run_one, complaints

NOWHERE = "/proc/nowhere"
"""Where not even root makes a folder."""
ELSEWHERE = {"mosca capture --out", "mosca rig convert out"}
"""Tried by the verb itself: a folder that must not be there yet, and what is a file or a folder."""
WRITTEN = {"out", "record", "junit", "baselines", "rig_out", "tracks_out"}


def verbs(group, name="mosca"):
    for word, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from verbs(command, f"{name} {word}")
        else:
            yield f"{name} {word}", command


OUTPUTS = [
    (f"{name} {param.opts[0]}", param)
    for name, command in verbs(cli)
    for param in command.params
    if param.name in WRITTEN or (name, param.name) == ("mosca new", "path")
]


@pytest.mark.parametrize("name", sorted({name for name, _ in OUTPUTS} - ELSEWHERE))
def test_every_verb_tries_where_it_writes_before_anything_else(name, tmp_path):
    assert isinstance(dict(OUTPUTS)[name].type, OutFile | OutFolder)
    *verb, last = name.split()[1:]
    option = [last] if last.startswith("--") else []
    before = ["in.file"] if verb[-1] in ("convert", "page", "ros2") else []
    line = refusal(*verb, *before, *option, f"{NOWHERE}/x.toml", cwd=tmp_path)
    assert NOWHERE in line


def test_those_that_try_it_themselves_are_no_others():
    assert {name for name, param in OUTPUTS if not isinstance(param.type, OutFile | OutFolder)} == ELSEWHERE


@contextmanager
def no_work(monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(run_module, "run_scenario", lambda *_: pytest.fail("the run was begun"))
        yield


def test_a_run_and_a_suite_do_not_begin_where_they_cannot_end(tmp_path, monkeypatch):
    path = write_tiny(tmp_path)
    with no_work(monkeypatch):
        assert NOWHERE in refusal("run", path, "--out", f"{NOWHERE}/x", cwd=tmp_path)
        assert NOWHERE in refusal("suite", path, "--tier", "full", "--out", f"{NOWHERE}/x", cwd=tmp_path)
        monkeypatch.chdir(tmp_path)
        assert "holds other files" in _run_one(str(path), "tiny", ".").error


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_full_disk_is_told_before_the_run(tmp_path, monkeypatch):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(disk)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no tmpfs can be mounted here: {mounted.stderr.strip()}")
    try:
        with no_work(monkeypatch):
            line = refusal("run", write_tiny(tmp_path), "--out", disk / "x", cwd=tmp_path)
            assert "runs: cannot be written: No space left" in refusal("run", tmp_path / "tiny.toml", cwd=disk)
        assert f"{disk}/x: cannot be written: No space left on device; make room" in line
        assert list(disk.iterdir()) == []
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_recording_for_which_there_is_no_room(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9 - 10**6, 10**6))
    line = refusal("run", write_tiny(tmp_path), "--record", "rec", cwd=tmp_path)
    # 30 pulses of four cameras with 320 x 240 px
    assert "rec: 0.00922 GB may be needed, 0.001 GB are free there; make room" in line
    assert not (tmp_path / "rec").exists()


@contextmanager
def files_end_at(size):
    """No file grows beyond ``size`` bytes, as on a disk that fills up."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def filling_up(monkeypatch):
    """Run folders are written to a disk that has no room for a page."""
    write = run_folder.write_run

    def limited(*given):
        with files_end_at(files.TRIED_BYTES):
            write(*given)

    monkeypatch.setattr(run_folder, "write_run", limited)


def test_a_disk_that_is_full_in_the_end_loses_no_figures(tmp_path, filling_up):
    path = write_tiny(tmp_path)
    done = mosca("run", path, "--out", "x", cwd=tmp_path)
    assert done.returncode == 2
    assert "position_rms" in done.stdout
    assert "every limit is met" in done.stdout
    assert "x/report.html\n" not in done.stdout
    (line,) = done.stderr.splitlines()
    assert line.startswith("mosca: x: not written: report.html (File too large); written: record.json, tracks")
    assert json.loads((tmp_path / "x/record.json").read_text())["passed"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tiny.toml", "x"]


def test_a_suite_keeps_the_record_of_a_run_whose_page_was_not_written(tmp_path, filling_up):
    outcome = _run_one(str(write_tiny(tmp_path)), "tiny", str(tmp_path / "x"))
    assert outcome.record is not None
    assert not outcome.passed
    assert "x: not written: report.html (File too large)" in complaints(outcome)[0]
    assert Outcome("tiny", outcome.record, "", 1.0).passed


def test_without_its_record_an_earlier_run_folder_stays(tmp_path, monkeypatch):
    path = write_tiny(tmp_path)
    assert mosca("run", path, "--out", "x", cwd=tmp_path).returncode == 0
    before = (tmp_path / "x/record.json").read_bytes()

    def full(record, path):
        raise InputError(f"{path}: not written") from OSError(28, "No space left on device")

    monkeypatch.setattr(run_folder, "write_record", full)
    done = mosca("run", path, "--out", "x", "--seed", "5", cwd=tmp_path)
    assert done.returncode == 2
    assert "x: not written: record.json (No space left on device); written: nothing" in done.stderr
    assert (tmp_path / "x/record.json").read_bytes() == before


def test_a_page_that_cannot_be_made_is_a_bug_that_loses_nothing_else(tmp_path, monkeypatch, capsys):
    def fails(*given):
        raise ZeroDivisionError("no page")

    monkeypatch.setattr(run_folder, "write_page", fails)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["mosca", "run", str(write_tiny(tmp_path)), "--out", "x"])
    with pytest.raises(ZeroDivisionError):
        cli_main()
    assert "position_rms" in capsys.readouterr().out
    assert sorted(p.name for p in Path("x").iterdir()) == ["record.json", "tracks.csv", "tracks.npz"]


def cli_main():
    from scenarios.cli.main import main

    main()


def test_a_file_that_outgrows_the_disk_names_itself_and_leaves_the_earlier_one(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("earlier")
    with pytest.raises(InputError, match=r"tracks.csv: not written: File too large"), files_end_at(1000):
        files.write_text(path, 2000 * "x")
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]
