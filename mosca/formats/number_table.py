"""Tables that hold only numbers, from text files of other programs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.decimals import BLANKS, real, reals
from mosca.errors import InputError


def number_table(path: Path, rows: Sequence[tuple[int, Sequence[str]]], row: str, wanted: str) -> Array:
    """Return the cells (n, columns) of a file's rows as numbers, NaN where there is none.

    InputError names row and column of a cell that is no number, and a row that is not as long as the first one.

    Parameters
    ----------
    path
        The file, for messages.
    rows
        One or more rows, each with its number in the file and its cells.
    row
        What messages call a row: "row" or "line".
    wanted
        What messages say may stand in a cell.
    """
    table = np.empty((len(rows), len(rows[0][1])))
    for k, (number, cells) in enumerate(rows):
        if len(cells) != table.shape[1]:
            raise InputError(
                f"{path}, {row} {number}: {len(cells)} values given, {table.shape[1]} wanted as in the first row"
            )
        plain = [cell.strip(BLANKS) or "nan" for cell in cells]
        try:
            table[k] = reals(plain)
        except ValueError:
            column = next(j for j, cell in enumerate(plain) if not _is_number(cell))
            raise InputError(
                f"{path}, {row} {number}, column {column + 1}: {cells[column][:40]!r} given; {wanted} is wanted"
            ) from None
    return table


def _is_number(cell: str) -> bool:
    try:
        real(cell)
    except ValueError:
        return False
    return True
