"""Table of the metrics of a run: unit, kind of quantity, whether more or less is better, how runs are compared."""

import math
from typing import Literal, NamedTuple

Sense = Literal["at_most", "at_least"]
Combination = Literal["mean", "root_mean", "extreme"]
Quantity = Literal["length", "share", "count", "ratio", "ppm", "image", "angle", "time", "rate", "speed", "turning"]

LONGEST_M = 1000.0
"""Largest length: the largest distance of a camera from the origin in a rig file. A larger one was given in mm."""


class MetricKind(NamedTuple):
    """Kind of a metric."""

    unit: str
    """Unit of its value, and of a limit that is a bare number."""
    sense: Sense
    """Sense of a limit; less is better where it is an upper limit."""
    quantity: Quantity
    made_by: Combination = "mean"
    """Computation from blocks. "mean": sum(sums) / sum(weights); "root_mean": the square root of that; "extreme": the
    largest of sums / weights."""
    wanted: float | None = None
    """The ideal value where neither less nor more is better: values farther from it are worse."""
    speed: bool = False
    """Whether the metric depends on the machine."""
    shown_in: str = ""
    """Unit in which pages always show the metric; "": the unit that reads best."""

    @property
    def highest(self) -> float:
        """The largest meaningful limit, in ``unit``; the smallest is 0 (see ``allows``)."""
        return {"length": LONGEST_M, "share": 1.0, "angle": math.pi}.get(self.quantity, math.inf)

    def allows(self, limit: float) -> bool:
        """Return whether a limit [unit] is meaningful: a lower limit of 0 could never be broken."""
        above = limit > 0 if self.sense == "at_least" else limit >= 0
        return math.isfinite(limit) and above and limit <= self.highest


