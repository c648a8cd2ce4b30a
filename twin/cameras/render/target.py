"""Rendering of targets, one after the other: boundary less hidden part, moved through the exposure, onto the pixels.

Where and when a target is imaged is found in ``target_image``. Its boundary is traced through the lens (``outline``)
and the occluded part is subtracted (``occlusion_scan``). Both move during the exposure while the rows of pixels
integrate (``boundary_integral``), through each patch of the pupil (``psf``).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel, step
from twin.cameras.optics.lens import project
from twin.cameras.render.boundary_integral import EDGE, SPOT, Blur, Increments, Panel, add_points, fill
from twin.cameras.render.bright_spots import spot_count, spots
from twin.cameras.render.inputs import ImageBox, NearSolids, RenderInputs, RowTiming, Solid, TargetPose
from twin.cameras.render.occluder_culling import hidden_by_one, near_solids, pose_solids
from twin.cameras.render.occluders import hit
from twin.cameras.render.occlusion_scan import BEFORE, anything_before, front_of, has_profile, scan_hidden
from twin.cameras.render.outline import (
    BALL,
    FIGURE,
    MOST_PANELS,
    PANEL_PX,
    circle_point,
    cut_pieces,
    image_box,
    lagrange_weights,
    outline_circle,
    outline_steps,
    position_at,
    quadratics,
    rotation_at,
    trace,
)
from twin.cameras.render.ray_samples import runs, sample_rays
from twin.cameras.render.target_image import HIDDEN, IN_VIEW, OUTSIDE, PARTLY, TargetImage, carried, image_of, lit_s

MESH_NEAR = -1
"""State of a target that a mesh may hide: only MuJoCo's rays can decide."""
BY_PRIMITIVES, ONLY_SPAN, HIDDEN_GIVEN, REST_GIVEN = 0, 1, 2, 3
"""How a target is rendered: with occlusion by primitives; not at all (only the span of its exposure is found); with a
given boundary (by mesh rays) of its hidden part; with that of its visible part."""
LEAST_E = 1e-3
"""Light below a thousandth of an electron is neglected, so that dark pixels stay exactly dark."""
WHOLLY = 1.0 - 1e-6
"""Hidden share from which a target counts as hidden."""
LARGEST_PX = 4000.0
"""Targets with a larger image are left out."""
WIDEST_PX = 20_000
"""Images that need more columns than this, with their motion, are left out."""


class Rendered(NamedTuple):
    """A target in an image: visible share, centre (x, y) and diameter of the whole target [px], state."""

    visible: float
    x: float
    y: float
    diameter: float
    state: int


class GivenBoundary(NamedTuple):
    """The boundary (n, 3) found by mesh rays; group g of instants begins at ``first[g]``; the hidden share."""

    edges: Array
    first: Array
    hidden: float


NO_BOUNDARY = GivenBoundary(np.empty((0, 3)), np.zeros(1, dtype=np.int64), 0.0)


@kernel
def render_chosen(
    light: Array, inputs: RenderInputs, which: Array, modes: Array, given: GivenBoundary, spans: Array
) -> Any:
    """Render the targets ``which`` (n,), each in a mode (n,); ``given``: the boundary for modes that need one.

    Returns (visible, x, y, diameter) of each (n, 4) and its state (n,): MESH_NEAR where only its span was asked for.
    ONLY_SPAN writes the begin, middle and end of a target's exposure to ``spans`` (n, 3) [s].
    """
    count = which.shape[0]
    seen = np.zeros((count, 4))
    state = np.zeros(count, dtype=np.int64)
    for i in range(count):
        result = _render_one(light, inputs, which[i], modes[i], given, spans[i])
        seen[i, 0], seen[i, 1], seen[i, 2], seen[i, 3] = result.visible, result.x, result.y, result.diameter
        state[i] = result.state
    return seen, state


