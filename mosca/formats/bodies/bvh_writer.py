"""BVH files written from a skeleton's motion; ``mosca.data.motion.bvh`` reads them.

Y is up in the file, as its readers expect: world (x, y, z) -> file (x, z, -y). Each joint has three rotation channels
in its own Euler order, completed where it has fewer. A bone's end without channels becomes the ``End Site``. A last
joint with channels gets an ``End Site`` at zero offset, since the format requires one on every branch.
"""

from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.whole_file import whole_file
from mosca.data.motion.motion import (
    END_SUFFIX,
    WORLD_FROM_Y_UP,
    Motion,
    Skeleton,
    angles_from_matrices,
    matrices_from_quaternions,
)
from mosca.errors import InputError

FULL_ORDER = "ZXY"
DECIMALS = 9


def write_bvh(motion: Motion, path: Path, *, metres_per_unit: float = 0.01) -> None:
    """Write ``motion`` as BVH, whole or not at all, lengths in units of ``metres_per_unit`` (which BVH cannot state).

    Raises InputError where it holds no frame, a number that is not finite, or joint names that differ in blanks only.
    """
    path = Path(path)
    if not 0 < metres_per_unit < np.inf:
        raise InputError(f"{path}: metres_per_unit = {metres_per_unit:g} given; one above 0 is wanted")
    if not len(motion.root_xyz):
        raise InputError(f"{path}: no frame to write; a BVH file holds one at least")
    if not (np.isfinite(motion.root_xyz).all() and np.isfinite(motion.rotations).all()):
        raise InputError(f"{path}: a pose is no finite number; fill the gaps or leave these frames out")
    names = ["_".join(name.split()) for name in motion.skeleton.names]
    if len(set(names)) < len(names) or "" in names:
        raise InputError(f"{path}: joint names must differ in more than blanks: {', '.join(names)[:60]}")
    order: list[int] = []
    lines = ["HIERARCHY", *_joint(motion.skeleton, names, 0, 1.0 / metres_per_unit, 0, order)]
    table = _channels(motion, order, 1.0 / metres_per_unit)
    lines += ["MOTION", f"Frames: {len(table)}", f"Frame Time: {1.0 / motion.frame_rate_hz!r}"]
    with whole_file(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write("\n".join(lines) + "\n")
        np.savetxt(file, table, fmt=f"%.{DECIMALS}f")


def _is_end(skeleton: Skeleton, k: int) -> bool:
    parent = int(skeleton.parents[k])
    return (
        parent >= 0
        and not skeleton.orders[k]
        and k not in skeleton.parents
        and skeleton.names[k] == skeleton.names[parent] + END_SUFFIX
    )


def _order(skeleton: Skeleton, k: int) -> str:
    given = skeleton.orders[k]
    return FULL_ORDER if not given else given + "".join(a for a in FULL_ORDER if a not in given)


def _joint(skeleton: Skeleton, names: list[str], k: int, scale: float, depth: int, order: list[int]) -> list[str]:
    """Return the lines of joint ``k`` and all below it; those with channels are appended to ``order`` in turn."""
    pad = "  " * depth
    x, y, z = scale * skeleton.offsets[k] @ WORLD_FROM_Y_UP
    offset = f"{pad}  OFFSET {x:.{DECIMALS}f} {y:.{DECIMALS}f} {z:.{DECIMALS}f}"
    if _is_end(skeleton, k):
        return [f"{pad}End Site", f"{pad}{{", offset, f"{pad}}}"]
    order.append(k)
    turns = " ".join(f"{letter}rotation" for letter in _order(skeleton, k))
    places = "6 Xposition Yposition Zposition" if k == 0 else "3"
    lines = [f"{pad}{'JOINT' if k else 'ROOT'} {names[k]}", f"{pad}{{", offset]
    lines.append(f"{pad}  CHANNELS {places} {turns}")
    children = np.flatnonzero(skeleton.parents == k).tolist()
    for child in children:
        lines += _joint(skeleton, names, child, scale, depth + 1, order)
    if not children:
        lines += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 0 0 0", f"{pad}  }}"]
    return [*lines, f"{pad}}}"]


def _channels(motion: Motion, order: list[int], scale: float) -> Array:
    """Return the channel table (t, c) in file units and degrees."""
    columns = [scale * motion.root_xyz @ WORLD_FROM_Y_UP]
    for k in order:
        q = motion.rotations[:, k]
        turned = np.concatenate([q[:, :1], q[:, 1:] @ WORLD_FROM_Y_UP], axis=1)
        angles = angles_from_matrices(matrices_from_quaternions(turned), _order(motion.skeleton, k))
        columns.append(np.rad2deg(np.unwrap(angles, axis=0)))
    return np.concatenate(columns, axis=1)
