"""One target after the other: its boundary, less what hides it, moved through the exposure, onto the pixels.

A target's boundary is traced through the lens (``outline``), what stands before it is taken off (``scan``), and
both move during the exposure while the rows of pixels integrate (``collect``), through each patch of the
pupil (``psf``).
"""

import math

import numpy as np

from mosca.numba_support.decorators import kernel
from twin.cameras.optics.lens import land
from twin.cameras.optics.lens_vector import FISHEYE, KIND
from twin.cameras.optics.psf import patches
from twin.cameras.render.boundary_integral import (
    EDGE,
    MOST_NODES,
    NODE_AT,
    NODE_SHARE,
    SPOT,
    add_points,
    fill,
)
from twin.cameras.render.occluder_culling import geoms_at, hidden_by_one, near_geoms
from twin.cameras.render.occluders import hit
from twin.cameras.render.occlusion_scan import front_of, scan_hidden
from twin.cameras.render.outline import (
    BALL,
    FIGURE,
    MOST_PANELS,
    PANEL_PX,
    circle_of,
    cut_pieces,
    lagrange,
    lands,
    outline_steps,
    place,
    quadratics,
    rim,
    trace,
    turned,
)
from twin.cameras.render.ray_samples import runs, sample_rays

IN_VIEW, PARTLY, HIDDEN, OUTSIDE, DARK, MESH_NEAR, MESH_REST = 0, 1, 2, 3, 4, -1, -2
LEAST_E = 1e-3
"""Light below a thousandth of an electron is left out, so that dark pixels stay exactly dark."""


@kernel
def render_all(  # type: ignore[no-untyped-def]
    light, lens, table, reach, terms, nodes, timing, path, turn, radius, shape, figure, electrons, lit, profile,
    pieces, first, kind, size, geom_marker, geom_xyz, geom_turn, solids, mesh,
):  # fmt: skip
    """Render all targets; returns (visible, x, y, diameter) of each, its state (MESH_NEAR: left to mesh rays), and
    for those when they are exposed: from, in the middle, until [s].
    """
    count = path.shape[0]
    seen = np.zeros((count, 4))
    state = np.zeros(count, dtype=np.int64)
    spans = np.zeros((count, 3))
    nothing, none = np.empty((0, 3)), np.zeros(1, dtype=np.int64)
    for m in range(count):
        how = OUTSIDE if mesh[m] == 0 else IN_VIEW
        result = render_one(
            light, lens, table, reach, terms, nodes, timing, path, turn, radius, shape, figure, electrons, lit,
            profile, pieces, first, kind, size, geom_marker, geom_xyz, geom_turn, solids, m, how, spans[m],
            nothing, none, 0.0,
        )  # fmt: skip
        seen[m, 0], seen[m, 1], seen[m, 2], seen[m, 3] = result[0], result[1], result[2], result[3]
        state[m] = int(result[4])
    return seen, state, spans


