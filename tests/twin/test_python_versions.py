"""Frames are the same bytes under another Python with other versions of numpy and scipy, where one is installed.

``MOSCA_OTHER_PYTHON`` names an interpreter that has the project's packages; else the python3.x on the path are tried.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import hashlib
from pathlib import Path
from scenarios.build.scene import build_scene
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.spec.scenario import load_scenario
from twin.source import TwinSource

path = Path("scenarios/library/subjects/actor.toml")
spec = load_scenario(path, ("capture.duration_s=0.1",))
cameras = virtual_cameras(spec, true_rig(spec, path.parent))
scene = build_scene(spec, path.parent)
total = hashlib.sha256()
for frame in TwinSource(scene, cameras, frame_rate_hz=100, exposure_s=1e-3, pulses=10, seed=1):
    total.update(frame.image.tobytes())
print(total.hexdigest())
"""


def others() -> list[str]:
    """Return interpreters of another version than this one that have the project's packages."""
    named = os.environ.get("MOSCA_OTHER_PYTHON")
    found = [named] if named else [shutil.which(f"python3.{minor}") for minor in range(11, 16)]
    usable = []
    for python in found:
        if python is None:
            continue
        ask = "import sys, numba, mujoco, scipy, pydantic, cv2; print(sys.version_info[:2])"
        done = subprocess.run([python, "-c", ask], capture_output=True, text=True)
        if done.returncode == 0 and done.stdout.strip() != str(tuple(sys.version_info[:2])):
            usable.append(python)
    return usable


def digest(python: str, cache: Path) -> str:
    place = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([python, "-c", SCRIPT], cwd=ROOT, env=place, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_another_python_makes_the_same_bytes(tmp_path):
    there = others()
    if not there:
        pytest.skip("no other Python with the project's packages; name one in MOSCA_OTHER_PYTHON")
    assert digest(there[0], tmp_path / "other") == digest(sys.executable, tmp_path / "own")
