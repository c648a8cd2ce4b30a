"""Other ways to install: each command of the page, from a local address."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINES = [
    line
    for line in re.findall(r"\| `([^`]*)` \|", (ROOT / "docs/install.md").read_text(encoding="utf-8"))
    if not line.startswith("docker")
]


def test_the_page_has_its_commands():
    assert [line.split()[0] for line in LINES] == ["pipx", "uvx", "uv"]


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_it_installs_from_git(line, tmp_path):
    words = shlex.split(line.replace("ADDRESS", f"file://{ROOT}"))
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not installed (pip install 'mosca-testbench[bench]')")
    if not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    home = {"HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path / "data"), "XDG_BIN_HOME": str(tmp_path / "bin")}
    done = subprocess.run(
        words, env={**os.environ, **home}, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    if words[0] != "uvx":
        program = next(path for path in tmp_path.rglob("bin/mosca") if os.access(path, os.X_OK))
        done = subprocess.run([program, "list"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "subjects/actor" in done.stdout


def test_the_dockerfile_has_no_findings():
    if shutil.which("hadolint") is None:
        pytest.skip("hadolint is not installed (pip install 'mosca-testbench[bench]')")
    done = subprocess.run(["hadolint", str(ROOT / "Dockerfile")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