@kernel
def render_one(  # type: ignore[no-untyped-def]
    light, lens, table, reach, terms, nodes, timing, path, turn, radius, shape, figure, electrons, lit, profile,
    pieces, first, kind, size, geom_marker, geom_xyz, geom_turn, solids, m, how, span,
    given_edges, given_first, given_share,
):  # fmt: skip
    """Render target m.

    ``how``: OUTSIDE plainly; IN_VIEW only to see whether meshes must be asked; MESH_NEAR with the boundary of what is
    hidden given, MESH_REST with that of what is left. Returns (visible, x, y, diameter, state).
    """
    height, width = light.shape
    r = radius[m]
    sigma = terms[8]
    weights = np.empty(nodes.shape[0])
    axes = np.empty((3, 3))
    length, row_time = timing[0], timing[1]
    on, off = max(timing[2], lit[m, 0]), min(timing[3], lit[m, 1])
    # when its rows expose: where it is tells when, and when tells where
    instant = (
        0.5 * (max(0.0, on) + min(length, off)) if row_time == 0.0 else 0.5 * height * row_time + 0.5 * length
    )
    u = v = x = y = z = 0.0
    ux = uy = uz = vx = vy = vz = 0.0
    for _ in range(1 if row_time == 0.0 else 60):
        lagrange(nodes, instant, weights)
        x, y, z = place(path[m], weights)
        u, v, ux, uy, uz, vx, vy, vz, ok = land(lens, x, y, z)
        if not ok or x * x + y * y + z * z < 4 * r * r:
            return 0.0, np.nan, np.nan, np.nan, OUTSIDE
        if row_time != 0.0:
            opens = min(max(v, -0.2 * height), 1.2 * height) * row_time
            begin, end = max(opens, on), min(opens + length, off)
            before_s = instant
            instant = 0.5 * (begin + end) if end > begin else opens + 0.5 * length
            if abs(instant - before_s) < 1e-12:
                break
    turned(turn[m], weights, axes)
    # size of the image from the stretch across the viewing direction
    stretch = math.sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz))
    diameter = 2.0 * r * stretch
    # a plane is in focus, with a fisheye a sphere
    patch = patches(terms, u, v, math.sqrt(x * x + y * y + z * z) if lens[KIND] == FISHEYE else z)
    spread = 0.0
    for i in range(patch.shape[0]):
        spread = max(spread, max(abs(patch[i, 0]), abs(patch[i, 1])))
    margin = 0.75 * diameter + reach + 1.0 + spread
    # the time in which any of its rows collects its light
    if row_time == 0.0:
        begin, end = max(0.0, on), min(length, off)
    else:
        rows = margin + 2.0
        begin = max(0.0, _row_instant(lens, nodes, path[m], instant, v - rows, -rows, 0.0, row_time, height))
        end = _row_instant(lens, nodes, path[m], instant, v + rows, rows, length, row_time, height)
        begin, end = max(begin, on), min(min(end, (height - 1) * row_time + length), off)
    if end <= begin:
        return 0.0, u, v, diameter, DARK
    motion, swing = _motion(lens, nodes, path[m], begin, instant, end, weights)
    if motion < 0.0:
        return 0.0, u, v, diameter, OUTSIDE
    if (
        u < -margin - motion
        or v < -margin - motion
        or u > width + margin + motion
        or v > height + margin + motion
    ):
        return 0.0, u, v, diameter, OUTSIDE
    away = math.sqrt(x * x + y * y + z * z)
    if shape[m] != BALL and axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z >= -0.02 * away:
        return 0.0, u, v, diameter, HIDDEN
    if how == IN_VIEW:
        span[0], span[1], span[2] = begin, instant, end
        return 0.0, u, v, diameter, MESH_NEAR
    whole, left, right, top, bottom = lands(lens, shape[m], axes, x, y, z, r)
    if max(right - left, bottom - top) > 4000.0:
        return 0.0, u, v, diameter, OUTSIDE
    my_pieces = np.empty((0, 9))
    points = outline_steps(diameter, sigma)
    if shape[m] == FIGURE:
        f = figure[m]
        my_pieces, points = cut_pieces(pieces[first[f] : first[f + 1]], stretch, sigma)

    profiled = profile[m, 0] != 0.0 or profile[m, 1] != 0.0 or profile[m, 2] != 0.0 or profile[m, 3] != 0.0

    # what stands before it
    hidden = 0.0
    near = np.empty(kind.shape[0], dtype=np.int64)
    near_count = 0
    groups = 1
    if how != MESH_NEAR and how != MESH_REST:
        near_count, groups = near_geoms(
            near, m, solids, geom_marker, geom_xyz, geom_turn, nodes, lens, path[m], x, y, z, r, begin, instant, end,
            swing,
        )  # fmt: skip
    here_xyz, here_turn = np.empty((kind.shape[0], 3)), np.empty((kind.shape[0], 3, 3))
    if near_count > 0:
        lagrange(nodes, instant, weights)
        geoms_at(near, near_count, geom_xyz, geom_turn, weights, here_xyz, here_turn)
        if groups == 1 and hidden_by_one(
            near, near_count, kind, size, here_xyz, here_turn, shape[m], axes, x, y, z, r
        ):
            return 0.0, u, v, diameter, HIDDEN

    # room for the image of the whole motion
    pad = reach + 2 + math.ceil(spread)
    x0, x1 = math.floor(left - motion) - pad, math.ceil(right + motion) + pad + 1
    y0, y1 = math.floor(top - motion) - pad, math.ceil(bottom + motion) + pad + 1
    y0, y1 = max(y0, -1), min(y1, height + 1)
    if y1 <= y0 or x1 - x0 > 20000:
        return 0.0, u, v, diameter, OUTSIDE
    change = np.zeros((y1 - y0, x1 - x0 + 2))
    if not whole:
        # the lens cuts it: its light is what the rays through its own image meet
        if shape[m] == FIGURE:
            return 0.0, u, v, diameter, OUTSIDE
        share = _add_sampled(
            change, x0, y0, table, reach, patch, lens, nodes, path[m], axes, x, y, z, r, shape[m], near, near_count,
            kind, size, here_xyz, here_turn, begin, instant, end, motion, sigma, timing, on, off,
        )  # fmt: skip
        fill(light, change, x0, y0, electrons[m], LEAST_E)
        return share * _inside(lens, shape[m], axes, x, y, z, r, width, height), u, v, diameter, PARTLY

    rows_window = (length, row_time, on, off)
    if how in (MESH_NEAR, MESH_REST):
        hidden = given_share
        groups = given_first.shape[0] - 1
        for g in range(groups):
            edges = given_edges[given_first[g] : given_first[g + 1]]
            if hidden == 1.0 or edges.shape[0] == 0:
                continue
            group_begin = begin + (end - begin) * g / groups
            group_end = begin + (end - begin) * (g + 1) / groups
            middle = instant if groups == 1 else 0.5 * (group_begin + group_end)
            lagrange(nodes, middle, weights)
            gx, gy, gz = place(path[m], weights)
            gu, gv, _a, _b, _c, _d, _e, _f, _ok = land(lens, gx, gy, gz)
            moving = _carried(edges, lens, nodes, path[m], gu, gv, group_begin, middle, group_end, weights)
            here = (group_begin, group_end)
            scaled = motion * 0.6 / sigma / groups
            add_points(EDGE, change, x0, y0, table, reach, patch, moving, here, scaled, rows_window)
        if how == MESH_REST and hidden < 1.0:
            fill(light, change, x0, y0, electrons[m], LEAST_E)
            visible = (1.0 - hidden) * _inside(lens, shape[m], axes, x, y, z, r, width, height)
            return visible, u, v, diameter, PARTLY
    elif near_count > 0:
        rest = False
        total_hidden = total_lit = 0.0
        for g in range(groups):
            group_begin = begin + (end - begin) * g / groups
            group_end = begin + (end - begin) * (g + 1) / groups
            middle = instant if groups == 1 else 0.5 * (group_begin + group_end)
            box = (left, right, top, bottom)
            gx, gy, gz, gu, gv = x, y, z, u, v
            if groups > 1:
                lagrange(nodes, middle, weights)
                gx, gy, gz = place(path[m], weights)
                turned(turn[m], weights, axes)
                geoms_at(near, near_count, geom_xyz, geom_turn, weights, here_xyz, here_turn)
                gu, gv, _a, _b, _c, _d, _e, _f, _ok = land(lens, gx, gy, gz)
                _w, gl, gr, gt, gb = lands(lens, shape[m], axes, gx, gy, gz, r)
                box = (gl, gr, gt, gb)
            edges, lit_edges, hidden_area, lit_area = scan_hidden(
                lens, shape[m], axes, gx, gy, gz, r, my_pieces, box, near, near_count, kind, size, here_xyz,
                here_turn, profile[m],
            )  # fmt: skip
            total_hidden += hidden_area
            total_lit += lit_area
            # of what is mostly hidden the rest is summed itself: a difference of large areas would blur it
            rest = rest or ((groups > 1 or hidden_area > 0.5 * lit_area) and not profiled)
            if hidden_area >= (1.0 - 1e-6) * lit_area:
                continue
            here = (group_begin, group_end)
            scaled = motion * 0.6 / sigma / groups
            for which in range(2):
                some = edges if which == 0 else lit_edges
                if some.shape[0] > 0 and (which == 0 or rest):
                    moving = _carried(
                        some, lens, nodes, path[m], gu, gv, group_begin, middle, group_end, weights
                    )
                    add_points(EDGE, change, x0, y0, table, reach, patch, moving, here, scaled, rows_window)
        hidden = min(1.0, max(0.0, total_hidden / total_lit)) if total_lit != 0.0 else 0.0
        if rest and hidden <= 1.0 - 1e-6:
            fill(light, change, x0, y0, electrons[m], LEAST_E)
            visible = (1.0 - hidden) * _inside(lens, shape[m], axes, x, y, z, r, width, height)
            return visible, u, v, diameter, PARTLY
    if hidden > 1.0 - 1e-6:
        return 0.0, u, v, diameter, HIDDEN

    # the whole of it, panel by panel of time
    panels = min(MOST_PANELS, 1 + int(motion * 0.6 / sigma / PANEL_PX))
    sense = 1.0 if shape[m] == BALL else -1.0
    spots = 0
    if profiled and shape[m] != FIGURE:
        spots = _spot_count(diameter)
    before, at, after = np.empty((points, 3)), np.empty((points, 3)), np.empty((points, 3))
    spot_before, spot_at, spot_after = np.empty((spots, 3)), np.empty((spots, 3)), np.empty((spots, 3))
    still = motion < 1e-3
    for panel in range(panels):
        panel_begin = begin + (end - begin) * panel / panels
        panel_end = begin + (end - begin) * (panel + 1) / panels
        for k in range(3):
            if still and k != 1:
                continue
            t = panel_begin + 0.5 * k * (panel_end - panel_begin)
            lagrange(nodes, t, weights)
            px, py, pz = place(path[m], weights)
            turned(turn[m], weights, axes)
            out = before if k == 0 else (at if k == 1 else after)
            trace(lens, shape[m], axes, px, py, pz, r, my_pieces, points, sense, out)
            if spots > 0:
                spot_out = spot_before if k == 0 else (spot_at if k == 1 else spot_after)
                _spots(lens, shape[m], axes, px, py, pz, r, profile[m], diameter, spot_out)
        if still:
            before, after = at, at
            spot_before, spot_after = spot_at, spot_at
        here = (panel_begin, panel_end)
        scaled = motion * 0.6 / sigma / panels
        add_points(
            EDGE,
            change,
            x0,
            y0,
            table,
            reach,
            patch,
            quadratics(before, at, after),
            here,
            scaled,
            rows_window,
        )
        if spots > 0:
            add_points(
                SPOT, change, x0, y0, table, reach, patch, quadratics(spot_before, spot_at, spot_after), here, scaled,
                rows_window,
            )  # fmt: skip
    fill(light, change, x0, y0, electrons[m], LEAST_E)
    visible = 1.0 - hidden
    half = 0.6 * diameter + 1.0
    if u < half or v < half or u > width - 1 - half or v > height - 1 - half:
        lagrange(nodes, instant, weights)
        turned(turn[m], weights, axes)
        visible *= _inside(lens, shape[m], axes, x, y, z, r, width, height)
    return visible, u, v, diameter, IN_VIEW if hidden == 0.0 else PARTLY


