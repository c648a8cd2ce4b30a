"""The metrics of a run, one table: unit, kind of quantity, whether a limit is an upper or a lower one, its range."""

import math
from typing import Literal, NamedTuple

Sense = Literal["at_most", "at_least"]
Quantity = Literal["length", "share", "count", "ratio", "ppm", "image", "angle", "time", "rate"]

LONGEST_M = 1000.0
"""As far as a rig file lets a camera stand from the origin: a larger one was given in millimetres."""


class MetricKind(NamedTuple):
    """What a metric is."""

    unit: str
    """Of its value and of a limit that is a bare number."""
    sense: Sense
    quantity: Quantity

    @property
    def highest(self) -> float:
        """The largest limit that means anything, in ``unit``; the smallest is 0 (see ``allows``)."""
        return {"length": LONGEST_M, "share": 1.0, "angle": math.pi}.get(self.quantity, math.inf)

    def allows(self, limit: float) -> bool:
        """Return whether a limit [unit] means anything: a lower limit of 0 could never be broken."""
        above = limit > 0 if self.sense == "at_least" else limit >= 0
        return math.isfinite(limit) and above and limit <= self.highest


METRICS = {
    "position_rms": MetricKind("m", "at_most", "length"),
    "position_p95": MetricKind("m", "at_most", "length"),
    "position_max": MetricKind("m", "at_most", "length"),
    "relative_accuracy": MetricKind("1", "at_most", "share"),
    "sets_complete": MetricKind("1", "at_least", "share"),
    "frames_complete": MetricKind("1", "at_least", "share"),
    "completeness": MetricKind("1", "at_least", "share"),
    "ghosts_per_frame": MetricKind("1", "at_most", "count"),
    "identity_switches": MetricKind("1", "at_most", "count"),
    "hota": MetricKind("1", "at_least", "share"),
    "nees": MetricKind("1", "at_most", "ratio"),
    "coverage95": MetricKind("1", "at_least", "share"),
    "efficiency": MetricKind("1", "at_least", "share"),
    "efficiency_detection": MetricKind("1", "at_least", "share"),
    "body_position_rms": MetricKind("m", "at_most", "length"),
    "body_angle_rms": MetricKind("rad", "at_most", "angle"),
    "body_completeness": MetricKind("1", "at_least", "share"),
    "reprojection_rms": MetricKind("px", "at_most", "image"),
    "calibration_rays_rms": MetricKind("px", "at_most", "image"),
    "calibration_volume_rms": MetricKind("m", "at_most", "length"),
    "calibration_sigma_x": MetricKind("m", "at_most", "length"),
    "calibration_sigma_y": MetricKind("m", "at_most", "length"),
    "clock_frames": MetricKind("1", "at_most", "ratio"),
    "clock_drift_ppm": MetricKind("1", "at_most", "ppm"),
    "over_synchronous": MetricKind("1", "at_most", "ratio"),
    "rms_linear": MetricKind("m", "at_most", "length"),
    "rms_cubic": MetricKind("m", "at_most", "length"),
    "rms_neural": MetricKind("m", "at_most", "length"),
    "lamps_found": MetricKind("1", "at_least", "share"),
    "lamp_px": MetricKind("px", "at_most", "image"),
    "camera_position_rms": MetricKind("m", "at_most", "length"),
    "camera_angle_rms": MetricKind("rad", "at_most", "angle"),
    "length_rms": MetricKind("m", "at_most", "length"),
    "length_max": MetricKind("m", "at_most", "length"),
    "rigidity_rms": MetricKind("m", "at_most", "length"),
    "static_noise": MetricKind("m", "at_most", "length"),
    "latency_p99": MetricKind("s", "at_most", "time"),
    "frame_rate": MetricKind("1/s", "at_least", "rate"),
}
"""Metrics that a scenario can limit."""


def kind_of(name: str) -> MetricKind | None:
    """Return what a metric is: its own row, else that of the longest name that it starts with, else None.

    So ``efficiency_match`` or ``efficiency.match`` of a stage is read as ``efficiency`` is.
    """
    names = [known for known in METRICS if name == known or name.startswith((known + "_", known + "."))]
    return METRICS[max(names, key=len)] if names else None