METRICS = {
    "position_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "position_p95": MetricKind("m", "at_most", "length"),
    "position_max": MetricKind("m", "at_most", "length", "extreme"),
    "relative_accuracy": MetricKind("1", "at_most", "share", "root_mean"),
    "sets_complete": MetricKind("1", "at_least", "share"),
    "frames_complete": MetricKind("1", "at_least", "share"),
    "completeness": MetricKind("1", "at_least", "share"),
    "rays_used": MetricKind("1", "at_least", "share"),
    "ghosts_per_frame": MetricKind("1", "at_most", "count"),
    "identity_switches": MetricKind("1", "at_most", "count"),
    "hota": MetricKind("1", "at_least", "share"),
    "nees": MetricKind("1", "at_most", "ratio", wanted=3.0),
    "coverage95": MetricKind("1", "at_least", "share", wanted=0.95),
    "efficiency": MetricKind("1", "at_least", "share"),
    "efficiency_detection": MetricKind("1", "at_least", "share"),
    "body_position_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "body_angle_rms": MetricKind("rad", "at_most", "angle", "root_mean"),
    "body_completeness": MetricKind("1", "at_least", "share"),
    "joint_center_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "joint_angle_rms": MetricKind("rad", "at_most", "angle", "root_mean", shown_in="deg"),
    "joint_center_nees": MetricKind("1", "at_most", "ratio", wanted=3.0),
    "joint_angle_nees": MetricKind("1", "at_most", "ratio", wanted=3.0),
    "joint_center_coverage95": MetricKind("1", "at_least", "share", wanted=0.95),
    "joint_angle_coverage95": MetricKind("1", "at_least", "share", wanted=0.95),
    "joint_completeness": MetricKind("1", "at_least", "share"),
    "v_x_rms": MetricKind("m/s", "at_most", "speed", "root_mean"),
    "v_x_nees": MetricKind("1", "at_most", "ratio", wanted=1.0),
    "v_x_fit_ratio": MetricKind("1", "at_least", "ratio"),
    "yaw_rate_rms": MetricKind("rad/s", "at_most", "turning", "root_mean"),
    "yaw_rate_nees": MetricKind("1", "at_most", "ratio", wanted=1.0),
    "yaw_rate_fit_ratio": MetricKind("1", "at_least", "ratio"),
    "object_position_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "object_angle_rms": MetricKind("rad", "at_most", "angle", "root_mean"),
    "object_nees": MetricKind("1", "at_most", "ratio", wanted=3.0),
    "object_age_p99": MetricKind("s", "at_most", "time"),
    "objects_current": MetricKind("1", "at_least", "share"),
    "label_f1": MetricKind("1", "at_least", "share"),
    "label_switches": MetricKind("1", "at_most", "count"),
    "modes_found": MetricKind("1", "at_least", "share"),
    "mode_frequency_error": MetricKind("1", "at_most", "share"),
    "mode_damping_error": MetricKind("1", "at_most", "ratio"),
    "mode_mac": MetricKind("1", "at_least", "share"),
    "noise_floor_ratio": MetricKind("1", "at_most", "ratio", wanted=1.0),
    "self_position_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "self_angle_rms": MetricKind("rad", "at_most", "angle", "root_mean", shown_in="deg"),
    "self_nees": MetricKind("1", "at_most", "ratio", wanted=6.0),
    "self_completeness": MetricKind("1", "at_least", "share"),
    "rig_camera_position_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "rig_camera_angle_rms": MetricKind("rad", "at_most", "angle", "root_mean", shown_in="deg"),
    "rig_camera_nees": MetricKind("1", "at_most", "ratio", wanted=6.0),
    "light_clock_error": MetricKind("s", "at_most", "time"),
    "budget_explained": MetricKind("1", "at_least", "share"),
    "flight_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "flight_max": MetricKind("m", "at_most", "length", "extreme"),
    "flight_sigma_ratio": MetricKind("1", "at_most", "ratio", "root_mean"),
    "prediction_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "prediction_nees": MetricKind("1", "at_most", "ratio", wanted=3.0),
    "crashes": MetricKind("1", "at_most", "count"),
    "pose_delay": MetricKind("s", "at_most", "time"),
    "pose_delay_error": MetricKind("s", "at_most", "time"),
    "pose_delay_mismatch": MetricKind("s", "at_most", "time"),
    "reprojection_rms": MetricKind("px", "at_most", "image", "root_mean"),
    "calibration_rays_rms": MetricKind("px", "at_most", "image", "root_mean"),
    "calibration_volume_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "calibration_sigma_x": MetricKind("m", "at_most", "length"),
    "calibration_sigma_y": MetricKind("m", "at_most", "length"),
    "clock_frames": MetricKind("1", "at_most", "ratio"),
    "clock_drift_ppm": MetricKind("1", "at_most", "ppm"),
    "over_synchronous": MetricKind("1", "at_most", "ratio"),
    "rms_linear": MetricKind("m", "at_most", "length", "root_mean"),
    "rms_cubic": MetricKind("m", "at_most", "length", "root_mean"),
    "rms_neural": MetricKind("m", "at_most", "length", "root_mean"),
    "lamps_found": MetricKind("1", "at_least", "share"),
    "lamp_px": MetricKind("px", "at_most", "image"),
    "camera_position_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "camera_angle_rms": MetricKind("rad", "at_most", "angle", "root_mean"),
    "length_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "length_max": MetricKind("m", "at_most", "length"),
    "length_error_share": MetricKind("1", "at_most", "ratio"),
    "cluster_error_share": MetricKind("1", "at_most", "ratio"),
    "rigidity_rms": MetricKind("m", "at_most", "length", "root_mean"),
    "static_noise": MetricKind("m", "at_most", "length", "root_mean"),
    "latency_p99": MetricKind("s", "at_most", "time", speed=True),
    "frame_rate": MetricKind("1/s", "at_least", "rate", speed=True),
}
"""Metrics that a scenario can limit. Their blocks hold, as (sums, weights) of each block:

position_rms (sum of squared 3D errors [m^2], samples); relative_accuracy (the same sums, samples times the
working space squared [m^2]); other root mean squares (sum of squares, items); position_p95 (the block's own p95 times
samples, samples); position_max (the block's largest, 1); completeness (matched, visible); rays_used (images from
which points were made, cameras that saw their markers); ghosts_per_frame (ghosts, frames); identity_switches
(switches, 1 / number of blocks); nees (sum of NEES, samples); coverage95 (samples inside, samples); hota and
efficiency (the block's own figure times samples, samples); latency_p99 and frame_rate (the block's own figure times
frames, frames). A block without samples has weight 0."""


def kind_of(name: str) -> MetricKind | None:
    """Return the kind of a metric: its own row, else that of the longest name that it starts with, else None.

    So ``efficiency_match`` or ``efficiency.match`` of a stage has the kind of ``efficiency``.
    """
    names = [known for known in METRICS if name == known or name.startswith((known + "_", known + "."))]
    return METRICS[max(names, key=len)] if names else None
