"""Rays of a coarse grid of pixels against a scene's geoms: the first geom met, its distance and its normal.

Intersections with MuJoCo's primitives and planes are analytic, in the camera frame with rays from its origin. Rays
are culled by tiles: a tile of rays is a cone, the bounding sphere of a geom is another, and rays are cast only where
the two cones meet.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step
from twin.cameras.optics.lens import TwinLens
from twin.cameras.render.inputs import Solid
from twin.cameras.render.occluders import BOX, CAPSULE, CYLINDER, ELLIPSOID, SPHERE, hit

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
TILE = 4
"""Rays along a tile's edge."""


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Rays through a grid of pixels."""

    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    step_px: int
    """Distance of the rays."""
    rays: Array
    """(rows, columns, 3): unit directions, camera frame, through the middles of step x step pixels; NaN: the lens
    images nothing there."""
    tile_axis: Array
    """(r, c, 3): axis of the cone around the rays of each tile."""
    tile_angle: Array
    """(r, c): its half angle [rad]; -1: no ray in it."""


@dataclass(frozen=True, eq=False)
class Met:
    """First intersection of each ray, all (rows, columns)."""

    geom: Array
    """Row in the geoms' arrays, or -1."""
    distance: Array
    """Distance to it [m]."""
    normal: Array
    """(rows, columns, 3): unit normal, camera frame."""
    other: Array
    """Whether the ray comes near a geom of a kind that only MuJoCo's own ray caster handles."""


