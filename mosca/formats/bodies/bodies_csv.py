"""``bodies.csv``: one line a body and frame, every number at full precision.

Columns ``frame,time_ns,body,qw,qx,qy,qz,x,y,z``, the covariance's 21 elements, ``n_markers,residual_m,status``: pose
world_from_body (unit quaternion, m); the covariance's axes are the position's x, y, z [m] and the rotation vector's
u, v, w about the world's x, y, z [rad], upper triangle row by row: ``cxx,cxy,...,cww``. Empty where unknown or
withheld.
"""

from itertools import combinations_with_replacement
from pathlib import Path

from mosca.data.bodies import BodyPoses
from mosca.formats.tracks.csv_columns import integers, reals, write_columns

_ELEMENTS = tuple(combinations_with_replacement(range(6), 2))
_COVARIANCE = tuple(f"c{'xyzuvw'[i]}{'xyzuvw'[j]}" for i, j in _ELEMENTS)
_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")
COLUMNS = ("frame", "time_ns", "body", *_POSE, *_COVARIANCE, "n_markers", "residual_m", "status")


def write_bodies_csv(poses: BodyPoses, path: Path) -> None:
    """Write ``poses`` to ``path``, whole or not at all. Raises InputError where that cannot be."""
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
