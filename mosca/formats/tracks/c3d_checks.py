"""Check of a C3D file's parameter section: ezc3d follows its offsets and group numbers unchecked and can crash.

The records are walked as the C3D user guide lays them out: name length, group number (negative for a group), name,
offset of the next record, then for a parameter its type, dimensions and values, and a description.
"""

import math
import struct
from collections.abc import Mapping
from typing import NamedTuple

BLOCK = 512
KEY = 0x50
PROCESSORS = {84: "<", 85: "<", 86: ">"}
CHARACTERS = 0xFF
TYPES = {CHARACTERS: 1, 1: 1, 2: 2, 4: 4}
"""Bytes of a value: characters, bytes, 16-bit whole numbers, floats."""
NEEDED = {"USED": 2, "SCALE": 4, "RATE": 4, "DATA_START": 2, "FRAMES": 2}
"""Parameters that the group POINT must have, and the least number of bytes of their value."""
SCALARS = ("USED", "RATE", "RATIO", "DATA_START", "GEN_SCALE")
"""Parameters whose first value ezc3d takes, in the groups that it interprets."""
INTERPRETED = ("ANALOG", "ROTATION", "FORCE_PLATFORM")
MOST_DIMENSIONS = 7
MOST_BYTES = 1 << 26
"""Largest file [B]: ezc3d takes 17 bytes of memory for an analog sample, which takes 2 or 4 in the file."""
MOST_SAMPLES = 3 << 20
"""Most points times frames: ezc3d takes 265 bytes of memory for each, which takes 8 or 16 in the file."""
ROTATION_BYTES = 17 * 4
"""Bytes of a rotation: a matrix of 4 x 4 and its reliability."""


def fault_of(data: bytes) -> str:
    """Return what is wrong with the header and parameters of a C3D file's bytes; "" for nothing."""
    if len(data) < BLOCK or data[1] != KEY:
        return "its first block is not a C3D header"
    start = BLOCK * (data[0] - 1)
    if start < BLOCK or start + 4 > len(data):
        return f"its parameters are said to be in block {data[0]}, which is not there"
    blocks, processor = data[start + 2], data[start + 3]
    if processor not in PROCESSORS:
        return f"processor {processor} given; 84 (Intel), 85 (DEC) and 86 (MIPS) are known"
    section, order = data[start : start + BLOCK * max(blocks, 1)], PROCESSORS[processor]
    held: dict[tuple[str, str], _Value] = {}
    try:
        return _fault_of_section(section, order, held) or _fault_of_sizes(data, order, held)
    except (IndexError, struct.error):
        return "its parameters run past the end of their section"


def frames_of_parameters(data: bytes) -> int:
    """Return POINT:FRAMES of a file without a fault, 0 where it is not given as a 16-bit whole number."""
    start = BLOCK * (data[0] - 1)
    section, held = data[start : start + BLOCK * max(data[start + 2], 1)], dict[tuple[str, str], _Value]()
    _fault_of_section(section, PROCESSORS[data[start + 3]], held)
    return held["POINT", "FRAMES"].first


class _Value(NamedTuple):
    """Type, number and first value (as a 16-bit whole number; 0 for others) of a parameter."""

    kind: int
    n: int
    first: int


def _fault_of_section(section: bytes, order: str, held: dict[tuple[str, str], _Value]) -> str:
    """Return what is wrong with the parameters; ``held`` is filled with them, by group and name."""
    groups: dict[int, str] = {}
    parameters: list[tuple[int, str, _Value]] = []
    at = 4
    while section[at]:
        length = abs(struct.unpack_from("b", section, at)[0])
        group = struct.unpack_from("b", section, at + 1)[0]
        name = section[at + 2 : at + 2 + length].decode("latin-1").upper()
        at += 2 + length
        step = struct.unpack_from(f"{order}H", section, at)[0]
        end, kind, count = at + 2, 0, 0
        if group > 0:
            kind, n_dimensions = section[end], section[end + 1]
            if kind not in TYPES or n_dimensions > MOST_DIMENSIONS:
                return f"parameter {name!r} has type {kind} and {n_dimensions} dimensions"
            if kind == CHARACTERS and n_dimensions == 0:
                return f"parameter {name!r} is a text without a length"  # ezc3d takes its first dimension
            count = math.prod(section[end + 2 + k] for k in range(n_dimensions))
            end += 2 + n_dimensions
            first = struct.unpack_from(f"{order}H", section, end)[0] if kind == 2 and count else 0
            end += count * TYPES[kind]
            parameters.append((group, name, _Value(kind, count, first)))
        elif group < 0:
            if -group in groups or name in groups.values():
                return f"group {name!r} stands twice"
            groups[-group] = name
        else:
            return f"record {name!r} belongs to no group"
        end += 1 + section[end]
        if end > len(section):
            return f"record {name!r} runs past the end of the parameters"
        if step == 0:
            break
        if at + step < end:
            return f"record {name!r} overlaps the next"
        at += step
    for number, name, value in parameters:
        if number not in groups:
            return f"parameter {name!r} is in group {number}, which is not there"
        held[groups[number], name] = value
    return _fault_of_values(held)


def _fault_of_values(held: Mapping[tuple[str, str], _Value]) -> str:
    """Return which parameter is missing or is no number; "" for none."""
    for (group, name), value in held.items():
        if group in INTERPRETED and name in SCALARS and value.n == 0:
            return f"parameter {group}:{name} has no value"
    for name, width in NEEDED.items():
        kind, count, _ = held.get(("POINT", name), _Value(0, 0, 0))
        if count != 1 or TYPES[kind] not in (2, 4) or (width == 4 and kind != 4):
            return f"parameter POINT:{name} is missing or is no number"
    return ""


def _fault_of_sizes(data: bytes, order: str, held: Mapping[tuple[str, str], _Value]) -> str:
    """Return what would take too much memory, or lies behind the end of the file; "" for nothing."""

    def stated(group: str, name: str) -> int:
        return held.get((group, name), _Value(0, 0, 0)).first

    n_points, first, last = struct.unpack_from(f"{order}2xH2x2H", data)
    if last < first:
        return f"its header states frames {first} to {last}"
    n_points, n_frames = max(n_points, stated("POINT", "USED")), max(last - first + 1, stated("POINT", "FRAMES"))
    if n_points * n_frames > MOST_SAMPLES:
        return f"{n_points} points in {n_frames} frames; at most {MOST_SAMPLES} samples are read; cut it into parts"
    # ezc3d ends the process where rotations are missing
    n_rotations = stated("ROTATION", "USED") * max(stated("ROTATION", "RATIO"), 1) * n_frames
    end = BLOCK * (stated("ROTATION", "DATA_START") - 1) + n_rotations * ROTATION_BYTES
    return f"cut short, {len(data)} of {end} bytes" if n_rotations and end > len(data) else ""
