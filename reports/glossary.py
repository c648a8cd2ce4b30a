"""Glossary: the meaning of each metric of a record in a plain sentence, with its formula and the source of that."""

from typing import NamedTuple


class Term(NamedTuple):
    """An entry of the glossary."""

    sentence: str
    formula: str = ""
    """Formula of the metric, and its source."""


_RMS = "square root of the mean of the squares"
_NEES = "mean of e' C^-1 e, e: error, C: stated covariance (Bar-Shalom, Li and Kirubarajan 2001, section 5.4)"

GLOSSARY = {
    "position_rms": Term("Typical 3D distance of measured markers from the true ones.", f"{_RMS} over all samples"),
    "position_p95": Term("95 of 100 samples are nearer to the truth than this.", "95 % quantile of the 3D distances"),
    "position_max": Term("The largest 3D distance of any sample from the truth.", "maximum of the 3D distances"),
    "relative_accuracy": Term(
        "Position error as a share of the working space, so that small and large set-ups compare.",
        "rms position error / longest edge of the working space",
    ),
    "sets_complete": Term(
        "Share of trigger pulses from which a frame set of all cameras came.", "complete frame sets / pulses"
    ),
    "frames_complete": Term(
        "Share of the expected frames that arrived, of the camera that delivered least.", "usable / expected frames"
    ),
    "completeness": Term(
        "Share of the visible markers that were measured; visible: at least half of the disc in two cameras.",
        "matched / (frame, marker) pairs that could be seen, from the truth alone",
    ),
    "rays_used": Term(
        "Share of the cameras' views of measured markers that went into the measured points.",
        "cameras that a sample was made of / cameras that saw its marker",
    ),
    "ghosts_per_frame": Term("Measured points a frame that belong to no marker.", "unmatched samples / frames"),
    "identity_switches": Term(
        "How often a marker is followed by another track than before.", "changes of the track's number, all markers"
    ),
    "hota": Term(
        "One figure for finding markers and keeping them apart; 1 is perfect. It falls with misses, ghosts, position "
        "errors and exchanged identities.",
        "mean over alpha of sqrt(detection x association accuracy) (Luiten et al. 2021, HOTA)",
    ),
    "nees": Term(
        "Whether the stated covariance is right: 3 where it is, above 3 where the real errors are larger than "
        "stated, below where they are smaller.",
        f"normalised estimation error squared, {_NEES}",
    ),
    "coverage95": Term(
        "Share of the samples whose error lies inside the stated 95 % ellipsoid; 0.95 where the covariance is right.",
        "share with e' C^-1 e <= 7.81, the 95 % quantile of chi-squared with 3 degrees of freedom",
    ),
    "efficiency": Term(
        "How near the position errors come to the smallest that the noise of the images allows; 1 is the limit.",
        "Cramer-Rao bound / mean squared error, in space (Kay 1993, section 3.9)",
    ),
    "efficiency_detection": Term(
        "The same for the image points alone.", "Cramer-Rao bound / mean squared error, in the image (Kay 1993)"
    ),
    "body_position_rms": Term("Typical error of the position of rigid bodies.", f"{_RMS} over bodies and frames"),
    "body_angle_rms": Term(
        "Typical error of the orientation of rigid bodies.", f"angle of the rotation from truth to estimate, {_RMS}"
    ),
    "body_completeness": Term("Share of the frames in which a body's pose was found.", "found / possible poses"),
    "joint_center_rms": Term(
        "Typical distance of a person's joint centres from the true ones.",
        f"{_RMS} over hips, knees, ankles, shoulders, elbows, wrists",
    ),
    "joint_angle_rms": Term(
        "Typical error of a joint's rotation about each of its three axes.",
        f"components of r in R_true = R exp([r]), distal axes, {_RMS}",
    ),
    "joint_center_nees": Term("Whether the stated covariance of joint centres is right: 3 where it is.", _NEES),
    "joint_angle_nees": Term("Whether the stated covariance of joint rotations is right: 3 where it is.", _NEES),
    "joint_center_coverage95": Term(
        "Share of the joint centres inside their stated 95 % ellipsoid.", "as coverage95"
    ),
    "joint_angle_coverage95": Term(
        "Share of the joint rotations inside their stated 95 % ellipsoid.", "as coverage95"
    ),
    "joint_completeness": Term(
        "Share of the joint centres and rotations that have an estimate.", "estimated / those that the truth knows"
    ),
    "v_x_rms": Term(
        "Typical error of the robot's forward speed.", f"against true means over a frame's period, {_RMS}"
    ),
    "v_x_nees": Term("Whether the stated variance of the forward speed is right: 1 where it is.", _NEES),
    "v_x_fit_ratio": Term(
        "How well the identified model predicts the forward speed on a drive it has not seen; 1: as well as the best "
        "linear model of the true motion.",
        "fit of the model / of the best linear one (docs/identification.md)",
    ),
    "yaw_rate_rms": Term(
        "Typical error of the robot's turning rate.", f"against true means over a frame's period, {_RMS}"
    ),
    "yaw_rate_nees": Term("Whether the stated variance of the turning rate is right: 1 where it is.", _NEES),
    "yaw_rate_fit_ratio": Term(
        "The same as v_x_fit_ratio for the turning rate.",
        "fit of the model / of the best linear one (docs/identification.md)",
    ),
    "label_f1": Term(
        "How well markers got their names; 1 where every one has the right one.",
        "F1 = 2 right / (samples with a label + samples that are a true marker)",
    ),
    "label_switches": Term("How often a marker gets another name than before.", "changes of the label, all markers"),
    "modes_found": Term("Share of the panel's true modes that were found.", "found within 5 % in frequency / true"),
    "mode_frequency_error": Term("Relative error of the worst mode's frequency.", "|measured - true| / true"),
    "mode_damping_error": Term(
        "Error of the worst mode's damping, as a share of what is allowed.",
        "relative error / (15 % or twice the bound)",
    ),
    "mode_mac": Term(
        "How alike the measured and the true shape of the worst mode are; 1 for the same shape.",
        "modal assurance criterion |a' b|^2 / (a'a b'b) (Allemang 2003)",
    ),
    "noise_floor_ratio": Term(
        "Noise of the measured vibration against what the tracks state; 1 where that is right.", "measured / expected"
    ),
    "self_position_rms": Term(
        "How far the camera's own poses, from a test field in its images, lie from the true ones.",
        f"{_RMS} over its frames",
    ),
    "self_angle_rms": Term(
        "How far the camera's own rotations are from the true ones.", f"{_RMS} of the rotation vector, 3D"
    ),
    "self_nees": Term(
        "Whether the covariance of the camera's own poses is right: 6 where it is.", f"{_NEES}; position and rotation"
    ),
    "self_completeness": Term(
        "Share of the camera's frames of which a pose was found.", "frames with a pose / frames"
    ),
    "rig_camera_position_rms": Term(
        "How far the same camera's poses by the rig lie from the true ones.", f"{_RMS} over its frames"
    ),
    "rig_camera_angle_rms": Term(
        "How far its rotations by the rig are from the true ones.", f"{_RMS} of the rotation vector, 3D"
    ),
    "rig_camera_nees": Term(
        "Whether the covariance of the camera's poses by the rig is right: 6 where it is.",
        f"{_NEES}; position and rotation",
    ),
    "light_clock_error": Term(
        "Error of the offset between the two recordings' clocks, found from a lamp that both see blink.",
        "|estimated - true offset|",
    ),
    "budget_explained": Term(
        "Share of the difference of the two sides that the listed sources of error explain, each switched off alone.",
        "sum over sources of sum(c' d) / sum(d' d), d: difference in position, c: what the source changes in it",
    ),
    "object_position_rms": Term(
        "How far virtual objects are from their bodies at the instant at which they are shown.",
        f"{_RMS} of distances",
    ),
    "object_angle_rms": Term(
        "How far virtual objects are turned from their bodies when they are shown.", f"{_RMS} of the rotation vector"
    ),
    "object_nees": Term(
        "Whether the covariance stated for what is shown is right: 3 where it is.", f"{_NEES}; positions"
    ),
    "object_age_p99": Term(
        "Time from the exposure of what is shown to its display.", "99 % quantile over the displays"
    ),
    "objects_current": Term(
        "Share of the displays at which objects are shown from poses that are new enough.",
        "displays that are interpolated or extrapolated / displays",
    ),
    "flight_rms": Term(
        "How far the drone is from where it was to be, while it flies on the measured poses.", f"{_RMS} of distances"
    ),
    "flight_max": Term("The farthest that the drone came from where it was to be.", "maximum of the distances"),
    "flight_sigma_ratio": Term(
        "How many stated standard deviations of the poses the drone is off its path.",
        "rms off the path / rms of the poses' stated 3D standard deviation",
    ),
    "prediction_rms": Term(
        "How far the predicted position, by which the drone is steered, lies from the true one.",
        f"{_RMS} of distances",
    ),
    "prediction_nees": Term(
        "Whether the covariance of the predicted positions is right: 3 where it is.", f"{_NEES}; positions"
    ),
    "crashes": Term(
        "Whether the drone left the working space, came below 5 cm or tilted by more than 90 degrees.", "0 or 1"
    ),
    "pose_delay": Term(
        "Mean time from mid-exposure to the arrival of a pose, estimated from the flight's own log.",
        "maximum likelihood (Ljung 1999, section 7)",
    ),
    "pose_delay_error": Term("Error of that estimate.", "|estimated - true mean delay|"),
    "pose_delay_mismatch": Term(
        "Difference of the estimate from the delay that the predictor believes in.",
        "|estimated - believed mean delay|",
    ),
    "reprojection_rms": Term(
        "How far image points lie from the projections of their 3D points. It needs no truth, and is no error in "
        "space.",
        f"{_RMS} over samples",
    ),
    "calibration_rays_rms": Term(
        "How far the estimated cameras' rays miss what the pixels really show, in pixels.", f"{_RMS} over all images"
    ),
    "calibration_volume_rms": Term(
        "Error that the calibration alone gives to points in the working space.",
        f"noise-free grid, triangulated with the estimated rig, {_RMS}",
    ),
    "calibration_sigma_x": Term(
        "Stated standard deviation of the target's points across the field.", f"{_RMS} over points, x"
    ),
    "calibration_sigma_y": Term(
        "Stated standard deviation of the target's points up the field.", f"{_RMS} over points, y"
    ),
    "clock_frames": Term(
        "Largest error of a free camera's estimated clock offset, in frame periods.",
        "worst camera, worse end of the run",
    ),
    "clock_drift_ppm": Term(
        "Largest error of a free camera's estimated clock rate.", "worst camera, parts per million"
    ),
    "over_synchronous": Term(
        "Error without synchronisation against that of the same cameras triggered together.",
        "rms / rms, over samples that both measured",
    ),
    "rms_linear": Term("Position error with linear interpolation in place of our motion model.", _RMS),
    "rms_cubic": Term("Position error with cubic interpolation in place of our motion model.", _RMS),
    "rms_neural": Term("Position error with a neural motion model in place of ours.", _RMS),
    "lamps_found": Term(
        "Share of the body-worn cameras' lamps that another camera sees.", "seen in most frames / lamps"
    ),
    "lamp_px": Term("How far the lamps' images lie from where they should be.", f"{_RMS} over images"),
    "camera_position_rms": Term(
        "Typical error of the position of moving cameras.", f"{_RMS} over cameras and frames"
    ),
    "camera_angle_rms": Term(
        "Typical error of the orientation of moving cameras.", f"angle of the rotation from truth to estimate, {_RMS}"
    ),
    "length_rms": Term("Typical error of lengths that were certified beforehand.", f"measured - certified, {_RMS}"),
    "length_max": Term("Largest error of a certified length.", "maximum of |measured - certified|"),
    "length_error_share": Term(
        "Largest error of a test length on the measuring lines of an acceptance test, over what is permitted of it.",
        "maximum of |mean measured - calibrated| / min(A + K L, B)",
    ),
    "cluster_error_share": Term(
        "Largest figure of two clusters on a bar in an acceptance test, over its limit.",
        "maximum over rms, 99.7th percentile and largest error of distance and angle, and missing frames",
    ),
    "rigidity_rms": Term(
        "How far markers of a rigid body lie from their places in it.", f"after the best fit of the body, {_RMS}"
    ),
    "static_noise": Term(
        "Scatter of markers at rest about their own mean: noise without bias.",
        f"{_RMS} of the 3D distance from the mean",
    ),
    "latency_p99": Term(
        "99 of 100 frame sets are computed within this time, without transfer.", "99 % quantile of the computing time"
    ),
    "frame_rate": Term("Frame sets computed a second on this machine.", "frame sets / computing time"),
}
"""Metric -> entry."""