@step
def _render_one(light: Array, inputs: RenderInputs, m: int, mode: int, given: GivenBoundary, span: Array) -> Any:
    """Render target ``m`` in a ``mode``; ONLY_SPAN writes begin, middle and end of its exposure to ``span`` (3,)."""
    height, width = light.shape
    weights = np.empty((3, inputs.nodes_s.shape[0]))
    image = image_of(inputs, m, height, width, weights[0])
    if image.state != IN_VIEW:
        return _not_seen(image, image.state)
    if mode == ONLY_SPAN:
        span[0], span[1], span[2] = image.begin_s, image.instant_s, image.end_s
        return _not_seen(image, int(MESH_NEAR))
    whole, box = image_box(inputs.lens, image.target)
    if max(box.right - box.left, box.bottom - box.top) > LARGEST_PX:
        return _not_seen(image, int(OUTSIDE))
    near, groups = _near(inputs, m, mode, image, weights)
    if near.found > 0:
        pose_solids(near, inputs.solids, inputs.nodes_s, image.instant_s, weights[0])
        if groups == 1 and hidden_by_one(near, image.target):
            return _not_seen(image, int(HIDDEN))
    out = _increments(image, box, inputs.pixel_reach, height)
    if out.values.shape[0] == 0 or (not whole and image.target.shape == FIGURE):
        return _not_seen(image, int(OUTSIDE))
    electrons = inputs.targets.electrons[m]
    if not whole:
        # the lens images only a part of it: its light is sampled by rays through its own image
        share = _add_sampled(out, inputs, m, image, near)
        fill(light, out, electrons, LEAST_E)
        return _seen_share(image, share * _inside(inputs.lens, image.target, width, height), int(PARTLY))

    hidden, rest = 0.0, False
    contours, points = _contours(inputs, m, image)
    if mode in (HIDDEN_GIVEN, REST_GIVEN):
        _add_given(out, inputs, m, image, given)
        hidden = given.hidden
        rest = mode == REST_GIVEN and hidden < 1.0
    elif near.found > 0:
        hidden, rest = _add_hidden(out, inputs, m, image, box, contours, near, groups)
        rest = rest and hidden <= WHOLLY
    if rest:
        fill(light, out, electrons, LEAST_E)
        inside = _inside(inputs.lens, image.target, width, height)
        return _seen_share(image, (1.0 - hidden) * inside, int(PARTLY))
    if hidden > WHOLLY:
        return _not_seen(image, int(HIDDEN))

    _add_whole(out, inputs, m, image, contours, points)
    fill(light, out, electrons, LEAST_E)
    visible = 1.0 - hidden
    half = 0.6 * image.diameter + 1.0
    if image.u < half or image.v < half or image.u > width - 1 - half or image.v > height - 1 - half:
        lagrange_weights(inputs.nodes_s, image.instant_s, weights[0])
        rotation_at(inputs.targets.rotation[m], weights[0], image.target.rotation)
        visible *= _inside(inputs.lens, image.target, width, height)
    return _seen_share(image, visible, int(IN_VIEW if hidden == 0.0 else PARTLY))


@bare_step
def _not_seen(image: TargetImage, state: int) -> Any:
    return Rendered(0.0, image.u, image.v, image.diameter, state)


@bare_step
def _seen_share(image: TargetImage, visible: float, state: int) -> Any:
    return Rendered(visible, image.u, image.v, image.diameter, state)


@step
def _near(inputs: RenderInputs, m: int, mode: int, image: TargetImage, weights: Array) -> Any:
    """Return the solids that may hide a target, and the number of groups of instants for its hidden part.

    ``weights`` (3, K) is working memory.
    """
    solids = inputs.solids
    k = solids.kind.shape[0]
    number = np.empty(k, dtype=np.int64)
    count, groups = 0, 1
    if mode == BY_PRIMITIVES:
        count, groups = near_solids(inputs, m, image, number, weights)
    near = NearSolids(number, count, solids.kind, solids.size, np.empty((k, 3)), np.empty((k, 3, 3)))
    return near, groups


@step
def _increments(image: TargetImage, box: ImageBox, reach: int, height: int) -> Any:
    """Return zero increments that hold the image with all its motion; without rows if there is nothing to render."""
    pad = reach + 2 + math.ceil(image.spread)
    motion = image.motion_px
    x0, x1 = math.floor(box.left - motion) - pad, math.ceil(box.right + motion) + pad + 1
    y0, y1 = math.floor(box.top - motion) - pad, math.ceil(box.bottom + motion) + pad + 1
    y0, y1 = max(y0, -1), min(y1, height + 1)
    if y1 <= y0 or x1 - x0 > WIDEST_PX:
        y0, y1, x0, x1 = 0, 0, 0, 0
    return Increments(np.zeros((y1 - y0, x1 - x0 + 2)), x0, y0)


@step
def _contours(inputs: RenderInputs, m: int, image: TargetImage) -> Any:
    """Return the pieces of a figure's contours (n, 9), and the number of points of any target's boundary."""
    sigma = inputs.blur_terms[8]
    if inputs.targets.shape[m] != FIGURE:
        return np.empty((0, 9)), outline_steps(image.diameter, sigma)
    f = inputs.targets.figure[m]
    first = inputs.figure_first
    return cut_pieces(inputs.figure_pieces[first[f] : first[f + 1]], image.stretch, sigma)


@step
def _blur_and_rows(inputs: RenderInputs, m: int, image: TargetImage) -> Any:
    """Return how a target's light spreads, and when its rows collect it."""
    on, off = lit_s(inputs, m)
    rows = RowTiming(inputs.rows.length_s, inputs.rows.row_time_s, on, off)
    return Blur(inputs.pixel_taps, inputs.pixel_reach, image.patches), rows


