"""ASF/AMC: Acclaim's skeleton file and motion file, as in CMU's motion capture database.

A bone has a direction and a length in the world of the rest pose, and its own axes C about which its degrees of
freedom rotate. Its rotation against the parent is C M C^-1 in axes that are parallel to the world's at rest (Lander
1998, "Working with Motion Capture File Formats"), the convention of ``mosca.data.motion.motion``. A bone's joint is
where the bone starts; the far end of a bone without children becomes a joint with ``_end``.
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
    multiply_quaternions,
    number,
    numbers,
    quaternions_from_euler,
    rotations_in_world,
    without_flips,
)
from mosca.errors import InputError

METRES_PER_INCH = 0.0254
"""ASF ``length`` is units per inch: CMU's 0.45 makes a unit of 0.0254 / 0.45 = 0.0564444 m."""
_DOFS = ("rx", "ry", "rz")


@dataclass
class _Bone:
    name: str
    direction: Array = field(default_factory=lambda: np.zeros(3))  # start to end, world of the rest pose
    length: float = 0.0
    axis_angles: Array = field(default_factory=lambda: np.zeros(3))
    axis_order: str = "XYZ"  # rotations applied first to last about fixed axes
    dofs: tuple[str, ...] = ()
    parent: str = ""


@dataclass
class _Subject:
    bones: dict[str, _Bone]  # "root" first
    root_channels: tuple[str, ...]
    root_position: Array
    length: float
    in_degrees: bool


def read_asf_amc(
    asf: Path, amc: Path, *, frame_rate_hz: float = 120.0, metres_per_unit: float | None = None
) -> Motion:
    """Return the motion in AMC file ``amc`` of the subject in ASF file ``asf`` in the world (Z up, m).

    AMC states no frame rate: CMU's is 120 Hz. ``metres_per_unit`` replaces 0.0254 / ``length``. Bones that the AMC
    never names keep the rest pose. Raises InputError naming file, line and what is expected.
    """
    subject = _read_asf(read_text(asf, "an ASF file", "latin-1"), asf)
    unit = METRES_PER_INCH / subject.length if metres_per_unit is None else metres_per_unit
    if not (unit > 0 and frame_rate_hz > 0):
        raise InputError(f"{amc}: metres_per_unit and frame_rate_hz must be positive")
    values, in_degrees = _read_amc(read_text(amc, "an AMC file", "latin-1", MOST_TABLE_BYTES), amc, subject)
    return _motion(subject, values, frame_rate_hz, unit, in_degrees)


def _read_asf(text: str, path: Path) -> _Subject:
    subject = _Subject({"root": _Bone("root")}, (), np.zeros(3), 1.0, True)
    section, bone = "", None
    for line_number, line in enumerate(text.split("\n"), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}: line {line_number}"
        if bone is not None and (words[0] == "begin" or words[0].startswith(":")):
            raise InputError(f"{where}: '{words[0]}' stands in a bone that has not ended; 'end' is wanted before it")
        if words[0].startswith(":"):
            section = words[0][1:]
        elif section == "units" and len(words) == 2 and words[0] == "length":
            subject.length = number(words[1], where)
            if not subject.length > 1e-6:
                raise InputError(f"{where}: length {words[1]} given, a positive scale wanted (CMU has 0.45)")
        elif section == "units" and words[0] == "angle":
            subject.in_degrees = words[1:2] != ["rad"]
        elif section == "root":
            _read_root_line(subject, words, where)
        elif section == "bonedata" and words[0] == "begin":
            bone = _Bone("")
        elif section == "bonedata" and words[0] == "end":
            if bone is None or not bone.name or bone.name in subject.bones:
                raise InputError(f"{where}: this bone has no name or one that is used twice; names must differ")
            subject.bones[bone.name] = bone
            bone = None
        elif section == "bonedata" and bone is not None:
            _read_bone_line(bone, words, where)
        elif section == "hierarchy" and words[0] not in ("begin", "end"):
            _read_children(subject.bones, words, where)
    if bone is not None:
        raise InputError(f"{path}: its last bone has no 'end'; it is cut short")
    if not subject.root_channels:
        raise InputError(f"{path}: no ':root' section with an 'order' line; an ASF file is wanted")
    loose = [b.name for b in subject.bones.values() if b.name != "root" and not b.parent]
    if loose:
        raise InputError(f"{path}: bones {', '.join(loose)} have no parent in ':hierarchy'; add them")
    return subject


