"""Occlusion of a marker by MuJoCo's ray caster, line by line, at one instant or many.

A small world is built in camera coordinates: marker and obstacles are mocap bodies, so that each can be moved
to its pose at an instant. Scan lines of rays go through the lens; edges along a line are found by bisection
(``witness.image.scan``).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from witness.image import Array, lines_image, lines_moments, scan
from witness.render import WitnessLens, area_and_centroid, ball_outline, disc_outline

MARKER_GROUP, UNSEEN_GROUP = 4, 5
Path = Callable[[float], Array]
"""Time -> centre (3,) or rotation (3, 3), camera frame."""

# world_from_camera: optical axis near the world's +y, tilted a little down and sideways
ROTATION = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) @ Rotation.from_rotvec([-0.2, 0.1, 0.15]).as_matrix()
POSITION = np.array([0.1, -2.0, 0.3])


def fixed(value: Any) -> Path:
    """Return a constant path."""
    array = np.asarray(value, float)
    return lambda t: array


class World:
    """One marker (geom 0, ``marker``) and its occluders, moving as given."""

    def __init__(self, at: Path, radius: float, normal: Array | None = None) -> None:
        self.spec, self.paths = mujoco.MjSpec(), list[tuple[Path, Path]]()
        self.flat, self.radius = normal is not None, radius
        if normal is None:
            self.add(mujoco.mjtGeom.mjGEOM_SPHERE, [radius, 0, 0], at, None, MARKER_GROUP)
        else:
            turn = fixed(Rotation.align_vectors([normal], [[0, 0, 1.0]])[0].as_matrix())
            self.add(mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, 1e-6, 0], at, turn, MARKER_GROUP)

    def add(self, kind: Any, size: Any, at: Path, turn: Path | None = None, group: int = 0, **more: Any) -> "World":
        """Add a geom with positions ``at`` [m] and rotations ``turn`` over time, both in the camera frame."""
        number = len(self.paths)
        body = self.spec.worldbody.add_body(name=f"b{number}", mocap=True)
        body.add_geom(type=kind, size=size, group=group, name=f"g{number}", **more)
        self.paths.append((at, fixed(np.eye(3)) if turn is None else turn))
        return self

    def add_mesh(self, shape: Any, at: Path, turn: Path | None = None) -> "World":
        """Add a trimesh."""
        name = f"m{len(self.paths)}"
        self.spec.add_mesh(name=name, uservert=shape.vertices.ravel(), userface=shape.faces.ravel())
        return self.add(mujoco.mjtGeom.mjGEOM_MESH, [0, 0, 0], at, turn, meshname=name)

    def compile(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return model and data, at instant 0."""
        model = self.spec.compile()
        data = mujoco.MjData(model)
        self.move(model, data, 0.0)
        return model, data

    def move(self, model: mujoco.MjModel, data: mujoco.MjData, t: float) -> None:
        """Set the poses of all bodies at ``t``."""
        for number, (at, turn) in enumerate(self.paths):
            k = model.body(f"b{number}").mocapid[0]
            data.mocap_pos[k] = ROTATION @ at(t) + POSITION
            data.mocap_quat[k] = Rotation.from_matrix(ROTATION @ turn(t)).as_quat(scalar_first=True)
        mujoco.mj_forward(model, data)


@dataclass(frozen=True, eq=False)
class SeenOverTime:
    """The visible part of a marker: means over the instants of an exposure."""

    share: float
    """Visible share of the marker's light, relative to scan lines of the whole marker, to 3e-4."""
    centroid: Array
    """(2,) centroid of the visible light [px]."""
    image: Array
    """(H, W) image of the visible light."""
    area: float
    """Area of the whole marker's image [px^2]."""


def seen_over_time(
    world: World,
    lens: WitnessLens,
    size: tuple[int, int],
    sigma_px: float,
    instants: int = 1,
    length_s: float = 1.0,
    lines_per_px: int = 24,
) -> SeenOverTime:
    """Return the visible part of the marker (geom 0) by rays: means over instants in the middles of cells."""
    model, data = world.compile()
    marker = model.geom("g0").id
    total, light, moment = 0.0, 0.0, np.zeros(2)
    image = np.zeros((size[1], size[0]))
    for t in (np.arange(instants) + 0.5) / instants * length_s:
        world.move(model, data, float(t))
        centre = world.paths[0][0](float(t))
        if world.flat:
            outline = lens.project(disc_outline(centre, world.paths[0][1](float(t))[:, 2], world.radius))
        else:
            outline = lens.project(ball_outline(centre, world.radius))
        low, high = outline.min(axis=0) - 0.3, outline.max(axis=0) + 0.3
        lines, step = scan(lambda xy: meets(model, data, lens, xy, marker), low, high, lines_per_px)
        total += area_and_centroid(outline)[0]
        area, centroid = lines_moments(lines, step)
        if area > 0.0:
            light += area
            moment += area * centroid
            image += lines_image(lines, step, sigma_px, *size)
    with np.errstate(invalid="ignore"):
        return SeenOverTime(light / total, moment / np.float64(light), image / instants, total / instants)


def meets(model: mujoco.MjModel, data: mujoco.MjData, lens: WitnessLens, xy: Array, marker: int) -> Array:
    """Return whether the rays of pixels (n, 2) meet the marker before any other visible geom (n,)."""
    directions = lens.unproject(xy) @ ROTATION.T
    directions = np.ascontiguousarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    n = len(directions)
    first, distance = np.full(n, -1, dtype=np.int32), np.zeros(n)
    groups = np.ones(6, dtype=np.uint8)
    groups[UNSEEN_GROUP] = 0
    mujoco.mj_multiRay(model, data, POSITION, directions.ravel(), groups, 1, -1, first, distance, None, n, 1e6)
    return np.asarray(first == marker)
