"""Occluders between the camera and a marker: analytic rays against MuJoCo's primitives.

All is in the camera frame, and rays start at its origin. Meshes are left to ``mj_multiRay`` (see ``mesh_occlusion``).
Planes and height fields are floors: for a camera above them they hide nothing that is above them, and are skipped.
"""

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, callable_bare_step
from twin.cameras.render.inputs import Solid
from twin.scenes.scene import MARKER_GROUP, UNSEEN_GROUP, Scene

SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = (
    int(mujoco.mjtGeom.mjGEOM_SPHERE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER),
    int(mujoco.mjtGeom.mjGEOM_BOX),
)
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
PRIMITIVES = (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX)


@dataclass(frozen=True, eq=False)
class Occluders:
    """The geoms of a scene that can hide a marker: primitives (k,), markers included, and meshes (q,)."""

    geom: Array
    """(k,): ids of the primitives."""
    kind: Array
    """(k,): MuJoCo's types of the primitives."""
    size: Array
    """(k, 3): MuJoCo's sizes of the primitives [m]."""
    marker: Array
    """(k,): number of the marker that a geom represents, or -1."""
    mesh_geom: Array
    """(q,): ids of the meshes."""
    mesh_radius: Array
    """(q,): radii of the meshes' bounding spheres [m]."""


def occluders_of(scene: Scene) -> Occluders:
    """Return the geoms that can hide a marker in ``scene``: visible primitives and meshes outside UNSEEN_GROUP.

    Left out are planes and height fields, geoms of alpha 0, and geoms of MARKER_GROUP that are not among the
    scene's ``marker_geoms``. Markers that are listed hide each other. (MuJoCo's ray caster, which is used for
    markers that a mesh may hide, leaves out none of these but alpha 0.)
    """
    model = scene.model
    marker_of = {geom: k for k, geom in enumerate(scene.marker_geoms)}
    seen = [
        g
        for g in range(model.ngeom)
        if model.geom_group[g] != UNSEEN_GROUP
        and model.geom_rgba[g, 3] > 0
        and (model.geom_group[g] != MARKER_GROUP or g in marker_of)
    ]
    solid = [g for g in seen if model.geom_type[g] in PRIMITIVES]
    meshes = [g for g in seen if model.geom_type[g] == MESH]
    return Occluders(
        np.array(solid, dtype=np.int64),
        np.array([model.geom_type[g] for g in solid], dtype=np.int64),
        np.ascontiguousarray(model.geom_size[solid], dtype=float).reshape(-1, 3),
        np.array([marker_of.get(g, -1) for g in solid], dtype=np.int64),
        np.array(meshes, dtype=np.int64),
        np.array([model.geom_rbound[g] for g in meshes], dtype=float),
    )


@bare_step
def axis_reach(kind: int, size: Array) -> Any:
    """Half length (along the geom's z axis) and radius of a capsule that encloses the geom [m]."""
    if kind == SPHERE:
        return 0.0, size[0]
    if kind == CAPSULE:
        return size[1], size[0]
    if kind == CYLINDER:
        # the rim lies outside the capsule of the same length: enclose the corner
        return 0.0, math.sqrt(size[0] ** 2 + size[1] ** 2)
    if kind == ELLIPSOID:
        return 0.0, max(size[0], max(size[1], size[2]))
    return 0.0, math.sqrt(size[0] ** 2 + size[1] ** 2 + size[2] ** 2)