def _read_root_line(subject: _Subject, words: list[str], where: str) -> None:
    key, rest = words[0], words[1:]
    if key == "order":
        channels = tuple(word.lower() for word in rest)
        allowed = {"tx", "ty", "tz", *_DOFS}
        if not channels or not set(channels) <= allowed or len(set(channels)) < len(channels):
            raise InputError(f"{where}: root order '{' '.join(rest)}' given; different ones of TX TY TZ RX RY RZ")
        subject.root_channels = channels
    elif key == "axis":
        subject.bones["root"].axis_order = _axis_order(rest[:1], where)
    elif key == "position":
        subject.root_position = _three(rest, where)
    elif key == "orientation" and np.any(_three(rest, where) != 0):
        raise InputError(f"{where}: a root orientation other than 0 0 0 is not supported; turn the motion instead")


def _read_bone_line(bone: _Bone, words: list[str], where: str) -> None:
    key, rest = words[0], words[1:]
    if key == "name" and rest:
        bone.name = rest[0]
    elif key == "direction":
        bone.direction = _three(rest, where)
    elif key == "length":
        bone.length = number(rest[0] if rest else "", where)
    elif key == "axis":
        bone.axis_angles = _three(rest[:3], where)
        bone.axis_order = _axis_order(rest[3:4], where)
    elif key == "dof":
        bone.dofs = tuple(word.lower() for word in rest)
        if not set(bone.dofs) <= set(_DOFS) or len(set(bone.dofs)) < len(bone.dofs):
            raise InputError(f"{where}: dof '{' '.join(rest)}' given; different ones of rx ry rz wanted")


def _read_children(bones: dict[str, _Bone], words: list[str], where: str) -> None:
    parent, children = words[0], words[1:]
    # Parents come before their children in every ASF file; it also rules out cycles.
    if parent not in bones or (parent != "root" and not bones[parent].parent):
        raise InputError(f"{where}: '{parent[:40]}' stands in ':hierarchy' before it has a parent of its own")
    for child in children:
        if child not in bones or child == "root" or bones[child].parent:
            raise InputError(f"{where}: '{child[:40]}' is no bone of ':bonedata' or has two parents")
        bones[child].parent = parent


def _three(words: list[str], where: str) -> Array:
    if len(words) != 3:
        raise InputError(f"{where}: {len(words)} numbers given, 3 wanted")
    return np.array([number(word, where) for word in words])


def _axis_order(words: list[str], where: str) -> str:
    order = "".join(words).upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise InputError(f"{where}: axis order '{order[:40]}' given; XYZ or another order of the three wanted")
    return order


def _read_amc(text: str, path: Path, subject: _Subject) -> tuple[dict[str, Array], bool]:
    """Return each bone's numbers (t, its degrees of freedom), and whether angles are in degrees."""
    in_degrees = subject.in_degrees
    cells: list[str] = []
    first: list[str] = []  # bone names of the first frame; all frames must have the same
    names: list[str] = []
    counts = {name: len(bone.dofs) for name, bone in subject.bones.items()}
    counts["root"] = len(subject.root_channels)
    frames = number_of_frame = 0
    for line_number, line in enumerate(text.split("\n"), 1):
        words = line.split()
        if not words or words[0][0] in ":#":
            if words and words[0].upper() in (":DEGREES", ":RADIANS"):
                in_degrees = words[0].upper() == ":DEGREES"
        elif len(words) == 1 and words[0].isdecimal():
            if frames == 1:
                first = names
            _check_frame(names, first, frames, f"{path}: line {line_number}")
            if frames and words[0] != str(number_of_frame + 1):
                raise InputError(
                    f"{path}: line {line_number}: frame {words[0][:20]} follows {number_of_frame}; a frame is "
                    "missing, and leaving it out would shift all that follow"
                )
            number_of_frame = int(number(words[0], f"{path}: line {line_number}"))
            names, frames = [], frames + 1
        elif not frames or counts.get(words[0]) != len(words) - 1:
            wanted = f"{counts[words[0]]} numbers" if words[0] in counts else "a bone of the ASF file"
            raise InputError(
                f"{path}: line {line_number}: '{words[0][:40]}' with {len(words) - 1} numbers given, {wanted} wanted"
            )
        else:
            names.append(words[0])
            cells += words[1:]
    first = names if frames == 1 else first
    _check_frame(names, first, frames, f"{path}: at its end")
    if not frames or "root" not in first or len(set(first)) < len(first):
        raise InputError(f"{path}: no frame with a root and each bone once; an AMC file is wanted")
    table = numbers(cells, str(path)).reshape(frames, -1)
    ends = np.cumsum([counts[name] for name in first])
    return {n: table[:, end - counts[n] : end] for n, end in zip(first, ends, strict=True)}, in_degrees


