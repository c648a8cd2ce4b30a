"""A person's joints compared with the truth. Pure: no files, no clocks, no twin.

The error of a joint's centre is its 3D distance from the true one; the centres in ``CENTRES`` are scored. The error
of a joint's rotation is the rotation vector r of R_true = R exp([r]), in the axes of the distal segment. Unlike
differences of Euler angles it has no singular positions, and the covariance refers to its components. Joints whose
centre or rotation is unknown in the truth (NaN) are left out. A value that is known in the truth but not in the
estimate is a miss. Nothing is aligned. Intervals come from a bootstrap over blocks of frames.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.joint_motion import JointMotion
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.errors import InputError
from scenarios.score.tracks import block_of, in_time, nearest, pair, ratio_of_sums
from scenarios.types import Score

CENTRES = tuple(
    f"{side}_{joint}" for side in "lr" for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
)
"""Joints whose centres are scored; that of the pelvis is not the centre of a joint."""
INSIDE_95 = float(chi2.ppf(0.95, 3))


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Errors of j joints at t instants of a truth; NaN where truth or estimate is unknown.

    ``joints`` (j): names; ``known`` (t, j): whether the truth is known; ``error`` (t, j, 3) [m or rad]; ``nees``
    (t, j): inf where the covariance is not positive definite.
    """

    joints: tuple[str, ...]
    known: Array
    error: Array
    nees: Array

    @property
    def found(self) -> Array:
        """Whether both truth and estimate are known (t, j)."""
        return np.asarray(self.known & np.isfinite(self.error).all(axis=2))


def centre_errors(
    motion: JointMotion, truth: Truth, calibration: Callable[[Array], Array] | None = None
) -> JointErrors:
    """Return errors of the joints' centres [m].

    ``calibration``: the covariance (n, 3, 3) [m^2] that an estimated calibration's own error gives to points (n, 3)
    [m]; NEES is computed with the sum.
    """
    assert truth.joints is not None
    names = tuple(name for name in truth.joints.names if name in CENTRES)
    true = truth.joints.centre[:, [truth.joints.names.index(name) for name in names]]
    centre, covariance = (
        _of_truth(motion, truth, names, values) for values in (motion.centre, motion.centre_covariance)
    )
    error = centre - true
    if calibration is not None:
        there = np.isfinite(centre).all(axis=2)
        covariance[there] += calibration(centre[there])
    return JointErrors(names, np.asarray(np.isfinite(true).all(axis=2)), error, _nees(error, covariance))


def rotation_errors(motion: JointMotion, truth: Truth) -> JointErrors:
    """Return errors of the joints' rotations, as rotation vectors in the distal axes [rad]."""
    assert truth.joints is not None
    names = truth.joints.names
    quaternion, covariance = (
        _of_truth(motion, truth, names, values) for values in (motion.rotation, motion.rotation_covariance)
    )
    error = rotation_vectors(quaternion, truth.joints.rotation)
    known = np.asarray(np.isfinite(truth.joints.rotation).all(axis=2))
    return JointErrors(names, known, error, _nees(error, covariance))


def rotation_vectors(first: Array, second: Array) -> Array:
    """Return r (t, j, 3) [rad] of R_second = R_first exp([r]) for quaternions wxyz (t, j, 4); NaN where one is."""
    result = np.full((*first.shape[:2], 3), np.nan)
    there = np.isfinite(first).all(axis=2) & np.isfinite(second).all(axis=2)
    one, two = (Rotation.from_quat(q[there], scalar_first=True) for q in (first, second))
    result[there] = (one.inv() * two).as_rotvec()
    return result


def joint_scores(centres: JointErrors, rotations: JointErrors) -> dict[str, Score]:
    """Return the metrics of joints: rms, NEES and coverage of centres and rotations, and the share that was found.

    ``joint_angle_rms`` is the rms over joints, frames and the three components.
    """
    frames = len(centres.known)
    if not frames:
        return {}
    block = block_of(frames)
    found = _blocks(block, centres.found) + _blocks(block, rotations.found)
    known = _blocks(block, centres.known) + _blocks(block, rotations.known)
    items = int(centres.known.sum() + rotations.known.sum())
    scores = {"joint_completeness": ratio_of_sums(found, known, items)}
    for name, one, components in (("center", centres, 1), ("angle", rotations, 3)):
        there = one.found
        n = int(there.sum())
        if not n:
            continue
        count = _blocks(block, there)
        square = _blocks(block, np.where(there, np.sum(one.error**2, axis=2), 0.0))
        scores[f"joint_{name}_rms"] = ratio_of_sums(square, components * count, n, np.sqrt)
        nees = np.where(there, one.nees, 0.0)
        if np.isfinite(nees).all():
            scores[f"joint_{name}_nees"] = ratio_of_sums(_blocks(block, nees), count, n)
        else:
            scores[f"joint_{name}_nees"] = Score(float("inf"), n)
        inside = there & (one.nees <= INSIDE_95)
        scores[f"joint_{name}_coverage95"] = ratio_of_sums(_blocks(block, inside), count, n)
    return scores