def ray_grid(lens: TwinLens, width: int, height: int, step_px: int) -> RayGrid:
    """Return the lens's own rays through every ``step_px``-th pixel in x and y."""
    x = step_px * np.arange(-(-width // step_px)) + (step_px - 1) / 2
    y = step_px * np.arange(-(-height // step_px)) + (step_px - 1) / 2
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    grid = np.ascontiguousarray(lens.directions(pixels).reshape(len(y), len(x), 3))
    axis, angle = _tiles(grid)
    for array in (grid, axis, angle):
        array.setflags(write=False)
    return RayGrid(width, height, step_px, grid, axis, angle)


def cast(grid: RayGrid, kind: Array, size: Array, bound: Array, xyz: Array, rotation: Array) -> Met:
    """Return the first intersections of the rays with geoms at ``xyz`` (k, 3), ``rotation`` (k, 3, 3) geom -> camera.

    ``kind`` (k,) and ``size`` (k, 3): as in MuJoCo; ``bound`` (k,): radii of bounding spheres [m]. Planes are met
    from their front side only, within their size (0: infinite).
    """
    return Met(*_cast(grid.rays, grid.tile_axis, grid.tile_angle, kind, size, bound, xyz, rotation))


def _tiles(rays: Array) -> tuple[Array, Array]:
    rows, columns = -(-rays.shape[0] // TILE), -(-rays.shape[1] // TILE)
    axis, angle = np.zeros((rows, columns, 3)), np.full((rows, columns), -1.0)
    for i in range(rows):
        for j in range(columns):
            tile = rays[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE].reshape(-1, 3)
            tile = tile[np.isfinite(tile[:, 0])]
            if len(tile):
                middle = tile.sum(axis=0)
                axis[i, j] = middle / np.linalg.norm(middle)
                chord = np.linalg.norm(tile - axis[i, j], axis=1).max()
                angle[i, j] = 2.0 * np.arcsin(min(1.0, chord / 2)) + 1e-9
    return axis, angle


@kernel
def _cast(
    rays: Array,
    tile_axis: Array,
    tile_angle: Array,
    kind: Array,
    size: Array,
    bound: Array,
    xyz: Array,
    rotation: Array,
) -> Any:
    rows, columns = rays.shape[:2]
    geoms = kind.shape[0]
    geom = np.full((rows, columns), -1, dtype=np.int64)
    distance = np.full((rows, columns), np.inf)
    normal = np.zeros((rows, columns, 3))
    other = np.zeros((rows, columns), dtype=np.bool_)
    away, half = np.empty(geoms), np.empty(geoms)
    for g in range(geoms):
        away[g] = math.sqrt(xyz[g, 0] ** 2 + xyz[g, 1] ** 2 + xyz[g, 2] ** 2)
        half[g] = math.asin(bound[g] / away[g]) if bound[g] < away[g] else math.pi
    cos_half, sin_half = np.cos(half), np.sin(half)
    near = np.empty(geoms, dtype=np.int64)
    for i in range(tile_angle.shape[0]):
        for j in range(tile_angle.shape[1]):
            if tile_angle[i, j] < 0.0:
                continue
            count, others = 0, False
            x, y, z = tile_axis[i, j, 0], tile_axis[i, j, 1], tile_axis[i, j, 2]
            cos_tile, sin_tile = math.cos(tile_angle[i, j]), math.sin(tile_angle[i, j])
            for g in range(geoms):
                if kind[g] != PLANE and half[g] + tile_angle[i, j] < math.pi:
                    widest = cos_half[g] * cos_tile - sin_half[g] * sin_tile
                    if x * xyz[g, 0] + y * xyz[g, 1] + z * xyz[g, 2] < widest * away[g]:
                        continue
                if _is_known(kind[g]):
                    near[count] = g
                    count += 1
                else:
                    others = True
            for p in range(i * TILE, min(rows, (i + 1) * TILE)):
                for q in range(j * TILE, min(columns, (j + 1) * TILE)):
                    dx, dy, dz = rays[p, q, 0], rays[p, q, 1], rays[p, q, 2]
                    if math.isnan(dx):
                        continue
                    other[p, q] = others
                    for k in range(count):
                        g = near[k]
                        if kind[g] == PLANE:
                            t = _meet_plane(size, xyz, rotation, g, dx, dy, dz)
                        else:
                            t = hit(Solid(kind[g], size[g], xyz[g], rotation[g]), dx, dy, dz)
                        if t < distance[p, q]:
                            distance[p, q], geom[p, q] = t, g
                    g = geom[p, q]
                    if g >= 0:
                        t = distance[p, q]
                        normal[p, q, 0], normal[p, q, 1], normal[p, q, 2] = _normal(
                            kind[g], size, xyz, rotation, g, t * dx, t * dy, t * dz
                        )
    return geom, distance, normal, other


@step
def _is_known(kind: int) -> bool:
    return kind in (PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX)


@step
def _meet_plane(size: Array, xyz: Array, rotation: Array, g: int, dx: float, dy: float, dz: float) -> Any:
    """Distance at which a ray meets the front of plane g (its +z side); inf if never."""
    fall = rotation[g, 0, 2] * dx + rotation[g, 1, 2] * dy + rotation[g, 2, 2] * dz
    height = rotation[g, 0, 2] * xyz[g, 0] + rotation[g, 1, 2] * xyz[g, 1] + rotation[g, 2, 2] * xyz[g, 2]
    if fall >= 0.0 or height >= 0.0:
        return np.inf
    t = height / fall
    for k in range(2):
        if size[g, k] > 0.0:
            x, y, z = t * dx - xyz[g, 0], t * dy - xyz[g, 1], t * dz - xyz[g, 2]
            if abs(rotation[g, 0, k] * x + rotation[g, 1, k] * y + rotation[g, 2, k] * z) > size[g, k]:
                return np.inf
    return t


@step
def _normal(kind: int, size: Array, xyz: Array, rotation: Array, g: int, px: float, py: float, pz: float) -> Any:
    """Outward unit normal of primitive g at a point of its surface, camera frame."""
    dx, dy, dz = px - xyz[g, 0], py - xyz[g, 1], pz - xyz[g, 2]
    x = rotation[g, 0, 0] * dx + rotation[g, 1, 0] * dy + rotation[g, 2, 0] * dz
    y = rotation[g, 0, 1] * dx + rotation[g, 1, 1] * dy + rotation[g, 2, 1] * dz
    z = rotation[g, 0, 2] * dx + rotation[g, 1, 2] * dy + rotation[g, 2, 2] * dz
    a, b, c = size[g, 0], size[g, 1], size[g, 2]
    if kind == PLANE:
        x, y, z = 0.0, 0.0, 1.0
    elif kind == CAPSULE:
        z -= min(max(z, -b), b)
    elif kind == ELLIPSOID:
        x, y, z = x / (a * a), y / (b * b), z / (c * c)
    elif kind == CYLINDER:
        if b - abs(z) < a - math.sqrt(x * x + y * y):
            x, y = 0.0, 0.0
        else:
            z = 0.0
    elif kind == BOX:
        inside_x, inside_y, inside_z = a - abs(x), b - abs(y), c - abs(z)
        if inside_x <= inside_y and inside_x <= inside_z:
            y, z = 0.0, 0.0
        elif inside_y <= inside_z:
            x, z = 0.0, 0.0
        else:
            x, y = 0.0, 0.0
    n = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / n, y / n, z / n
    return (
        rotation[g, 0, 0] * x + rotation[g, 0, 1] * y + rotation[g, 0, 2] * z,
        rotation[g, 1, 0] * x + rotation[g, 1, 1] * y + rotation[g, 1, 2] * z,
        rotation[g, 2, 0] * x + rotation[g, 2, 1] * y + rotation[g, 2, 2] * z,
    )


class Covers(NamedTuple):
    """Reflectance and cloths of the k geoms."""

    base: Array
    """(k,): reflectance of the geoms themselves."""
    wears: Array
    """(k, c): whether a cloth lies on a geom; the last one that covers a point counts."""
    cloths: Array
    """(c, 4) reflectance, retroreflection, range (from, to) along the geom's z axis."""


class Illumination(NamedTuple):
    """Light of a white surface: even ``ambient``, and ``lamp`` facing the camera's lamp at ``at_m`` [electrons]."""

    ambient: float
    lamp: float
    at_m: float


@kernel
def shade(
    rays: Array,
    geom: Array,
    distance: Array,
    normal: Array,
    xyz: Array,
    rotation: Array,
    covers: Covers,
    light: Illumination,
) -> Any:
    """Return the light (rows, columns) float32 that a pixel gets from the surface that its ray meets (``Met``).

    ``xyz`` (k, 3) and ``rotation`` (k, 3, 3): poses of the geoms, camera frame.
    """
    base, wears, cloths = covers
    ambient, lamp, at_m = light
    rows, columns = geom.shape
    out = np.zeros((rows, columns), dtype=np.float32)
    for p in range(rows):
        for q in range(columns):
            g = geom[p, q]
            if g < 0:
                continue
            d, t = rays[p, q], distance[p, q]
            reflectance, retro = base[g], 0.0
            for c in range(cloths.shape[0]):
                if wears[g, c]:
                    z = 0.0
                    for k in range(3):
                        z += rotation[g, k, 2] * (t * d[k] - xyz[g, k])
                    if cloths[c, 2] <= z <= cloths[c, 3]:
                        reflectance, retro = cloths[c, 0], cloths[c, 1]
            facing = abs(d[0] * normal[p, q, 0] + d[1] * normal[p, q, 1] + d[2] * normal[p, q, 2])
            near = (at_m / t) ** 2
            out[p, q] = reflectance * ambient + lamp * near * facing * (reflectance + retro * facing)
    return out
