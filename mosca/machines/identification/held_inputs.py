"""Inputs that are held between commands, and their exact values on the grid of the exposures."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class HeldInputs:
    """Values of k inputs, set by each command and held until the next; 0 before the first."""

    names: tuple[str, ...]
    time_s: Array
    """(m,) rising [s]."""
    values: Array
    """(m, k) in the unit of the commands, PWM for example."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        m = len(np.asarray(self.time_s))
        set_read_only(self, time_s=(m,), values=(m, len(self.names)))
        if not m or np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s: one command or more at rising times wanted")
        if not (np.isfinite(self.time_s).all() and np.isfinite(self.values).all()):
            raise ValueError("commands: finite times and values wanted")


@dataclass(frozen=True)
class IntervalGrid:
    """Instants start_s + i period_s for i = 0..n [s], and the n intervals between them."""

    start_s: float
    period_s: float
    n: int

    def instants(self) -> Array:
        """Return the instants (n + 1,) [s]."""
        return self.start_s + self.period_s * np.arange(self.n + 1)


@dataclass(frozen=True, eq=False)
class InputsOnGrid:
    """Inputs on a grid of n intervals: k values each, exact for commands at any time."""

    at_start: Array
    """(n, k) values at the start of each interval."""
    mean: Array
    """(n, k) means over each interval."""
    row: Array
    """(j,) interval of each command that falls into one."""
    rest_s: Array
    """(j,) time from that command to the interval's end [s]."""
    step: Array
    """(j, k) change of the inputs by that command."""


def on_grid(inputs: HeldInputs, delay_s: float, grid: IntervalGrid) -> InputsOnGrid:
    """Return the inputs, each command taking effect ``delay_s`` after its time."""
    place = (inputs.time_s + delay_s - grid.start_s) / grid.period_s
    row = np.ceil(place).astype(np.int64) - 1
    step = np.diff(inputs.values, axis=0, prepend=0.0)
    inside = (row >= 0) & (row < grid.n)
    changes = np.zeros((grid.n + 1, step.shape[1]))
    changes[0] = step[row < 0].sum(axis=0)
    np.add.at(changes, row[inside] + 1, step[inside])
    at_start = np.cumsum(changes, axis=0)[:-1]
    row, step = row[inside], step[inside]
    rest = (row + 1 - place[inside]) * grid.period_s
    mean = at_start.copy()
    np.add.at(mean, row, step * (rest / grid.period_s)[:, None])
    return InputsOnGrid(at_start, mean, row, rest, step)
