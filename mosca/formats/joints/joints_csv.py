"""``joints.csv``: one line for each joint and frame, every number at full precision.

Columns ``frame,time_ns,joint``; the centre in the world [m] and six elements of its covariance [m^2]; the unit
quaternion wxyz of proximal_from_distal (for the pelvis: world_from_pelvis) and six elements of the covariance of its
rotation vector in the distal segment's axes [rad^2]. Cells are empty where unknown. Each frame has the same joints in
the same order.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.whole_file import begin_part, check_writable
from mosca.data.joint_motion import JointMotion
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import integers, parsed, read_columns, reals, write_columns

_ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_NAMES = ("xx", "yy", "zz", "xy", "xz", "yz")
_PLACE = ("x_m", "y_m", "z_m")
_PLACE_COVARIANCE = tuple(f"s{name}_m2" for name in _NAMES)
_TURN = ("qw", "qx", "qy", "qz")
_TURN_COVARIANCE = tuple(f"r{name}_rad2" for name in _NAMES)
COLUMNS = ("frame", "time_ns", "joint", *_PLACE, *_PLACE_COVARIANCE, *_TURN, *_TURN_COVARIANCE)
_LARGEST_NORM_ERROR = 1e-6
"""Largest difference of a quaternion's norm from 1: float32 writes its four parts to 6e-8."""


def write_joints_csv(motion: JointMotion, path: Path) -> None:
    """Write ``motion`` to ``path``, whole or not at all. Raises InputError where that fails."""
    write_columns(path, COLUMNS, _cells(motion))


class JointsLog:
    """Joints written to disk while they are estimated: appended to ``PATH.part.csv``, which ``finish`` renames.

    InputError for another suffix than .csv, and where a part file of an earlier run still exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".csv":
            raise InputError(f"{path}: suffix '{self.path.suffix}' given; joints are a .csv file")
        check_writable(self.path)
        self.part, self._file = begin_part(self.path)
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(COLUMNS)
        self.frames = 0

    def write(self, motion: JointMotion) -> None:
        """Append joints; each call must have the same names."""
        self._writer.writerows(zip(*_cells(motion), strict=True))
        self.frames += len(motion)

    def close(self) -> None:
        """Close the part file; it is kept where it holds joints. May be called twice."""
        self._file.close()
        if not self.frames:
            self.part.unlink(missing_ok=True)

    def finish(self) -> int:
        """Rename the part file to its final name and return its number of frames; no frames make no file."""
        self.close()
        if self.frames:
            self.part.replace(self.path)
        return self.frames


def _cells(motion: JointMotion) -> list[Sequence[str]]:
    n, j = len(motion), len(motion.joints)
    return [
        integers(np.repeat(motion.frame, j)),
        integers(np.repeat(motion.time_ns, j)),
        list(motion.joints) * n,
        *(reals(motion.centre[..., k].ravel()) for k in range(3)),
        *(reals(motion.centre_covariance[..., a, b].ravel()) for a, b in _ELEMENTS),
        *(reals(motion.rotation[..., k].ravel()) for k in range(4)),
        *(reals(motion.rotation_covariance[..., a, b].ravel()) for a, b in _ELEMENTS),
    ]


def read_joints_csv(path: Path) -> JointMotion:
    """Read a ``joints.csv``. Raises InputError naming the row or column and what is allowed."""
    path = Path(path)
    cells = read_columns(path, COLUMNS, "joints.csv")
    frame, time_ns = (parsed(cells[name], name, int, path) for name in ("frame", "time_ns"))
    joints = _joints(path, frame, time_ns, cells["joint"])
    n, j = (len(frame) // len(joints), len(joints)) if joints else (0, 0)

    def table(names: tuple[str, ...]) -> Array:
        values = np.stack([parsed(cells[name], name, float, path) for name in names], axis=1)
        if np.isinf(values).any():
            row, column = np.argwhere(np.isinf(values))[0]
            raise InputError(f"{path}, row {row + 2}: {names[column]} is not finite; a number or nothing is wanted")
        return values

    def covariance(names: tuple[str, ...]) -> Array:
        elements, result = table(names), np.empty((n * j, 3, 3))
        for (a, b), element in zip(_ELEMENTS, elements.T, strict=True):
            result[:, a, b] = result[:, b, a] = element
        return result.reshape(n, j, 3, 3)

    turns = table(_TURN)
    unknown = np.isnan(turns).all(axis=1)
    odd = np.flatnonzero(~unknown & ~(np.abs(np.linalg.norm(turns, axis=1) - 1) <= _LARGEST_NORM_ERROR))
    if len(odd):
        raise InputError(f"{path}, row {odd[0] + 2}: qw, qx, qy, qz are no unit quaternion; its norm must be 1")
    step = max(j, 1)
    return JointMotion(
        frame=frame[::step],
        time_ns=time_ns[::step],
        joints=joints,
        centre=table(_PLACE).reshape(n, j, 3),
        centre_covariance=covariance(_PLACE_COVARIANCE),
        rotation=turns.reshape(n, j, 4),
        rotation_covariance=covariance(_TURN_COVARIANCE),
    )


def _joints(path: Path, frame: Array, time_ns: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return the joints of each frame; InputError names the first row that breaks the order."""
    if not len(frame):
        return ()
    other = np.flatnonzero(frame != frame[0])
    j = int(other[0]) if len(other) else len(frame)
    joints = tuple(names[:j])
    if len(set(joints)) < j:
        raise InputError(f"{path}: frame {frame[0]} names a joint twice; each joint has one row in each frame")
    for row, name in enumerate(names):
        first = row - row % j
        if name != joints[row % j] or frame[row] != frame[first] or time_ns[row] != time_ns[first]:
            raise InputError(
                f"{path}, row {row + 2}: frame {frame[row]} with joint {name[:40]!r}; wanted is "
                f"{joints[row % j][:40]!r} of frame {frame[first]} and its time: frames have the same joints in order"
            )
        if row and row % j == 0 and frame[row] <= frame[row - 1]:
            raise InputError(f"{path}, row {row + 2}: frame {frame[row]} after {frame[row - 1]}; frames must rise")
    if len(frame) % j:
        raise InputError(f"{path}: its last frame has {len(frame) % j} of {j} joints; the file is cut short")
    return joints
