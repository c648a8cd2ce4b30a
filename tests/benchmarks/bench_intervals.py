"""Are stated 95 % intervals of calibrations honest? Error against stated sigma over many runs.

Run: ``python tests/benchmarks/bench_intervals.py [--runs 200] [--workers 2] [CASE ...]``, cases as in ``CASES``.

Each run has a rig of four cameras (656 x 491 px), a target and noise of its own, drawn anew; the images are
projections in closed form with 0.02 px noise a mark and a shake of whole images (each exposure of each camera) of
0.03 px, or none. All but the seed is the production path: ``calibrate_rigid`` and the covariance that it states.
Compared are the cameras' poses and lens parameters, in the world of the estimate (``rigid_scenes.errors_of``).

Printed of each case: the pooled share of |error| <= 1.96 sigma, the 99 % band of it by bootstrap over runs (the
parameters of one run are not independent), the least covered parameters, rms of error / sigma by group.
"""

import argparse
import os
import sys
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "mosca"))

from rigid_scenes import board_marks, carried, errors_of, field_marks, seen, some_rig, still, stood

from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice

NOISE_PX, SHAKE_PX, MARK_SIGMA_M, PITCH_MM = 0.02, 0.03, 1e-5, 0.0099
CASES = ("field", "field-steady", "stands", "board", "board-steady", "field-opencv")
WITHIN = 1.959964
BOOTSTRAPS = 4000
POSES = ("turn", "X_m", "Y_m", "Z_m")


def run(case: str, seed: int) -> tuple[dict[str, tuple[float, float]], float, float, tuple[str, ...]]:
    """Return error and sigma of each parameter of one calibration, the shake found, sigma0, and the weak ones."""
    rng = np.random.default_rng([sum(map(ord, case)), seed])
    model = "opencv" if case.endswith("opencv") else "mosca"
    rig = some_rig(rng, model=model)
    shake = 0.0 if case.endswith("steady") else SHAKE_PX
    if case.startswith("board"):
        marks, poses, sigma = board_marks(), carried(rng, 60), 0.0
        facing = np.tile([0.0, 0.0, -1.0], (len(marks), 1))
    else:
        marks, facing = field_marks(rng), None
        poses, sigma = (stood(rng, 6, 5), MARK_SIGMA_M) if case == "stands" else (still(20), 0.0)
    sightings = seen(rig, marks, poses, rng, noise=NOISE_PX, shake=shake, facing=facing)
    given = marks + rng.normal(0, 1, marks.shape) * sigma
    settings = RigidSettings(LensChoice(model, PITCH_MM))
    done = calibrate_rigid(sightings, RigidTarget("target", given, sigma), settings)
    return errors_of(done, rig, poses), done.body_px, done.sigma0, done.weak


def coverage_band(inside: list[np.ndarray], share: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the pooled share of True in ``inside`` (one array a run) and its ``share`` band, by bootstrap."""
    hits, counts = (np.array([f(one) for one in inside], dtype=float) for f in (np.sum, len))
    pick = rng.integers(0, len(hits), (BOOTSTRAPS, len(hits)))
    shares = hits[pick].sum(axis=1) / counts[pick].sum(axis=1)
    low, high = np.quantile(shares, [(1 - share) / 2, (1 + share) / 2])
    return float(hits.sum() / counts.sum()), float(low), float(high)


def report(case: str, results: list, seconds: float) -> None:
    """Print the table of a case."""
    ratios: dict[str, list[float]] = defaultdict(list)
    inside = []
    for errors, *_ in results:
        ratio = {name: error / sigma for name, (error, sigma) in errors.items()}
        inside.append(np.abs(list(ratio.values())) <= WITHIN)
        for name, value in ratio.items():
            ratios[name].append(value)
    pooled, low, high = coverage_band(inside, 0.99, np.random.default_rng(1))
    shares = {name: float(np.mean(np.abs(r) <= WITHIN)) for name, r in ratios.items()}
    least = sorted(shares, key=shares.__getitem__)[:4]
    by_run = np.array([np.mean(one) for one in inside])
    body, sigma0 = (np.array([r[k] for r in results]) for k in (1, 2))
    weak = sum(len(r[3]) for r in results) / len(results)
    honest = "holds 95 %" if low <= 0.95 <= high else "95 % OUTSIDE"
    print(
        f"{case}: {len(results)} runs, {len(shares)} parameters, pooled {100 * pooled:.2f} %, 99 % band "
        f"{100 * low:.2f} to {100 * high:.2f} ({honest}); {seconds / len(results):.1f} s a run"
    )
    print("  least covered: " + ", ".join(f"{n} {100 * shares[n]:.1f} % of {len(ratios[n])}" for n in least))
    groups: dict[str, list[float]] = defaultdict(list)
    for name, r in ratios.items():
        own = name.split(".")[1]
        groups["turns" if own.startswith("turn") else "positions" if own in POSES else own] += r
    line = ", ".join(f"{name} {np.sqrt(np.mean(np.square(r))):.3f}" for name, r in groups.items())
    print(f"  rms error / sigma: {line}")
    print(
        f"  runs below 80 %: {np.sum(by_run < 0.8)}; shake {body.mean():.4f} +- {body.std():.4f} px, sigma0 "
        f"{sigma0.mean():.4f} +- {sigma0.std():.4f}, weak parameters a run {weak:.2f}",
        flush=True,
    )


def main() -> None:
    """Run the requested cases."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("cases", nargs="*", default=CASES, metavar="CASE")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers) as pool:
        for case in given.cases:
            start = time.perf_counter()
            seeds = range(given.first, given.first + given.runs)
            report(case, list(pool.map(partial(run, case), seeds)), time.perf_counter() - start)


if __name__ == "__main__":
    main()
