"""A human actor: limbs that occlude, markers on the skin, moved by a recording or a built-in walk or action.

The model is the skeleton itself: one body a joint with a ball joint at its rest offset, under a free
root. A configuration is the root's position and every joint's rotation, so that bones keep their length
and MuJoCo's kinematics gives the positions. Nothing is simulated.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import (
    Motion,
    forward_kinematics,
    multiply_quaternions,
    quaternions_from_euler,
    rest_positions,
)
from mosca.errors import InputError
from twin.scenes.actions import ACTIONS, Action, ActionName, act, check_inside
from twin.scenes.actor_markers import Seat, seats
from twin.scenes.anatomy import FOOT_RADIUS_M, Anatomy, limb_shapes, read_anatomy
from twin.scenes.emission import ALL_SIDES_DEG, Blink, Glow
from twin.scenes.gait import GAIT_PATHS, Gait, GaitPath, walk, walker_skeleton
from twin.scenes.paths import SplinePath, normalized, spline_path
from twin.scenes.posture import Balance
from twin.scenes.scene import Scene
from twin.scenes.target_plate import add_ball_at
from twin.scenes.world import Box, Shape, add_ball_marker, add_shape, compiled, new_stage, positive

_SKIN_M = 0.12
"""How far skin and markers reach beyond the joints [m], for the working space."""
STAY_INSIDE = "enlarge it, turn the motion by heading_deg, play less of it, or set keep_in_box = false"


@dataclass(frozen=True)
class BodyLamp:
    """A lamp that a worn camera carries: an LED in a ball that shines evenly to all sides."""

    name: str
    body: str
    place_m: tuple[float, float, float]
    """Its position in the axes of ``body``."""
    diameter_m: float = 0.012
    blink: Blink | None = None
    """Its code; None: always on."""


def build_actor(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    motion_file: Path | None = None,
    skeleton_file: Path | None = None,
    start_s: float = 0.1,
    metres_per_unit: float | None = None,
    frame_rate_hz: float | None = None,
    drop_frames: int | None = None,
    placement: Literal["center", "file"] = "center",
    heading_deg: float = 0.0,
    keep_in_box: bool = True,
    action: ActionName = "walk",
    gait: GaitPath = "circle",
    speed_mps: float = 1.0,
    stature_m: float = 1.75,
    markers: int = 50,
    marker_diameter_m: float = 0.016,
    lamps: tuple[BodyLamp, ...] = (),
    floor: bool = True,
) -> Scene:
    """Return an actor with ``markers`` (30..60) ball markers in a working space, on the floor z = 0; or InputError.

    Parameters
    ----------
    duration_s, box_center_m, box_size_m, floor
        Length of the scene, working space ((3,) each), and whether there is a floor.
    markers, marker_diameter_m, lamps
        Number and size of the ball markers; lamps of worn cameras, which come after the markers.
    rng
        Draws start and first step of a walk, and the loops of the other actions.
    motion_file, skeleton_file, start_s
        Recording (.amc with .asf, or .bvh), interpolated by a C2 spline, and where it starts (converted BVH
        files need some frames to leave an added T-pose).
    metres_per_unit, frame_rate_hz, drop_frames
        What the file lacks (defaults: ASF from its length, 120 Hz; BVH 0.01, the file's rate, 1 frame dropped).
    placement, heading_deg, keep_in_box
        "center": rotated by the heading about the vertical, the middle of the part played over the middle of the box,
        its lowest heel or ball on the floor; "file": unchanged. Whether a recording that leaves the box is an error.
    action, gait, speed_mps, stature_m
        Without a recording. "walk": "in_place", "circle" (the largest in the box) or "back_and_forth" along the box's
        longer side; "boxing", "dance", "jump": a loop over the middle of the box.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s, "marker_diameter_m": marker_diameter_m})
    if motion_file is None:
        _check_built_in(action, gait, speed_mps, stature_m, box)
        skeleton = walker_skeleton(stature_m)
        anatomy = read_anatomy(skeleton, f"stature_m = {stature_m}")
    else:
        motion = _read(Path(motion_file), skeleton_file, metres_per_unit, frame_rate_hz, drop_frames)
        anatomy = read_anatomy(motion.skeleton, str(motion_file))
        _check_length(motion, start_s, duration_s, str(motion_file))
        motion = _placed(motion, anatomy, box, start_s, duration_s, placement, heading_deg)
        if keep_in_box:
            about = f"{motion_file}: from {start_s} s for {duration_s} s the actor"
            check_inside(_played(motion, start_s, duration_s), box, _SKIN_M, about, STAY_INSIDE)
    shapes = limb_shapes(anatomy)
    seated = seats(anatomy, shapes, markers)
    spec, joints = _specify(anatomy, shapes, seated, marker_diameter_m, floor)
    _wear(spec, lamps)
    names = (*(seat.name for seat in seated), *(lamp.name for lamp in lamps))
    model, geoms = compiled(spec, names)
    carried = {part: tuple(s.name for s in seated if s.part == part) for part in shapes}
    bodies = {part: those for part, those in carried.items() if len(those) >= 3}
    path: BuiltInConfiguration | SplinePath
    if motion_file is not None:
        path = _recorded(model, joints, motion, start_s)
    else:
        moved: Gait | Action
        if action == "walk":
            moved = walk(skeleton, gait, box.center[:2], box.size[:2] / 2, speed_mps, rng)
        else:
            moved = act(action, skeleton, _balance(model, joints, len(skeleton.names)), box, rng)
        path = BuiltInConfiguration(moved, _addresses(model, joints), model.nq)
    glows = {one.name: Glow("lamp", half_deg=ALL_SIDES_DEG, blink=one.blink) for one in lamps if one.blink}
    return Scene(model, names, geoms, path, duration_s, bodies, glows=glows)