@kernel
def _row_instant(lens, nodes, path, instant, row, shift, late, row_time, height):  # type: ignore[no-untyped-def]
    """When the row ``shift`` below a moving target opens, plus ``late``; ``instant`` and ``row``: where to begin."""
    weights = np.empty(nodes.shape[0])
    t = instant
    for _ in range(60):
        before = t
        t = min(max(row, -0.2 * height), 1.2 * height) * row_time + late
        if abs(t - before) < 1e-9 * row_time:
            break
        lagrange(nodes, min(max(t, nodes[0]), nodes[nodes.shape[0] - 1]), weights)
        x, y, z = place(path, weights)
        _u, v, _a, _b, _c, _d, _e, _f, ok = land(lens, x, y, z)
        if not ok:
            break
        row = v + shift
    return t


@kernel
def _motion(lens, nodes, path, begin, instant, end, weights):  # type: ignore[no-untyped-def]
    """Length of the image of a path [px], of one that turns or speeds up at its faster half's pace (-1: not
    imaged), and how far the target goes [m].
    """
    lagrange(nodes, begin, weights)
    ax, ay, az = place(path, weights)
    lagrange(nodes, end, weights)
    bx, by, bz = place(path, weights)
    swing = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2)
    ua, va, _a, _b, _c, _d, _e, _f, ok_a = land(lens, ax, ay, az)
    ub, vb, _a, _b, _c, _d, _e, _f, ok_b = land(lens, bx, by, bz)
    if not ok_a or not ok_b:
        return -1.0, swing
    chord = math.sqrt((ub - ua) ** 2 + (vb - va) ** 2)
    lagrange(nodes, 0.5 * (begin + end), weights)
    cx, cy, cz = place(path, weights)
    um, vm, _a, _b, _c, _d, _e, _f, ok_m = land(lens, cx, cy, cz)
    if not ok_m:
        return chord, swing
    turned_back = 2.0 * math.sqrt(max((um - ua) ** 2 + (vm - va) ** 2, (ub - um) ** 2 + (vb - vm) ** 2))
    # a path that is nearly straight and even keeps its chord; one that turns back or speeds up does not
    return (turned_back if turned_back > 1.2 * chord else chord), max(swing, 0.0)


