"""The hidden part of a target: rows of its image scanned for occluders.

In each row (8 a pixel) the lit intervals of the target (``lit_intervals``) are intersected with the intervals that
solids cover (``row_intervals``). The hidden part is returned as boundary points of negative light, in the same form
as the target's outline.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, step
from twin.cameras.optics.lens import pixel_direction, point_at_distance
from twin.cameras.optics.lens_vector import FISHEYE, KIND, PUPIL
from twin.cameras.render.bright_spots import fading
from twin.cameras.render.inputs import ImageBox, NearSolids, Solid, TargetPose
from twin.cameras.render.lit_intervals import lit_by_disc, lit_by_figure
from twin.cameras.render.occluders import hit
from twin.cameras.render.outline import BALL, FIGURE
from twin.cameras.render.row_intervals import covered

FINE_ROWS, ROWS, COARSE_ROWS = 12, 8, 2
"""Rows a pixel for images up to 12 px, up to 60 px, and beyond."""
SMALL_PX = 24.0
"""Image size up to which the lens is smooth enough to interpolate rays from nine."""
PIECE_PX = 3.0
"""Longest piece of a row that counts as straight in space: distortion bends it by at most 1e-3 px."""
PROFILE_PX = 0.4
"""Longest piece of a hidden interval over which the brightness of a profile counts as constant."""
BEFORE = 1.0 - 1e-9
"""Share of the distance to the target within which a solid hides it."""


class Scan(NamedTuple):
    """How a target's image is scanned; rays are scaled to even spacing along a row."""

    box: ImageBox
    rows: int
    """Number of rows, ``step_px`` apart."""
    step_px: float
    pieces: int
    """Pieces of a row, ``piece_px`` long each."""
    piece_px: float
    distance_m: float
    """Distance of the plane onto which the rays of a fisheye (``gnomonic``) are scaled."""
    gnomonic: bool
    small: bool
    """Whether rays are interpolated in the lattice."""
    lattice: Array
    """(3, 3, 3) rays at the box's corners, edges and middle."""


@step
def scan_hidden(
    lens: Array, target: TargetPose, contours: Array, box: ImageBox, near: NearSolids, profile: Array, skip_free: bool
) -> Any:
    """Return the boundaries (u, v, dv) of the hidden part (n, 3) and the lit whole (k, 3), and both areas [px^2].

    ``contours``: the pieces of a figure; ``box``: that of the target's image; ``near``: the NearSolids; ``profile``
    (6,): limb, shade (camera frame), fade of a ball or disc. Both boundaries together bound the visible part.
    ``skip_free``: whether to make neither boundary for a figure that has no solid in front of it.
    """
    scan = _scan(lens, target, box)
    figure = target.shape == FIGURE
    if skip_free and figure and not _anything_before(lens, target, scan, near):
        return np.empty((0, 3)), np.empty((0, 3)), 0.0, 1.0
    rays, a, b = np.empty((scan.pieces + 1, 3)), np.empty(3), np.empty(3)
    most_lit = 2 * contours.shape[0] if figure else 2
    lit_u, lit_step = np.empty(most_lit), np.empty(most_lit)
    low, high = np.empty(scan.pieces * near.found), np.empty(scan.pieces * near.found)
    edges, lit_edges = np.empty((64, 3)), np.empty((64, 3))
    # integer variables, no literals: Numba would compile the function once for each literal argument
    edge_count = lit_count = np.int64(0)
    hidden_area = lit_area = 0.0
    for j in range(scan.rows):
        v = box.top + (j + 0.5) * scan.step_px
        lit = 0
        if figure:
            _whole_row(lens, target, scan, v, a, b)
            lit = lit_by_figure(lens, target, contours, a, b, lit_u, lit_step)
            for i in range(lit):
                lit_area -= lit_u[i] * lit_step[i] * scan.step_px
        _row_rays(lens, target, scan, j, v, rays)
        found, lit_low, lit_high = _covered_in_row(target, scan, near, rays, low, high, a, b)
        if not figure and lit_high > lit_low:
            lit_u[0], lit_u[1] = lit_low, lit_high
            lit_step[0], lit_step[1] = 1.0, -1.0
            lit = 2
            lit_area += (lit_high - lit_low) * scan.step_px
        if lit_count + lit > lit_edges.shape[0]:
            lit_edges = _wider(lit_edges, lit_count, lit)
        for k in range(lit):
            _put(lit_edges, lit_count, lit_u[k], v, -lit_step[k] * scan.step_px)
            lit_count += 1
        if found == 0 or lit == 0:
            continue
        found = _merge(low, high, found)
        for i in range(found):
            edges, edge_count, hidden_area = _hide(
                edges, edge_count, hidden_area, scan, profile, v, low[i], high[i], lit_u[:lit], lit_step[:lit]
            )
    return edges[:edge_count], lit_edges[:lit_count], hidden_area, lit_area


