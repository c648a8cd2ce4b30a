"""Where and when a target is imaged in one exposure: timing, culling, size, and the motion of its image."""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, step
from twin.cameras.optics.lens import project
from twin.cameras.optics.lens_vector import FISHEYE, KIND
from twin.cameras.optics.psf import patches
from twin.cameras.render.inputs import RenderInputs, TargetPose
from twin.cameras.render.outline import BALL, lagrange_weights, position_at, rotation_at

IN_VIEW, PARTLY, HIDDEN, OUTSIDE, DARK = 0, 1, 2, 3, 4
"""States of a target in an image."""
EDGE_ON = 0.02
"""A flat target is visible where the cosine of the viewing angle to its normal exceeds this."""
ROW_ITERATIONS = 60
"""Most iterations for the instant at which a moving target's rows expose (rolling shutter)."""
ROW_INSTANT_S = 1e-12
"""Change of that instant below which the iterations end."""
BEYOND_IMAGE = 0.2
"""Distance beyond the image's edges up to which rows are continued, as a share of its height."""


class TargetImage(NamedTuple):
    """A target in one exposure."""

    state: int
    """IN_VIEW, or OUTSIDE, DARK or HIDDEN (a flat target from behind): fields after ``diameter`` are undefined."""
    target: TargetPose
    """Pose of the target at ``instant_s``."""
    u: float
    """Image of the centre (u, v) [px]."""
    v: float
    diameter: float
    """[px]"""
    stretch: float
    """Ratio of image length to length across the line of sight [px/m]."""
    patches: Array
    """(n, 3): patches of the blur."""
    spread: float
    """Largest displacement of a patch [px]."""
    begin_s: float
    """The target is exposed and shines from here to ``end_s``."""
    instant_s: float
    """Mid-exposure of the target's rows."""
    end_s: float
    motion_px: float
    """Motion of the image from ``begin_s`` to ``end_s``."""
    moved_m: float
    """Motion of the target from ``begin_s`` to ``end_s``."""


@step
def image_of(inputs: RenderInputs, m: int, height: int, width: int, weights: Array) -> Any:
    """Return the TargetImage of target ``m`` in an image of height x width; ``weights`` (K,) is working memory."""
    rotation = np.empty((3, 3))
    (x, y, z), u, v, stretch, instant, imaged = _mid_exposure(inputs, m, rotation, weights, height)
    lens, path, r = inputs.lens, inputs.targets.path[m], inputs.targets.radius[m]
    target = TargetPose(inputs.targets.shape[m], rotation, x, y, z, r)
    state = int(OUTSIDE)
    if not imaged:
        return TargetImage(
            state, target, np.nan, np.nan, np.nan, 0.0, np.empty((1, 3))[:0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        )
    diameter = 2.0 * r * stretch
    away = math.sqrt(x * x + y * y + z * z)
    # the surface of sharp focus is a plane, for a fisheye a sphere
    patch = patches(inputs.blur_terms, u, v, away if lens[KIND] == FISHEYE else z)
    spread = 0.0
    for i in range(patch.shape[0]):
        spread = max(spread, max(abs(patch[i, 0]), abs(patch[i, 1])))
    margin = 0.75 * diameter + inputs.pixel_reach + 1.0 + spread
    begin, end = _exposed(inputs, m, instant, v, margin + 2.0, height, weights)
    motion, moved = 0.0, 0.0
    if end <= begin:
        state = int(DARK)
    else:
        motion, moved = image_motion(lens, inputs.nodes_s, path, begin, end, weights)
        in_columns = -margin - motion <= u <= width + margin + motion
        if motion >= 0.0 and in_columns and -margin - motion <= v <= height + margin + motion:
            behind = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z >= -EDGE_ON * away
            state = int(HIDDEN) if target.shape != BALL and behind else int(IN_VIEW)
    return TargetImage(state, target, u, v, diameter, stretch, patch, spread, begin, instant, end, motion, moved)


@bare_step
def lit_s(inputs: RenderInputs, m: int) -> Any:
    """Begin and end of the time in which target ``m`` shines and the strobe is on."""
    lit = inputs.targets.lit_s
    return max(inputs.rows.on_s, lit[m, 0]), min(inputs.rows.off_s, lit[m, 1])


@bare_step
def _mid_exposure(inputs: RenderInputs, m: int, rotation: Array, weights: Array, height: int) -> Any:
    """The target at the middle of its own rows' exposure; ``rotation`` (3, 3) is filled.

    With a rolling shutter, row and instant depend on each other, and a fixed point is sought. Returns the centre, its
    image (u, v), the stretch, the instant, and whether the lens images it.
    """
    lens, nodes, path, r = inputs.lens, inputs.nodes_s, inputs.targets.path[m], inputs.targets.radius[m]
    length, row_time = inputs.rows.length_s, inputs.rows.row_time_s
    on, off = lit_s(inputs, m)
    instant = 0.5 * (max(0.0, on) + min(length, off)) if row_time == 0.0 else 0.5 * height * row_time + 0.5 * length
    u = v = x = y = z = stretch = 0.0
    imaged = True
    for _ in range(1 if row_time == 0.0 else ROW_ITERATIONS):
        lagrange_weights(nodes, instant, weights)
        x, y, z = position_at(path, weights)
        u, v, ux, uy, uz, vx, vy, vz, ok = project(lens, x, y, z)
        if not ok or x * x + y * y + z * z < 4 * r * r:
            imaged = False
            break
        stretch = math.sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz))
        if row_time != 0.0:
            opens = min(max(v, -BEYOND_IMAGE * height), (1.0 + BEYOND_IMAGE) * height) * row_time
            begin, end = max(opens, on), min(opens + length, off)
            before_s = instant
            instant = 0.5 * (begin + end) if end > begin else opens + 0.5 * length
            if abs(instant - before_s) < ROW_INSTANT_S:
                break
    rotation_at(inputs.targets.rotation[m], weights, rotation)
    return (x, y, z), u, v, stretch, instant, imaged