@kernel
def _carried(edges, lens, nodes, path, u, v, begin, middle, end, weights):  # type: ignore[no-untyped-def]
    """Boundary points found at ``middle``, carried along by the target's image (u, v) through begin..end."""
    lagrange(nodes, begin, weights)
    x, y, z = place(path, weights)
    ua, va, _a, _b, _c, _d, _e, _f, _ok = land(lens, x, y, z)
    lagrange(nodes, end, weights)
    x, y, z = place(path, weights)
    ub, vb, _a, _b, _c, _d, _e, _f, _ok = land(lens, x, y, z)
    # the quadratic through the three places, in tau of begin..end
    at = (2.0 * middle - begin - end) / (end - begin)
    one_u, one_v = 0.5 * (ub - ua), 0.5 * (vb - va)
    two_u = (u - 0.5 * (ua + ub) - one_u * at) / (at * at - 1.0)
    two_v = (v - 0.5 * (va + vb) - one_v * at) / (at * at - 1.0)
    zero_u, zero_v = 0.5 * (ua + ub) - two_u - u, 0.5 * (va + vb) - two_v - v
    out = np.zeros((edges.shape[0], 9))
    for j in range(edges.shape[0]):
        out[j, 0], out[j, 1], out[j, 2] = edges[j, 0] + zero_u, one_u, two_u
        out[j, 3], out[j, 4], out[j, 5] = edges[j, 1] + zero_v, one_v, two_v
        out[j, 6] = edges[j, 2]
    return out