@step
def anything_before(lens: Array, target: TargetPose, box: ImageBox, near: NearSolids) -> Any:
    """Whether any of the solids may hide a part of a target whose image is in ``box``."""
    return _anything_before(lens, target, _scan(lens, target, box), near)


@step
def _scan(lens: Array, target: TargetPose, box: ImageBox) -> Any:
    """Return the Scan of a target's image, with the lattice of rays for a small one."""
    left, right, top, bottom = box
    large = max(right - left, bottom - top)
    per_px = FINE_ROWS if large <= 12.0 else (ROWS if large <= 60.0 else COARSE_ROWS)
    rows = int((bottom - top) * per_px) + 2
    pieces = 1 + int((right - left) / PIECE_PX)
    distance = math.sqrt(target.x * target.x + target.y * target.y + target.z * target.z)
    small = large <= SMALL_PX
    lattice = np.empty((3, 3, 3))
    scan = Scan(
        box, rows, (bottom - top) / rows, pieces, (right - left) / pieces, distance, lens[KIND] == FISHEYE, small,
        lattice,
    )  # fmt: skip
    if small:
        for i in range(3):
            for k in range(3):
                u, v = left + 0.5 * k * (right - left), top + 0.5 * i * (bottom - top)
                lattice[i, k, 0], lattice[i, k, 1], lattice[i, k, 2] = _ray(lens, target, scan, u, v)
    return scan


@bare_step
def _ray(lens: Array, target: TargetPose, scan: Scan, u: float, v: float) -> Any:
    """A direction to pixel (u, v), scaled so that even steps along a straight line of pixels are even in space."""
    if lens[PUPIL] != 0.0:
        dx, dy, dz = point_at_distance(lens, u, v, scan.distance_m)
        if not scan.gnomonic:
            return dx / dz, dy / dz, 1.0
    else:
        dx, dy, dz = pixel_direction(lens, u, v)
    if scan.gnomonic:
        k = scan.distance_m / (dx * target.x + dy * target.y + dz * target.z)
        return dx * k, dy * k, dz * k
    return dx, dy, dz


@bare_step
def _whole_row(lens: Array, target: TargetPose, scan: Scan, v: float, a: Array, b: Array) -> None:
    """Write the fan a + s b of a whole row of the box, s from 0 to 1."""
    a[0], a[1], a[2] = _ray(lens, target, scan, scan.box.left, v)
    dx, dy, dz = _ray(lens, target, scan, scan.box.right, v)
    b[0], b[1], b[2] = dx - a[0], dy - a[1], dz - a[2]


@bare_step
def _row_rays(lens: Array, target: TargetPose, scan: Scan, j: int, v: float, rays: Array) -> None:
    """Write the rays (pieces + 1, 3) at the ends of the pieces of row ``j``, at height ``v`` of the image."""
    if not scan.small:
        rays[0, 0], rays[0, 1], rays[0, 2] = _ray(lens, target, scan, scan.box.left, v)
        for piece in range(scan.pieces):
            u = scan.box.left + piece * scan.piece_px + scan.piece_px
            rays[piece + 1, 0], rays[piece + 1, 1], rays[piece + 1, 2] = _ray(lens, target, scan, u, v)
        return
    p, q, w = _quadratic_weights((j + 0.5) / scan.rows)
    top, middle, bottom = scan.lattice[0], scan.lattice[1], scan.lattice[2]
    for i in range(3):
        left = p * top[0, i] + q * middle[0, i] + w * bottom[0, i]
        half = p * top[1, i] + q * middle[1, i] + w * bottom[1, i]
        right = p * top[2, i] + q * middle[2, i] + w * bottom[2, i]
        rays[0, i] = left
        for piece in range(scan.pieces):
            one, two, three = _quadratic_weights((piece + 1.0) / scan.pieces)
            rays[piece + 1, i] = one * left + two * half + three * right


