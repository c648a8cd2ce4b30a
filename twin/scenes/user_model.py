"""A user's own model, MJCF or URDF with its meshes, with markers on it.

The visible geoms are those that MuJoCo's viewer shows: geom groups 0 to 2. Geoms of other groups (collision shapes)
are not visible and do not occlude; nor do the collision shapes of a URDF link with visuals.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_TABLE_BYTES, read_text
from mosca.data.files.decimals import reals
from mosca.data.motion.motion import LARGEST_NUMBER
from mosca.errors import InputError
from twin.scenes.paths import normalized, quaternion_addresses, spline_path, step_path
from twin.scenes.scene import UNSEEN_GROUP, Scene
from twin.scenes.user_markers import MarkersInModel, read_marker_table, seat_markers, surfaces_of
from twin.scenes.world import Box, add_floor, compiled, new_stage, positive

OwnMotion = Literal["turntable", "physics", "table"]
OWN_MOTIONS: tuple[OwnMotion, ...] = ("turntable", "physics", "table")
_PREFIX = "own/"
_LAST_SEEN_GROUP = 2
_URDF_EXTENSION = '<mujoco><compiler discardvisual="false" fusestatic="false" strippath="false"/></mujoco>'
_TILT_RAD = 0.35
DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""Warnings after which MuJoCo resets itself to the start."""


