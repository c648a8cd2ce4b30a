"""BVH: a hierarchy of joints with named channels, then one line of numbers a frame (Biovision, 1990s).

BVH states no unit and its frame time is often wrong: both can be given. What the file calls
``End Site`` becomes a joint named after its parent with ``_end``.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.motion.motion import (
    END_SUFFIX,
    Motion,
    Skeleton,
    in_world,
    number,
    numbers,
    quaternions_from_euler,
    rotations_in_world,
    without_flips,
)
from mosca.errors import InputError

_CHANNELS = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
_LARGEST_STRETCH_M = 1e-3
"""Largest change of a bone's length by position channels [m] that counts as rounding in the file."""


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: list[str] = field(default_factory=list)


def read_bvh(
    path: Path, *, metres_per_unit: float = 0.01, frame_rate_hz: float | None = None, drop_frames: int = 0
) -> Motion:
    """Return the motion in BVH file ``path`` in the world (Z up, m); the file's world has Y up.

    ``metres_per_unit``: size of the file's unit, which BVH does not state. ``frame_rate_hz`` replaces the file's
    frame time. ``drop_frames``: frames left out at the start (CMU's BVH files begin with an added T-pose). Position
    channels of joints other than the root are accepted where they do not change. Raises InputError naming file, line
    and what is expected.
    """
    text = read_text(path, "a BVH file", "latin-1", MOST_TABLE_BYTES)
    head, found, body = text.partition("MOTION")
    if not found:
        raise InputError(f"{path}: no 'MOTION' section; a BVH file is wanted")
    joints = _read_hierarchy(head, path)
    width = sum(len(joint.channels) for joint in joints)
    rate, table = _read_table(body, width, path, head.count("\n") + 1)
    if not 0 <= drop_frames < len(table):
        raise InputError(
            f"{path}: drop_frames = {drop_frames} given; the file has {len(table)} frames, so 0 to "
            f"{len(table) - 1} can be dropped"
        )
    rate = rate if frame_rate_hz is None else frame_rate_hz
    if not (metres_per_unit > 0 and rate > 0):
        raise InputError(f"{path}: metres_per_unit and frame_rate_hz must be positive")
    return _motion(joints, table[drop_frames:], rate, metres_per_unit, path)


def _read_hierarchy(text: str, path: Path) -> list[_Joint]:
    joints: list[_Joint] = []
    open_joints: list[int] = []  # joints whose brace is open, innermost last
    opening = False  # a joint is named and its brace is still to come
    lines = text.split("\n")
    for line_number, line in enumerate(lines, 1):
        where = f"{path}: line {line_number}"
        words = line.split()
        if not words or words == ["HIERARCHY"]:
            continue
        keyword, rest = words[0], words[1:]
        if keyword in ("ROOT", "JOINT", "End"):
            if opening or (keyword == "ROOT") != (not joints) or (keyword != "ROOT" and not open_joints):
                raise InputError(f"{where}: '{keyword}' is out of place; one ROOT, then joints inside it")
            parent = open_joints[-1] if open_joints else -1
            rest = rest[:-1] if words[-1] == "{" else rest
            name = joints[parent].name + END_SUFFIX if keyword == "End" else "_".join(rest)
            if not name or name in {joint.name for joint in joints}:
                raise InputError(f"{where}: joint name '{name}' is empty or used twice; names must differ")
            joints.append(_Joint(name, parent))
            opening = True
            words = words[-1:] if words[-1] == "{" else []
            keyword = words[0] if words else ""
        if keyword == "{":
            if not opening:
                raise InputError(f"{where}: '{{' without a joint before it")
            open_joints.append(len(joints) - 1)
            opening = False
        elif keyword == "}":
            if opening or not open_joints:
                raise InputError(f"{where}: '}}' closes nothing")
            open_joints.pop()
        elif keyword in ("OFFSET", "CHANNELS"):
            if opening or not open_joints:
                raise InputError(f"{where}: '{keyword}' outside a joint's braces")
            _read_property(joints[open_joints[-1]], keyword, rest, where)
        elif keyword:
            raise InputError(
                f"{where}: '{keyword[:40]}' given; ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace wanted"
            )
    if not joints or open_joints or opening:
        raise InputError(f"{path}: the HIERARCHY section ends before its last brace is closed")
    for joint in joints:
        if joint.offset is None:
            raise InputError(f"{path}: joint '{joint.name}' has no OFFSET; add one")
    return joints


def _read_property(joint: _Joint, keyword: str, words: list[str], where: str) -> None:
    if keyword == "OFFSET":
        if len(words) != 3:
            raise InputError(f"{where}: OFFSET has {len(words)} numbers, 3 wanted")
        joint.offset = [number(word, where) for word in words]
        return
    names = words[1:]
    if not words or words[0] != str(len(names)) or not set(names) <= _CHANNELS or len(set(names)) < len(names):
        raise InputError(
            f"{where}: CHANNELS must be a count and as many different ones of {', '.join(sorted(_CHANNELS))}"
        )
    joint.channels = names


def _read_table(text: str, width: int, path: Path, first_line: int) -> tuple[float, Array]:
    """Return the frame rate [Hz] and the channel table (t, width)."""
    words = text.split()
    if len(words) < 5 or words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
        raise InputError(f"{path}: line {first_line}: 'Frames: n' and 'Frame Time: s' must follow MOTION")
    where = f"{path}: MOTION"
    frames, step = number(words[1], where), number(words[4], where)
    if not step > 1e-6:
        raise InputError(f"{where}: Frame Time {words[4]} given, seconds above zero wanted")
    cells = words[5:]
    if frames < 1 or width < 1 or len(cells) != frames * width:
        raise InputError(
            f"{where}: {len(cells)} numbers given; {words[1]} frames of {width} channels need "
            f"{frames * width:.0f}: the file is cut short or its header is wrong"
        )
    return 1.0 / step, numbers(cells, where).reshape(-1, width)


def _motion(joints: list[_Joint], table: Array, rate: float, metres_per_unit: float, path: Path) -> Motion:
    offsets = np.array([joint.offset for joint in joints])
    rotations = np.zeros((len(table), len(joints), 4))
    orders: list[str] = []
    root = np.broadcast_to(offsets[0], (len(table), 3))
    column = 0
    for k, joint in enumerate(joints):
        cells = table[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        turning = [c for c, channel in enumerate(joint.channels) if channel.endswith("rotation")]
        orders.append("".join(joint.channels[c][0] for c in turning))
        rotations[:, k] = quaternions_from_euler(np.deg2rad(cells[:, turning]), orders[-1])
        # Position channels replace OFFSET as the joint's position in its parent's axes.
        place = np.broadcast_to(offsets[k], (len(table), 3)).copy()
        for c, channel in enumerate(joint.channels):
            if channel.endswith("position"):
                place[:, "XYZ".index(channel[0])] = cells[:, c]
        if k == 0:
            root = place
            continue
        stretch = float(np.ptp(place, axis=0).max()) * metres_per_unit
        if stretch > _LARGEST_STRETCH_M:
            raise InputError(
                f"{path}: joint '{joint.name}' moves {stretch * 1e3:.1f} mm against its parent; only bones of "
                "fixed length can be read: export with rotations only below the root"
            )
        offsets[k] = place[0]
    offsets[0] = 0.0
    skeleton = Skeleton(
        tuple(joint.name for joint in joints),
        np.array([joint.parent for joint in joints]),
        in_world(offsets) * metres_per_unit,
        tuple(orders),
    )
    return Motion(skeleton, rate, in_world(root) * metres_per_unit, without_flips(rotations_in_world(rotations)))