@bare_step
def _motion_in_steps(inputs: RenderInputs, image: TargetImage) -> Any:
    """The image's motion times 0.6 px over the blur's sigma, which decides how finely time is divided."""
    return image.motion_px * 0.6 / inputs.blur_terms[8]


@bare_step
def _group(image: TargetImage, g: int, groups: int) -> Any:
    """Begin, middle and end of the exposure of group ``g`` of instants."""
    begin, end = image.begin_s, image.end_s
    group_begin = begin + (end - begin) * g / groups
    group_end = begin + (end - begin) * (g + 1) / groups
    return group_begin, image.instant_s if groups == 1 else 0.5 * (group_begin + group_end), group_end


@step
def _add_given(out: Increments, inputs: RenderInputs, m: int, image: TargetImage, given: GivenBoundary) -> None:
    """Add the boundary that mesh rays found, group after group of instants."""
    lens, nodes, path = inputs.lens, inputs.nodes_s, inputs.targets.path[m]
    blur, rows = _blur_and_rows(inputs, m, image)
    weights = np.empty(nodes.shape[0])
    groups = given.first.shape[0] - 1
    for g in range(groups):
        edges = given.edges[given.first[g] : given.first[g + 1]]
        if given.hidden == 1.0 or edges.shape[0] == 0:
            continue
        begin, middle, end = _group(image, g, groups)
        lagrange_weights(nodes, middle, weights)
        x, y, z = position_at(path, weights)
        u, v, _a, _b, _c, _d, _e, _f, _ok = project(lens, x, y, z)
        moving = carried(edges, lens, nodes, path, u, v, begin, middle, end)
        panel = Panel(begin, end, _motion_in_steps(inputs, image) / groups)
        add_points(EDGE, out, blur, moving, panel, rows)


@step
def _add_hidden(
    out: Increments,
    inputs: RenderInputs,
    m: int,
    image: TargetImage,
    box: ImageBox,
    contours: Array,
    near: NearSolids,
    groups: int,
) -> Any:
    """Add the boundary of the part that solids hide; for a mostly hidden target, that of the visible rest instead.

    As a difference of large areas that rest would be blurred. Returns the hidden share, and whether the boundary is
    that of the rest. With several groups, the rotations in ``image`` and the poses in ``near`` are left at the last.
    """
    lens, nodes, path, profile = (inputs.lens, inputs.nodes_s, inputs.targets.path[m], inputs.targets.profile[m])
    if groups > 1 and image.target.shape == FIGURE and not _ever_hidden(inputs, m, image, near, groups):
        return 0.0, False
    blur, rows = _blur_and_rows(inputs, m, image)
    weights = np.empty(nodes.shape[0])
    rest = False
    total_hidden = total_lit = 0.0
    for g in range(groups):
        begin, middle, end = _group(image, g, groups)
        target, u, v, group_box = image.target, image.u, image.v, box
        if groups > 1:
            lagrange_weights(nodes, middle, weights)
            x, y, z = position_at(path, weights)
            rotation_at(inputs.targets.rotation[m], weights, target.rotation)
            target = TargetPose(target.shape, target.rotation, x, y, z, target.radius)
            pose_solids(near, inputs.solids, nodes, middle, weights)
            u, v, _a, _b, _c, _d, _e, _f, _ok = project(lens, x, y, z)
            _whole, group_box = image_box(lens, target)
        edges, lit_edges, hidden_area, lit_area = scan_hidden(
            lens, target, contours, group_box, near, profile, groups == 1
        )
        total_hidden += hidden_area
        total_lit += lit_area
        rest = rest or ((groups > 1 or hidden_area > 0.5 * lit_area) and not has_profile(profile))
        if hidden_area >= WHOLLY * lit_area:
            continue
        panel = Panel(begin, end, _motion_in_steps(inputs, image) / groups)
        for which in range(2):
            some = edges if which == 0 else lit_edges
            if some.shape[0] > 0 and (which == 0 or rest):
                moving = carried(some, lens, nodes, path, u, v, begin, middle, end)
                add_points(EDGE, out, blur, moving, panel, rows)
    hidden = min(1.0, max(0.0, total_hidden / total_lit)) if total_lit != 0.0 else 0.0
    return hidden, rest


@step
def _ever_hidden(inputs: RenderInputs, m: int, image: TargetImage, near: NearSolids, groups: int) -> Any:
    """Whether anything may hide a part of the target in any of the groups of instants."""
    lens, nodes = inputs.lens, inputs.nodes_s
    weights = np.empty(nodes.shape[0])
    for g in range(groups):
        _begin, middle, _end = _group(image, g, groups)
        lagrange_weights(nodes, middle, weights)
        x, y, z = position_at(inputs.targets.path[m], weights)
        rotation_at(inputs.targets.rotation[m], weights, image.target.rotation)
        target = TargetPose(image.target.shape, image.target.rotation, x, y, z, image.target.radius)
        pose_solids(near, inputs.solids, nodes, middle, weights)
        _whole, box = image_box(lens, target)
        if anything_before(lens, target, box, near):
            return True
    return False