def build_own(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    model_file: Path,
    markers_file: Path | MarkersInModel,
    motion: OwnMotion = "turntable",
    motion_file: Path | None = None,
    speed_mps: float = 0.3,
    turn_rad_s: float = 1.0,
    floor: bool = True,
) -> Scene:
    """Return the model in ``model_file`` (MJCF .xml or .urdf) with markers on it.

    The scene's rigid bodies are all bodies with markers. Raises InputError for files that MuJoCo cannot load, unknown
    bodies, a box too small for a turntable, a table that does not fit, physics that diverges.

    Parameters
    ----------
    duration_s, box_center_m, box_size_m
        Length of the scene, and working space ((3,) each).
    rng
        Draws the start of the turntable.
    model_file, markers_file
        Model, and table of its markers or the choice of the model's own sites or spheres as markers.
    motion
        "turntable": the whole model, joints at rest, moves about the box, rotates and tilts; "physics": simulated
        from its first keyframe, else its rest pose, at -0.1 s; "table": ``motion_file``.
    motion_file
        CSV with header, column 1 the time [s], then all of qpos.
    speed_mps, turn_rad_s
        Largest speed of the turntable per axis, and its rotation rate.
    floor
        Add the plane z = 0 unless the model has a plane.
    """
    model_file = Path(model_file)
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s})
    if motion not in OWN_MOTIONS or (motion == "table") != (motion_file is not None):
        raise InputError(
            f"motion = {motion!r}, motion_file = {motion_file}: motion is one of {', '.join(OWN_MOTIONS)}, and "
            "motion_file goes with 'table' only"
        )
    if isinstance(markers_file, MarkersInModel):
        spec, bare = load_model(model_file)
        markers = markers_file.found(bare, model_file)
        markers_file.place(spec, surfaces_of(bare), markers, model_file)
    else:
        markers = read_marker_table(markers_file)
        spec, bare = load_model(model_file)
        seat_markers(spec, surfaces_of(bare), markers, markers_file)
    names = tuple(marker.name for marker in markers)
    bodies = {b: tuple(m.name for m in markers if m.body == b) for b in dict.fromkeys(m.body for m in markers)}
    if motion == "turntable":
        positive({"speed_mps": speed_mps, "turn_rad_s": turn_rad_s})
        try:
            model, geoms = compiled(_on_turntable(spec, floor), names, _PREFIX)
        except ValueError as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{model_file}: cannot be put on a turntable: {reason}; use 'physics'") from None
        path = _turntable(model, box, speed_mps, turn_rad_s, rng)
        return Scene(model, names, geoms, path, duration_s, bodies)
    if floor and not (bare.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any():
        add_floor(spec)
    model, geoms = compiled(spec, names)
    if motion_file is not None:
        times, qpos = _read_table(Path(motion_file), model, duration_s)
        return Scene(
            model, names, geoms, spline_path(times, qpos, quaternion_addresses(model)[0]), duration_s, bodies
        )
    qpos, qvel = _let_go(model, duration_s, str(model_file))
    fallen = step_path(model, -0.1, model.opt.timestep, qpos, qvel)
    return Scene(model, names, geoms, fallen, duration_s, bodies)


@dataclass(frozen=True, eq=False)
class Turntable:
    """The configuration of a free body that is moved about a point and rotated."""

    center: Array
    """(3,) [m]"""
    swing: Array
    """(3,) amplitude of the motion along each axis [m]."""
    rates: Array
    """(3,): frequencies of the swing [rad/s]."""
    phases: Array
    turn_rad_s: float
    pivot: Array
    """(3,) the body's middle in its own axes [m]."""
    rest: Array
    """qpos of the model mounted on it."""

    def __call__(self, time_s: float) -> Array:
        """Return qpos (nq,) at session time ``time_s``."""
        qpos = self.rest.copy()
        yaw, tilt = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(yaw, np.array([0.0, 0.0, 1.0]), self.turn_rad_s * time_s + self.phases[3])
        lean = _TILT_RAD * np.sin(0.6 * self.turn_rad_s * time_s + self.phases[4])
        mujoco.mju_axisAngle2Quat(tilt, np.array([1.0, 0.0, 0.0]), lean)
        mujoco.mju_mulQuat(qpos[3:7], yaw, tilt)
        arm = np.zeros(3)
        mujoco.mju_rotVecQuat(arm, self.pivot, qpos[3:7])
        qpos[:3] = self.center + self.swing * np.sin(self.rates * time_s + self.phases[:3]) - arm
        return qpos


def load_model(path: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Return the specification and the model in ``path``, MJCF or URDF, collision shapes invisible.

    InputError for a file that MuJoCo cannot load.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; an MJCF (.xml) or URDF (.urdf) model is wanted")
    try:
        if path.suffix.lower() == ".urdf":
            text = read_text(path, "a URDF model", most_bytes=MOST_TABLE_BYTES)
            if "<mujoco" not in text:
                text = re.sub(r"(<robot\b[^>]*>)", rf"\1{_URDF_EXTENSION}", text, count=1)
            spec = mujoco.MjSpec.from_string(text)
            spec.modelfiledir = str(path.resolve().parent)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
        for body in spec.bodies:
            seen = [g for g in body.geoms if g.contype == 0 and g.conaffinity == 0]
            for geom in body.geoms:
                hidden = path.suffix.lower() == ".urdf" and seen and geom not in seen
                if hidden or geom.group > _LAST_SEEN_GROUP:
                    geom.group = UNSEEN_GROUP
        return spec, spec.compile()
    except (ValueError, OSError) as error:  # MuJoCo raises ValueError for models and files alike
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: MuJoCo cannot load it: {reason} (meshes: STL, OBJ or MSH)") from None


def _on_turntable(spec: mujoco.MjSpec, floor: bool) -> mujoco.MjSpec:
    """Return a stage with the model mounted on a free body named ``turntable``."""
    for geom in list(spec.geoms):
        if geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
            spec.delete(geom)
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    for key in list(spec.keys):
        spec.delete(key)
    stage = new_stage(floor=floor)
    carrier = stage.worldbody.add_body(name="turntable")
    carrier.add_freejoint(name="turntable")
    carrier.mass, carrier.inertia, carrier.explicitinertial = 1e-3, [1e-6, 1e-6, 1e-6], True
    stage.attach(spec, prefix=_PREFIX, frame=carrier.add_frame())
    return stage


def _turntable(
    model: mujoco.MjModel, box: Box, speed_mps: float, turn_rad_s: float, rng: np.random.Generator
) -> Turntable:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    centers, reach = data.geom_xpos[solid], model.geom_rbound[solid]
    pivot = ((centers - reach[:, None]).min(axis=0) + (centers + reach[:, None]).max(axis=0)) / 2
    radius = float((np.linalg.norm(centers - pivot, axis=1) + reach).max())
    swing = box.half_inside(np.full(3, radius), "this model as it turns")
    phases = rng.uniform(0, 2 * np.pi, 5)
    # Unequal shares of the speed: the path fills the box and does not close.
    rates = speed_mps * np.array([1.0, 0.83, 0.61]) / swing
    return Turntable(box.center, swing, np.minimum(rates, 2 * np.pi), phases, turn_rad_s, pivot, model.qpos0.copy())


def _let_go(model: mujoco.MjModel, duration_s: float, source: str) -> tuple[Array, Array]:
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    steps = int(np.ceil((duration_s + 0.2) / model.opt.timestep)) + 1
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    for k in range(steps + 1):
        qpos[k], qvel[k] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
        if any(data.warning[kind].number for kind in DIVERGED):
            raise InputError(
                f"{source}: the physics diverges {k * model.opt.timestep:.3f} s after the start; use a smaller "
                "timestep in its <option>, or motion = 'turntable' or 'table'"
            )
    return qpos, qvel


def _read_table(path: Path, model: mujoco.MjModel, duration_s: float) -> tuple[Array, Array]:
    text = read_text(path, "a CSV of time and qpos", most_bytes=MOST_TABLE_BYTES)
    try:
        rows = [line.split(",") for line in text.splitlines() if line.strip()]
        table = np.array([reals(row) for row in rows[1:]], dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: a header and rows of {model.nq + 1} numbers are wanted: {error}") from None
    if table.ndim != 2 or table.shape[1] != model.nq + 1 or len(table) < 2:
        raise InputError(
            f"{path}: table of shape {table.shape} given; time and {model.nq} numbers of qpos in two rows or more "
            f"are wanted (joints: {', '.join(model.joint(j).name or '?' for j in range(model.njnt))})"
        )
    times, qpos = table[:, 0], table[:, 1:]
    if not (np.abs(table) <= LARGEST_NUMBER).all() or (np.diff(times) <= 0).any():
        raise InputError(f"{path}: numbers must be finite and times must rise from row to row")
    if times[0] > 0 or times[-1] < duration_s:
        raise InputError(
            f"{path}: times {times[0]:g} to {times[-1]:g} s given; 0 to duration_s = {duration_s:g} s must be covered"
        )
    quaternions = quaternion_addresses(model)[0]
    norms = np.linalg.norm(qpos[:, quaternions[:, None] + np.arange(4)], axis=-1)
    if norms.size and norms.min() < 0.5:
        raise InputError(f"{path}: a quaternion (w, x, y, z) of length {norms.min():.3g} given; 1 is wanted")
    return times, normalized(qpos, quaternions)
