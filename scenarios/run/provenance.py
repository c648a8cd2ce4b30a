"""What made a result: versions, platform, commit."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any


def provenance() -> dict[str, Any]:
    """Return what made a result: versions, platform, git commit."""
    packages = ("mujoco", "numpy", "scipy", "numba", "opencv-python-headless")
    return {
        "versions": {"mosca": version("mosca-testbench"), "python": platform.python_version()}
        | {name: version(name) for name in packages},
        "platform": f"{platform.system()} {platform.machine()}",
        "git": _git(),
    }


def _git() -> str:
    """Return the commit of the checkout, with '+' where files differ from it; 'unknown' outside one."""
    folder = Path(__file__).resolve().parent
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],
            cwd=folder, capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return described.stdout.strip()