@step
def _add_whole(
    out: Increments, inputs: RenderInputs, m: int, image: TargetImage, contours: Array, points: int
) -> None:
    """Add a target's whole boundary (``points`` points) and its spots, panel by panel of time."""
    lens, profile, shape = inputs.lens, inputs.targets.profile[m], image.target.shape
    blur, rows = _blur_and_rows(inputs, m, image)
    motion = _motion_in_steps(inputs, image)
    panels = min(MOST_PANELS, 1 + int(motion / PANEL_PX))
    sense = 1.0 if shape == BALL else -1.0
    spot_points = 0
    if has_profile(profile) and shape != FIGURE:
        spot_points = spot_count(image.diameter)
    before, at, after = np.empty((points, 3)), np.empty((points, 3)), np.empty((points, 3))
    spot_before, spot_at = np.empty((spot_points, 3)), np.empty((spot_points, 3))
    spot_after = np.empty((spot_points, 3))
    weights = np.empty(inputs.nodes_s.shape[0])
    still = image.motion_px < 1e-3
    for panel in range(panels):
        begin, _middle, end = _group(image, panel, panels)
        for k in range(3):
            if still and k != 1:
                continue
            lagrange_weights(inputs.nodes_s, begin + 0.5 * k * (end - begin), weights)
            x, y, z = position_at(inputs.targets.path[m], weights)
            rotation_at(inputs.targets.rotation[m], weights, image.target.rotation)
            target = TargetPose(shape, image.target.rotation, x, y, z, image.target.radius)
            trace(lens, target, contours, points, sense, before if k == 0 else (at if k == 1 else after))
            if spot_points > 0:
                spot_out = spot_before if k == 0 else (spot_at if k == 1 else spot_after)
                spots(lens, target, profile, image.diameter, spot_out)
        if still:
            before, after = at, at
            spot_before, spot_after = spot_at, spot_at
        here = Panel(begin, end, motion / panels)
        add_points(EDGE, out, blur, quadratics(before, at, after), here, rows)
        if spot_points > 0:
            add_points(SPOT, out, blur, quadratics(spot_before, spot_at, spot_after), here, rows)


@step
def _add_sampled(out: Increments, inputs: RenderInputs, m: int, image: TargetImage, near: NearSolids) -> Any:
    """Add the part of a target that the lens images and nothing hides, from samples; return its share."""
    lens, nodes, path = inputs.lens, inputs.nodes_s, inputs.targets.path[m]
    rays, cell, grid = sample_rays(lens, image.target, 0)
    free = np.ones(rays.shape[0], dtype=np.bool_)
    seen = 0
    for i in range(rays.shape[0]):
        dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2]
        front = front_of(image.target, dx, dy, dz)
        for q in range(near.found):
            g = near.number[q]
            solid = Solid(near.kind[g], near.size[g], near.xyz[g], near.rotation[g])
            if hit(solid, dx, dy, dz) < front * BEFORE:
                free[i] = False
                break
        if free[i]:
            seen += 1
    if seen == 0:
        return 0.0
    u, v, _a, _b, _c, _d, _e, _f, _ok = project(lens, image.target.x, image.target.y, image.target.z)
    edges = runs(cell, grid, free, 1.0)
    moving = carried(edges, lens, nodes, path, u, v, image.begin_s, image.instant_s, image.end_s)
    blur, rows = _blur_and_rows(inputs, m, image)
    panel = Panel(image.begin_s, image.end_s, _motion_in_steps(inputs, image))
    add_points(EDGE, out, blur, moving, panel, rows)
    return seen / rays.shape[0]


@bare_step
def _inside(lens: Array, target: TargetPose, width: int, height: int) -> Any:
    """Share of a target's disc that lies inside the image, from 240 points on it."""
    circle = outline_circle(target, target.radius)
    count = 0
    for i in range(10):
        q = math.sqrt((i + 0.5) / 10.0)
        for k in range(24):
            dx, dy, dz, _a, _b, _c = circle_point(circle, 2.0 * math.pi * (k + 0.5 * (i % 2)) / 24)
            cx, cy, cz = circle[0], circle[1], circle[2]
            u, v, _a, _b, _c, _d, _e, _f, ok = project(
                lens, cx + q * (dx - cx), cy + q * (dy - cy), cz + q * (dz - cz)
            )
            if ok and -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                count += 1
    return count / 240.0
