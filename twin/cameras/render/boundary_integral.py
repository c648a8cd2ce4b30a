"""Light on pixels from boundary points, by Green's theorem, for all kinds of targets.

The light on pixel (px, py) of a region is the sum over its boundary of ``share(u - px) weight(v - py) dv``, with the
share of a row's light up to a pixel and the weight of a row (``twin.cameras.optics.pixel_kernel``).
Only pixels near the boundary change along a row, so each point adds its steps to the increments and one running
sum along the rows fills the inside. A point moves during the exposure: its position and dv are quadratics in the
panel's time tau (-1..1), and each row of pixels integrates over its own window.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, step
from twin.cameras.optics.pixel_kernel import EDGE as EDGE
from twin.cameras.optics.pixel_kernel import ROWS, fill_taps
from twin.cameras.optics.pixel_kernel import SPOT as SPOT
from twin.cameras.render.inputs import RowTiming

MAX_NODES = 24
"""Nodes in a panel of time or of a contour."""
MOST_NODES = 64
NODE_AT = np.zeros((MOST_NODES + 1, MOST_NODES))
NODE_SHARE = np.zeros((MOST_NODES + 1, MOST_NODES))
for _n in range(1, MOST_NODES + 1):
    _at, _weight = np.polynomial.legendre.leggauss(_n)
    NODE_AT[_n, :_n], NODE_SHARE[_n, :_n] = _at, _weight / 2


class Increments(NamedTuple):
    """Changes of light from pixel to pixel along each row, ``values`` (h, w), the first one at pixel (x0, y0)."""

    values: Array
    x0: int
    y0: int


class Blur(NamedTuple):
    """How the light of a point spreads: the pixel kernel's taps and reach, and the patches (n, 3) of the pupil."""

    taps: Array
    reach: int
    patches: Array


class Panel(NamedTuple):
    """A part of the exposure, from the opening of the first row [s], and the length of the image's motion in it."""

    begin_s: float
    end_s: float
    motion_px: float


@bare_step
def nodes_for(motion_px: float) -> Any:
    """Gauss-Legendre nodes that integrate an image motion of this length, at most 15 px.

    They lie widest apart in the middle, at pi / 2 of their mean distance. With 1.6 nodes a pixel that is 1 px, which
    the pixel's own width smooths to below 1e-4 of the streak.
    """
    if motion_px < 1e-3:
        return 1
    if motion_px < 0.3:
        return 2
    return min(MAX_NODES, max(3 + int(motion_px), int(1.6 * motion_px)))


@step
def add_points(what: int, out: Increments, blur: Blur, points: Array, panel: Panel, rows: RowTiming) -> None:
    """Add moving pieces of boundary (EDGE, amount dv) or spots of light (SPOT, amount area) to ``out``.

    ``points`` (n, 9): coefficients of u, v and amount in tau. ``rows``: the RowTiming.
    """
    length, row_time, on, off = rows
    scratch = np.empty((2, 2 * blur.reach + 1))
    if row_time == 0.0:
        begin, end = max(panel.begin_s, max(0.0, on)), min(panel.end_s, min(length, off))
        if end > begin:
            _add_all_rows(what, out, blur, points, panel, begin, end, length, scratch)
        return
    for row in range(out.values.shape[0]):
        opens = (out.y0 + row) * row_time
        begin, end = max(panel.begin_s, max(opens, on)), min(panel.end_s, min(opens + length, off))
        if end > begin:
            _add_one_row(what, out, row, blur, points, panel, begin, end, length, scratch)


@bare_step
def _add_all_rows(
    what: int,
    out: Increments,
    blur: Blur,
    points: Array,
    panel: Panel,
    begin: float,
    end: float,
    length: float,
    scratch: Array,
) -> None:
    """Add points whose rows are all exposed from ``begin`` to ``end`` (global shutter)."""
    change, x0, y0 = out
    taps, reach, patch = blur
    step_x, row_share = scratch[0], scratch[1]
    half, middle = 0.5 * (panel.end_s - panel.begin_s), 0.5 * (panel.begin_s + panel.end_s)
    nodes = nodes_for(panel.motion_px * (end - begin) / (2.0 * half))
    rows = change.shape[0]
    for k in range(nodes):
        t = 0.5 * (begin + end) + 0.5 * (end - begin) * NODE_AT[nodes, k]
        tau = (t - middle) / half
        node_share = NODE_SHARE[nodes, k] * (end - begin) / length
        for j in range(points.shape[0]):
            c = points[j]
            u_here, v_here = c[0] + tau * (c[1] + tau * c[2]), c[3] + tau * (c[4] + tau * c[5])
            amount = node_share * (c[6] + tau * (c[7] + tau * c[8]))
            if amount == 0.0:
                continue
            for i in range(patch.shape[0]):
                u, v, part = u_here + patch[i, 0], v_here + patch[i, 1], amount * patch[i, 2]
                left, above = math.floor(u), math.floor(v)
                fill_taps(taps, what, u - left, step_x)
                fill_taps(taps, ROWS, 1.0 - (v - above), row_share)
                x, y = left - reach + 1 - x0, above - reach + 1 - y0
                for p in range(max(0, -y), min(2 * reach, rows - y)):
                    w = part * row_share[p]
                    for q in range(2 * reach + 1):
                        change[y + p, x + q] += w * step_x[q]


@bare_step
def _add_one_row(
    what: int,
    out: Increments,
    row: int,
    blur: Blur,
    points: Array,
    panel: Panel,
    begin: float,
    end: float,
    length: float,
    scratch: Array,
) -> None:
    """Add points to the one row that is exposed from ``begin`` to ``end`` (rolling shutter)."""
    change, x0, y0 = out
    taps, reach, patch = blur
    step_x, row_share = scratch[0], scratch[1]
    half, middle = 0.5 * (panel.end_s - panel.begin_s), 0.5 * (panel.begin_s + panel.end_s)
    nodes = nodes_for(panel.motion_px * (end - begin) / (2.0 * half))
    for k in range(nodes):
        t = 0.5 * (begin + end) + 0.5 * (end - begin) * NODE_AT[nodes, k]
        tau = (t - middle) / half
        node_share = NODE_SHARE[nodes, k] * (end - begin) / length
        for j in range(points.shape[0]):
            c = points[j]
            v_here = c[3] + tau * (c[4] + tau * c[5])
            for i in range(patch.shape[0]):
                v = v_here + patch[i, 1]
                above = math.floor(v)
                p = y0 + row - above + reach - 1
                amount = node_share * patch[i, 2] * (c[6] + tau * (c[7] + tau * c[8]))
                if amount == 0.0 or not 0 <= p < 2 * reach:
                    continue
                u = c[0] + tau * (c[1] + tau * c[2]) + patch[i, 0]
                left = math.floor(u)
                fill_taps(taps, what, u - left, step_x)
                fill_taps(taps, ROWS, 1.0 - (v - above), row_share)
                w, x = amount * row_share[p], left - reach + 1 - x0
                for q in range(2 * reach + 1):
                    change[row, x + q] += w * step_x[q]


@bare_step
def fill(light: Array, increments: Increments, electrons: float, least: float) -> None:
    """Add the running sums of the increments to the image; light below ``least`` electrons is left out."""
    change, x0, y0 = increments
    height, width = light.shape
    for p in range(max(0, -y0), min(change.shape[0], height - y0)):
        collected = 0.0
        for q in range(min(change.shape[1], width - x0)):
            collected += change[p, q]
            if x0 + q >= 0 and electrons * collected > least:
                light[y0 + p, x0 + q] += electrons * collected