COLUMNS = {
    "95 % interval": Term(
        "Where the figure lies with 95 % confidence, by chance of the run alone.",
        "block bootstrap over frames (after Künsch 1989), since neighbouring frames are correlated",
    ),
    "n": Term("How many items the figure is of: samples, frames, targets."),
    "Aligned by": Term(
        "What was fitted to the truth before comparing. None: errors are absolute, with those of the calibration; "
        "aligned figures are smaller and not comparable."
    ),
    "Of the limit": Term(
        "How much of what the limit allows is used up; from 85 % on the figure is named under Near the limit.",
        "value / limit of an upper one; of a lower limit of a share, what is missing to 1 / what may be missing",
    ),
}
"""Columns of the metrics' table -> entry."""


BENCHMARK_COLUMNS = {
    "ospa": Term(
        "One figure for accuracy, misses and ghosts of a benchmark's entrant: a miss or a ghost weighs as much as an "
        "error of 10 mm.",
        "root of (sum of min(d, c)^2 over pairs + c^2 (k - pairs)) / sum of k over all frames, k: the larger of the "
        "numbers of points and of visible markers, c = 10 mm (Schuhmacher, Vo and Vo 2008, order 2)",
    )
}
"""Columns of a benchmark's leaderboard, besides metrics of runs -> entry."""

