"""Is a C3D file's parameter section whole? ezc3d follows its offsets and group numbers unchecked and can crash.

Walks the records as the C3D user guide lays them out: name length, group number (negative for a group), name, offset
of the next record, then for a parameter its type, dimensions and values, and a description.
"""

import math
import struct

BLOCK = 512
KEY = 0x50
PROCESSORS = {84: "<", 85: "<", 86: ">"}
TYPES = {0xFF: 1, 1: 1, 2: 2, 4: 4}
"""Bytes of a value: characters, bytes, 16-bit whole numbers, floats."""
NEEDED = {"USED": 2, "SCALE": 4, "RATE": 4, "DATA_START": 2, "FRAMES": 2}
"""Parameters of the group POINT, and bytes of their value at least."""
MOST_DIMENSIONS = 7


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
    try:
        return _fault_of_section(data[start : start + BLOCK * max(blocks, 1)], PROCESSORS[processor])
    except (IndexError, struct.error):
        return "its parameters run past the end of their section"


def _fault_of_section(section: bytes, order: str) -> str:
    groups: dict[int, str] = {}
    parameters: list[tuple[int, str, int, int]] = []
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
            count = math.prod(section[end + 2 + k] for k in range(n_dimensions))
            end += 2 + n_dimensions + count * TYPES[kind]
            parameters.append((group, name, kind, count))
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
    return _fault_of_names(groups, parameters)


def _fault_of_names(groups: dict[int, str], parameters: list[tuple[int, str, int, int]]) -> str:
    """Return what is missing, or in no group."""
    held: dict[tuple[str, str], tuple[int, int]] = {}
    for group, name, kind, count in parameters:
        if group not in groups:
            return f"parameter {name!r} is in group {group}, which is not there"
        held[groups[group], name] = kind, count
    for name, width in NEEDED.items():
        kind, count = held.get(("POINT", name), (0, 0))
        if count != 1 or TYPES[kind] not in (2, 4) or (width == 4 and kind != 4):
            return f"parameter POINT:{name} is missing or is no number"
    return ""
