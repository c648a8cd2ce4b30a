"""Provenance of a result: versions, platform, commit."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite.binding import get_host_cpu_name


def provenance() -> dict[str, Any]:
    """Return the provenance of a result: versions, platform, git commit."""
    return {**numerics(), "git": _git()}


def numerics() -> dict[str, Any]:
    """Return all that affects last digits besides the code: versions, platform, processor."""
    packages = ("mujoco", "numpy", "scipy", "numba", "opencv-python-headless")
    return {
        "versions": {"mosca": version("mosca-testbench"), "python": platform.python_version()}
        | {name: version(name) for name in packages},
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }


def _processor() -> str:
    """Return the processor as seen by compiled code: last digits, and with them noise, differ between processors."""
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    name = os.environ.get("NUMBA_CPU_NAME") or get_host_cpu_name()
    return " ".join([name, *simd.get("found", ())])


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
