"""CSV files with fixed columns: numbers at full precision, a one-line error for an invalid cell."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files import decimals
from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.files.whole_file import whole_file
from mosca.errors import InputError


def write_columns(path: Path, names: Sequence[str], columns: Sequence[Sequence[str]]) -> None:
    """Write columns of text (each of n cells) under ``names``, whole or not at all."""
    with whole_file(Path(path)) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*columns, strict=True))


def read_columns(path: Path, names: Sequence[str], kind: str) -> dict[str, Sequence[str]]:
    """Return the cells (n) of each column of a CSV file that begins with the line ``names``.

    ``kind``: the name of such files in errors. Raises InputError where the file cannot be read or begins otherwise,
    or a row is too short or too long.
    """
    rows = read_rows(path)
    if not rows or rows[0] != list(names):
        raise InputError(f"{path}: its first line is not that of a {kind}; wanted is {','.join(names)}")
    return _columns(path, rows)


def read_named(path: Path, needed: Sequence[str], optional: Sequence[str], kind: str) -> dict[str, Sequence[str]]:
    """Return the cells (n) of the columns ``needed``, and of those ``optional`` ones that the file has.

    Columns may be in any order; others are ignored. ``kind``: the name of such files in errors. Raises InputError
    where the file cannot be read, lacks a column or names one twice, or a row is too short or too long.
    """
    rows = read_rows(path)
    header = rows[0] if rows else []
    for name in needed:
        if header.count(name) != 1:
            many = "lacks" if name not in header else "has more than one of"
            raise InputError(
                f"{path}: its first line {many} the column '{name}'; a {kind} has {', '.join(needed)}, and may have "
                f"{', '.join(optional)}"
            )
    for name in optional:
        if header.count(name) > 1:
            raise InputError(f"{path}: its first line has more than one of the column '{name}'; leave one")
    columns = _columns(path, rows)
    return {name: columns[name] for name in (*needed, *optional) if name in columns}


def read_rows(path: Path) -> list[list[str]]:
    """Return the cells of each line of a CSV file; InputError where it cannot be read."""
    text = read_text(path, "a CSV table", most_bytes=MOST_TABLE_BYTES)
    try:
        return list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}") from None


def _columns(path: Path, rows: list[list[str]]) -> dict[str, Sequence[str]]:
    names = rows[0]
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(names):
            raise InputError(f"{path}, row {line}: {len(row)} values given, {len(names)} wanted")
    if len(rows) == 1:
        return dict.fromkeys(names, ())
    return dict(zip(names, zip(*rows[1:], strict=True), strict=True))


def integers(values: Array) -> list[str]:
    """Return whole numbers as text."""
    return list(map(str, values.tolist()))


def reals(values: Array) -> list[str]:
    """Return the shortest decimals that read back to the same float64; an empty text for an unknown one (NaN)."""
    return ["" if value != value else repr(value) for value in values.tolist()]


def parsed(cells: Sequence[str], name: str, kind: type[int] | type[float], path: Path) -> Array:
    """Return a column's cells as numbers (n,), empty ones as NaN; InputError names an invalid row."""
    try:
        if kind is int:
            return np.array(decimals.integers(cells), dtype=np.int64)
        return np.array(decimals.reals(cell or "nan" for cell in cells))
    except (ValueError, OverflowError):
        line, cell = next((k, c) for k, c in enumerate(cells, start=2) if not _is(kind, c))
        wanted = "a whole number of 64 bit" if kind is int else "a number or nothing"
        raise InputError(f"{path}, row {line}: {name} = {cell[:40]!r}; {wanted} is wanted") from None


def one_of(cells: Sequence[str], name: str, allowed: Sequence[str], path: Path) -> Array:
    """Return a column's words (n,); InputError names the row of one that is not allowed."""
    for line, cell in enumerate(cells, start=2):
        if cell not in allowed:
            raise InputError(f"{path}, row {line}: {name} {cell[:40]!r}; {', '.join(allowed)} are allowed")
    return np.array(cells, dtype=np.str_)


def _is(kind: type[int] | type[float], cell: str) -> bool:
    try:
        if kind is int:
            return -(2**63) <= decimals.integers([cell])[0] < 2**63
        return not cell or decimals.real(cell) is not None
    except ValueError:
        return False
