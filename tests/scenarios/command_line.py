"""The command line in this process: a process of its own spends seconds on imports alone."""

import io
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from types import SimpleNamespace
from unittest.mock import patch

from scenarios.cli import progress
from scenarios.cli.main import main

MOSCA = [sys.executable, "-m", "scenarios.cli.main"]


def mosca(*words, cwd):
    """Run a command line in a folder; return exit code and output, as of a process."""
    code, out, errors = 0, io.StringIO(), io.StringIO()
    line = ["mosca", *map(str, words)]
    silent = patch.object(progress, "EVERY_S", 1e6)  # no test depends on how long it took
    with silent, chdir(cwd), patch.object(sys, "argv", line), redirect_stdout(out), redirect_stderr(errors):
        try:
            main()
        except SystemExit as ended:
            code = ended.code
    return SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=errors.getvalue())


def mosca_alone(*words, cwd=None):
    """Run a command line in a process of its own."""
    return subprocess.run(
        [*MOSCA, *map(str, words)], cwd=cwd, capture_output=True, text=True, timeout=1800, check=False
    )


def refusal(*words, cwd):
    """Run a command line that must fail, with exit code 2 and one line; return that line."""
    done = mosca(*words, cwd=cwd)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("mosca: ")
    return line