@bare_step
def _quadratic_weights(f: float) -> Any:
    """Weights that interpolate values given at 0, 1/2 and 1."""
    return (2.0 * f - 1.0) * (f - 1.0), 4.0 * f * (1.0 - f), f * (2.0 * f - 1.0)


@bare_step
def _covered_in_row(
    target: TargetPose, scan: Scan, near: NearSolids, rays: Array, low: Array, high: Array, a: Array, b: Array
) -> Any:
    """Write the intervals of a row in which solids hide the target; ``a`` and ``b`` (3,) are working memory.

    Returns their number, and the begin and end of the part of the row that lies in a ball or disc.
    """
    found = np.int64(0)
    lit_low, lit_high = np.inf, -np.inf
    for piece in range(scan.pieces):
        start = scan.box.left + piece * scan.piece_px
        for i in range(3):
            a[i] = rays[piece, i]
            b[i] = (rays[piece + 1, i] - rays[piece, i]) / scan.piece_px
        one, two = 0.0, scan.piece_px
        if target.shape != FIGURE:
            one, two = lit_by_disc(target, a, b)
            one, two = max(one, 0.0), min(two, scan.piece_px)
            if one >= two:
                continue
            lit_low, lit_high = min(lit_low, start + one), max(lit_high, start + two)
        for q in range(near.found):
            first, last = _covered_before(target, near, near.number[q], a, b, one, two)
            if first < last:
                low[found], high[found] = start + first, start + last
                found += 1
    return found, lit_low, lit_high


@bare_step
def _covered_before(target: TargetPose, near: NearSolids, g: int, a: Array, b: Array, one: float, two: float) -> Any:
    """The part of one..two in which solid ``g`` covers the fan a + s b before the target; low >= high: none."""
    solid = Solid(near.kind[g], near.size[g], near.xyz[g], near.rotation[g])
    first, last = covered(solid, a, b)
    first, last = max(first, one), min(last, two)
    if first >= last:
        return np.inf, -np.inf
    return _in_front(solid, a, b, first, last, target)


@step
def _hide(
    edges: Array,
    count: int,
    area: float,
    scan: Scan,
    profile: Array,
    v: float,
    low: float,
    high: float,
    lit_u: Array,
    lit_step: Array,
) -> Any:
    """Add the boundary of the part hidden from ``low`` to ``high`` in the row at ``v``; ``area``: that hidden so far.

    ``lit_u`` and ``lit_step`` (k,): where the target's light rises in this row, and by how much. Returns the edges,
    their number and the area.
    """
    left, right, top, bottom = scan.box
    step, lit = scan.step_px, lit_u.shape[0]
    profiled = has_profile(profile)
    cuts = 1 + int((high - low) / PROFILE_PX) if profiled else 1
    width = (high - low) / cuts
    for cut in range(cuts):
        begin, end = low + cut * width, low + (cut + 1) * width
        bright = 1.0
        if profiled:
            bright = brightness(
                profile, (0.5 * (begin + end) - 0.5 * (left + right)) / (0.5 * (right - left)),
                (v - 0.5 * (top + bottom)) / (0.5 * (bottom - top)),
            )  # fmt: skip
        if count + lit + 2 > edges.shape[0]:
            edges = _wider(edges, count, lit + 2)
        level = 0.0
        for k in range(lit):
            if lit_u[k] <= begin:
                level += lit_step[k]
        _put(edges, count, begin, v, bright * level * step)
        count += 1
        area -= level * begin * step
        for k in range(lit):
            if begin < lit_u[k] < end:
                _put(edges, count, lit_u[k], v, bright * lit_step[k] * step)
                count += 1
                level += lit_step[k]
                area -= lit_step[k] * lit_u[k] * step
        _put(edges, count, end, v, -bright * level * step)
        count += 1
        area += level * end * step
    return edges, count, area


