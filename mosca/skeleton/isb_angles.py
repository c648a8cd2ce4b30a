"""Joint angles as the ISB recommends (Grood & Suntay 1983; Wu et al. 2002, 2005), with standard deviations.

Segments' axes: x forward, y up, z to the right on both sides of the body, all segments parallel in the anatomical
position (arms down, palms forward). ``CONVENTIONS`` is the table of all angles. Each joint's proximal_from_distal is

    R = Rz(a) Rx(b) Ry(c)    Cardan sequence Z-X'-Y'', all joints but the shoulder; b within +-90 deg
    R = Ry(a) Rx(b) Ry(c)    shoulder, Y-X'-Y'', b from -180 to 0 deg

and an angle is the ``sign`` of its row times a, b or c. On the left b and c, of the shoulder a, b and c, have the
other sign: a motion and its mirror image have equal angles on opposite sides.

Singular positions. The axes of the first and third angle coincide where b is +-90 deg (Cardan) and where the arm
hangs down or points up (shoulder): only their sum or difference is determined there. Their standard deviation grows
with 1 / cos b (1 / sin b). Where it exceeds pi / sqrt(3), the value for a wholly unknown angle, both are NaN. The
middle angle is determined everywhere. After a joint has passed through a singular position, its first and third angle
differ by half a turn from before.
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.data.motion.motion import WORLD_FROM_Y_UP, angles_from_matrices, matrices_from_quaternions


class Convention(NamedTuple):
    """One row of the table: an angle of a joint."""

    joint: str
    """Without its side."""
    name: str
    position: int
    """In the sequence: 0, 1, 2 for a, b, c."""
    sign: int
    """Sign for the right side and the middle of the body."""
    left_sign: int
    """Sign for the left side."""
    positive: str
    """The sense in which it grows."""


CONVENTIONS = (
    Convention("pelvis", "tilt", 0, -1, -1, "anterior: its front goes down"),
    Convention("pelvis", "obliquity", 1, 1, 1, "left side up"),
    Convention("pelvis", "rotation", 2, 1, 1, "turned to the left"),
    Convention("lumbar", "flexion", 0, -1, -1, "trunk forward"),
    Convention("lumbar", "bending", 1, 1, 1, "to the right"),
    Convention("lumbar", "rotation", 2, 1, 1, "to the left"),
    Convention("neck", "flexion", 0, -1, -1, "head forward"),
    Convention("neck", "bending", 1, 1, 1, "to the right"),
    Convention("neck", "rotation", 2, 1, 1, "to the left"),
    Convention("hip", "flexion", 0, 1, 1, "thigh forward"),
    Convention("hip", "adduction", 1, 1, -1, "thigh to the middle of the body"),
    Convention("hip", "internal_rotation", 2, 1, -1, "front of the thigh to the middle"),
    Convention("knee", "flexion", 0, -1, -1, "shank backward, though its rotation about z is negative"),
    Convention("knee", "adduction", 1, 1, -1, "shank to the middle (varus)"),
    Convention("knee", "internal_rotation", 2, 1, -1, "front of the shank to the middle"),
    Convention("ankle", "dorsiflexion", 0, 1, 1, "toes up"),
    Convention("ankle", "inversion", 1, 1, -1, "sole to the middle"),
    Convention("ankle", "internal_rotation", 2, 1, -1, "toes to the middle"),
    Convention("shoulder", "plane_of_elevation", 0, 1, -1, "0 abduction, 90 deg forward flexion"),
    Convention("shoulder", "elevation", 1, -1, 1, "0 hanging, 180 deg up"),
    Convention("shoulder", "internal_rotation", 2, 1, -1, "front of the upper arm to the middle"),
    Convention("elbow", "flexion", 0, 1, 1, "forearm forward"),
    Convention("elbow", "adduction", 1, 1, -1, "forearm to the middle (varus); minus the carrying angle"),
    Convention("elbow", "pronation", 2, 1, -1, "palm turns from forward to the middle"),
    Convention("wrist", "flexion", 0, 1, 1, "to the palm"),
    Convention("wrist", "adduction", 1, 1, -1, "to the little finger (ulnar deviation)"),
    Convention("wrist", "pronation", 2, 1, -1, "as that of the elbow"),
)
"""All angles; their names are joint and name, ``l_hip_flexion``, ``pelvis_tilt``."""
UNKNOWN_RAD = np.pi / np.sqrt(3)
"""Standard deviation of a wholly unknown angle: uniform on a circle [rad]."""
_SINGULAR = 1e-6
"""Sine of the distance from a singular position below which rounding of R, 1e-16, spoils 10 digits of a and c."""
_SEQUENCES = {"shoulder": (1, 0, 1)}
_CARDAN = (2, 0, 1)


def isb_angles(motion: JointMotion, *, heading_rad: float = 0.0) -> JointAngles:
    """Return the angles of all joints that ``CONVENTIONS`` has, in the order of ``motion.joints``.

    The pelvis' angles refer to a world whose x is turned by ``heading_rad`` about the vertical from the world's x.
    For walking this is the direction of progression, since tilt and obliquity are about fixed axes. Standard
    deviations are first order in ``rotation_covariance``, and NaN where it is NaN. Joints of other names have no
    angles.
    """
    names: list[str] = []
    angles, sigmas = [np.empty((len(motion), 0))], [np.empty((len(motion), 0))]
    for k, joint in enumerate(motion.joints):
        side, kind = (joint[0], joint[2:]) if joint[:2] in ("l_", "r_") else ("", joint)
        rows = [row for row in CONVENTIONS if row.joint == kind]
        if not rows:
            continue
        proximal_from_distal = matrices_from_quaternions(motion.rotation[:, k])
        if joint == "pelvis":
            proximal_from_distal = _y_up_from_world(heading_rad) @ proximal_from_distal
        sequence = _SEQUENCES.get(kind, _CARDAN)
        signs = np.array([row.left_sign if side == "l" else row.sign for row in rows], dtype=np.float64)
        turns = _turns(proximal_from_distal, sequence, left=side == "l")
        sigma = _sigma(turns, motion.rotation_covariance[:, k], sequence)
        names += [f"{joint}_{row.name}" for row in rows]
        turns[:, [0, 2]] = np.where(np.isinf(sigma[:, [0, 2]]), np.nan, turns[:, [0, 2]])
        angles.append(_running_on(signs * turns))
        sigmas.append(np.where(np.isinf(sigma), np.nan, sigma))
    return JointAngles(motion.frame, motion.time_ns, tuple(names), np.hstack(angles), np.hstack(sigmas))


def _y_up_from_world(heading_rad: float) -> Array:
    """Return the rotation (3, 3) to axes with x along this heading, y up and z to its right."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    return np.asarray(WORLD_FROM_Y_UP.T @ [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _turns(rotations: Array, sequence: tuple[int, int, int], *, left: bool) -> Array:
    """Return a, b and c (n, 3) [rad] of rotations (n, 3, 3)."""
    if sequence == _CARDAN:
        return angles_from_matrices(rotations, "ZXY")
    # On the left, elevation is a positive turn about x: take the branch whose signs make it positive on both sides.
    s = -1.0 if left else 1.0
    r = rotations
    a = np.arctan2(-s * r[:, 0, 1], -s * r[:, 2, 1])
    c = np.arctan2(-s * r[:, 1, 0], s * r[:, 1, 2])
    b = -s * np.arctan2(np.hypot(r[:, 0, 1], r[:, 2, 1]), r[:, 1, 1])
    return np.stack([a, b, c], axis=1)


