"""The hidden part of a target: rows of its image scanned for what stands before it.

In each row (8 a pixel) the lit intervals of the target are cut with the intervals that solids cover (``cover``).
What is hidden leaves as boundary points of negative light, in the same form as the target's outline.
"""

import math

import numpy as np

from mosca.numba_support.decorators import kernel
from twin.cameras.optics.lens import land, origin, origin_at
from twin.cameras.optics.lens_vector import FISHEYE, PUPIL
from twin.cameras.render.occluders import hit
from twin.cameras.render.outline import BALL, FIGURE, along
from twin.cameras.render.row_intervals import covered, roots
from twin.scenes.figure import LINE

FINE_ROWS, ROWS, COARSE_ROWS = 12, 8, 2
"""Rows a pixel for images up to 12 px, up to 60 px, and beyond."""
SMALL_PX = 24.0
"""Up to this size the lens is smooth enough to be read from nine rays."""
PIECE_PX = 3.0
"""Longest piece of a row that counts as straight in space: distortion bends it by 1e-3 px at most."""


@kernel
def scan_hidden(  # type: ignore[no-untyped-def]
    lens, shape, turn, x, y, z, r, pieces, box, near, near_count, kind, size, geom_xyz, geom_turn, profile
):
    """Return the boundary of what is hidden (n, 3) and of what is lit (k, 3) as (u, v, dv), and both areas [px^2].

    ``box``: left, right, top, bottom of the target's image; ``near`` the geoms that may hide it; ``profile``
    (4,): limb and shade (camera frame) of a ball or disc. Both boundaries together are that of what is left.
    """
    left, right, top, bottom = box
    large = max(right - left, bottom - top)
    per_px = FINE_ROWS if large <= 12.0 else (ROWS if large <= 60.0 else COARSE_ROWS)
    rows = int((bottom - top) * per_px) + 2
    step = (bottom - top) / rows
    across = 1 + int((right - left) / PIECE_PX)
    piece_px = (right - left) / across
    profiled = profile[0] != 0.0 or profile[1] != 0.0 or profile[2] != 0.0 or profile[3] != 0.0
    reach = math.sqrt(x * x + y * y + z * z)
    gnomonic = lens[0] == FISHEYE
    small = large <= SMALL_PX
    if shape == FIGURE and not _anything_before(
        lens, shape, turn, x, y, z, r, box, near, near_count, kind, size, geom_xyz, geom_turn, reach, gnomonic
    ):
        return np.empty((0, 3)), np.empty((0, 3)), 0.0, 1.0
    lattice = np.empty((3, 3, 3))
    if small:
        for i in range(3):
            for k in range(3):
                dx, dy, dz = _ray(
                    lens,
                    left + 0.5 * k * (right - left),
                    top + 0.5 * i * (bottom - top),
                    x,
                    y,
                    z,
                    reach,
                    gnomonic,
                )
                lattice[i, k, 0], lattice[i, k, 1], lattice[i, k, 2] = dx, dy, dz
    row = np.empty((3, 3))
    a, b = np.empty(3), np.empty(3)
    most_lit = 2 if shape != FIGURE else 2 * pieces.shape[0]
    lit_u, lit_step = np.empty(most_lit), np.empty(most_lit)
    low, high = np.empty(across * near_count), np.empty(across * near_count)
    edges, lit_edges = np.empty((64, 3)), np.empty((64, 3))
    # whole numbers, no constants: each constant handed to a function would have it compiled once more
    edge_count = lit_count = np.int64(0)
    hidden_area = lit_area = 0.0
    for j in range(rows):
        v = top + (j + 0.5) * step
        # what the target itself lights in this row
        lit = 0
        ball_low, ball_high = np.inf, -np.inf
        if shape == FIGURE:
            d0x, d0y, d0z = _ray(lens, left, v, x, y, z, reach, gnomonic)
            d1x, d1y, d1z = _ray(lens, right, v, x, y, z, reach, gnomonic)
            a[0], a[1], a[2] = d0x, d0y, d0z
            b[0], b[1], b[2] = d1x - d0x, d1y - d0y, d1z - d0z
            lit = _lit_by_figure(lens, turn, x, y, z, pieces, a, b, lit_u, lit_step)
            for i in range(lit):
                lit_area -= lit_u[i] * lit_step[i] * step
        found = np.int64(0)
        if small:
            _along_lattice(lattice, (j + 0.5) / rows, row)
            d1x, d1y, d1z = row[0, 0], row[0, 1], row[0, 2]
        else:
            d1x, d1y, d1z = _ray(lens, left, v, x, y, z, reach, gnomonic)
        for piece in range(across):
            start = left + piece * piece_px
            d0x, d0y, d0z = d1x, d1y, d1z
            if small:
                f = (piece + 1.0) / across
                p, q, w = (2.0 * f - 1.0) * (f - 1.0), 4.0 * f * (1.0 - f), f * (2.0 * f - 1.0)
                d1x = p * row[0, 0] + q * row[1, 0] + w * row[2, 0]
                d1y = p * row[0, 1] + q * row[1, 1] + w * row[2, 1]
                d1z = p * row[0, 2] + q * row[1, 2] + w * row[2, 2]
            else:
                d1x, d1y, d1z = _ray(lens, start + piece_px, v, x, y, z, reach, gnomonic)
            a[0], a[1], a[2] = d0x, d0y, d0z
            b[0], b[1], b[2] = (d1x - d0x) / piece_px, (d1y - d0y) / piece_px, (d1z - d0z) / piece_px
            if shape != FIGURE:
                one, two = _lit_by_disc(shape, turn, x, y, z, r, a, b)
                one, two = max(one, 0.0), min(two, piece_px)
                if one >= two:
                    continue
                ball_low, ball_high = min(ball_low, start + one), max(ball_high, start + two)
            else:
                one, two = 0.0, piece_px
            for which in range(near_count):
                g = near[which]
                first, last = covered(kind[g], size[g], geom_xyz[g], geom_turn[g], a, b)
                first, last = max(first, one), min(last, two)
                if first >= last:
                    continue
                first, last = _in_front(
                    kind[g], size[g], geom_xyz[g], geom_turn[g], a, b, first, last, shape, turn, x, y, z, r
                )
                if first < last:
                    low[found], high[found] = start + first, start + last
                    found += 1
        if shape != FIGURE and ball_high > ball_low:
            lit_u[0], lit_u[1] = ball_low, ball_high
            lit_step[0], lit_step[1] = 1.0, -1.0
            lit = 2
            lit_area += (ball_high - ball_low) * step
        if lit_count + lit > lit_edges.shape[0]:
            lit_edges = _wider(lit_edges, lit_count, lit)
        for k in range(lit):
            _put(lit_edges, lit_count, lit_u[k], v, -lit_step[k] * step)
            lit_count += 1
        if found == 0 or lit == 0:
            continue
        found = _merge(low, high, found)
        for i in range(found):
            cuts = 1 + int((high[i] - low[i]) / 0.4) if profiled else 1
            width = (high[i] - low[i]) / cuts
            for cut in range(cuts):
                begin, end = low[i] + cut * width, low[i] + (cut + 1) * width
                bright = 1.0
                if profiled:
                    bright = brightness(
                        profile, (0.5 * (begin + end) - 0.5 * (left + right)) / (0.5 * (right - left)),
                        (v - 0.5 * (top + bottom)) / (0.5 * (bottom - top)),
                    )  # fmt: skip
                if edge_count + lit + 2 > edges.shape[0]:
                    edges = _wider(edges, edge_count, lit + 2)
                level = 0.0
                at_begin = 0.0
                for k in range(lit):
                    if lit_u[k] <= begin:
                        at_begin += lit_step[k]
                level = at_begin
                _put(edges, edge_count, begin, v, bright * at_begin * step)
                edge_count += 1
                hidden_area -= at_begin * begin * step
                for k in range(lit):
                    if begin < lit_u[k] < end:
                        _put(edges, edge_count, lit_u[k], v, bright * lit_step[k] * step)
                        edge_count += 1
                        level += lit_step[k]
                        hidden_area -= lit_step[k] * lit_u[k] * step
                _put(edges, edge_count, end, v, -bright * level * step)
                edge_count += 1
                hidden_area += level * end * step
    return edges[:edge_count], lit_edges[:lit_count], hidden_area, lit_area


