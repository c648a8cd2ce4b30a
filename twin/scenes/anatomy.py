"""From a skeleton's joints to a body: which joint is which, and the limbs' shapes in the rest pose.

Shapes and marker positions are given in the rest pose, in world axes with the root joint at the origin:
the subject faces -y, its left is at +x, arms along x, palms down. Sizes follow the subject's own bones.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.motion import Skeleton, rest_positions
from mosca.errors import InputError
from twin.scenes.world import Shape, capsule, ellipsoid

FORWARD = np.array([0.0, -1.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
LEFT = np.array([1.0, 0.0, 0.0])
_STANDARD_HIP_TO_NECK_AND_LEG_M = 1.33  # of a person of 1.75 m
_SCALES = (0.7, 1.4)
FOOT_RADIUS_M = 0.034

# Names of the joint at which each part starts: CMU's ASF (also as BVH), its BVH releases for Daz Studio
# and for MotionBuilder. The first name that the skeleton has is taken.
_CENTRE = {
    "pelvis": ("root", "hip", "Hips", "hips"),
    "abdomen": ("upperback", "abdomen", "Spine", "LowerBack"),
    "chest": ("thorax", "chest", "Spine1", "Chest"),
    "neck": ("lowerneck", "neck", "Neck"),
    "head": ("head", "Head"),
}
_SIDED = {
    "upper_arm": ("{l}humerus", "{l}Shldr", "{Left}Arm"),
    "forearm": ("{l}radius", "{l}ForeArm", "{Left}ForeArm"),
    "wrist": ("{l}wrist",),
    "hand": ("{l}hand", "{l}Hand", "{Left}Hand"),
    "thigh": ("{l}femur", "{l}Thigh", "{Left}UpLeg"),
    "shank": ("{l}tibia", "{l}Shin", "{Left}Leg"),
    "foot": ("{l}foot", "{l}Foot", "{Left}Foot"),
    "toes": ("{l}toes", "{Left}ToeBase"),
}
_OPTIONAL = ("wrist", "toes")
_SHORTEST_M = 0.01  # a bone shorter than this is a joint that the file keeps without using it


@dataclass(frozen=True, eq=False)
class Anatomy:
    """A skeleton read as a person."""

    skeleton: Skeleton
    parts: Mapping[str, int]
    """Part ("pelvis", "l_thigh", ...) -> index of its first joint; "l_wrist", "l_toes", ... may be absent."""
    points: Mapping[str, Array]
    """Name -> rest position (3,) [m]: joints by their part's name, "hips", "head_center", "l_heel", ..."""
    scale: float
    """Size relative to a person of 1.75 m."""

    def part_or(self, part: str, other: str) -> str:
        """Return ``part`` where the skeleton has it, else ``other``."""
        return part if part in self.parts else other


def read_anatomy(skeleton: Skeleton, source: str) -> Anatomy:
    """Return ``skeleton`` as a person; ``source`` names it in errors.

    Raises InputError that names missing joints, or for a size that no person has (a wrong unit).
    """
    parts = _find_parts(skeleton, source)
    rest = rest_positions(skeleton)
    for part in [p for p in parts if p[2:] in _OPTIONAL]:
        tip = rest[_far_end(skeleton, parts[part], source)]
        if np.linalg.norm(tip - rest[parts[part]]) < _SHORTEST_M:
            del parts[part]
    points = {part: rest[k] for part, k in parts.items()}
    hips = (points["l_thigh"] + points["r_thigh"]) / 2
    leg = sum(
        float(np.linalg.norm(points[a] - points[b])) for a, b in (("l_thigh", "l_shank"), ("l_shank", "l_foot"))
    )
    scale = (float(np.linalg.norm(points["neck"] - hips)) + leg) / _STANDARD_HIP_TO_NECK_AND_LEG_M
    if not _SCALES[0] < scale < _SCALES[1]:
        raise InputError(
            f"{source}: this person would be about {1.75 * scale:.3g} m tall; set metres_per_unit (CMU's ASF "
            "skeletons as BVH: 0.0564444; CMU's BVH for Daz: 0.0104)"
        )
    points["hips"] = hips
    points["head_center"] = points["neck"] + scale * (0.19 * UP + 0.02 * FORWARD)
    for s in "lr":
        along = points[f"{s}_hand"] - points[f"{s}_forearm"]
        points[f"{s}_fingers"] = points[f"{s}_hand"] + 0.17 * scale * along / np.linalg.norm(along)
        ankle = points[f"{s}_foot"]
        ball = rest[_far_end(skeleton, parts[f"{s}_foot"], source)]
        level = np.array([ball[0] - ankle[0], ball[1] - ankle[1], 0.0])
        if np.linalg.norm(level) < 0.02 * scale:
            raise InputError(f"{source}: the bone of joint '{skeleton.names[parts[f'{s}_foot']]}' is too short")
        heel = ankle - 0.045 * scale * level / np.linalg.norm(level)
        points[f"{s}_ball"], points[f"{s}_heel"] = ball, np.array([heel[0], heel[1], ball[2]])
        if f"{s}_toes" in parts:
            points[f"{s}_toe_tips"] = rest[_far_end(skeleton, parts[f"{s}_toes"], source)]
    return Anatomy(skeleton, parts, points, scale)