@callable_bare_step
def may_hide(centre: Array, axis: Array, half: float, reach: float, x: float, y: float, z: float, r: float) -> bool:
    """Whether a geom within ``reach`` of an axis segment can hide any of a marker of radius r at (x, y, z).

    Conservative: every ray to the marker lies within r of the segment from the camera to its centre.
    """
    ax, ay, az = centre[0] - half * axis[0], centre[1] - half * axis[1], centre[2] - half * axis[2]
    dx, dy, dz = 2 * half * axis[0], 2 * half * axis[1], 2 * half * axis[2]
    # closest points of the segments s (x, y, z) and a + t d, s and t in 0..1
    a = x * x + y * y + z * z
    e = dx * dx + dy * dy + dz * dz
    c = -(x * ax + y * ay + z * az)
    if e < 1e-18:
        s, t = min(max(-c / a, 0.0), 1.0), 0.0
    else:
        f = -(dx * ax + dy * ay + dz * az)
        b = x * dx + y * dy + z * dz
        det = a * e - b * b
        s = min(max((b * f - c * e) / det, 0.0), 1.0) if det > 1e-12 * a * e else 0.0
        t = (b * s + f) / e
        if t < 0.0:
            t, s = 0.0, min(max(-c / a, 0.0), 1.0)
        elif t > 1.0:
            t, s = 1.0, min(max((b - c) / a, 0.0), 1.0)
    ex, ey, ez = s * x - ax - t * dx, s * y - ay - t * dy, s * z - az - t * dz
    result: bool = ex * ex + ey * ey + ez * ez < (reach + r) ** 2
    return result


@bare_step
def hit(solid: Solid, dx: float, dy: float, dz: float) -> float:
    """Distance along (dx, dy, dz), in its lengths, at which a ray from the origin enters the solid; inf if never.

    An origin inside the solid counts as not entering.
    """
    kind, size, centre, rotation = solid
    ox = -(rotation[0, 0] * centre[0] + rotation[1, 0] * centre[1] + rotation[2, 0] * centre[2])
    oy = -(rotation[0, 1] * centre[0] + rotation[1, 1] * centre[1] + rotation[2, 1] * centre[2])
    oz = -(rotation[0, 2] * centre[0] + rotation[1, 2] * centre[1] + rotation[2, 2] * centre[2])
    x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if kind == SPHERE:
        result: float = _enter_sphere(ox, oy, oz, x, y, z, size[0])
        return result
    if kind == ELLIPSOID:
        p, q, r = size[0], size[1], size[2]
        result = _enter_sphere(ox / p, oy / q, oz / r, x / p, y / q, z / r, 1.0)
        return result
    if kind == CAPSULE:
        side = _enter_side(ox, oy, oz, x, y, z, size[0], size[1])
        low = _enter_sphere(ox, oy, oz + size[1], x, y, z, size[0])
        high = _enter_sphere(ox, oy, oz - size[1], x, y, z, size[0])
        result = min(side, min(low, high))
        return result
    if kind == CYLINDER:
        nearest = _enter_side(ox, oy, oz, x, y, z, size[0], size[1])
        if z != 0.0:
            t = ((-size[1] if z > 0.0 else size[1]) - oz) / z
            if t > 0.0 and (ox + t * x) ** 2 + (oy + t * y) ** 2 <= size[0] ** 2:
                nearest = min(nearest, t)
        result = nearest
        return result
    first, last = -np.inf, np.inf
    for o, d, h in ((ox, x, size[0]), (oy, y, size[1]), (oz, z, size[2])):
        if d == 0.0:
            if abs(o) > h:
                return np.inf
        else:
            one, two = (-h - o) / d, (h - o) / d
            first, last = max(first, min(one, two)), min(last, max(one, two))
    return first if 0.0 < first <= last else np.inf


@bare_step
def _enter_sphere(ox: float, oy: float, oz: float, x: float, y: float, z: float, r: float) -> float:
    a = x * x + y * y + z * z
    b = ox * x + oy * y + oz * z
    c = ox * ox + oy * oy + oz * oz - r * r
    d = b * b - a * c
    if d < 0.0 or c < 0.0:
        return np.inf
    t = (-b - math.sqrt(d)) / a
    return t if t > 0.0 else np.inf


@bare_step
def _enter_side(ox: float, oy: float, oz: float, x: float, y: float, z: float, r: float, half: float) -> float:
    """Distance at which a ray enters the side wall of a cylinder about z."""
    a = x * x + y * y
    if a == 0.0:
        return np.inf
    b = ox * x + oy * y
    c = ox * ox + oy * oy - r * r
    d = b * b - a * c
    if d < 0.0 or c < 0.0:
        return np.inf
    t = (-b - math.sqrt(d)) / a
    return t if t > 0.0 and abs(oz + t * z) <= half else np.inf