@kernel
def _anything_before(  # type: ignore[no-untyped-def]
    lens, shape, turn, x, y, z, r, box, near, near_count, kind, size, geom_xyz, geom_turn, reach, gnomonic
):
    """Whether any geom stands before the box of a figure, by rows of half a pixel: most figures have none."""
    left, right, top, bottom = box
    a, b = np.empty(3), np.empty(3)
    rows = 2 + int(2.0 * (bottom - top))
    for j in range(rows):
        v = top + (bottom - top) * (j + 0.5) / rows
        a[0], a[1], a[2] = _ray(lens, left, v, x, y, z, reach, gnomonic)
        dx, dy, dz = _ray(lens, right, v, x, y, z, reach, gnomonic)
        b[0], b[1], b[2] = dx - a[0], dy - a[1], dz - a[2]
        for which in range(near_count):
            g = near[which]
            first, last = covered(kind[g], size[g], geom_xyz[g], geom_turn[g], a, b)
            first, last = max(first, 0.0), min(last, 1.0)
            if first < last:
                first, last = _in_front(
                    kind[g], size[g], geom_xyz[g], geom_turn[g], a, b, first, last, shape, turn, x, y, z, r
                )
                if first < last:
                    return True
    return False


@kernel
def _put(edges, n, u, v, amount):  # type: ignore[no-untyped-def]
    edges[n, 0], edges[n, 1], edges[n, 2] = u, v, amount


