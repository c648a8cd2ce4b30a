"""A flight in closed loop compared with the truth: path, prediction, delay, crash. Pure: no files, no clocks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.closed_loop.delay import DelayEstimate
from scenarios.score.tracks import block_of, ratio_of_sums
from scenarios.types import Score


@dataclass(frozen=True, eq=False)
class FlownPath:
    """A flight, control step by control step (n)."""

    time_s: Array
    position: Array
    """(n, 3) true [m]."""
    wanted: Array
    """(n, 3) [m]"""
    estimated: Array
    """(n, 3) predicted for each instant [m]; NaN before the first pose."""
    covariance: Array
    """(n, 3, 3) covariance of ``estimated`` [m^2]."""
    pose_age_s: Array
    """(n,) age of the newest fused pose."""
    calibration_m2: Array
    """(3, 3) covariance of the error of the calibration, which all poses share [m^2]."""
    pose_sigma_m: float
    """Rms over the poses of the stated standard deviation of their positions, 3D [m]."""
    true_delay_s: float
    believed_delay_s: float
    crash: str
    """The crash in words; "" where there was none."""
    crashed_s: float
    scored_from_s: float

    @property
    def scored(self) -> Array:
        """Whether each step is scored (n,) bool."""
        mask: Array = (self.time_s >= self.scored_from_s) & (self.time_s < self.crashed_s)
        return mask


def flight_scores(path: FlownPath, delay: DelayEstimate | None) -> dict[str, Score]:
    """Return the metrics of a flight; after a crash there is nothing to score."""
    scores = {"crashes": Score(float(bool(path.crash)), 1)}
    rows = np.flatnonzero(path.scored)
    if len(rows):
        block = block_of(len(rows))
        count = np.bincount(block).astype(float)
        off2 = ((path.position[rows] - path.wanted[rows]) ** 2).sum(axis=1)
        error = path.estimated[rows] - path.position[rows]
        rms = ratio_of_sums(np.bincount(block, off2), count, len(rows), np.sqrt)
        scores["flight_rms"] = rms
        scores["flight_max"] = Score(float(np.sqrt(off2.max())), len(rows))
        if path.pose_sigma_m > 0:
            low, high = rms.ci95 or (rms.value, rms.value)
            sigma = path.pose_sigma_m
            scores["flight_sigma_ratio"] = Score(rms.value / sigma, len(rows), (low / sigma, high / sigma))
        known = np.isfinite(error).all(axis=1)
        if known.all():
            squared = (error**2).sum(axis=1)
            nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(path.covariance[rows] + path.calibration_m2), error)
            scores["prediction_rms"] = ratio_of_sums(np.bincount(block, squared), count, len(rows), np.sqrt)
            scores["prediction_nees"] = ratio_of_sums(np.bincount(block, nees), count, len(rows))
    if delay is not None:
        scores["pose_delay"] = Score(delay.delay_s, delay.poses, delay.ci95)
        scores["pose_delay_error"] = Score(abs(delay.delay_s - path.true_delay_s), delay.poses)
        scores["pose_delay_mismatch"] = Score(abs(delay.delay_s - path.believed_delay_s), delay.poses)
    return scores


def joined(steps: Sequence[Any], **rest: Any) -> FlownPath:
    """Return the path of control steps, which have the fields of ``FlownPath`` with one value per step.

    ``rest``: the other fields.
    """
    names = ("time_s", "position", "wanted", "estimated", "covariance", "pose_age_s")
    columns: dict[str, Any] = {name: np.array([getattr(step, name) for step in steps]) for name in names}
    return FlownPath(**columns, **rest)
