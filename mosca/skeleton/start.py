"""Starting values of a fit: size from distances within bodies, pose from bodies with three markers."""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rotations import aligning_rotation, quaternion_from_rotation
from mosca.errors import InputError
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import Kinematics, SkeletonModel
from mosca.skeleton.pose import PoseSolution, solve_pose

SHORTEST_M = 0.1
"""Distances between markers shorter than this determine the size poorly [m]."""
SIZES = (0.3, 2.5)
"""Range of sizes of people relative to the model's 1.75 m, from small children up; beyond it the unit is wrong."""
COARSE_M = (0.2, 0.06, 0.025)
"""Standard deviations of the markers against the unfitted model, from far to near [m]."""


def size_of(model: SkeletonModel, frames: MarkerFrames, source: str) -> float:
    """Return the subject's size relative to the model: the median ratio of distances within bodies.

    InputError, naming ``source``, where no body has two markers or the size is no person's.
    """
    kinematics = Kinematics(model)
    local = kinematics.local
    ratios = []
    for a in range(len(model.labels)):
        for b in range(a):
            nominal = float(np.linalg.norm(local[a] - local[b]))
            if kinematics.body_of_marker[a] != kinematics.body_of_marker[b] or nominal < SHORTEST_M:
                continue
            distance = np.linalg.norm(frames.xyz[:, a] - frames.xyz[:, b], axis=1)
            if np.isfinite(distance).any():
                ratios.append(float(np.nanmedian(distance)) / nominal)
    if not ratios:
        raise InputError(f"{source}: no two labelled markers on one body are seen together; label more of them")
    size = float(np.median(ratios))
    if not SIZES[0] < size < SIZES[1]:
        raise InputError(
            f"{source}: the subject would be {size:.3g} times the model's size; {SIZES[0]} to {SIZES[1]} is a "
            "person's. Are the coordinates in metres?"
        )
    return size


def starting_pose(kinematics: Kinematics, xyz: Array) -> PoseSolution:
    """Return the pose for markers ``xyz`` (m, 3) [m], NaN where not measured, without an earlier pose.

    The rotation of a body with three markers off a line is computed from them (Kabsch 1976); that of others starts
    as their parent's.
    """
    q = np.array(kinematics.mj.qpos0)
    seen = np.isfinite(xyz[:, 0])
    world_from = np.tile(np.eye(3), (kinematics.mj.nbody, 1, 1))
    kinematics.pose(q)
    local = kinematics.local
    for body in range(1, kinematics.mj.nbody):
        rows = np.flatnonzero(seen & (kinematics.body_of_marker == body))
        parent = world_from[kinematics.mj.body_parentid[body]]
        if body == 1 and not _spans(local[rows]):
            # A root with too few markers: use those of all bodies, in the template's posture.
            rows = np.flatnonzero(seen & kinematics.above[kinematics.body_of_marker, 1])
            local_here = kinematics.markers()
        else:
            local_here = local
        world_from[body] = aligning_rotation(local_here[rows], xyz[rows]) if _spans(local_here[rows]) else parent
        if body == 1:
            q[:3] = xyz[rows].mean(axis=0) - world_from[1] @ local_here[rows].mean(axis=0)
            q[3:7] = quaternion_from_rotation(world_from[1])
        else:
            start = int(kinematics.mj.jnt_qposadr[body - 1])
            q[start : start + 4] = quaternion_from_rotation(parent.T @ world_from[body])
    for sigma in COARSE_M:
        information = np.where(seen, sigma**-2.0, 0.0)[:, None, None] * np.eye(3)
        solution = solve_pose(kinematics, q, xyz, information)
        q = solution.q
    return solution


def _spans(points: Array) -> bool:
    """Return whether ``points`` (n, 3) are three or more and not on a line."""
    if len(points) < 3:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 0.2 * spread[0])