@kernel
def _wider(edges, count, more):  # type: ignore[no-untyped-def]
    """Room for more edges."""
    wider = np.empty((2 * edges.shape[0] + more, 3))
    # one by one: an assignment of slices would compile what it says of shapes that differ
    for i in range(count):
        wider[i, 0], wider[i, 1], wider[i, 2] = edges[i, 0], edges[i, 1], edges[i, 2]
    return wider


@kernel
def brightness(profile, qx, qy):  # type: ignore[no-untyped-def]
    """Brightness at (qx, qy), the place on the disc over its radius: limb darkening and a gradient."""
    inside = max(0.0, 1.0 - qx * qx - qy * qy)
    return 1.0 - profile[0] * (1.0 - math.sqrt(inside)) + profile[1] * qx + profile[2] * qy


@kernel
def _ray(lens, u, v, x, y, z, reach, gnomonic):  # type: ignore[no-untyped-def]
    """A direction to pixel (u, v), scaled so that straight lines of pixels are evenly spaced along it."""
    if lens[PUPIL] != 0.0:
        dx, dy, dz = origin_at(lens, u, v, reach)
        if not gnomonic:
            return dx / dz, dy / dz, 1.0
    else:
        dx, dy, dz = origin(lens, u, v)
    if gnomonic:
        k = reach / (dx * x + dy * y + dz * z)
        return dx * k, dy * k, dz * k
    return dx, dy, dz


@kernel
def _along_lattice(lattice, f, row):  # type: ignore[no-untyped-def]
    """Write the rays (3, 3) at the left, middle and right of the row at height f (0..1) of a lattice (3, 3, 3)."""
    p, q, w = (2.0 * f - 1.0) * (f - 1.0), 4.0 * f * (1.0 - f), f * (2.0 * f - 1.0)
    for k in range(3):
        for i in range(3):
            row[k, i] = p * lattice[0, k, i] + q * lattice[1, k, i] + w * lattice[2, k, i]


@kernel
def _lit_by_disc(shape, turn, x, y, z, r, a, b):  # type: ignore[no-untyped-def]
    """Interval of s in which the rays a + s b meet a ball, or a flat round target."""
    if shape == BALL:
        k = x * x + y * y + z * z - r * r
        ca, cb = x * a[0] + y * a[1] + z * a[2], x * b[0] + y * b[1] + z * b[2]
        aa = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
        ab = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
        q2, q1, q0 = cb * cb - k * bb, ca * cb - k * ab, ca * ca - k * aa
    else:
        # P = t d with t = c.n / d.n; |t d - c|^2 <= r^2, times (d.n)^2
        nx, ny, nz = turn[0, 2], turn[1, 2], turn[2, 2]
        cn = x * nx + y * ny + z * nz
        na, nb = a[0] * nx + a[1] * ny + a[2] * nz, b[0] * nx + b[1] * ny + b[2] * nz
        px, py, pz = cn * a[0] - na * x, cn * a[1] - na * y, cn * a[2] - na * z
        qx, qy, qz = cn * b[0] - nb * x, cn * b[1] - nb * y, cn * b[2] - nb * z
        q2 = r * r * nb * nb - qx * qx - qy * qy - qz * qz
        q1 = r * r * na * nb - px * qx - py * qy - pz * qz
        q0 = r * r * na * na - px * px - py * py - pz * pz
    low, high, some = roots(q2, q1, q0)
    if not some or q2 >= 0.0:
        return np.inf, -np.inf
    return low, high


