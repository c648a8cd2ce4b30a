"""An actor's recording: reading, check of its length, and placement in the working space."""

from pathlib import Path

import numpy as np

from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion, forward_kinematics, multiply_quaternions, quaternions_from_euler
from mosca.errors import InputError
from twin.scenes.actions import check_inside
from twin.scenes.anatomy import FOOT_RADIUS_M, Anatomy
from twin.scenes.world import Box

_SKIN_M = 0.12
"""Distance by which skin and markers reach beyond the joints, for the working space [m]."""
STAY_INSIDE = "enlarge it, turn the motion by heading_deg, play less of it, or set keep_in_box = false"


def read(path: Path, skeleton_file: Path | None, unit: float | None, rate: float | None, drop: int | None) -> Motion:
    """Return the recording in a .bvh, or in an .amc with its .asf; missing values are as in ``build_actor``."""
    suffix = path.suffix.lower()
    if suffix == ".bvh" and skeleton_file is None:
        dropped = 1 if drop is None else drop
        return read_bvh(path, metres_per_unit=0.01 if unit is None else unit, frame_rate_hz=rate, drop_frames=dropped)
    if suffix == ".amc" and skeleton_file is not None:
        motion = read_asf_amc(
            Path(skeleton_file), path, frame_rate_hz=120.0 if rate is None else rate, metres_per_unit=unit
        )
        kept = slice(drop or 0, None)
        return Motion(motion.skeleton, motion.frame_rate_hz, motion.root_xyz[kept], motion.rotations[kept])
    raise InputError(
        f"motion_file = {path}, skeleton_file = {skeleton_file}: a .bvh alone, or an .amc with its .asf as "
        "skeleton_file, is wanted"
    )


def _check_length(motion: Motion, start_s: float, duration_s: float, source: str) -> None:
    """Raise InputError where the motion ends before ``duration_s`` of it have been played."""
    if start_s < 0 or start_s + duration_s > motion.duration_s or len(motion.root_xyz) < 2:
        raise InputError(
            f"{source}: start_s = {start_s} and duration_s = {duration_s} asked for; the motion lasts "
            f"{motion.duration_s:.3f} s ({len(motion.root_xyz)} frames at {motion.frame_rate_hz:g} Hz): "
            "shorten the duration or start earlier"
        )


def played(motion: Motion, start_s: float, duration_s: float) -> Motion:
    """Return the frames from ``start_s`` on for ``duration_s``."""
    first = int(np.floor(start_s * motion.frame_rate_hz))
    last = int(np.ceil((start_s + duration_s) * motion.frame_rate_hz)) + 1
    return Motion(motion.skeleton, motion.frame_rate_hz, motion.root_xyz[first:last], motion.rotations[first:last])


def placed(
    motion: Motion,
    anatomy: Anatomy,
    box: Box,
    start_s: float,
    duration_s: float,
    placement: str,
    heading_deg: float,
    keep_in_box: bool,
    source: str,
) -> Motion:
    """Return the motion placed by ``placement`` ("center", "file"; see ``build_actor``).

    Raises InputError where it ends before ``duration_s`` of it have been played, or leaves the box.
    """
    _check_length(motion, start_s, duration_s, source)
    if placement not in ("file", "center"):
        raise InputError(f"placement = {placement!r} given; allowed: center, file")
    if placement == "center":
        motion = _over_the_middle(motion, anatomy, box, start_s, duration_s, heading_deg)
    if keep_in_box:
        about = f"{source}: from {start_s} s for {duration_s} s the actor"
        check_inside(played(motion, start_s, duration_s), box, _SKIN_M, about, STAY_INSIDE)
    return motion


def _over_the_middle(
    motion: Motion, anatomy: Anatomy, box: Box, start_s: float, duration_s: float, heading_deg: float
) -> Motion:
    turn = quaternions_from_euler(np.deg2rad([heading_deg]), "Z")
    c, s = np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg))
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    root = motion.root_xyz @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    turned = Motion(motion.skeleton, motion.frame_rate_hz, root, rotations)
    positions, world_from_joint = forward_kinematics(played(turned, start_s, duration_s))
    middle = (positions.min(axis=(0, 1)) + positions.max(axis=(0, 1))) / 2
    radius = FOOT_RADIUS_M * anatomy.scale
    lowest = np.inf  # of heel and ball; toes bend through the floor in some recordings
    for side in ("l_", "r_"):
        foot = anatomy.parts[f"{side}foot"]
        for point in ("heel", "ball"):
            arm = anatomy.points[side + point] - anatomy.points[f"{side}foot"]
            lowest = min(lowest, float((positions[:, foot] + world_from_joint[:, foot] @ arm)[:, 2].min()))
    shift = np.array([box.center[0] - middle[0], box.center[1] - middle[1], radius - lowest])
    return Motion(motion.skeleton, motion.frame_rate_hz, root + shift, rotations)
