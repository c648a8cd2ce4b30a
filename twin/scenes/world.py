"""Floor, working space, solid shapes, and markers on them.

Everything that shows, hides or carries a marker is a MuJoCo primitive added through MjSpec. Markers are geoms
without contacts and mass; their names in the model begin with ``marker/``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.errors import InputError
from twin.scenes.scene import MARKER_GROUP

MARKER_PREFIX = "marker/"
SEAT_M = 0.005
"""Thickness of a ball marker's base between skin and ball [m]."""
FLAT_HALF_THICKNESS_M = 0.0002
"""Half the thickness of a flat target's disc [m]: printed paper."""
_CLOTH = (0.12, 0.12, 0.14, 1.0)
_WHITE = (1.0, 1.0, 1.0, 1.0)
_FLOOR = (0.2, 0.2, 0.2, 1.0)
_FAR_M = 100.0


@dataclass(frozen=True, eq=False)
class Box:
    """The working space, axes parallel to the world's: ``center`` (3,) and ``size`` (3,) [m]."""

    center: Array
    size: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", read_only(self.center, (3,), "box_center_m"))
        object.__setattr__(self, "size", read_only(self.size, (3,), "box_size_m"))
        if not np.isfinite(self.center).all() or not (np.isfinite(self.size).all() and (self.size > 0).all()):
            raise InputError(
                f"box_center_m = {self.center.tolist()}, box_size_m = {self.size.tolist()}: finite numbers [m] "
                "and sizes above zero are wanted"
            )

    @property
    def low(self) -> Array:
        """Corner (3,) of the smallest coordinates [m]."""
        return np.asarray(self.center - self.size / 2)

    @property
    def high(self) -> Array:
        """Corner (3,) of the largest coordinates [m]."""
        return np.asarray(self.center + self.size / 2)

    def half_inside(self, margin: Array, what: str) -> Array:
        """Return half sizes (3,) less ``margin`` (3,) [m]; InputError where no room remains for ``what``."""
        half: Array = self.size / 2 - margin
        if not (half > 0).all():
            needs = " x ".join(f"{2 * m:.2f}" for m in np.asarray(margin))
            raise InputError(
                f"box_size_m = {self.size.tolist()}: too small for {what}, which needs more than {needs} m; "
                "enlarge the box"
            )
        return half


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid primitive: MuJoCo ``kind`` and ``size`` (3,) [m], ``center`` (3,) [m] and ``rotation`` (3, 3).

    All shapes of a body and the marker positions on them are given in the same axes.
    """

    kind: mujoco.mjtGeom
    size: Array
    center: Array
    rotation: Array

    def moved(self, by: Array) -> "Shape":
        """Return the shape moved by ``by`` (3,) [m]."""
        return Shape(self.kind, self.size, self.center + by, self.rotation)


def capsule(start: Array, end: Array, radius: float) -> Shape:
    """Return the capsule around the line from ``start`` to ``end`` (3,) [m]."""
    return _along(mujoco.mjtGeom.mjGEOM_CAPSULE, start, end, radius)


def cylinder(start: Array, end: Array, radius: float) -> Shape:
    """Return the cylinder around the line from ``start`` to ``end`` (3,) [m]."""
    return _along(mujoco.mjtGeom.mjGEOM_CYLINDER, start, end, radius)


def ellipsoid(center: Array, semi_axes: Array, long_axis: Array | None = None) -> Shape:
    """Return an ellipsoid with ``semi_axes`` (3,) [m]; ``long_axis`` (3,), where given, is its third axis.

    The first axis is then level (or along x where the third one is vertical).
    """
    rotation = np.eye(3) if long_axis is None else rotation_to(np.asarray(long_axis))
    return Shape(mujoco.mjtGeom.mjGEOM_ELLIPSOID, np.asarray(semi_axes, float), np.asarray(center, float), rotation)


def block(center: Array, size: Array) -> Shape:
    """Return a box with edges ``size`` (3,) [m] parallel to the axes."""
    half = np.asarray(size, dtype=np.float64) / 2
    return Shape(mujoco.mjtGeom.mjGEOM_BOX, half, np.asarray(center, dtype=np.float64), np.eye(3))


def rotation_to(z_axis: Array) -> Array:
    """Return a rotation (3, 3) whose third column is along ``z_axis`` (3,) and whose first one is level."""
    z = z_axis / np.linalg.norm(z_axis)
    level = np.array([-z[1], z[0], 0.0])
    x = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.stack([x, np.cross(z, x), z], axis=1)


def outermost(shapes: Sequence[Shape], origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return the point where the ray from ``origin`` along ``direction`` (3,) last leaves the union of ``shapes``.

    Returns the point (3,) [m] and the unit outward normal (3,) there. Raises ValueError where the ray
    misses all shapes.
    """
    outward = direction / np.linalg.norm(direction)
    eye = origin + _FAR_M * outward  # the ray is cast inwards: its first hit is the outermost
    nearest, normal = np.inf, outward
    for shape in shapes:
        seen = np.zeros(3)
        pose = shape.center, shape.rotation.reshape(-1), shape.size
        distance = mujoco.mju_rayGeom(*pose, eye, -outward, int(shape.kind), seen)
        if 0 <= distance < nearest:
            nearest, normal = distance, seen
    if not np.isfinite(nearest):
        raise ValueError("no shape lies along this ray")
    return eye - nearest * outward, normal / np.linalg.norm(normal)


