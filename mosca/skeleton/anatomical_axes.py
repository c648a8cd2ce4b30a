"""Anatomical axes of a person's segments from joint centres and landmarks (ISB: Wu et al. 2002, 2005).

Each segment's axes, x forward, y up, z to the right in the anatomical position, are fixed in the model's body:

- pelvis: z from LASI to RASI, x forward in the plane of these two and the midpoint of LPSI and RPSI; a set with waist
  markers instead of iliac spine markers (CMU's) uses LFWT, RFWT, LBWT, RBWT, which tilts the pelvis a little;
- thorax: y from the midpoint of STRN and T10 to the midpoint of CLAV and C7, z perpendicular to the plane of CLAV, C7
  and the midpoint of STRN and T10;
- head: x from the midpoint of LBHD and RBHD to that of LFHD and RFHD, z nearest to the direction from left to right;
- thigh, upper arm: y from the distal joint's centre to the proximal one's, z nearest to the flexion axis of knee or
  elbow;
- shank: y from ankle to knee, z nearest to the knee's flexion axis;
- forearm: y from wrist to elbow, z nearest to the line through WRA and WRB;
- foot: x from HEE to TOE, z nearest to the line through TOE and MT5; this line slopes, so inversion has an offset;
- hand: y from the midpoint of FIN and PNK to the wrist, z nearest to the line through FIN and PNK.

A knee's flexion axis is the direction that stays most nearly the same in thigh and shank over the take (SARA: Ehrig
et al. 2007). An elbow's flexion axis is perpendicular to the plane, or to the base of the cone, that the forearm's
long axis sweeps relative to the upper arm. Pronation does not move this long axis.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array

Landmark = Callable[[str], Array]
"""Place of a marker, or of a joint, by its name, in the axes of the body that carries it."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Bodies of a joint: ``proximal`` ("" for the world) and ``distal``; the ``centre`` is the joint of that name."""

    proximal: str
    distal: str
    centre: str


CHAINS: Mapping[str, Chain] = {
    "pelvis": Chain("", "pelvis", ""),
    "lumbar": Chain("pelvis", "chest", ""),
    "neck": Chain("chest", "head", ""),
    **{
        f"{s}_{joint}": Chain(proximal.format(s=s), f"{s}_{distal}", f"{s}_{joint}")
        for s in "lr"
        for joint, proximal, distal in (
            ("hip", "pelvis", "thigh"),
            ("knee", "{s}_thigh", "shank"),
            ("ankle", "{s}_shank", "foot"),
            ("shoulder", "chest", "upper_arm"),
            ("elbow", "{s}_upper_arm", "distal_forearm"),
            ("wrist", "{s}_distal_forearm", "hand"),
        )
    },
}
"""Joint of ``mosca.data.joint_motion.JOINTS`` -> its bodies in the model of a person."""
KNEES: Mapping[str, tuple[str, str]] = {f"{s}_knee": (f"{s}_thigh", f"{s}_shank") for s in "lr"}
"""Joint that is nearly a hinge -> the bodies that it turns against each other."""
ELBOWS: Mapping[str, tuple[str, str]] = {f"{s}_elbow": (f"{s}_upper_arm", f"{s}_distal_forearm") for s in "lr"}
"""Joint that bends, and twists about the distal bone's long axis -> its bodies."""


PELVIS_MARKERS = (("ASI", "PSI"), ("FWT", "BWT"))
"""Names of front and back markers of the pelvis, the preferred pair first."""


def axes_from(first: int, along: Array, second: int, toward: Array) -> Array:
    """Return right-handed axes (3, 3), columns x, y, z: ``first`` along one vector, ``second`` nearest to another."""
    axes = np.empty((3, 3))
    axes[:, first] = along / np.linalg.norm(along)
    across = toward - toward @ axes[:, first] * axes[:, first]
    axes[:, second] = across / np.linalg.norm(across)
    third = 3 - first - second
    sign = 1.0 if (second - first) % 3 == 1 else -1.0
    axes[:, third] = sign * np.cross(axes[:, first], axes[:, second])
    return axes


def _pelvis_axes(at: Landmark) -> Array:
    for front, back in PELVIS_MARKERS:
        try:
            left, right, behind = at(f"L{front}"), at(f"R{front}"), (at(f"L{back}") + at(f"R{back}")) / 2
        except KeyError:
            continue
        return axes_from(2, right - left, 0, (right + left) / 2 - behind)
    raise KeyError("pelvis")


def segment_axes(body: str, at: Landmark, hinges: Mapping[str, Array]) -> Array:
    """Return body_from_anatomical (3, 3) of ``body``.

    ``at`` gives places in the body's axes; the body's own joint is its origin. ``hinges``: joint -> its flexion axis
    in this body's axes, pointing right. KeyError where a landmark is missing.
    """
    side, _, name = body.rpartition("_") if body[:2] not in ("l_", "r_") else (body[0], "", body[2:])
    origin = np.zeros(3)
    if body == "pelvis":
        return _pelvis_axes(at)
    if body == "chest":
        low, high = (at("STRN") + at("T10")) / 2, (at("CLAV") + at("C7")) / 2
        return axes_from(1, high - low, 2, np.cross(at("CLAV") - low, at("C7") - low))
    if body == "head":
        front, back = (at("LFHD") + at("RFHD")) / 2, (at("LBHD") + at("RBHD")) / 2
        return axes_from(0, front - back, 2, (at("RFHD") + at("RBHD") - at("LFHD") - at("LBHD")) / 2)
    letter, outward = side.upper(), 1.0 if side == "r" else -1.0
    if name in ("thigh", "upper_arm"):
        joint = f"{side}_{'knee' if name == 'thigh' else 'elbow'}"
        return axes_from(1, origin - at(joint), 2, hinges[joint])
    if name == "shank":
        return axes_from(1, origin - at(f"{side}_ankle"), 2, hinges[f"{side}_knee"])
    if name == "distal_forearm":
        between = at(f"{letter}WRA") - at(f"{letter}WRB")
        return axes_from(1, origin - at(f"{side}_wrist"), 2, outward * between)
    if name == "foot":
        toe = at(f"{letter}TOE")
        return axes_from(0, toe - at(f"{letter}HEE"), 2, outward * (at(f"{letter}MT5") - toe))
    finger, little = at(f"{letter}FIN"), at(f"{letter}PNK")
    return axes_from(1, origin - (finger + little) / 2, 2, outward * (finger - little))
