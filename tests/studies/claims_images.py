"""Verdicts of ``mosca claim`` on virtual rigs through rendered images, beside the truth of many other runs.

    python -m tests.studies.claims_images [--rigs 20] [--truth-runs 100] [--seed 1] [--out runs/claims_images]

Each kind of rig is the scenario controls/none with other cameras, markers and noise. In each run its cameras stand
elsewhere, shake by another amount, and one was turned by an unknown angle since it was calibrated. Its truth is the
rms of the position errors over ``--truth-runs`` runs with seeds that no campaign has. The limit of its claim is that
truth divided by a number drawn uniformly in 0.5 to 1.5. Where the truth's interval holds the limit, the truth is then
estimated from four times as many runs, whatever the verdict. The claim files stay in ``--out``: ``mosca claim``
repeats each.
"""

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from scenarios.spec.claim import ClaimFile
from scenarios.studies.campaign.campaign import run_claim
from scenarios.studies.campaign.collect import collect
from scenarios.studies.campaign.engine import Engine, LocalEngine
from scenarios.studies.campaign.tasks import run_tasks
from scenarios.studies.campaign.worker import Work, run_task

METRIC = "position_rms"
RUNS = 200
TRUTH_SEED = 1_000_000
"""First seed of the runs of the truths; campaigns have seeds below."""
MORE = 4
"""So many times as many runs has the truth of a rig whose interval holds the limit; the limit stays."""
HEAD = (
    "| rig | cameras | truth, 95 % [mm] | truth over limit | verdict | found, 95 % [mm] | runs |\n"
    "|---|---|---|---|---|---|---|"
)


