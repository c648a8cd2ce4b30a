"""Words of the skeleton verbs on a fit and a take: segment lengths, undetermined joints, standard deviations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.errors import InputError
from mosca.skeleton.anatomical_axes import CHAINS
from mosca.skeleton.fit import LEAST_SEEN, FittedSubject
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.mjcf import compiled
from mosca.skeleton.track import track_subject

UNTOLD_M = 0.01
"""Standard deviation of a joint's centre in its worst direction above which the joint is named [m]."""
COINCIDENT_M = 1e-3
"""Distance below which two joints count as one place [m]."""
LOOKED_AT = 12
"""Number of frames of a take from which the uncertainty of joints is taken."""
OF_95_PERCENT = 1.96
"""Half of a 95 % interval, in standard deviations."""
MOVEMENTS: Mapping[str, str] = {
    "hip": "swing the leg forward, back and out, and circle it",
    "knee": "bend the knee; along its axis only a marker on its inner side tells (KNM)",
    "ankle": "move the foot up, down and in circles; along the axis a marker on the inner side tells (ANM)",
    "shoulder": "raise the arm forward and to the side, and circle it",
    "elbow": "bend the elbow and turn the forearm; along its axis only a marker on its inner side tells (ELM)",
    "wrist": "bend the hand to all sides and circle it",
}
"""Joint without its side -> movement in a take that determines its centre."""


def check_bodies(subject: FittedSubject, path: Path) -> None:
    """Raise InputError where the joints of a model cannot be read, which is by the names of bodies and joints."""
    mj: Any = compiled(subject.model.mjcf, str(path))
    bodies = {mj.body(k).name for k in range(1, mj.nbody)}
    if not any(chain.distal in bodies for chain in CHAINS.values()):
        raise InputError(
            f"{path}: none of its bodies has a name as in human.xml (pelvis, l_thigh, ...); joints are by name"
        )
    for joint, chain in CHAINS.items():
        if chain.distal not in bodies:
            continue
        if chain.proximal and chain.proximal not in bodies:
            raise InputError(
                f"{path}: body '{chain.distal}' without '{chain.proximal}'; joint {joint} is between them"
            )
        if chain.centre and chain.centre not in subject.model.joints:
            raise InputError(
                f"{path}: body '{chain.distal}' is there and no joint '{chain.centre}'; give it this name"
            )


def lengths(subject: FittedSubject) -> list[str]:
    """Return lines with the distances of joints on one body, with their 95 % uncertainty."""
    model = subject.model
    mj: Any = compiled(model.mjcf, "model")
    lines = []
    place_of = {mj.joint(0).name: mj.joint(0).name}
    for k, joint in enumerate(model.joints):
        parent = mj.joint(int(mj.body_parentid[k + 2]) - 1).name
        length, sigma = _distance(subject, {joint: 1.0})
        # a joint that coincides with another one in the model has the name of that one
        place_of[joint] = place_of[parent] if length < COINCIDENT_M else joint
        if length >= COINCIDENT_M and parent != mj.joint(0).name:
            lines.append(_length(place_of[parent], joint, length, sigma))
    for joint in model.joints:
        pair = [joint, f"r_{joint[2:]}"]
        if joint.startswith("l_") and pair[1] in model.joints:
            carriers = {int(mj.body_parentid[2 + model.joints.index(name)]) for name in pair}
            if len(carriers) == 1:
                length, sigma = _distance(subject, {pair[0]: -1.0, pair[1]: 1.0})
                lines.append(_length(pair[0], pair[1], length, sigma))
    return lines


def _length(first: str, second: str, length: float, sigma: float) -> str:
    return f"length {first} to {second}: {1e3 * length:.1f} +- {1e3 * OF_95_PERCENT * sigma:.1f} mm (95 %)"


def _distance(subject: FittedSubject, weights: Mapping[str, float]) -> tuple[float, float]:
    """Return the length of a weighted sum of joint positions in one body, and its standard deviation [m]."""
    rows = {joint: subject.model.joint_rows(joint) for joint in weights}
    place = np.sum([w * subject.parameters[rows[joint]] for joint, w in weights.items()], axis=0)
    length = float(np.linalg.norm(place))
    slope = np.zeros(len(subject.parameters))
    for joint, w in weights.items():
        slope[rows[joint]] = w * place / max(length, COINCIDENT_M)
    return length, float(np.sqrt(slope @ subject.covariance @ slope))


def untold(subject: FittedSubject, frames: MarkerFrames) -> list[str]:
    """Return a line for each joint whose centre the take does not determine, with the movement that would."""
    try:
        check_bodies(subject, Path("model"))
    except InputError as error:
        return [f"joints are not read: {error}"]
    full = np.flatnonzero(frames.seen.mean(axis=1) >= LEAST_SEEN)
    chosen = full[np.unique(np.linspace(0, len(full) - 1, LOOKED_AT).round().astype(int))]
    # frames far apart are no sequence: each is solved separately
    parts = [track_subject(subject, frames.select(np.array([k]))).joints for k in chosen]
    sigma = np.median([_worst(part.centre_covariance[0]) for part in parts], axis=0)
    lines = []
    for joint, value in zip(parts[0].joints, sigma.tolist(), strict=True):
        if value > UNTOLD_M and CHAINS[joint].centre:
            does = MOVEMENTS[joint.removeprefix("l_").removeprefix("r_")]
            lines.append(f"not told by this take: {joint}, known to {1e3 * value:.0f} mm; missing: {does}")
    return lines


def _worst(covariance: Array) -> Array:
    """Return the standard deviation (...) in the worst direction of covariances (..., 3, 3); NaN where unknown."""
    known: Array = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)))
    largest = np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0))[..., -1]
    return np.where(known, np.sqrt(np.maximum(largest, 0.0)), np.nan)


def sigmas(joints: JointMotion) -> list[str]:
    """Return a line for each joint: the medians of its standard deviations over the take."""
    lines = []
    places, turns = _worst(joints.centre_covariance), np.rad2deg(_worst(joints.rotation_covariance))
    for k, name in enumerate(joints.joints):
        told = []
        for kind, values, scale, unit in (("centre", places, 1e3, "mm"), ("rotation", turns, 1.0, "deg")):
            if np.isfinite(values[:, k]).any():
                told.append(f"{kind} {scale * float(np.nanmedian(values[:, k])):.2g} {unit}")
            elif kind == "rotation":
                told.append("rotation unknown, for want of landmarks or movement")
        lines.append(f"  {name}: {', '.join(told)}")
    return lines
