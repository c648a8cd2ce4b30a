"""Selection of the solids that may hide a target, their poses at an instant, and their motion past it."""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel
from twin.cameras.optics.lens import project
from twin.cameras.render.inputs import NearSolids, RenderInputs, Solid, SolidArrays, TargetPose
from twin.cameras.render.occluders import axis_reach, hit, may_hide
from twin.cameras.render.outline import circle_point, lagrange_weights, outline_circle, position_at, rotation_at
from twin.cameras.render.target_image import TargetImage

GROUP_PX = 0.25
"""Motion of a target past an occluder for which the hidden part is computed anew [px]."""
MOST_GROUPS = 40
OUTLINE_MARGIN = 1.05
"""Factor on the outline: a target counts as wholly hidden where one solid hides its outline enlarged by this."""


@kernel
def motion_bounds(kind: Array, size: Array, geom_xyz: Array, geom_rotation: Array) -> Any:
    """Return (k, 8): each geom's centre and axis at the middle node, half length and reach with all its motion."""
    last = geom_xyz.shape[0] - 1
    middle = last // 2
    out = np.empty((kind.shape[0], 8))
    for g in range(kind.shape[0]):
        half, reach = axis_reach(kind[g], size[g])
        moved = bent = 0.0
        for i in range(3):
            moved = max(moved, (geom_xyz[last, g, i] - geom_xyz[0, g, i]) ** 2)
            bent += (geom_rotation[last, g, i, 2] - geom_rotation[0, g, i, 2]) ** 2
            out[g, i], out[g, 3 + i] = geom_xyz[middle, g, i], geom_rotation[middle, g, i, 2]
        out[g, 6], out[g, 7] = half, reach + math.sqrt(3.0 * moved) + half * math.sqrt(bent)
    return out


@bare_step
def near_solids(inputs: RenderInputs, m: int, image: TargetImage, number: Array, weights: Array) -> Any:
    """Write the numbers of the solids that may hide target m.

    Returns their number, and the number of groups of instants into which the exposure must be divided. ``image``: the
    target's TargetImage; ``weights`` (3, K) is working memory.
    """
    solids, target = inputs.solids, image.target
    bounds = solids.bounds
    count = 0
    for g in range(bounds.shape[0]):
        if solids.marker[g] != m and may_hide(
            bounds[g, :3], bounds[g, 3:6], bounds[g, 6], bounds[g, 7] + image.moved_m, target.x, target.y, target.z,
            target.radius,
        ):  # fmt: skip
            number[count] = g
            count += 1
    if count == 0:
        return 0, 1
    slip = _slip_px(inputs, m, image, number, count, weights)
    return count, 1 if slip < GROUP_PX else min(MOST_GROUPS, 1 + int(slip / GROUP_PX))


@bare_step
def _slip_px(inputs: RenderInputs, m: int, image: TargetImage, number: Array, count: int, memory: Array) -> Any:
    """Largest motion past the target, in the image, of a solid's point nearest the line of sight [px]."""
    lens, nodes, path = inputs.lens, inputs.nodes_s, inputs.targets.path[m]
    x, y, z = image.target.x, image.target.y, image.target.z
    weights, at_begin, at_end = memory[0], memory[1], memory[2]
    lagrange_weights(nodes, image.instant_s, weights)
    lagrange_weights(nodes, image.begin_s, at_begin)
    lagrange_weights(nodes, image.end_s, at_end)
    ax, ay, az = position_at(path, at_begin)
    bx, by, bz = position_at(path, at_end)
    ua, va, _a, _b, _c, _d, _e, _f, ok_a = project(lens, ax, ay, az)
    ub, vb, _a, _b, _c, _d, _e, _f, ok_b = project(lens, bx, by, bz)
    slip = 0.0
    for q in range(count):
        xyz, rotation = inputs.solids.xyz[:, number[q]], inputs.solids.rotation[:, number[q]]
        cx, cy, cz = position_at(xyz, weights)
        f = min(max((cx * x + cy * y + cz * z) / (x * x + y * y + z * z), 0.05), 1.0)
        px, py, pz = f * x - cx, f * y - cy, f * z - cz
        in_x = in_y = in_z = 0.0
        for k in range(weights.shape[0]):
            t, w = rotation[k], weights[k]
            in_x += w * (t[0, 0] * px + t[1, 0] * py + t[2, 0] * pz)
            in_y += w * (t[0, 1] * px + t[1, 1] * py + t[2, 1] * pz)
            in_z += w * (t[0, 2] * px + t[1, 2] * py + t[2, 2] * pz)
        uc, vc, ok_c = _material(lens, xyz, rotation, at_begin, in_x, in_y, in_z)
        ud, vd, ok_d = _material(lens, xyz, rotation, at_end, in_x, in_y, in_z)
        if ok_a and ok_b and ok_c and ok_d:
            slip = max(slip, math.sqrt((ud - uc - ub + ua) ** 2 + (vd - vc - vb + va) ** 2))
    return slip


@bare_step
def _material(lens: Array, xyz: Array, rotation: Array, weights: Array, in_x: float, in_y: float, in_z: float) -> Any:
    """Image of a point that is fixed in a geom, at ``in_x``, ``in_y``, ``in_z`` of its own axes, at an instant."""
    x, y, z = position_at(xyz, weights)
    for k in range(weights.shape[0]):
        t = rotation[k]
        x += weights[k] * (t[0, 0] * in_x + t[0, 1] * in_y + t[0, 2] * in_z)
        y += weights[k] * (t[1, 0] * in_x + t[1, 1] * in_y + t[1, 2] * in_z)
        z += weights[k] * (t[2, 0] * in_x + t[2, 1] * in_y + t[2, 2] * in_z)
    u, v, _a, _b, _c, _d, _e, _f, ok = project(lens, x, y, z)
    return u, v, ok


@bare_step
def pose_solids(near: NearSolids, solids: SolidArrays, nodes: Array, instant_s: float, weights: Array) -> None:
    """Write the poses of the near solids at an instant; ``weights`` (K,) is working memory."""
    lagrange_weights(nodes, instant_s, weights)
    for q in range(near.found):
        g = near.number[q]
        near.xyz[g, 0], near.xyz[g, 1], near.xyz[g, 2] = position_at(solids.xyz[:, g], weights)
        rotation_at(solids.rotation[:, g], weights, near.rotation[g])


@bare_step
def hidden_by_one(near: NearSolids, target: TargetPose) -> Any:
    """Whether one convex solid hides the whole outline, enlarged by 5 %, and so all of the target."""
    circle = outline_circle(target, OUTLINE_MARGIN * target.radius)
    away = math.sqrt(target.x * target.x + target.y * target.y + target.z * target.z)
    for q in range(near.found):
        g = near.number[q]
        solid = Solid(near.kind[g], near.size[g], near.xyz[g], near.rotation[g])
        all_hit = True
        for k in range(12):
            dx, dy, dz, _a, _b, _c = circle_point(circle, k * math.pi / 6)
            front = (away - target.radius) / math.sqrt(dx * dx + dy * dy + dz * dz)
            if not hit(solid, dx, dy, dz) < front:
                all_hit = False
                break
        if all_hit:
            return True
    return False