def rig_kind(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a kind of rig: ``set`` and ``vary`` of its claim file."""
    shared = {
        "capture.duration_s": 0.1,
        "calibration.target": "none",
        "scene.markers": int(rng.integers(8, 17)),
        "cameras.count": int(rng.integers(3, 7)),
        "cameras.radius_m": round(rng.uniform(1.6, 2.2), 3),
        "cameras.height_m": round(rng.uniform(0.2, 0.8), 3),
        "errors.body_px": round(rng.uniform(0.02, 0.1), 4),
        "fault.kind": "turned_camera",
        "fault.camera": "cam1",
    }
    turned_px = round(rng.uniform(0.05, 0.3), 4)
    spread = round(rng.uniform(1.1, 1.5), 3)
    vary = [
        {"kind": "normal", "key": "fault.turn_px", "sigma": turned_px},
        {"kind": "lognormal", "key": "errors.body_px", "by": "scale", "factor": spread},
        {"kind": "normal", "key": "cameras.radius_m", "by": "add", "sigma": 0.03},
        {"kind": "uniform", "key": "scene.speed_mps", "low": 0.2, "high": 1.0},
    ]
    return {"set": shared, "vary": vary}


def claim_document(kind: dict[str, Any], limit_m: float, seed: int, runs: int) -> dict[str, Any]:
    """Return the content of a claim file: rigs of this kind measure to ``limit_m`` rms."""
    claimed = [{"metric": METRIC, "limit": limit_m, "statistic": "rms"}]
    about = {"title": "rigs of one kind", "scenario": "controls/none", "seed": seed, "runs": runs}
    return {**about, **kind, "claim": claimed}


@dataclass(frozen=True)
class Judged:
    """A kind of rig, its truth with an interval [m], and the verdict of its claim."""

    cameras: int
    truth: float
    low: float
    high: float
    limit: float
    verdict: str
    found: tuple[float, float, float]
    """Figure of the campaign and the ends of its interval [m]."""
    runs: int

    @property
    def false_accept(self) -> bool:
        """Found conforming, and is not."""
        return self.verdict == "conforming" and self.truth > self.limit

    @property
    def false_reject(self) -> bool:
        """Found not conforming, and conforms."""
        return self.verdict == "not conforming" and self.truth <= self.limit

    @property
    def intervals_meet(self) -> bool:
        """Whether the intervals of the campaign and of the truth have a common part."""
        return self.found[1] <= self.high and self.found[2] >= self.low

    def row(self, name: object) -> str:
        """Return a line of the table."""
        mm = [1e3 * value for value in (self.truth, self.low, self.high, *self.found)]
        return (
            f"| {name} | {self.cameras} | {mm[0]:.4f} ({mm[1]:.4f} .. {mm[2]:.4f}) | {self.truth / self.limit:.3f} | "
            f"{self.verdict} | {mm[3]:.4f} ({mm[4]:.4f} .. {mm[5]:.4f}) | {self.runs} |"
        )


def truth_of(kind: dict[str, Any], runs: int, engine: Engine, work: Work = run_task) -> tuple[float, float, float]:
    """Return the rms over ``runs`` runs and the ends of its interval of 95 % (normal approximation) [m]."""
    claim = ClaimFile.model_validate(claim_document(kind, 1.0, TRUTH_SEED, runs))
    outcomes = collect(run_tasks(claim, Path("truth.toml")), engine, lambda done: len(done) + 1, work=work)
    failed = [one.failed for one in outcomes if METRIC not in one.metrics]
    if failed:
        raise RuntimeError(f"{len(failed)} runs of the truth failed, the first: {failed[0]}")
    squares = np.array([one.metrics[METRIC] for one in outcomes]) ** 2
    half = 1.96 * squares.std(ddof=1) / len(squares) ** 0.5
    low, middle, high = np.sqrt([max(squares.mean() - half, 0.0), squares.mean(), squares.mean() + half])
    return float(middle), float(low), float(high)


def judged(
    kind: dict[str, Any], ratio: float, seed: int, truth_runs: int, engine: Engine, path: Path, work: Work = run_task
) -> Judged:
    """Return the verdict on rigs of a kind whose truth is ``ratio`` times the limit; ``path``: of the claim file."""
    truth, low, high = truth_of(kind, truth_runs, engine, work)
    limit = truth / ratio
    path.write_text(tomli_w.dumps(claim_document(kind, limit, seed, RUNS)), encoding="utf-8")
    result = run_claim(path, engine, work=work)
    one = result.document["claims"][0]
    if low <= limit <= high:  # the truth does not show on which side of the limit it is
        truth, low, high = truth_of(kind, MORE * truth_runs, engine, work)
    found = (one["estimate"], one["low"] or 0.0, np.inf if one["high"] is None else one["high"])
    return Judged(kind["set"]["cameras.count"], truth, low, high, limit, result.verdict, found, one["runs"])


def summary(rigs: Sequence[Judged]) -> str:
    """Return the shares of false and missing verdicts."""
    counts: dict[str, Callable[[Judged], bool]] = {
        "false accept": lambda one: one.false_accept,
        "false reject": lambda one: one.false_reject,
        "undecided": lambda one: one.verdict == "undecided",
        "intervals of campaign and truth meet": lambda one: one.intervals_meet,
    }
    return ", ".join(f"{name}: {sum(map(test, rigs))} of {len(rigs)}" for name, test in counts.items())


def main() -> None:
    """Print the table."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--rigs", type=int, default=20)
    given.add_argument("--truth-runs", type=int, default=100)
    given.add_argument("--seed", type=int, default=1)
    given.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given.add_argument("--out", type=Path, default=Path("runs/claims_images"))
    options = given.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(options.seed)
    drawn = [(rig_kind(rng), rng.uniform(0.5, 1.5)) for _ in range(options.rigs)]
    engine = LocalEngine(options.jobs)
    found = []
    print(HEAD)
    try:
        for k, (kind, ratio) in enumerate(drawn, start=1):
            path = options.out / f"rig_{k:02}.toml"
            found.append(judged(kind, ratio, 1 + 1000 * k, options.truth_runs, engine, path))
            print(found[-1].row(k), flush=True)
    finally:
        engine.close()
    print(summary(found))


if __name__ == "__main__":
    main()