def _sigma(turns: Array, covariance: Array, sequence: tuple[int, int, int]) -> Array:
    """Return standard deviations (n, 3) [rad] of the turns; infinite where first and third are not determined.

    A small rotation vector in the distal axes is r = u0 da + u1 db + u2 dc, with the axes u of the three turns in the
    distal segment's axes; u1 is perpendicular to both others. ``rows`` are those of the inverse of (u0, u1, u2).
    """
    last = _about(sequence[2], turns[:, 2])
    u0 = (_about(sequence[1], turns[:, 1]) @ last)[:, sequence[0]]
    u1 = last[:, sequence[1]]
    u2 = np.broadcast_to(np.eye(3)[sequence[2]], u1.shape)
    volume = np.einsum("ni,ni->n", u0, np.cross(u1, u2))
    singular = np.abs(volume) < _SINGULAR
    safe = np.where(singular, 1.0, volume)[:, None]
    rows = np.stack([np.cross(u1, u2) / safe, u1, np.cross(u0, u1) / safe], axis=1)
    variance = np.einsum("nai,nij,naj->na", rows, covariance, rows)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    lost = singular | (sigma[:, [0, 2]] > UNKNOWN_RAD).any(axis=1)
    sigma[np.ix_(lost, [0, 2])] = np.inf
    return np.asarray(sigma)


def _about(axis: int, angle: Array) -> Array:
    """Return rotations (n, 3, 3) about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.tile(np.eye(3), (len(angle), 1, 1))
    matrices[:, i, i] = matrices[:, j, j] = np.cos(angle)
    matrices[:, j, i] = np.sin(angle)
    matrices[:, i, j] = -matrices[:, j, i]
    return matrices


def _running_on(angles: Array) -> Array:
    """Return angles (n, a) with whole turns added so that successive known values differ by at most half a turn."""
    result = angles.copy()
    for column in result.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known])
    return result