@kernel
def _inside(lens, shape, axes, x, y, z, r, width, height):  # type: ignore[no-untyped-def]
    """Share of a target's disc that lies inside the image, from 240 places on it."""
    circle = circle_of(shape, axes, x, y, z, r)
    count = 0
    for i in range(10):
        q = math.sqrt((i + 0.5) / 10.0)
        for k in range(24):
            dx, dy, dz, _a, _b, _c = rim(circle, 2.0 * math.pi * (k + 0.5 * (i % 2)) / 24)
            cx, cy, cz = circle[0], circle[1], circle[2]
            u, v, _a, _b, _c, _d, _e, _f, ok = land(
                lens, cx + q * (dx - cx), cy + q * (dy - cy), cz + q * (dz - cz)
            )
            if ok and -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                count += 1
    return count / 240.0


@kernel
def _rings(diameter):  # type: ignore[no-untyped-def]
    return min(MOST_NODES, 4 + int(diameter)), 12 + int(math.pi * diameter / 0.7)


@kernel
def _spot_count(diameter):  # type: ignore[no-untyped-def]
    rings, around = _rings(diameter)
    return rings * around


@kernel
def _spots(lens, shape, axes, x, y, z, r, profile, diameter, out):  # type: ignore[no-untyped-def]
    """Write spots (u, v, amount) of the brightness of a disc beyond 1: Gauss in the radius, even angles.

    The radius is the sine of the quadrature's variable, in which limb darkening is smooth.
    """
    rings, around = _rings(diameter)
    circle = circle_of(shape, axes, x, y, z, r)
    cx, cy, cz = circle[0], circle[1], circle[2]
    n = 0
    for i in range(rings):
        angle = 0.25 * math.pi * (NODE_AT[rings, i] + 1.0)
        q, dq = math.sin(angle), 0.5 * math.pi * NODE_SHARE[rings, i] * math.cos(angle)
        for k in range(around):
            dx, dy, dz, ex, ey, ez = rim(circle, 2.0 * math.pi * (k + 0.5 * (i % 2)) / around)
            gx, gy, gz = dx - cx, dy - cy, dz - cz
            u, v, ux, uy, uz, vx, vy, vz, _ok = land(lens, cx + q * gx, cy + q * gy, cz + q * gz)
            u_q, v_q = ux * gx + uy * gy + uz * gz, vx * gx + vy * gy + vz * gz
            u_a, v_a = q * (ux * ex + uy * ey + uz * ez), q * (vx * ex + vy * ey + vz * ez)
            area = abs(u_q * v_a - v_q * u_a) * dq * 2.0 * math.pi / around
            size = math.sqrt(gx * gx + gy * gy + gz * gz)
            shine = 1.0 - profile[0] * (1.0 - math.sqrt(1.0 - q * q))
            shine += q * (profile[1] * gx + profile[2] * gy + profile[3] * gz) / size
            out[n, 0], out[n, 1], out[n, 2] = u, v, area * (shine - 1.0)
            n += 1


