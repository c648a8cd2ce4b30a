"""Runs README.md's command blocks word for word, each as a newcomer would: nothing of this machine but its registry.

``python3 .ci/readme_commands.py [K ...]`` runs block K of the section "Two commands" (all without numbers) in a fresh
clone of this checkout's HEAD, with an empty home and bare environment variables. Only what says where packages come
from is passed on. Exit code 1 where a command fails; its output is shown as it comes.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KEPT = re.compile(r"PIP_|.*_proxy$|.*_PROXY$|SSL_CERT|REQUESTS_CA|CURL_CA")
"""Variables about the way to the package registry."""


def commands() -> list[str]:
    """Return the commands of the README's section, one each, without their comments."""
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("## Two commands\n")[1].split("\n## ")[0]
    block = re.search(r"```sh\n(.*?)```", section, re.DOTALL)
    if block is None:
        raise SystemExit("README.md: section 'Two commands' has no ```sh block")
    return [line for line in block[1].splitlines() if line.strip() and not line.startswith("#")]


def environment(home: Path) -> dict[str, str]:
    """Return bare environment variables for a newcomer whose home is ``home``."""
    bare = {"PATH": os.environ["PATH"], "HOME": str(home), "LANG": "C.UTF-8", "TERM": "dumb"}
    bare |= {name: value for name, value in os.environ.items() if KEPT.match(name)}
    config = Path.home() / ".config" / "pip" / "pip.conf"
    if config.exists():
        bare.setdefault("PIP_CONFIG_FILE", str(config))
    return bare


def run(command: str) -> int:
    """Run one command in a fresh clone; returns its exit code."""
    with tempfile.TemporaryDirectory(prefix="newcomer-") as folder:
        home, clone = Path(folder) / "home", Path(folder) / "mosca"
        home.mkdir()
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        print(f"$ {command}", flush=True)
        start = time.monotonic()
        code = subprocess.run(
            ["bash", "-c", command], cwd=clone, env=environment(home), stdin=subprocess.DEVNULL
        ).returncode
        print(f"exit code {code} after {time.monotonic() - start:.0f} s", flush=True)
        return code


if __name__ == "__main__":
    there = commands()
    wanted = [int(k) for k in sys.argv[1:]] or range(1, len(there) + 1)
    sys.exit(max(int(run(there[k - 1]) != 0) for k in wanted))
