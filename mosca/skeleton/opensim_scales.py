"""Scale factors that make OpenSim's generic model gait2354 as large as a fitted subject."""

import numpy as np

from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.model import SkeletonModel

GENERIC_M = {"pelvis": 0.167, "femur": 0.39585, "tibia": 0.43}
"""Lengths in gait2354 (Delp et al. 1990) before scaling [m]: between the hips; hip to knee, and knee to ankle, at a
straight knee."""
GENERIC_STATURE_M, STATURE_M = 1.80, 1.75
"""Statures of the person of gait2354, and of mosca's model at size 1 [m]."""


_LENGTHS = {"pelvis": ("l_hip", "r_hip")} | {
    f"{body}_{side}": (f"{side}_{joint}",) for side in "rl" for body, joint in (("femur", "knee"), ("tibia", "ankle"))
}
"""Body of gait2354 -> the joint whose distance from its parent's is the body's length, or the two joints at the
body's ends."""
_BY_STATURE = {"torso": "l_shoulder"} | {
    f"{body}_{side}": f"{side}_ankle" for side in "rl" for body in ("talus", "calcn", "toes")
}
"""Body without a joint at its other end -> the joint that a model with this body has."""


def scaled_bodies(model: SkeletonModel) -> tuple[str, ...]:
    """Return the bodies of gait2354 that a model's joints scale."""
    by_length = [body for body, joints in _LENGTHS.items() if set(joints) <= set(model.joints)]
    return (*by_length, *(body for body, joint in _BY_STATURE.items() if joint in model.joints))


def gait2354_scales(subject: FittedSubject) -> dict[str, tuple[float, float, float]]:
    """Return body of gait2354 -> factors along its x, y, z, the same for all three.

    Pelvis, thighs and shanks are scaled by the distances between fitted joints. Torso and feet, which have no joint
    at their other end, are scaled by stature.
    """
    model, stature = subject.model, subject.size * STATURE_M / GENERIC_STATURE_M
    factors = {}
    for body in scaled_bodies(model):
        factors[body] = stature
        if body in _LENGTHS:
            first, *other = (subject.parameters[model.joint_rows(joint)] for joint in _LENGTHS[body])
            length = float(np.linalg.norm(first - other[0] if other else first))
            factors[body] = length / GENERIC_M[body.split("_")[0]]
    return {body: (factor, factor, factor) for body, factor in factors.items()}