def joint_table(centres: JointErrors, rotations: JointErrors) -> dict[str, dict[str, Any]]:
    """Return a table for the record, joint by joint: rms, NEES and coverage of centre and rotation, share found.

    ``angle_rms_rad`` holds the three components. Unknown values are None.
    """
    table: dict[str, dict[str, Any]] = {}
    for joint in dict.fromkeys((*rotations.joints, *centres.joints)):
        row: dict[str, Any] = {}
        for name, one in (("center", centres), ("angle", rotations)):
            if joint not in one.joints or not one.known[:, (k := one.joints.index(joint))].any():
                continue
            there = one.found[:, k]
            row[f"{name}_completeness"] = float(there.sum() / one.known[:, k].sum())
            if not there.any():
                continue
            error, nees = one.error[there, k], one.nees[there, k]
            if name == "center":
                row["center_rms_m"] = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
            else:
                row["angle_rms_rad"] = [float(v) for v in np.sqrt(np.mean(error**2, axis=0))]
            row[f"{name}_nees"] = float(nees.mean()) if np.isfinite(nees).all() else None
            row[f"{name}_coverage95"] = float(np.mean(nees <= INSIDE_95))
        if row:
            table[joint] = row
    return table


def labelled_by_truth(tracks: Tracks, truth: Truth, working_space_m: float) -> Tracks:
    """Return ``tracks`` with the names of the true markers that ``scenarios.score.tracks.pair`` assigns to samples.

    Samples without a true marker get "". ``working_space_m``: longest edge of the working space [m].
    """
    pairs = pair(tracks, truth, working_space_m)
    label = np.full(len(tracks), "", dtype=np.asarray(truth.names, dtype=np.str_).dtype)
    label[pairs.row] = np.asarray(truth.names, dtype=np.str_)[pairs.marker]
    return replace(tracks, label=label)


def label_scores(labelled: Tracks, truth: Truth, working_space_m: float) -> dict[str, Score]:
    """Return F1 of the labels of measured samples, and the number of changes of a true marker's label.

    F1 = 2 right / (samples with a label + samples that ``pair`` pairs with a true marker).
    """
    frames = len(truth.time_ns)
    if not frames:
        return {}
    pairs = pair(labelled, truth, working_space_m)
    block = block_of(frames)
    given = labelled.label[pairs.row]
    right = given == np.asarray(truth.names, dtype=np.str_)[pairs.marker]
    named = nearest(truth.time_ns, labelled.time_ns[(labelled.label != "") & (labelled.status == "measured")])
    above, true, with_label = (
        np.bincount(block[at], weights=weights, minlength=int(block.max()) + 1)
        for at, weights in ((pairs.frame, right), (pairs.frame, None), (named, None))
    )
    switches = 0
    for marker in np.unique(pairs.marker):
        names = given[(pairs.marker == marker) & (given != "")]
        switches += int(np.count_nonzero(names[1:] != names[:-1]))
    n = len(pairs.row)
    return {"label_f1": ratio_of_sums(2 * above, true + with_label, n), "label_switches": Score(float(switches), n)}


def with_labels_swapped(tracks: Tracks, pairs: Sequence[tuple[str, str]]) -> Tracks:
    """Return ``tracks`` with the labels of each pair exchanged; InputError where one of them does not exist."""
    other = {one: two for pair in pairs for one, two in (pair, pair[::-1])}
    for name in other:
        if not (tracks.label == name).any():
            there = ", ".join(sorted(set(tracks.label.tolist()) - {""}))
            raise InputError(f"fault.pairs: '{name}' given; the tracks have {there}")
    label = np.array([other.get(name, name) for name in tracks.label.tolist()], dtype=tracks.label.dtype)
    return replace(tracks, label=label)


def true_motion(truth: Truth) -> JointMotion:
    """Return the true joints as a measurement without error, in the order of the truth's instants."""
    assert truth.joints is not None
    t, j = truth.joints.centre.shape[:2]
    nothing = np.zeros((t, j, 3, 3))
    joints = truth.joints
    return JointMotion(np.arange(t), truth.time_ns, joints.names, joints.centre, nothing, joints.rotation, nothing)


def _of_truth(motion: JointMotion, truth: Truth, names: Sequence[str], values: Array) -> Array:
    """Return values (n, j, ...) of ``motion`` at the truth's instants for joints ``names``; NaN where there are none.

    An instant of the motion belongs to the nearest true one, if that is no farther than half a period.
    """
    result = np.full((len(truth.time_ns), len(names), *values.shape[2:]), np.nan)
    at = nearest(truth.time_ns, motion.time_ns)
    rows = np.flatnonzero(in_time(truth.time_ns, motion.time_ns, at))
    for k, name in enumerate(names):
        if name in motion.joints:
            result[at[rows], k] = values[rows, motion.joints.index(name)]
    return result


def _nees(error: Array, covariance: Array) -> Array:
    """Return e^T C^-1 e of errors (t, j, 3) with covariances (t, j, 3, 3); NaN where one is unknown."""
    result = np.full(error.shape[:2], np.nan)
    there = np.isfinite(error).all(axis=2)
    whole = np.asarray(np.isfinite(covariance[there]).all(axis=(1, 2)))
    symmetric = np.where(whole[:, None, None], covariance[there], 0.0)
    value, vector = np.linalg.eigh(symmetric)
    along = np.einsum("nij,ni->nj", vector, error[there])
    good = value[:, 0] > 0
    result[there] = np.where(good, np.sum(along**2 / np.where(good[:, None], value, 1.0), axis=1), np.inf)
    return result


def _blocks(block: Array, values: Array) -> Array:
    """Return sums of values (t, j) over joints and blocks of instants; ``block`` (t,): number of the block."""
    return np.bincount(block, weights=values.sum(axis=1).astype(float), minlength=int(block.max()) + 1)