@step
def _anything_before(lens: Array, target: TargetPose, scan: Scan, near: NearSolids) -> Any:
    """Whether any solid hides a part of the box of a figure, by rows of half a pixel: most figures have none."""
    top, bottom = scan.box.top, scan.box.bottom
    a, b = np.empty(3), np.empty(3)
    rows = 2 + int(2.0 * (bottom - top))
    for j in range(rows):
        _whole_row(lens, target, scan, top + (bottom - top) * (j + 0.5) / rows, a, b)
        for q in range(near.found):
            first, last = _covered_before(target, near, near.number[q], a, b, 0.0, 1.0)
            if first < last:
                return True
    return False


@bare_step
def _put(edges: Array, n: int, u: float, v: float, amount: float) -> None:
    edges[n, 0], edges[n, 1], edges[n, 2] = u, v, amount


@step
def _wider(edges: Array, count: int, more: int) -> Any:
    """Return the edges in a larger array."""
    wider = np.empty((2 * edges.shape[0] + more, 3))
    # element by element: Numba would compile an assignment of slices with its error message for unequal shapes
    for i in range(count):
        wider[i, 0], wider[i, 1], wider[i, 2] = edges[i, 0], edges[i, 1], edges[i, 2]
    return wider


@bare_step
def has_profile(profile: Array) -> Any:
    """Whether the brightness of a target varies over it."""
    shaded = profile[1] != 0.0 or profile[2] != 0.0 or profile[3] != 0.0
    return shaded or profile[0] != 0.0 or profile[4] < 0.5 * math.pi


@bare_step
def brightness(profile: Array, qx: float, qy: float) -> Any:
    """Brightness at (qx, qy), a position on the disc in units of its radius: limb darkening and a gradient."""
    inside = max(0.0, 1.0 - qx * qx - qy * qy)
    shine = 1.0 - profile[0] * (1.0 - math.sqrt(inside)) + profile[1] * qx + profile[2] * qy
    return shine * fading(profile, math.sqrt(1.0 - inside))


@bare_step
def front_of(target: TargetPose, dx: float, dy: float, dz: float) -> Any:
    """Distance along d at which a ray meets the target's front (the silhouette's edge counts as met)."""
    shape, rotation, x, y, z, r = target
    if shape != BALL:
        nx, ny, nz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
        return (x * nx + y * ny + z * nz) / (dx * nx + dy * ny + dz * nz)
    a = dx * dx + dy * dy + dz * dz
    b = dx * x + dy * y + dz * z
    return (b - math.sqrt(max(0.0, b * b - a * (x * x + y * y + z * z - r * r)))) / a


@bare_step
def _before(solid: Solid, a: Array, b: Array, s: float, target: TargetPose) -> Any:
    """Whether the ray at s meets the solid before the target."""
    dx, dy, dz = a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]
    return hit(solid, dx, dy, dz) < front_of(target, dx, dy, dz) * BEFORE


@bare_step
def _in_front(solid: Solid, a: Array, b: Array, first: float, last: float, target: TargetPose) -> Any:
    """The part of an interval in which the solid hides the target; solids that intersect it divide it once."""
    at_first = _before(solid, a, b, first + 0.05 * (last - first), target)
    at_last = _before(solid, a, b, last - 0.05 * (last - first), target)
    if at_first and at_last:
        return first, last
    if not at_first and not at_last:
        return np.inf, -np.inf
    near, far = first, last
    for _ in range(12):
        middle = 0.5 * (near + far)
        if _before(solid, a, b, middle, target) == at_first:
            near = middle
        else:
            far = middle
    return (first, near) if at_first else (near, last)


@bare_step
def _merge(low: Array, high: Array, count: int) -> Any:
    """Sort intervals and join those that touch, in place; return how many are left."""
    for i in range(1, count):
        one, two = low[i], high[i]
        k = i - 1
        while k >= 0 and low[k] > one:
            low[k + 1], high[k + 1] = low[k], high[k]
            k -= 1
        low[k + 1], high[k + 1] = one, two
    kept = 0
    for i in range(1, count):
        if low[i] <= high[kept] + 1e-9:
            high[kept] = max(high[kept], high[i])
        else:
            kept += 1
            low[kept], high[kept] = low[i], high[i]
    return kept + 1
