"""A plan's prediction compared with its simulation: images of the planned cameras, calibrated from images."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.truth import Truth
from scenarios.run.scenario import RunResult, run_scenario
from scenarios.spec.scenario import load_scenario
from scenarios.studies.plan.plan import Plan, predicted_of
from scenarios.studies.plan.room import options_of, room_of
from scenarios.studies.plan.scenario import SCENARIO_FILE, subjects_of
from scenarios.types import RunOptions

DRAWS = 200
"""Draws of each point's error, for quantiles of all points' errors together."""
MOST_FRAMES = 40
"""Most frames whose markers are predicted, evenly spaced."""


@dataclass(frozen=True)
class Verified:
    """Predicted and simulated errors of the same markers, at the same positions [m]."""

    predicted_rms_m: float
    simulated_rms_m: float
    simulated_low_m: float
    simulated_high_m: float
    """``simulated_low_m`` to this: 95 % interval by the noise of this take; the calibration is one draw."""
    predicted_p95_m: float
    simulated_p95_m: float
    predicted_unseen: float
    """Share of markers and frames that are visible to fewer cameras than a point needs."""
    simulated_unseen: float
    """Share for which fewer than two cameras see at least half of the marker."""
    completeness: float

    @property
    def ratio(self) -> float:
        """Predicted over simulated rms error."""
        return self.predicted_rms_m / self.simulated_rms_m

    def document(self) -> dict[str, Any]:
        """Return the comparison in the form of the result file."""
        return {**asdict(self), "ratio": self.ratio}


def verify(
    plan: Plan, folder: Path, workers: int = 1, stage: Callable[[str], None] | None = None, *, seed: int | None = None
) -> tuple[Verified, RunResult]:
    """Run the scenario in ``folder``; return its errors with the predicted ones, and the run.

    The prediction is that of a target alone. What many targets show of the cameras' turns is therefore not used here.
    ``stage``: called with the name of each stage. ``seed``: of the simulation; default: the scenario's.
    """
    spec = load_scenario(folder / SCENARIO_FILE, ("pipeline.match.turns=false",))
    if seed is not None:
        spec = spec.model_copy(update={"seed": seed})
    run = run_scenario(spec, "plan", folder, RunOptions(workers=workers, stage=stage))
    assert run.truth is not None
    assert isinstance(run.truth, Truth)
    sigma, errors, seen, unseen = _at_truth(plan, run.truth)
    metrics = {one.name: one for one in run.record.metrics}
    rms = metrics["position_rms"]
    low, high = rms.ci95 if rms.ci95 is not None else (rms.value, rms.value)
    verified = Verified(
        float(np.sqrt(np.mean(sigma**2))), rms.value, low, high, float(np.quantile(errors, 0.95)),
        metrics["position_p95"].value, unseen, float(np.mean(seen < 2)), metrics["completeness"].value,
    )  # fmt: skip
    return verified, run


def _at_truth(plan: Plan, truth: Truth) -> tuple[Array, Array, Array, float]:
    """Return sigma of markers that are predicted to be seen, draws of their errors, the number of cameras that truly
    see each marker, and the share predicted to be unseen.
    """
    spec, best = plan.spec, plan.best
    subjects = subjects_of(spec)
    frames = np.unique(np.linspace(0, len(truth.xyz) - 1, MOST_FRAMES).round().astype(int))
    order = [truth.names.index(name) for name in subjects.names]
    xyz = np.asarray(truth.xyz)[frames][:, order]
    rows = best.layout.rows(plan.mounts, np.array([one.row for one in options_of(spec)]))
    draw = np.random.default_rng(spec.seed)
    sigma, errors, total, unseen = [], [], 0, 0
    for normal in np.unique(subjects.normals, axis=0):
        points = xyz[:, (subjects.normals == normal).all(axis=1)].reshape(-1, 3)
        facing = normal[None] if normal.any() else np.empty((0, 3))
        found = predicted_of(spec, best.rig, rows, room_of(spec, points, facing))
        good = np.isfinite(found.covariance[:, 0, 0, 0])
        total += len(points)
        unseen += int((~np.isfinite(found.sigma_m)).sum())
        sigma.append(np.sqrt(np.trace(found.covariance[good, 0], axis1=1, axis2=2)))
        roots = np.linalg.cholesky(found.covariance[good, 0])
        errors.append(np.linalg.norm(np.einsum("nij,nkj->nki", roots, draw.standard_normal((len(roots), DRAWS, 3))),
                                     axis=2).ravel())  # fmt: skip
    seen = (np.asarray(truth.visible)[frames][:, order] >= 0.5).sum(axis=2)
    known = np.concatenate(sigma)
    return known, np.concatenate(errors), seen, unseen / total
