"""The way from scene to score without what Windows lacks: POSIX modules, signals and processes that fork.

No stand-in for those systems; it shows that nothing on that way imports or calls what they do not have.
"""

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
