"""Images from a seed are the same bytes on other processors, but for pixels at a rounding boundary."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mosca.recording.open import open_recording

OLD = (str(Path(__file__).resolve().parents[2] / ".ci/processors"), "--with", "x86-64-v2")
"""Neither AVX2 nor FMA, in compiled kernels, NumPy, OpenBLAS and the C library."""
ROUNDED = 1e-5
"""Share of pixels that may differ by one digital number: rounding errors near 1e-10 of a digital number reach the
next one in fewer."""


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["rigs/points_200", "subjects/actor", "light/polished_floor"])
def test_frames_from_a_seed_are_the_same_on_a_processor_without_avx(scenario, tmp_path):
    kernels = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    for name, features, environment in (("own", (), {}), ("old", OLD, kernels)):
        done = subprocess.run(
            [*features, sys.executable, "-m", "scenarios.cli.main", "run", scenario,
             "--set", "capture.duration_s=0.3", "--out", str(tmp_path / name),
             "--record", str(tmp_path / "frames" / name)],
            env={**os.environ, **environment}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode in (0, 1), done.stderr
    pixels = rounded = 0
    frames = [open_recording(tmp_path / "frames" / name) for name in ("own", "old")]
    for own, old in zip(*frames, strict=True):
        assert (own.camera, own.index, own.time_ns, own.status) == (old.camera, old.index, old.time_ns, old.status)
        difference = np.abs(own.image.astype(int) - old.image)
        assert difference.max() <= 1
        pixels, rounded = pixels + difference.size, rounded + difference.sum()
    assert pixels > 0
    assert rounded <= ROUNDED * pixels
