"""A person as a stick figure: lines between the centres of joints."""

from collections.abc import Sequence

import numpy as np

from mosca.data.arrays import Array

STRIPS = (
    ("pelvis", "l_hip", "l_knee", "l_ankle"),
    ("pelvis", "r_hip", "r_knee", "r_ankle"),
    ("pelvis", "shoulders"),
    ("shoulders", "l_shoulder", "l_elbow", "l_wrist"),
    ("shoulders", "r_shoulder", "r_elbow", "r_wrist"),
)
"""Joints of ``mosca.data.joint_motion.JOINTS`` in each line. "shoulders" is midway between both shoulders: lumbar
joints and neck have no centre."""


def strips(joints: Sequence[str], centre: Array) -> list[Array]:
    """Return lines (k, 3) [m] through the known joints of ``centre`` (j, 3); an unknown joint ends a line."""
    place = {name: centre[k] for k, name in enumerate(joints)}
    if "l_shoulder" in place and "r_shoulder" in place:
        place["shoulders"] = (place["l_shoulder"] + place["r_shoulder"]) / 2
    lines: list[Array] = []
    for strip in STRIPS:
        points = np.array([place.get(name, np.full(3, np.nan)) for name in strip])
        known = np.isfinite(points).all(axis=1)
        for part in np.split(np.arange(len(points)), np.flatnonzero(~known)):
            part = part[known[part]]
            if len(part) > 1:
                lines.append(points[part])
    return lines