SUITE_COLUMNS = {
    "Must": Term(
        "What the scenario's file expects: a claim must pass, a control's planted fault must break its limits, a "
        "fault of a calibration must be caught."
    ),
    "Did": Term(
        "What happened, in capitals where that is not what it must do. WORSE: every limit is met, and a figure is "
        "worse than in the committed baseline by more than 2 % and by more than the interval of the difference."
    ),
    "Nearest limit": Term(
        "The figure that uses most of what its limit allows; amber from 85 % on.",
        "as Of the limit on the run's page; of a range, distance from its middle / half its width",
    ),
    "History": Term(
        "The main figure in earlier suites, oldest left, with its limit dashed; red points are outside. Results of "
        "other settings or another seed are left out.",
        "position_rms where it has a limit, else relative_accuracy, else the first limit; of a control what it must "
        "break",
    ),
    "Time": Term("Wall-clock time of the scenario in this suite; others ran beside it where --jobs is above 1."),
}
"""Columns of a suite's page -> entry."""

COMPARISON_COLUMNS = {
    "worse, better": Term(
        "The figure changed by more than 2 %, by more than the 95 % interval of the difference, and by more than "
        "twice the spread over processors that a baseline states. Towards 3, 1 or 6 is better for a NEES, not less.",
        "jackknife of the paired difference by blocks of time (Künsch 1989) for the same seed and the same versions, "
        "else the intervals of both runs, added in quadrature",
    ),
    "same": Term("It did not change by that much. This does not show that nothing changed."),
    "not comparable": Term(
        "No better or worse is stated: the runs are of other settings, frames or expectations, the figure is a speed "
        "of another machine, or its change cannot be told from chance."
    ),
}
"""Words of a comparison's page -> entry."""


def term(metric: str) -> Term | None:
    """Return the entry of a metric: its own, else that of the longest name that it starts with, else None."""
    names = [known for known in GLOSSARY if metric == known or metric.startswith((known + "_", known + "."))]
    return GLOSSARY[max(names, key=len)] if names else None
