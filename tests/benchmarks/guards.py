"""Speed and accuracy claims, held against peers in the same run: exit code 1 where a ratio falls below its limit.

Run: ``pip install -e ".[bench]"``, ``python tests/benchmarks/guards.py``. Ratios of processor time depend little on
the machine. A limit is about half of what was measured when it was set (in brackets), so that a loss of a factor of
two is found and a busy machine is not; accuracy limits are the claims themselves.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import bench_bundle
import bench_detect_peers as detectors
import bench_match_peers as matchers

from mosca.detection.settings import DetectionSettings

Figure = tuple[str, float, float, str]
"""What is measured, its value, its limit, and ">=" or "<="."""


def detection() -> Iterator[Figure]:
    """Yield error over the Cramer-Rao bound and time beside OpenPTV for 200 discs of 8 px in 656 x 491 pixels."""
    rng = np.random.default_rng(1)
    contrast, threshold = 50.0, round(detectors.BLACK + 6)
    images, places = detectors.made(8.0, "uniform", contrast, 8, rng)
    bound = detectors.bound_px(8.0, "uniform", contrast, rng)
    settings = DetectionSettings(
        thresholds="paper",
        lowest_dn=threshold,
        contrast_dn=threshold,
        read_noise_dn=contrast / detectors.SNR,
        gain_dn_per_e=0.0,
    )
    name = "OpenPTV target_recognition"
    finders = {"ours": detectors.ours(images, settings), name: detectors.peers(8.0, threshold)[name]}
    off, false = detectors.errors_px(finders["ours"], images, places)
    yield ("detection, rms error / Cramer-Rao bound (0.98)", float(np.sqrt(np.mean(off**2))) / bound, 1.05, "<=")
    yield "detection, false targets in 8 images", false, 0, "<="
    taken = detectors.least_ms(finders, images, 5)
    yield "detection, OpenPTV's time / ours (1.5-2.3)", taken[name] / taken["ours"], 1.0, ">="


def correspondence() -> Iterator[Figure]:
    """Yield time beside OpenPTV and wrong groups for 200 markers in 4 cameras."""
    rig = matchers.ring(4)
    frames = matchers.frames_of(rig, 200, 0, 0.0)
    theirs, ours = matchers.theirs(rig, frames), matchers.ours(rig, frames, False)
    yield "correspondence, OpenPTV's time / ours (13)", theirs[0] / ours[0], 6.0, ">="
    yield "correspondence, wrong groups a set", ours[2], 0.0, "<="
    yield "correspondence, missed targets a set", ours[3], 0.0, "<="


def adjustment() -> Iterator[Figure]:
    """Yield time beside scipy with an analytic sparse Jacobian, to the same cost."""
    from mosca.calibration.bundle.solver import BundleSettings, solve

    data = bench_bundle.scene(1_000)
    problem, settings = bench_bundle.ours(data), BundleSettings(precision=False)
    cost = solve(problem, settings).cost
    scipy_cost, _evaluations = bench_bundle.scipy_solver(data, 1e-8)
    yield "bundle adjustment, our cost / scipy's", cost / scipy_cost, 1.0001, "<="
    ours = bench_bundle.best_ms(lambda: solve(problem, settings), 10)[1]
    scipy = bench_bundle.best_ms(lambda: bench_bundle.scipy_solver(data, 1e-4), 3)[1]
    yield "bundle adjustment, scipy's time / ours (11-14)", scipy / ours, 5.0, ">="


def main() -> int:
    """Print each figure beside its limit; return 1 where one is broken."""
    broken = 0
    for group in (detection, correspondence, adjustment):
        for name, value, limit, sense in group():
            met = value <= limit if sense == "<=" else value >= limit
            broken += not met
            print(f"{name:55s} {value:8.3f}  {sense} {limit:g}  {'met' if met else 'BROKEN'}", flush=True)
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