def new_stage(*, floor: bool = True) -> mujoco.MjSpec:
    """Return an empty specification in radians, with a floor at z = 0 if wanted."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    if floor:
        add_floor(spec)
    return spec


def add_floor(spec: mujoco.MjSpec) -> None:
    """Add the plane z = 0 (geom ``floor``, infinite for rays and contacts)."""
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], rgba=_FLOOR)


def add_shape(
    body: mujoco.MjsBody,
    shape: Shape,
    *,
    name: str = "",
    solid: bool = False,
    mass: float | None = None,
    rgba: tuple[float, float, float, float] = _CLOTH,
) -> mujoco.MjsGeom:
    """Add ``shape`` to ``body``, in whose axes it is given; ``solid`` shapes collide; ``mass`` in kg."""
    weight = {} if mass is None else {"mass": mass}
    return body.add_geom(
        name=name,
        type=shape.kind,
        size=shape.size,
        pos=shape.center,
        quat=quaternion_from(shape.rotation),
        contype=int(solid),
        conaffinity=int(solid),
        rgba=rgba,
        **weight,
    )


def add_ball_marker(body: mujoco.MjsBody, name: str, surface: Array, normal: Array, diameter: float) -> None:
    """Add a ball of ``diameter`` [m] with its base on the skin at ``surface`` (3,), off it along ``normal`` (3,)."""
    center = ball_centre(surface, normal, diameter)
    add_marker(body, name, mujoco.mjtGeom.mjGEOM_SPHERE, [diameter / 2, 0, 0], center, np.eye(3))


def ball_centre(surface: Array, normal: Array, diameter: float) -> Array:
    """Return the centre (3,) [m] of a ball of ``diameter`` on its base at ``surface`` (3,), off along ``normal``."""
    return np.asarray(surface) + (diameter / 2 + SEAT_M) * np.asarray(normal)


def add_flat_target(body: mujoco.MjsBody, name: str, surface: Array, normal: Array, diameter: float) -> None:
    """Add a flat round target of ``diameter`` [m] stuck on ``surface`` (3,), facing along ``normal`` (3,)."""
    normal = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    center = np.asarray(surface) + FLAT_HALF_THICKNESS_M * normal
    size = [diameter / 2, FLAT_HALF_THICKNESS_M, 0]
    add_marker(body, name, mujoco.mjtGeom.mjGEOM_CYLINDER, size, center, rotation_to(normal))


def compiled(
    spec: mujoco.MjSpec, marker_names: Sequence[str], prefix: str = ""
) -> tuple[mujoco.MjModel, tuple[int, ...]]:
    """Return the compiled model and the markers' geom ids in the order of ``marker_names``.

    ``prefix``: the prefix that an attachment has added to the markers' names in the model.
    """
    model = spec.compile()
    return model, tuple(int(model.geom(prefix + MARKER_PREFIX + name).id) for name in marker_names)


def quaternion_from(rotation: Array) -> Array:
    """Return the unit quaternion (4,) wxyz of a rotation (3, 3)."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, np.ascontiguousarray(rotation, dtype=np.float64).reshape(-1))
    return wxyz


def positive(values: Mapping[str, float]) -> None:
    """Raise InputError for the first of the named ``values`` that is not a finite number above zero."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} = {value} given; a finite number above zero is wanted")


def _along(kind: mujoco.mjtGeom, start: Array, end: Array, radius: float) -> Shape:
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    rotation = rotation_to(b - a) if length > 0 else np.eye(3)
    return Shape(kind, np.array([radius, length / 2, 0.0]), (a + b) / 2, rotation)


def add_marker(
    body: mujoco.MjsBody,
    name: str,
    kind: mujoco.mjtGeom,
    size: list[float],
    center: Array,
    rotation: Array,
    rgba: tuple[float, float, float, float] = _WHITE,
) -> None:
    """Add a marker at ``center`` (3,), turned by ``rotation`` (3, 3), without mass and contacts."""
    body.add_geom(
        name=MARKER_PREFIX + name,
        type=kind,
        size=size,
        pos=center,
        quat=quaternion_from(rotation),
        contype=0,
        conaffinity=0,
        mass=0,
        group=MARKER_GROUP,
        rgba=rgba,
    )