def _check_built_in(action: str, gait: str, speed_mps: float, stature_m: float, box: Box) -> None:
    """Raise InputError where an actor without a recording cannot do what is wanted in the box."""
    positive({"speed_mps": speed_mps})
    if action not in ACTIONS:
        raise InputError(f"action = {action!r} given; allowed: {', '.join(ACTIONS)}")
    if not 1.3 <= stature_m <= 2.3:
        raise InputError(f"stature_m = {stature_m} given; 1.3 to 2.3 m wanted")
    if gait not in GAIT_PATHS:
        raise InputError(f"gait = {gait!r} given; allowed: {', '.join(GAIT_PATHS)}")
    if box.high[2] < stature_m:
        raise InputError(
            f"box_center_m = {box.center.tolist()}, box_size_m = {box.size.tolist()}: the box ends at "
            f"{box.high[2]:.2f} m and the actor, standing on z = 0, at {stature_m} m; raise or enlarge the box"
        )


def _wear(spec: mujoco.MjSpec, lamps: tuple[BodyLamp, ...]) -> None:
    for lamp in lamps:
        body = spec.body(lamp.body)
        if body is None:
            known = ", ".join(one.name for one in spec.bodies if one.name != "world")
            raise InputError(f"lamp '{lamp.name}': body = '{lamp.body}' given; the actor has {known}")
        add_ball_at(body, lamp.name, np.asarray(lamp.place_m, dtype=float), lamp.diameter_m)


@dataclass(frozen=True, eq=False)
class BuiltInConfiguration:
    """The configuration at any time of an actor who moves without a recording."""

    moved: Gait | Action
    addresses: tuple[Array, Array]  # joints driven, and where their quaternions start in qpos
    nq: int

    def __call__(self, time_s: float) -> Array:
        """Return qpos (nq,) at session time ``time_s`` [s]."""
        root, rotations = self.moved.at(time_s)
        joints, starts = self.addresses
        qpos = np.empty(self.nq)
        qpos[:3] = root
        qpos[starts[:, None] + np.arange(4)] = rotations[joints]
        return normalized(qpos, starts)


def _recorded(model: mujoco.MjModel, joints: list[int], motion: Motion, start_s: float) -> SplinePath:
    driven, starts = _addresses(model, joints)
    frames = len(motion.root_xyz)
    qpos = np.empty((frames, model.nq))
    qpos[:, :3] = motion.root_xyz
    qpos[:, starts[:, None] + np.arange(4)] = motion.rotations[:, driven]
    return spline_path(np.arange(frames) / motion.frame_rate_hz, qpos, starts, start_s=start_s)


