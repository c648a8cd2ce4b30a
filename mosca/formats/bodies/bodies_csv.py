"""``bodies.csv``: one line for each body and frame, every number at full precision.

Columns ``frame,time_ns,body,qw,qx,qy,qz,x,y,z``, the covariance's 21 elements, ``n_markers,residual_m,status``. The
pose is world_from_body (unit quaternion, m). The covariance's axes are the position's x, y, z [m] and the rotation
vector's u, v, w about the world's x, y, z [rad]; its upper triangle is written row by row: ``cxx,cxy,...,cww``. Cells
are empty where unknown or withheld.
"""

from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from mosca.data.bodies import BODY_STATUSES, BodyPoses
from mosca.formats.tracks.csv_columns import integers, one_of, parsed, read_columns, reals, write_columns

_ELEMENTS = tuple(combinations_with_replacement(range(6), 2))
_COVARIANCE = tuple(f"c{'xyzuvw'[i]}{'xyzuvw'[j]}" for i, j in _ELEMENTS)
_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")
COLUMNS = ("frame", "time_ns", "body", *_POSE, *_COVARIANCE, "n_markers", "residual_m", "status")


def write_bodies_csv(poses: BodyPoses, path: Path) -> None:
    """Write ``poses`` to ``path``, whole or not at all. Raises InputError where that fails."""
    columns = [
        integers(poses.frame),
        integers(poses.time_ns),
        poses.body.tolist(),
        *(reals(poses.quaternion[:, k]) for k in range(4)),
        *(reals(poses.position[:, k]) for k in range(3)),
        *(reals(poses.covariance[:, i, j]) for i, j in _ELEMENTS),
        integers(poses.n_markers),
        reals(poses.residual_m),
        poses.status.tolist(),
    ]
    write_columns(path, COLUMNS, columns)


def read_bodies_csv(path: Path) -> BodyPoses:
    """Read a ``bodies.csv``. Raises InputError naming the line or column and what is allowed."""
    path = Path(path)
    cells = read_columns(path, COLUMNS, "bodies.csv")
    status = one_of(cells["status"], "status", BODY_STATUSES, path)

    def columns(names: tuple[str, ...]) -> list[np.ndarray]:
        return [parsed(cells[name], name, float, path) for name in names]

    covariance = np.empty((len(status), 6, 6))
    for (i, j), column in zip(_ELEMENTS, columns(_COVARIANCE), strict=True):
        covariance[:, i, j] = covariance[:, j, i] = column
    pose = np.stack(columns(_POSE), axis=1)
    return BodyPoses(
        frame=parsed(cells["frame"], "frame", int, path),
        time_ns=parsed(cells["time_ns"], "time_ns", int, path),
        body=np.array(cells["body"], dtype=np.str_),
        quaternion=pose[:, :4],
        position=pose[:, 4:],
        covariance=covariance,
        n_markers=parsed(cells["n_markers"], "n_markers", int, path),
        residual_m=columns(("residual_m",))[0],
        status=status,
    )