@kernel
def _add_sampled(  # type: ignore[no-untyped-def]
    change, x0, y0, table, reach, patch, lens, nodes, path, axes, x, y, z, r, shape, near, near_count, kind, size,
    xyz, turn, begin, instant, end, motion, sigma, timing, on, off,
):  # fmt: skip
    """Add the part of a target that the lens images and nothing hides, from samples; return its share."""
    centre = np.array([x, y, z])
    rays, cell, grid = sample_rays(lens, centre, axes, r, shape, 0)
    free = np.ones(rays.shape[0], dtype=np.bool_)
    seen = 0
    for i in range(rays.shape[0]):
        dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2]
        front = front_of(shape, axes, x, y, z, r, dx, dy, dz)
        for q in range(near_count):
            g = near[q]
            if hit(kind[g], size[g], xyz[g], turn[g], dx, dy, dz) < front * (1.0 - 1e-9):
                free[i] = False
                break
        if free[i]:
            seen += 1
    if seen == 0:
        return 0.0
    u, v, _a, _b, _c, _d, _e, _f, _ok = land(lens, x, y, z)
    weights = np.empty(nodes.shape[0])
    moving = _carried(runs(cell, grid, free, 1.0), lens, nodes, path, u, v, begin, instant, end, weights)
    window = (timing[0], timing[1], on, off)
    add_points(EDGE, change, x0, y0, table, reach, patch, moving, (begin, end), motion * 0.6 / sigma, window)
    return seen / rays.shape[0]
