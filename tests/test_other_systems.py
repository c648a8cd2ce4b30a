"""The way from scene to score without what Windows lacks: POSIX modules, signals and processes that fork.

No stand-in for those systems; it shows that nothing on that way imports or calls what they do not have.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "scenarios"))
from tiny_scenario import write_tiny

ROOT = Path(__file__).parents[1]
MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty")
WITHOUT = f"""
import os, signal, sys

MODULES = {MODULES}

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError("No module named '" + name + "'", name=name)

for name in MODULES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())
for holder, names in (
    (os, ("fork", "forkpty", "getuid", "geteuid", "getpgid", "killpg", "mkfifo", "setsid",
          "sched_getaffinity", "sched_setaffinity", "nice")),
    (signal, ("pthread_sigmask", "pthread_kill", "sigwait", "setitimer", "alarm", "SIGHUP", "SIGUSR1", "SIGALRM")),
):
    for name in names:
        if hasattr(holder, name):
            delattr(holder, name)
"""
IMPORT_ALL = f"""
import importlib, sys
for name in sys.stdin.read().split():
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:  # optional packages may be missing
        if error.name in {MODULES}:
            print(name, "needs", error.name)
"""


@pytest.fixture
def without_posix(tmp_path):
    """Return the environment of Python processes, and of those that they spawn, without POSIX."""
    (tmp_path / "without").mkdir()
    (tmp_path / "without" / "sitecustomize.py").write_text(WITHOUT, encoding="utf-8")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "without"), str(ROOT)])}


def test_modules_are_missing_there(without_posix):
    """The control: what is taken away is away."""
    done = subprocess.run([sys.executable, "-c", "import fcntl"], env=without_posix, capture_output=True, check=False)
    assert b"No module named 'fcntl'" in done.stderr


def test_a_suite_of_processes_runs(without_posix, tmp_path):
    first = write_tiny(tmp_path)
    second = shutil.copy(first, tmp_path / "again.toml")
    files = [str(first), str(second)]
    done = subprocess.run(
        [sys.executable, "-m", "scenarios.cli.main", "suite", *files, "--jobs", "2", "--tier", "full"],
        env=without_posix, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "2 of 2 scenarios as they should be" in done.stdout, done.stdout + done.stderr
    assert (tmp_path / "runs/suite/suite.html").exists()


def test_all_modules_import(without_posix):
    rooms = ("mosca", "twin", "scenarios", "reports", "hardware")
    paths = [path for room in rooms for path in (ROOT / room).rglob("*.py") if path.name != "__init__.py"]
    names = sorted(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths)
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], input="\n".join(names), env=without_posix, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert not done.stdout


BARE = r"""
set -e
mount -t tmpfs none "$0"
for node in null zero full random urandom; do touch "$0/$node"; mount --bind "/dev/$node" "$0/$node"; done
ln -s /proc/self/fd "$0/fd"
mount --rbind "$0" /dev
exec "$@"
"""
"""A shell script that runs a command with a /dev of its own, in which there is no shm."""


@pytest.fixture
def without_shm(tmp_path):
    """Return what runs a command without /dev/shm, and without its shared memory and locks of processes."""
    (tmp_path / "dev").mkdir()
    words = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--map-root-user"])]
    words += ["sh", "-c", BARE, str(tmp_path / "dev")]
    if shutil.which("unshare") is None or subprocess.run([*words, "true"], capture_output=True).returncode:
        pytest.skip("mount namespaces are not allowed here")

    def run(*command, given=""):
        return subprocess.run(
            [*words, sys.executable, *command], input=given,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip

    return run


def test_there_is_no_shm_there(without_shm):
    """The control: what is taken away is away."""
    done = without_shm("-c", "import multiprocessing as m, os; print(os.path.exists('/dev/shm')); m.Lock()")
    assert done.stdout == "False\n"
    assert "FileNotFoundError" in done.stderr


RUN_EACH = """
import contextlib, io, json, sys
from scenarios.cli.main import main

for line in json.load(sys.stdin):
    code, out, errors = 0, io.StringIO(), io.StringIO()
    sys.argv = ["mosca", *line]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            main()
        except SystemExit as ended:
            code = ended.code
    print(json.dumps([code, out.getvalue(), errors.getvalue()]))
"""
"""Runs command lines, one after the other: a process spends seconds on imports and on loading kernels."""


def test_from_scene_to_score_from_frames_to_tracks_and_what_is_missing_for_processes(without_shm, tmp_path):
    tiny = str(write_tiny(tmp_path))
    lines = [
        ["suite", tiny, "--tier", "full"],
        ["run", tiny, "--record", "take", "--out", "run"],
        ["reconstruct", "take", "--rig", "take/rig.toml", "--out", "take.csv"],
    ]
    done = without_shm("-c", RUN_EACH, given=json.dumps(lines))
    assert done.returncode == 0, done.stderr
    (suite, _, told), (run, out, errors), (reconstruct, *rest) = map(json.loads, done.stdout.splitlines())
    assert suite == 2
    assert told.startswith("mosca: processes beside each other need locks, and this system gives none")
    assert "\n" not in told.strip()
    assert run == 0
    assert "tiny: every limit is met" in out, out + errors
    assert reconstruct == 0, rest
    assert (tmp_path / "take.csv").exists(), rest