def limb_shapes(anatomy: Anatomy) -> dict[str, list[Shape]]:
    """Return each part's shapes, in rest pose coordinates [m]."""
    p, s = anatomy.points, anatomy.scale
    trunk = p["neck"] - p["hips"]
    long = float(np.linalg.norm(trunk))
    half_shoulders = float(p["l_upper_arm"][0] - p["r_upper_arm"][0]) / 2
    inward = 0.03 * s * LEFT
    shapes: dict[str, list[Shape]] = {
        "pelvis": [ellipsoid(p["hips"] + 0.09 * s * UP, s * np.array([0.15, 0.115, 0.12]))],
        "abdomen": [ellipsoid(p["hips"] + 0.42 * trunk, np.array([0.135 * s, 0.095 * s, 0.26 * long]))],
        "chest": [
            ellipsoid(p["hips"] + 0.70 * trunk, np.array([0.85 * half_shoulders, 0.11 * s, 0.34 * long])),
            capsule(p["r_upper_arm"] + inward, p["l_upper_arm"] - inward, 0.053 * s),
            # the root of the neck, with the seventh cervical vertebra, moves with the chest
            capsule(p["hips"] + 0.9 * trunk, p["neck"] + 0.06 * s * UP, 0.055 * s),
        ],
        "neck": [capsule(p["neck"] + 0.03 * s * UP, p["head_center"] - 0.04 * s * UP, 0.052 * s)],
        "head": [ellipsoid(p["head_center"], s * np.array([0.078, 0.098, 0.115]))],
    }
    for side in ("l_", "r_"):
        elbow, wrist, hand = p[f"{side}forearm"], p.get(f"{side}wrist"), p[f"{side}hand"]
        knee, ankle = p[f"{side}shank"], p[f"{side}foot"]
        shapes[f"{side}upper_arm"] = [capsule(p[f"{side}upper_arm"], elbow, 0.045 * s)]
        if wrist is None:
            shapes[f"{side}forearm"] = [
                capsule(elbow, elbow + 0.6 * (hand - elbow), 0.037 * s), capsule(elbow, hand, 0.028 * s)
            ]  # fmt: skip
        else:
            shapes[f"{side}forearm"] = [capsule(elbow, wrist, 0.037 * s)]
            shapes[f"{side}wrist"] = [capsule(wrist, hand, 0.028 * s)]
        reach = p[f"{side}fingers"] - hand
        palm = s * np.array([0.042, 0.02, 0.0]) + [0, 0, float(np.linalg.norm(reach)) / 2]
        shapes[f"{side}hand"] = [ellipsoid(hand + reach / 2, palm, reach)]
        shapes[f"{side}thigh"] = [capsule(p[f"{side}thigh"], knee, 0.068 * s)]
        calf = ankle - knee
        swell = np.array([0.058 * s, 0.06 * s, 0.3 * float(np.linalg.norm(calf))])
        shapes[f"{side}shank"] = [
            capsule(knee, ankle, 0.041 * s),
            ellipsoid(knee + 0.32 * calf - 0.008 * s * FORWARD, swell, calf),
        ]
        shapes[f"{side}foot"] = [capsule(p[f"{side}heel"], p[f"{side}ball"], FOOT_RADIUS_M * s)]
        if f"{side}toes" in anatomy.parts:
            tips = p[f"{side}toe_tips"]
            shapes[f"{side}toes"] = [capsule(p[f"{side}ball"], tips, 0.028 * s)]
    return shapes


def _find_parts(skeleton: Skeleton, source: str) -> dict[str, int]:
    wanted = dict(_CENTRE)
    for side, words in (("l", {"l": "l", "Left": "Left"}), ("r", {"l": "r", "Left": "Right"})):
        for part, names in _SIDED.items():
            wanted[f"{side}_{part}"] = tuple(name.format(**words) for name in names)
    found = {
        part: next((skeleton.names.index(n) for n in names if n in skeleton.names), -1)
        for part, names in wanted.items()
    }
    missing = [part for part, k in found.items() if k < 0 and part[2:] not in _OPTIONAL]
    if missing:
        what = "; ".join(f"{part} ({' or '.join(wanted[part])})" for part in missing[:3])
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise InputError(
            f"{source}: no joint for {what}{more}; the file has {', '.join(skeleton.names)}: rename its joints"
        )
    return {part: k for part, k in found.items() if k >= 0}


def _far_end(skeleton: Skeleton, joint: int, source: str) -> int:
    children = np.nonzero(skeleton.parents == joint)[0]
    if not len(children):
        raise InputError(f"{source}: joint '{skeleton.names[joint]}' has no end; its bone's length is unknown")
    return int(children[0])
