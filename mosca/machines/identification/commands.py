"""Commands from a CSV file: a clock, and a column for each input.

The clock is ``time_ns`` or ``time_s``, on the tracks' session clock, or ``frame``, a frame number of the tracks.
Inputs are ``left`` and ``right``, or ``pwm_left`` and ``pwm_right`` (as in a run folder's commands.csv), in the unit
of the motor's driver, or columns given to the reader; other columns are ignored. Each row sets its values at its
time; they hold until the next row. Before the first row they are 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import parsed, read_named, read_rows
from mosca.machines.identification.held_inputs import HeldInputs

CLOCKS = ("time_ns", "time_s", "frame")
SIDES = (("left", "right"), ("pwm_left", "pwm_right"))
MOST_INPUTS = 16


@dataclass(frozen=True, eq=False)
class CommandRows:
    """Rows of a file of commands: ``at`` (m,) in the unit of ``clock``, rising; ``values`` (m, k) of the inputs."""

    clock: str
    at: Array
    names: tuple[str, ...]
    values: Array

    def __post_init__(self) -> None:
        m = len(np.asarray(self.at))
        set_read_only(self, np.float64 if self.clock == "time_s" else np.int64, at=(m,))
        set_read_only(self, values=(m, len(self.names)))

    def held(self, origin_ns: int, first_frame: int, period_s: float) -> HeldInputs:
        """Return the inputs on a clock that is 0 at ``origin_ns``, when ``first_frame`` was exposed."""
        match self.clock:
            case "time_ns":
                at = (self.at - origin_ns) * 1e-9
            case "time_s":
                at = self.at - origin_ns * 1e-9
            case _:
                at = (self.at - first_frame) * period_s
        return HeldInputs(self.names, at, self.values)


def read_commands(path: Path, inputs: Sequence[str] = ()) -> CommandRows:
    """Read commands. Raises InputError naming column or row and what is allowed.

    ``inputs``: the columns that are inputs, where they are not those of ``SIDES``.
    """
    path = Path(path)
    rows = read_rows(path)
    header = rows[0] if rows else []
    clocks = [name for name in CLOCKS if name in header]
    if len(clocks) != 1:
        raise InputError(
            f"{path}: its first line has {' and '.join(clocks) or 'no column'} for the time; one of "
            f"{', '.join(CLOCKS)} is wanted"
        )
    names = tuple(inputs) or next((pair for pair in SIDES if set(pair) <= set(header)), SIDES[0])
    if len(set(names)) < len(names) or len(names) > MOST_INPUTS or set(names) & set(CLOCKS):
        raise InputError(
            f"--inputs {','.join(names)[:60]}: 1 to {MOST_INPUTS} different columns are wanted, none of them a clock"
        )
    cells = read_named(path, (clocks[0], *names), (), "table of commands")
    at = parsed(cells[clocks[0]], clocks[0], float if clocks[0] == "time_s" else int, path)
    values = np.array([parsed(cells[name], name, float, path) for name in names]).T.reshape(len(at), len(names))
    if not len(at):
        raise InputError(f"{path}: no commands; a row for each is wanted")
    for name, column in ((clocks[0], at), *zip(names, values.T, strict=True)):
        if not np.isfinite(column).all():
            line = int(np.flatnonzero(~np.isfinite(column))[0]) + 2
            raise InputError(f"{path}, row {line}: {name} is no finite number; a command has all of its values")
    if (falling := np.flatnonzero(at[1:] <= at[:-1])).size:
        raise InputError(
            f"{path}, row {int(falling[0]) + 3}: {clocks[0]} does not rise; commands stand in order of time"
        )
    return CommandRows(clocks[0], at, names, values)