@bare_step
def _exposed(inputs: RenderInputs, m: int, instant: float, v: float, rows: float, height: int, weights: Array) -> Any:
    """Begin and end of the time in which any row within ``rows`` of the image at ``v`` collects the light."""
    lens, nodes, path = inputs.lens, inputs.nodes_s, inputs.targets.path[m]
    length, row_time = inputs.rows.length_s, inputs.rows.row_time_s
    on, off = lit_s(inputs, m)
    if row_time == 0.0:
        return max(0.0, on), min(length, off)
    begin = max(0.0, _row_instant(lens, nodes, path, weights, instant, v - rows, -rows, 0.0, row_time, height))
    end = _row_instant(lens, nodes, path, weights, instant, v + rows, rows, length, row_time, height)
    return max(begin, on), min(min(end, (height - 1) * row_time + length), off)


@bare_step
def _row_instant(
    lens: Array,
    nodes: Array,
    path: Array,
    weights: Array,
    instant: float,
    row: float,
    shift: float,
    late: float,
    row_time: float,
    height: int,
) -> Any:
    """Instant when the row ``shift`` below a moving target opens, plus ``late``; ``instant``, ``row``: guesses."""
    t = instant
    for _ in range(ROW_ITERATIONS):
        before = t
        t = min(max(row, -BEYOND_IMAGE * height), (1.0 + BEYOND_IMAGE) * height) * row_time + late
        if abs(t - before) < 1e-9 * row_time:
            break
        lagrange_weights(nodes, min(max(t, nodes[0]), nodes[nodes.shape[0] - 1]), weights)
        x, y, z = position_at(path, weights)
        _u, v, _a, _b, _c, _d, _e, _f, ok = project(lens, x, y, z)
        if not ok:
            break
        row = v + shift
    return t


@bare_step
def image_motion(lens: Array, nodes: Array, path: Array, begin: float, end: float, weights: Array) -> Any:
    """Length of the image of a path [px] (-1: not imaged), and distance between the ends of the path [m].

    For a path that reverses or accelerates, the speed of its faster half counts.
    """
    lagrange_weights(nodes, begin, weights)
    ax, ay, az = position_at(path, weights)
    lagrange_weights(nodes, end, weights)
    bx, by, bz = position_at(path, weights)
    swing = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2)
    ua, va, _a, _b, _c, _d, _e, _f, ok_a = project(lens, ax, ay, az)
    ub, vb, _a, _b, _c, _d, _e, _f, ok_b = project(lens, bx, by, bz)
    if not ok_a or not ok_b:
        return -1.0, swing
    chord = math.sqrt((ub - ua) ** 2 + (vb - va) ** 2)
    lagrange_weights(nodes, 0.5 * (begin + end), weights)
    cx, cy, cz = position_at(path, weights)
    um, vm, _a, _b, _c, _d, _e, _f, ok_m = project(lens, cx, cy, cz)
    if not ok_m:
        return chord, swing
    turned_back = 2.0 * math.sqrt(max((um - ua) ** 2 + (vm - va) ** 2, (ub - um) ** 2 + (vb - vm) ** 2))
    # the chord is used for a nearly straight, uniform path, but not for one that reverses or accelerates
    return (turned_back if turned_back > 1.2 * chord else chord), max(swing, 0.0)


@step
def carried(
    edges: Array, lens: Array, nodes: Array, path: Array, u: float, v: float, begin: float, middle: float, end: float
) -> Any:
    """Boundary points (n, 9) found at ``middle``, moved with the target's image (u, v) through begin..end."""
    weights = np.empty(nodes.shape[0])
    lagrange_weights(nodes, begin, weights)
    x, y, z = position_at(path, weights)
    ua, va, _a, _b, _c, _d, _e, _f, _ok = project(lens, x, y, z)
    lagrange_weights(nodes, end, weights)
    x, y, z = position_at(path, weights)
    ub, vb, _a, _b, _c, _d, _e, _f, _ok = project(lens, x, y, z)
    # the quadratic through the three positions, in tau of begin..end
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