@kernel
def _lit_by_figure(lens, turn, x, y, z, pieces, a, b, lit_u, lit_step):  # type: ignore[no-untyped-def]
    """Write where the row crosses the contours and by how much the light rises there; return how many times."""
    nx, ny, nz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    # the fan's plane in the figure's own coordinates: p + qx gx + qy gy = 0
    p = nx * x + ny * y + nz * z
    qx = nx * turn[0, 0] + ny * turn[1, 0] + nz * turn[2, 0]
    qy = nx * turn[0, 1] + ny * turn[1, 1] + nz * turn[2, 1]
    count = 0
    for i in range(pieces.shape[0]):
        tries = 0
        s0 = s1 = -1.0
        if pieces[i, 0] == LINE:
            begin = p + qx * pieces[i, 1] + qy * pieces[i, 2]
            end = p + qx * pieces[i, 3] + qy * pieces[i, 4]
            # half open, so that a corner on the row is crossed once
            if (begin > 0.0) != (end > 0.0):
                s0, tries = begin / (begin - end), 1
        else:
            size = pieces[i, 3] * math.hypot(qx, qy)
            here = p + qx * pieces[i, 1] + qy * pieces[i, 2]
            swing = pieces[i, 5] - pieces[i, 4]
            if abs(here) < size:
                middle, half = math.atan2(qy, qx), math.acos(-here / size)
                whole = 2.0 * math.pi
                s0 = _share_of_arc(middle + half, pieces[i, 4], swing, whole)
                s1 = _share_of_arc(middle - half, pieces[i, 4], swing, whole)
                tries = 2
        for k in range(tries):
            share = s0 if k == 0 else s1
            if share < 0.0 or share > 1.0:
                continue
            gx, gy, hx, hy = along(pieces[i], share)
            u, _v, _a, _b, _c, _d, _e, _f, ok = land(
                lens,
                x + gx * turn[0, 0] + gy * turn[0, 1],
                y + gx * turn[1, 0] + gy * turn[1, 1],
                z + gx * turn[2, 0] + gy * turn[2, 1],
            )
            if ok and count < lit_u.shape[0]:
                # the fan's normal points down the image: a contour that goes down has its inside, on its
                # left, to the right in the image
                lit_u[count] = u
                lit_step[count] = pieces[i, 6] if qx * hx + qy * hy > 0.0 else -pieces[i, 6]
                count += 1
    return count


@kernel
def _share_of_arc(angle, start, swing, whole):  # type: ignore[no-untyped-def]
    """The share of an arc at an angle; -1 where it does not reach."""
    away = (angle - start) % whole if swing > 0.0 else (start - angle) % whole
    return away / abs(swing) if away <= abs(swing) else -1.0


@kernel
def front_of(shape, turn, x, y, z, r, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Distance along d at which the target's own front is met (the silhouette's edge counts as met)."""
    if shape != BALL:
        nx, ny, nz = turn[0, 2], turn[1, 2], turn[2, 2]
        return (x * nx + y * ny + z * nz) / (dx * nx + dy * ny + dz * nz)
    a = dx * dx + dy * dy + dz * dz
    b = dx * x + dy * y + dz * z
    return (b - math.sqrt(max(0.0, b * b - a * (x * x + y * y + z * z - r * r)))) / a


@kernel
def _before(kind, size, centre, geom_turn, a, b, s, shape, turn, x, y, z, r):  # type: ignore[no-untyped-def]
    """Whether the ray at s meets the geom before the target."""
    dx, dy, dz = a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]
    return hit(kind, size, centre, geom_turn, dx, dy, dz) < front_of(shape, turn, x, y, z, r, dx, dy, dz) * (
        1.0 - 1e-9
    )


@kernel
def _in_front(kind, size, centre, geom_turn, a, b, first, last, shape, turn, x, y, z, r):  # type: ignore[no-untyped-def]
    """The part of an interval in which the geom stands before the target; solids that meet part it once."""
    at_first = _before(
        kind, size, centre, geom_turn, a, b, first + 0.05 * (last - first), shape, turn, x, y, z, r
    )
    at_last = _before(
        kind, size, centre, geom_turn, a, b, last - 0.05 * (last - first), shape, turn, x, y, z, r
    )
    if at_first and at_last:
        return first, last
    if not at_first and not at_last:
        return np.inf, -np.inf
    near, far = first, last
    for _ in range(12):
        middle = 0.5 * (near + far)
        if _before(kind, size, centre, geom_turn, a, b, middle, shape, turn, x, y, z, r) == at_first:
            near = middle
        else:
            far = middle
    return (first, near) if at_first else (near, last)


@kernel
def _merge(low, high, count):  # type: ignore[no-untyped-def]
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