def _check_frame(names: list[str], first: list[str], frames: int, where: str) -> None:
    if frames > 1 and names != first:
        odd = sorted(set(names) ^ set(first)) or ["another order"]
        raise InputError(f"{where}: frame has other bones than the first ({', '.join(odd)[:80]}); is it cut short?")


def _motion(subject: _Subject, values: dict[str, Array], rate: float, unit: float, in_degrees: bool) -> Motion:
    bones = _parents_first(subject.bones)
    index = {bone.name: k for k, bone in enumerate(bones)}
    frames = len(values["root"])
    root_turns = tuple(f"r{axis.lower()}" for axis in subject.bones["root"].axis_order)
    orders: list[str] = []
    rotations: list[Array] = []
    for bone in bones:
        # The root rotates in its axis order, whatever the order of its columns.
        columns = subject.root_channels if bone.name == "root" else bone.dofs
        dofs = tuple(d for d in root_turns if d in columns) if bone.name == "root" else columns
        cells = values.get(bone.name, np.zeros((frames, len(columns))))
        cells = cells[:, [columns.index(dof) for dof in dofs]] * (np.pi / 180 if in_degrees else 1.0)
        # First to last about fixed axes: the last one is leftmost in the product.
        orders.append("".join(dof[1].upper() for dof in dofs[::-1]))
        turn = quaternions_from_euler(cells[:, ::-1], orders[-1])
        axes = _axes(bone, subject.in_degrees)
        rotations.append(multiply_quaternions(multiply_quaternions(axes, turn), axes * [1, -1, -1, -1]))
    parents_of_children = {bone.parent for bone in bones}
    leaves = [bone for bone in bones if bone.name not in parents_of_children and bone.name != "root"]
    still = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (frames, 4))
    starts = [subject.bones[bone.parent] for bone in bones[1:]]
    offsets = [np.zeros(3), *(bone.direction * bone.length for bone in (*starts, *leaves))]
    root = np.tile(subject.root_position, (frames, 1))
    for k, channel in enumerate(("tx", "ty", "tz")):
        if channel in subject.root_channels:
            root[:, k] += values["root"][:, subject.root_channels.index(channel)]
    skeleton = Skeleton(
        (*(bone.name for bone in bones), *(bone.name + END_SUFFIX for bone in leaves)),
        np.array([-1, *(index[b.parent] for b in bones[1:]), *(index[b.name] for b in leaves)]),
        in_world(np.array(offsets)) * unit,
        (*orders, *("" for _ in leaves)),
    )
    quaternions = np.stack([*rotations, *(still for _ in leaves)], axis=1)
    return Motion(skeleton, rate, in_world(root) * unit, without_flips(rotations_in_world(quaternions)))


def _axes(bone: _Bone, in_degrees: bool) -> Array:
    """Return the quaternion (4,) of the bone's axes C at rest."""
    order = bone.axis_order[::-1]
    angles = np.array([bone.axis_angles["XYZ".index(axis)] for axis in order])
    return quaternions_from_euler(np.deg2rad(angles) if in_degrees else angles, order)


def _parents_first(bones: dict[str, _Bone]) -> list[_Bone]:
    ordered = [bones["root"]]
    for bone in ordered:  # grows while it is walked: breadth first
        ordered += [child for child in bones.values() if child.parent == bone.name]
    return ordered
