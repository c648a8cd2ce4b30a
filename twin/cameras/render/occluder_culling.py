"""Which solids may hide a target at all, where they stand, and how fast they pass it."""

import math

import numpy as np

from mosca.numba_support.decorators import kernel
from twin.cameras.optics.lens import land
from twin.cameras.render.occluders import axis_reach, hit, may_hide
from twin.cameras.render.outline import circle_of, lagrange, place, rim, turned

GROUP_PX = 0.25
"""Motion of a target past what hides it for which the hidden part is judged anew."""
MOST_GROUPS = 40


@kernel
def solids_of(kind, size, geom_xyz, geom_turn):  # type: ignore[no-untyped-def]
    """Return (k, 8) of each geom: centre and axis at the middle node, half length and reach with all its motion."""
    last = geom_xyz.shape[0] - 1
    middle = last // 2
    out = np.empty((kind.shape[0], 8))
    for g in range(kind.shape[0]):
        half, reach = axis_reach(kind[g], size[g])
        moved = bent = 0.0
        for i in range(3):
            moved = max(moved, (geom_xyz[last, g, i] - geom_xyz[0, g, i]) ** 2)
            bent += (geom_turn[last, g, i, 2] - geom_turn[0, g, i, 2]) ** 2
            out[g, i], out[g, 3 + i] = geom_xyz[middle, g, i], geom_turn[middle, g, i, 2]
        out[g, 6], out[g, 7] = half, reach + math.sqrt(3.0 * moved) + half * math.sqrt(bent)
    return out


@kernel
def near_geoms(  # type: ignore[no-untyped-def]
    near, m, solids, geom_marker, geom_xyz, geom_turn, nodes, lens, path, x, y, z, r, begin, instant, end, swing,
):  # fmt: skip
    """Write the geoms that may hide target m; return how many, and in how many groups of instants to look."""
    count = 0
    for g in range(solids.shape[0]):
        if geom_marker[g] != m and may_hide(
            solids[g, :3], solids[g, 3:6], solids[g, 6], solids[g, 7] + swing, x, y, z, r
        ):
            near[count] = g
            count += 1
    if count == 0:
        return 0, 1
    # how far a geom's own point nearest the line of sight slips past the target in the image
    weights, at_begin, at_end = np.empty(nodes.shape[0]), np.empty(nodes.shape[0]), np.empty(nodes.shape[0])
    lagrange(nodes, instant, weights)
    lagrange(nodes, begin, at_begin)
    lagrange(nodes, end, at_end)
    ax, ay, az = place(path, at_begin)
    bx, by, bz = place(path, at_end)
    ua, va, _a, _b, _c, _d, _e, _f, ok_a = land(lens, ax, ay, az)
    ub, vb, _a, _b, _c, _d, _e, _f, ok_b = land(lens, bx, by, bz)
    slip = 0.0
    local = np.empty(3)
    for q in range(count):
        xyz, turn = geom_xyz[:, near[q]], geom_turn[:, near[q]]
        cx, cy, cz = place(xyz, weights)
        f = min(max((cx * x + cy * y + cz * z) / (x * x + y * y + z * z), 0.05), 1.0)
        for i in range(3):
            local[i] = 0.0
            for k in range(weights.shape[0]):
                t = turn[k]
                local[i] += weights[k] * (
                    t[0, i] * (f * x - cx) + t[1, i] * (f * y - cy) + t[2, i] * (f * z - cz)
                )
        uc, vc, ok_c = _material(lens, xyz, turn, at_begin, local)
        ud, vd, ok_d = _material(lens, xyz, turn, at_end, local)
        if ok_a and ok_b and ok_c and ok_d:
            slip = max(slip, math.sqrt((ud - uc - ub + ua) ** 2 + (vd - vc - vb + va) ** 2))
    return count, 1 if slip < GROUP_PX else min(MOST_GROUPS, 1 + int(slip / GROUP_PX))


@kernel
def _material(lens, xyz, turn, weights, local):  # type: ignore[no-untyped-def]
    """Where a point that is fixed in a geom is imaged at an instant."""
    x, y, z = place(xyz, weights)
    for k in range(weights.shape[0]):
        t = turn[k]
        x += weights[k] * (t[0, 0] * local[0] + t[0, 1] * local[1] + t[0, 2] * local[2])
        y += weights[k] * (t[1, 0] * local[0] + t[1, 1] * local[1] + t[1, 2] * local[2])
        z += weights[k] * (t[2, 0] * local[0] + t[2, 1] * local[1] + t[2, 2] * local[2])
    u, v, _a, _b, _c, _d, _e, _f, ok = land(lens, x, y, z)
    return u, v, ok


@kernel
def geoms_at(near, count, geom_xyz, geom_turn, weights, xyz, turn):  # type: ignore[no-untyped-def]
    """Write the poses of the near geoms at an instant."""
    for q in range(count):
        g = near[q]
        xyz[g, 0], xyz[g, 1], xyz[g, 2] = place(geom_xyz[:, g], weights)
        turned(geom_turn[:, g], weights, turn[g])


@kernel
def hidden_by_one(near, count, kind, size, xyz, turn, shape, axes, x, y, z, r):  # type: ignore[no-untyped-def]
    """Whether one convex geom hides the whole outline, drawn 5 % too large, and so all of the target."""
    circle = circle_of(shape, axes, x, y, z, 1.05 * r)
    away = math.sqrt(x * x + y * y + z * z)
    for q in range(count):
        g = near[q]
        all_hit = True
        for k in range(12):
            dx, dy, dz, _a, _b, _c = rim(circle, k * math.pi / 6)
            front = (away - r) / math.sqrt(dx * dx + dy * dy + dz * dz)
            if not hit(kind[g], size[g], xyz[g], turn[g], dx, dy, dz) < front:
                all_hit = False
                break
        if all_hit:
            return True
    return False
