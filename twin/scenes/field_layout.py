"""Test fields that fill a working space: coded targets spread over the faces of a rigid structure.

"tower": a stepped pyramid, seen from all sides and from above. "corner": two walls and a floor that meet in a
corner, seen from the open side (+x, +y, +z). Field axes: parallel to the box's edges, origin in its middle.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mosca.data.arrays import Array
from mosca.data.target_codes import NUMBERS
from mosca.data.targets import PLATE, CodedTarget, PlacedTarget, TestField, face_axes
from mosca.errors import InputError
from twin.scenes.target_plate import FILM_M
from twin.scenes.world import Shape, block

FieldLayout = Literal["tower", "corner"]
FIELD_LAYOUTS: tuple[FieldLayout, ...] = ("tower", "corner")
FEWEST_TARGETS = 4
STEPS = 3
_SLAB_SHARE = 0.02  # a wall's thickness, of the shortest edge
_PLATE_SHARE = 0.55  # a plate's edge, of its cell: 0.78 along its diagonal
_OFFSET_SHARE = 0.1  # how far a target may be off its cell's middle: two plates stay 0.02 cells apart


@dataclass(frozen=True, eq=False)
class Face:
    """A rectangle for targets: ``center`` (3,), outward ``normal`` (3,), ``width`` along its x axis, ``height``."""

    center: Array
    normal: Array
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class LaidOutField:
    """A test field and the solid ``shapes`` that carry its targets, in the field's axes."""

    field: TestField
    shapes: tuple[Shape, ...]


def lay_out_field(
    size_m: Array,
    rng: np.random.Generator,
    *,
    n: int = 100,
    layout: FieldLayout = "tower",
    dot_radius_m: float | None = None,
) -> LaidOutField:
    """Return ``n`` coded targets, 4 to 507, on a structure that fills a box of ``size_m`` (3,).

    ``rng`` draws numbers, positions in the faces' cells, and how each plate is rolled. ``dot_radius_m``: by
    default as large as the cells allow. Raises InputError for targets that do not fit.
    """
    if layout not in FIELD_LAYOUTS:
        raise InputError(f"layout = {layout!r} given; allowed: {', '.join(FIELD_LAYOUTS)}")
    if not FEWEST_TARGETS <= n <= NUMBERS:
        raise InputError(f"n = {n} given; {FEWEST_TARGETS} to {NUMBERS} targets are allowed")
    size = np.asarray(size_m, dtype=np.float64)
    faces, shapes = _tower(size) if layout == "tower" else _corner(size)
    cell = _largest_cell(faces, n)
    largest = _PLATE_SHARE * cell / PLATE
    dot = largest if dot_radius_m is None else dot_radius_m
    if not 0 < dot <= largest:
        raise InputError(
            f"dot_radius_m = {dot:g}: {n} targets in a box of {' x '.join(f'{e:g}' for e in size)} m leave room for "
            f"dots of {largest:.4g} m; take smaller or fewer ones"
        )
    places = [(face, x, y) for face in faces for x, y in _cells(face, cell)]
    chosen = np.sort(rng.permutation(len(places))[:n])
    numbers = rng.permutation(NUMBERS)[:n]
    offsets = rng.uniform(-_OFFSET_SHARE, _OFFSET_SHARE, (n, 2)) * cell
    rolls = rng.uniform(0, 2 * np.pi, n)
    targets = []
    for k, (number, offset, roll) in enumerate(zip(numbers, offsets, rolls, strict=True)):
        face, x, y = places[chosen[k]]
        target = CodedTarget.of_dot(int(number), dot)
        targets.append(_on_face(target, face, x + offset[0], y + offset[1], roll))
    return LaidOutField(TestField(tuple(targets)), shapes)


def _on_face(target: CodedTarget, face: Face, x: float, y: float, roll: float) -> PlacedTarget:
    axes = face_axes(face.normal)
    center = face.center + axes @ np.array([x, y, FILM_M])
    return PlacedTarget(target.name, target, center, face.normal, axes @ [np.cos(roll), np.sin(roll), 0.0])


def _cells(face: Face, cell: float) -> list[tuple[float, float]]:
    """Return the middles of the square cells that are spread evenly over a face."""
    columns, rows = int(face.width / cell), int(face.height / cell)
    return [
        (((c + 0.5) / columns - 0.5) * face.width, ((r + 0.5) / rows - 0.5) * face.height)
        for r in range(rows)
        for c in range(columns)
    ]


def _largest_cell(faces: tuple[Face, ...], n: int) -> float:
    """Return the largest edge of a square cell such that ``n`` of them fit on the faces."""
    edges = np.array([edge for face in faces for edge in (face.width, face.height)])
    fitting = np.unique(edges[:, None] / np.arange(1, 2 * n + 1))[::-1]  # only there does a row more fit
    for cell in fitting * (1 - 1e-12):
        if sum(int(f.width / cell) * int(f.height / cell) for f in faces) >= n:
            return float(cell)
    raise AssertionError("2 n cells along an edge hold n targets")


def _tower(size: Array) -> tuple[tuple[Face, ...], tuple[Shape, ...]]:
    """Return a stepped pyramid: the four sides of each step, and the part of its top that the next leaves free."""
    faces, shapes = [], []
    high = (size[2] - FILM_M) / STEPS
    room = size[:2] - 2 * FILM_M  # the targets are off the sides
    for step in range(STEPS):
        x, y = room * (1 - step / STEPS) / 2
        inner_x, inner_y = room * (1 - (step + 1) / STEPS) / 2
        low = -size[2] / 2 + step * high
        middle, top = low + high / 2, low + high
        shapes.append(block(np.array([0.0, 0.0, middle]), np.array([2 * x, 2 * y, high])))
        for sign in (1.0, -1.0):
            faces += [
                Face(np.array([sign * x, 0.0, middle]), np.array([sign, 0.0, 0.0]), 2 * y, high),
                Face(np.array([0.0, sign * y, middle]), np.array([0.0, sign, 0.0]), 2 * x, high),
            ]
        up = np.array([0.0, 0.0, 1.0])
        if step + 1 == STEPS:
            faces.append(Face(np.array([0.0, 0.0, top]), up, 2 * x, 2 * y))
            continue
        for sign in (1.0, -1.0):
            faces += [
                Face(np.array([0.0, sign * (y + inner_y) / 2, top]), up, 2 * x, y - inner_y),
                Face(np.array([sign * (x + inner_x) / 2, 0.0, top]), up, x - inner_x, 2 * inner_y),
            ]
    return tuple(faces), tuple(shapes)


def _corner(size: Array) -> tuple[tuple[Face, ...], tuple[Shape, ...]]:
    """Return a floor and two walls, whose inner faces meet in the corner of smallest coordinates."""
    slab = _SLAB_SHARE * float(size.min())
    inner = size - slab
    faces, shapes = [], []
    for axis in range(3):
        normal = np.eye(3)[axis]
        center = normal * (slab - size[axis] / 2)
        thin = np.where(np.arange(3) == axis, slab, size)
        shapes.append(block(-normal * (size[axis] - slab) / 2, thin))
        # the part of the face that the other two leave free; width runs along its level axis
        center = center + (1 - normal) * slab / 2
        width, height = inner[[1, 0, 0][axis]], inner[[2, 2, 1][axis]]
        faces.append(Face(center, normal, float(width), float(height)))
    return tuple(faces), tuple(shapes)
