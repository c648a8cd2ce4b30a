"""``angles.csv``: one line a frame; ``frame,time_ns``, then ``NAME_deg,NAME_sigma_deg`` of each angle, in degrees.

``mosca.skeleton.isb_angles`` defines each name. Cells are empty where unknown.
"""

from pathlib import Path

import numpy as np

from mosca.data.joint_angles import JointAngles
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import integers, parsed, read_columns, read_rows, reals, write_columns

_VALUE, _SIGMA = "_deg", "_sigma_deg"


def write_angles_csv(angles: JointAngles, path: Path) -> None:
    """Write ``angles`` to ``path``, whole or not at all. Raises InputError where that fails."""
    columns = [integers(angles.frame), integers(angles.time_ns)]
    for k in range(len(angles.names)):
        columns += [reals(np.rad2deg(angles.angles[:, k])), reals(np.rad2deg(angles.sigma[:, k]))]
    write_columns(path, _header(angles.names), columns)


def read_angles_csv(path: Path) -> JointAngles:
    """Read an ``angles.csv``. Raises InputError naming the row or column and what is allowed."""
    path = Path(path)
    rows = read_rows(path)
    names = tuple(cell.removesuffix(_VALUE) for cell in (rows[0] if rows else [])[2::2])
    if len(set(names)) < len(names):
        raise InputError(f"{path}: its first line names an angle twice; each angle has one name")
    cells = read_columns(path, _header(names), "table of joint angles")
    n = len(cells["frame"])
    values = [np.empty((n, len(names))) for _ in range(2)]
    for table, suffix in zip(values, (_VALUE, _SIGMA), strict=True):
        for k, name in enumerate(names):
            table[:, k] = np.deg2rad(parsed(cells[name + suffix], name + suffix, float, path))
        if np.isinf(table).any():
            row, k = np.argwhere(np.isinf(table))[0]
            raise InputError(
                f"{path}, row {row + 2}: {names[k]}{suffix} is not finite; a number or nothing is wanted"
            )
    frame, time_ns = (parsed(cells[name], name, int, path) for name in ("frame", "time_ns"))
    return JointAngles(frame, time_ns, names, *values)


def _header(names: tuple[str, ...]) -> tuple[str, ...]:
    return ("frame", "time_ns", *(name + suffix for name in names for suffix in (_VALUE, _SIGMA)))