def _addresses(model: mujoco.MjModel, joints: list[int]) -> tuple[Array, Array]:
    starts = [int(model.joint(f"joint/{k}").qposadr[0]) + (3 if k == 0 else 0) for k in joints]
    return np.array(joints), np.array(starts)


def _balance(model: mujoco.MjModel, joints: list[int], total: int) -> Balance:
    """Return what each of the skeleton's ``total`` joints carries in ``model``."""
    bodies = [int(model.jnt_bodyid[model.joint(f"joint/{k}").id]) for k in joints]
    masses, centers = np.zeros(total), np.zeros((total, 3))
    masses[joints], centers[joints] = model.body_mass[bodies], model.body_ipos[bodies]
    return Balance(masses, centers)


def _specify(
    anatomy: Anatomy, shapes: dict[str, list[Shape]], seated: list[Seat], diameter: float, floor: bool
) -> tuple[mujoco.MjSpec, list[int]]:
    """Return the specification and the joints that are bodies in it: those that a part needs."""
    skeleton = anatomy.skeleton
    rest = rest_positions(skeleton)
    needed: set[int] = set()
    for joint in anatomy.parts.values():
        while joint >= 0 and joint not in needed:
            needed.add(joint)
            joint = int(skeleton.parents[joint])
    spec = new_stage(floor=floor)
    # Joints without a shape of their own (a clavicle) are moving bodies without mass otherwise.
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
    bodies: dict[int, mujoco.MjsBody] = {}
    for joint in sorted(needed):
        parent = spec.worldbody if joint == 0 else bodies[int(skeleton.parents[joint])]
        body = parent.add_body(name=skeleton.names[joint], pos=skeleton.offsets[joint])
        kind = mujoco.mjtJoint.mjJNT_FREE if joint == 0 else mujoco.mjtJoint.mjJNT_BALL
        body.add_joint(name=f"joint/{joint}", type=kind)
        bodies[joint] = body
    for part, solids in shapes.items():
        joint = anatomy.parts[part]
        for k, shape in enumerate(solids):
            add_shape(bodies[joint], shape.moved(-rest[joint]), name=f"{part}/{k}")
    for seat in seated:
        joint = anatomy.parts[seat.part]
        add_ball_marker(bodies[joint], seat.name, seat.surface - rest[joint], seat.normal, diameter)
    return spec, sorted(needed)


def _read(path: Path, skeleton_file: Path | None, unit: float | None, rate: float | None, drop: int | None) -> Motion:
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
    if start_s < 0 or start_s + duration_s > motion.duration_s or len(motion.root_xyz) < 2:
        raise InputError(
            f"{source}: start_s = {start_s} and duration_s = {duration_s} asked for; the motion lasts "
            f"{motion.duration_s:.3f} s ({len(motion.root_xyz)} frames at {motion.frame_rate_hz:g} Hz): "
            "shorten the duration or start earlier"
        )


def _played(motion: Motion, start_s: float, duration_s: float) -> Motion:
    first = int(np.floor(start_s * motion.frame_rate_hz))
    last = int(np.ceil((start_s + duration_s) * motion.frame_rate_hz)) + 1
    return Motion(motion.skeleton, motion.frame_rate_hz, motion.root_xyz[first:last], motion.rotations[first:last])


def _placed(
    motion: Motion, anatomy: Anatomy, box: Box, start_s: float, duration_s: float, placement: str, heading_deg: float
) -> Motion:
    if placement == "file":
        return motion
    if placement != "center":
        raise InputError(f"placement = {placement!r} given; allowed: center, file")
    turn = quaternions_from_euler(np.deg2rad([heading_deg]), "Z")
    c, s = np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg))
    rotations = motion.rotations.copy()
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    root = motion.root_xyz @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    turned = Motion(motion.skeleton, motion.frame_rate_hz, root, rotations)
    positions, world_from_joint = forward_kinematics(_played(turned, start_s, duration_s))
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
