"""A human actor: limbs that occlude, markers on the skin, moved by a recording or a built-in walk or action.

The model is the skeleton itself: one body for each joint, with a ball joint at its rest offset, under a free
root. A configuration is the root's position and every joint's rotation, so that bones keep their length
and MuJoCo's kinematics gives the positions. Nothing is simulated.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.motion import Motion, rest_positions
from mosca.errors import InputError
from twin.scenes.actions import ACTIONS, Action, ActionName, act
from twin.scenes.actor_joints import hinge_axes, joint_frames, recorded_axes
from twin.scenes.actor_markers import MarkerSet, Seat, scattered, seats
from twin.scenes.actor_recording import placed, played, read
from twin.scenes.anatomy import Anatomy, limb_shapes, read_anatomy
from twin.scenes.emission import ALL_SIDES_DEG, Blink, Glow
from twin.scenes.gait import GAIT_DETAILS, GAIT_PATHS, Gait, GaitDetail, GaitPath, walk, walker_skeleton
from twin.scenes.paths import SplinePath, normalized, spline_path
from twin.scenes.posture import Balance
from twin.scenes.scene import Scene
from twin.scenes.soft_tissue import SKINS, SLIDES, Skin, SoftTissue, add_slides, soft_tissue
from twin.scenes.target_plate import add_ball_at
from twin.scenes.world import Box, Shape, add_ball_marker, add_shape, compiled, new_stage, positive


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
    gait_detail: GaitDetail = "planar",
    speed_mps: float = 1.0,
    stature_m: float = 1.75,
    markers: int = 50,
    marker_set: MarkerSet = "default",
    skin: Skin = "off",
    seat_sigma_m: float = 0.0,
    marker_diameter_m: float = 0.016,
    lamps: tuple[BodyLamp, ...] = (),
    floor: bool = True,
) -> Scene:
    """Return an actor with ball markers in a working space, on the floor z = 0; or InputError.

    Parameters
    ----------
    duration_s, box_center_m, box_size_m, floor
        Length of the scene, working space ((3,) each), and whether there is a floor.
    markers, marker_set, marker_diameter_m, lamps
        Number (30..60 of the default set), set and size of the markers; lamps of worn cameras, which come after them.
    skin, seat_sigma_m
        Sliding of markers on the bones (``soft_tissue``), and their distance from the nominal sites (``scattered``).
    rng
        Draws start and first step of a walk, the loops of the other actions, and the skin.
    motion_file, skeleton_file, start_s
        Recording (.amc with .asf, or .bvh), and where it starts (converted BVH files begin with an added T-pose).
    metres_per_unit, frame_rate_hz, drop_frames
        Values that the file lacks (default: ASF from its length, 120 Hz; BVH 0.01, the file's rate, 1 frame dropped).
    placement, heading_deg, keep_in_box
        "center": rotated by the heading about the vertical, the middle of the part played over the middle of the box,
        its lowest heel or ball on the floor; "file": unchanged. Whether a recording that leaves the box is an error.
    action, gait, gait_detail, speed_mps, stature_m
        Used without a recording. "walk": "in_place", "circle" (the largest in the box) or "back_and_forth" along the
        box's longer side; the others are loops over the middle of the box.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s, "marker_diameter_m": marker_diameter_m})
    if motion_file is None:
        _check_built_in(action, gait, gait_detail, speed_mps, stature_m, box)
        anatomy, flexion = read_anatomy(walker_skeleton(stature_m), f"stature_m = {stature_m}"), hinge_axes()
    else:
        name = str(motion_file)
        motion = read(Path(motion_file), skeleton_file, metres_per_unit, frame_rate_hz, drop_frames)
        anatomy = read_anatomy(motion.skeleton, name)
        motion = placed(motion, anatomy, box, start_s, duration_s, placement, heading_deg, keep_in_box, name)
        flexion = recorded_axes(anatomy, played(motion, start_s, duration_s))
    shapes = limb_shapes(anatomy)
    seated = scattered(seats(anatomy, shapes, markers, marker_set), seat_sigma_m, rng.spawn(1)[0])
    spec, joints = _specify(anatomy, shapes, seated, marker_diameter_m, floor, slides=_is_soft(skin))
    _wear(spec, lamps)
    names = (*(seat.name for seat in seated), *(lamp.name for lamp in lamps))
    model, geoms = compiled(spec, names)
    if motion_file is not None:
        path: BuiltInConfiguration | SplinePath | SoftTissue = _recorded(model, joints, motion, start_s)
    elif action == "walk":
        moved = walk(anatomy.skeleton, gait, box.center[:2], box.size[:2] / 2, speed_mps, rng, gait_detail)
        path = _built_in(moved, model, joints)
    else:
        balance = _balance(model, joints, len(anatomy.skeleton.names))
        path = _built_in(act(action, anatomy.skeleton, balance, box, rng), model, joints)
    if _is_soft(skin):
        path = soft_tissue(path, model, anatomy, seated, skin, duration_s, rng.spawn(1)[0])  # alike in all actions
    frames = joint_frames(anatomy, seated, marker_diameter_m, flexion, model)
    return Scene(model, names, geoms, path, duration_s, _carried(seated, shapes), glows=_glows(lamps), joints=frames)


def _carried(seated: list[Seat], parts: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return the markers of each of the ``parts`` that carries three or more."""
    carried = {part: tuple(seat.name for seat in seated if seat.part == part) for part in parts}
    return {part: those for part, those in carried.items() if len(those) >= 3}


def _check_built_in(action: str, gait: str, detail: str, speed_mps: float, stature_m: float, box: Box) -> None:
    """Raise InputError where an actor without a recording cannot perform the action in the box."""
    positive({"speed_mps": speed_mps})
    if action not in ACTIONS:
        raise InputError(f"action = {action!r} given; allowed: {', '.join(ACTIONS)}")
    if not 1.3 <= stature_m <= 2.3:
        raise InputError(f"stature_m = {stature_m} given; 1.3 to 2.3 m wanted")
    if gait not in GAIT_PATHS:
        raise InputError(f"gait = {gait!r} given; allowed: {', '.join(GAIT_PATHS)}")
    if detail not in GAIT_DETAILS:
        raise InputError(f"gait_detail = {detail!r} given; allowed: {', '.join(GAIT_DETAILS)}")
    if box.high[2] < stature_m:
        raise InputError(
            f"box_center_m = {box.center.tolist()}, box_size_m = {box.size.tolist()}: the box ends at "
            f"{box.high[2]:.2f} m and the actor, standing on z = 0, at {stature_m} m; raise or enlarge the box"
        )


def _is_soft(skin: str) -> bool:
    """Return whether markers slide; InputError for an unknown word."""
    if skin not in SKINS:
        raise InputError(f"skin = {skin!r} given; allowed: {', '.join(SKINS)}")
    return skin != "off"


def _wear(spec: mujoco.MjSpec, lamps: tuple[BodyLamp, ...]) -> None:
    for lamp in lamps:
        body = spec.body(lamp.body)
        if body is None:
            known = ", ".join(b.name for b in spec.bodies if b.name != "world" and not b.name.startswith(SLIDES))
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
        qpos = np.zeros(self.nq)
        qpos[:3] = root
        qpos[starts[:, None] + np.arange(4)] = rotations[joints]
        return normalized(qpos, starts)


def _built_in(moved: Gait | Action, model: mujoco.MjModel, joints: list[int]) -> BuiltInConfiguration:
    return BuiltInConfiguration(moved, _addresses(model, joints), model.nq)


def _recorded(model: mujoco.MjModel, joints: list[int], motion: Motion, start_s: float) -> SplinePath:
    driven, starts = _addresses(model, joints)
    frames = len(motion.root_xyz)
    qpos = np.zeros((frames, model.nq))
    qpos[:, :3] = motion.root_xyz
    qpos[:, starts[:, None] + np.arange(4)] = motion.rotations[:, driven]
    return spline_path(np.arange(frames) / motion.frame_rate_hz, qpos, starts, start_s=start_s)


def _addresses(model: mujoco.MjModel, joints: list[int]) -> tuple[Array, Array]:
    starts = [int(model.joint(f"joint/{k}").qposadr[0]) + (3 if k == 0 else 0) for k in joints]
    return np.array(joints), np.array(starts)


def _balance(model: mujoco.MjModel, joints: list[int], total: int) -> Balance:
    """Return the mass and centre of mass that each of the skeleton's ``total`` joints carries in ``model``."""
    bodies = [int(model.jnt_bodyid[model.joint(f"joint/{k}").id]) for k in joints]
    masses, centers = np.zeros(total), np.zeros((total, 3))
    masses[joints], centers[joints] = model.body_mass[bodies], model.body_ipos[bodies]
    return Balance(masses, centers)


def _glows(lamps: tuple[BodyLamp, ...]) -> dict[str, Glow]:
    return {one.name: Glow("lamp", half_deg=ALL_SIDES_DEG, blink=one.blink) for one in lamps if one.blink}


def _specify(
    anatomy: Anatomy, shapes: dict[str, list[Shape]], seated: list[Seat], diameter: float, floor: bool, slides: bool
) -> tuple[mujoco.MjSpec, list[int]]:
    """Return the specification, and the joints that have bodies in it because a part needs them."""
    skeleton = anatomy.skeleton
    rest = rest_positions(skeleton)
    needed: set[int] = set()
    for joint in anatomy.parts.values():
        while joint >= 0 and joint not in needed:
            needed.add(joint)
            joint = int(skeleton.parents[joint])
    spec = new_stage(floor=floor)
    # Otherwise joints without a shape of their own (a clavicle) would be moving bodies without mass.
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
        holder = add_slides(bodies[joint], seat.name) if slides else bodies[joint]
        add_ball_marker(holder, seat.name, seat.surface - rest[joint], seat.normal, diameter)
    return spec, sorted(needed)
