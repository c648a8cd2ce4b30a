"""Mutants of a file: what damage, other programs and people make of it. Text by structure, binary by bytes."""

import re
import struct
from collections.abc import Callable
from random import Random

EXTREMES = (
    b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-320", b"-1", b"0", b"-0.0", b"2147483648", b"-2147483649",
    b"9223372036854775808", b"9223372036854775807", b"18446744073709551616", b"7" * 5000, b"", b"1_0", b"0x10",
    b"1,5", b"+5", b"1e5", b"\xd9\xa3", b"true", b'"3"', b"[]", b"1.5",
)  # fmt: skip
BLANKS = (b"\x0b", b"\x0c", b"\x1c", b"\x85", b"\xc2\xa0", b"\xe2\x80\xa8", b"\x00", b"\r", b"\t", b" ", b"")
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")
LARGEST = (0, 1, 2**7, 2**8 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


def mutant(data: bytes, text: bool, dice: Random) -> bytes:
    """Return ``data`` with one to three mutations; ``text``: of those for text too."""
    kinds = BINARY + 2 * TEXT if text else BINARY
    for _ in range(dice.choice((1, 1, 1, 1, 1, 2, 3))):
        data = dice.choice(kinds)(data, dice)
    return data


def _flip(data: bytes, dice: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 8))) if data else ():
        at = dice.randrange(len(data))
        changed[at] = changed[at] ^ 1 << dice.randrange(8) if dice.random() < 0.6 else dice.randrange(256)
    return bytes(changed)


def _cut(data: bytes, dice: Random) -> bytes:
    return data[: dice.randrange(len(data) + 1)]


def _span(data: bytes, dice: Random) -> tuple[int, int]:
    begin = dice.randrange(len(data) + 1)
    return begin, min(len(data), begin + dice.choice((1, 4, 8, 64, 512, 4096)))


def _twice(data: bytes, dice: Random) -> bytes:
    begin, end = _span(data, dice)
    return data[:end] + data[begin:end] + data[end:]


def _without(data: bytes, dice: Random) -> bytes:
    begin, end = _span(data, dice)
    return data[:begin] + data[end:]


def _zeros(data: bytes, dice: Random) -> bytes:
    begin, end = _span(data, dice)
    return data[:begin] + bytes(end - begin) + data[end:]


def _swapped(data: bytes, dice: Random) -> bytes:
    (a, b), (c, d) = sorted((_span(data, dice), _span(data, dice)))
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _large(data: bytes, dice: Random) -> bytes:
    """Overwrite a field of 2, 4 or 8 bytes by an extreme whole number or float."""
    width = dice.choice((2, 4, 8))
    at = dice.randrange(max(len(data) - width, 0) + 1)
    order = dice.choice(("little", "big"))
    field = (dice.choice(LARGEST) % 2 ** (8 * width)).to_bytes(width, order)  # type: ignore[arg-type]
    if dice.random() < 0.3:
        value = dice.choice((float("nan"), float("inf"), -1.0, 1e30, -0.0))
        field = struct.pack({2: "<e", 4: "<f", 8: "<d"}[width], value if width > 2 or abs(value) < 6e4 else 0.0)
    return data[:at] + field + data[at + width :]


def _lines(change: Callable[[list[bytes], Random], None]) -> Callable[[bytes, Random], bytes]:
    def changed(data: bytes, dice: Random) -> bytes:
        lines = data.split(b"\n")
        change(lines, dice)
        return b"\n".join(lines)

    return changed


def _line_twice(lines: list[bytes], dice: Random) -> None:
    begin = dice.randrange(len(lines))
    lines[begin:begin] = lines[begin : begin + dice.choice((1, 1, 3, 10))]


def _line_gone(lines: list[bytes], dice: Random) -> None:
    begin = dice.randrange(len(lines))
    del lines[begin : begin + dice.choice((1, 1, 3, 10))]


def _lines_swapped(lines: list[bytes], dice: Random) -> None:
    a, b = dice.randrange(len(lines)), dice.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]


def _number(data: bytes, dice: Random) -> bytes:
    """Another number, or what somebody takes for one, in a number's place; now and then in all of a line."""
    found = list(NUMBER.finditer(data))
    if not found:
        return data
    one = dice.choice(found)
    return data[: one.start()] + dice.choice(EXTREMES) + data[one.end() :]


def _in_number(data: bytes, dice: Random) -> bytes:
    found = list(NUMBER.finditer(data))
    if not found:
        return data
    one = dice.choice(found)
    at = dice.randrange(one.start(), one.end())
    return data[:at] + dice.choice((b"_", b",", b".", b" ", b"e", b"-", b"0", b"\xef\xbc\x91")) + data[at + 1 :]


def _key(data: bytes, dice: Random) -> bytes:
    """Rename or delete a word, or let two change places."""
    found = list(WORD.finditer(data))
    if not found:
        return data
    a, b = sorted((dice.choice(found), dice.choice(found)), key=lambda one: one.start())
    match dice.randrange(4):
        case 0:
            return data[: a.start()] + data[a.end() :]
        case 1:
            return data[: a.start()] + a[0] + b"x" + data[a.end() :]
        case 2:
            return data[: a.start()] + b[0] + data[a.end() :]
    if a.end() > b.start():
        return data
    return data[: a.start()] + b[0] + data[a.end() : b.start()] + a[0] + data[b.end() :]


def _blank(data: bytes, dice: Random) -> bytes:
    found = [k for k, byte in enumerate(data) if byte in b" \t\n,"]
    at = dice.choice(found) if found else 0
    return data[:at] + dice.choice(BLANKS) + data[at + 1 :]


def _encoding(data: bytes, dice: Random) -> bytes:
    text = data.decode("utf-8", "replace")
    match dice.randrange(6):
        case 0:
            return b"\xef\xbb\xbf" + data
        case 1:
            return text.encode("utf-16")
        case 2:
            return data.replace(b"\n", b"\r\n")
        case 3:
            return data.replace(b"\n", b"\r")
        case 4:
            return text.encode("utf-32")
    at = dice.randrange(len(data) + 1)
    return data[:at] + dice.choice((b"\xfc", b"\xff\xfe", b"\xed\xa0\x80", "ü".encode())) + data[at:]


BINARY = (_flip, _flip, _cut, _twice, _without, _zeros, _swapped, _large)
TEXT = (
    _number, _number, _number, _in_number, _in_number, _key, _key, _blank, _encoding,
    _lines(_line_twice), _lines(_line_gone), _lines(_lines_swapped),
)  # fmt: skip
