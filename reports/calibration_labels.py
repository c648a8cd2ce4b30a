"""Names beside points of a drawing, placed so that they cover neither each other nor the points."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from mosca.data.arrays import Array
from reports.plot_style import INK, MUTED

SIZE_PT, WIDTH_PT, HEIGHT_PT = 8.0, 5.4, 10.0
"""Font size, and width and height of a letter: wide enough for substitute fonts of the reader's machine."""
DOT_PT = 3.5
RINGS_PT = (5.0, 14.0, 24.0, 36.0, 50.0, 66.0, 84.0)
DIRECTIONS = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
LEADER_FROM_PT = 10.0
"""Distance of a name from its point above which a line joins them."""


def label_points(axes: Axes, places: Array, names: Sequence[str]) -> None:
    """Write ``names`` beside the points ``places`` (n, 2) of a drawing whose limits are final."""
    axes.apply_aspect()
    points_pt = axes.transData.transform(places) * 72 / axes.figure.dpi
    frame = axes.get_window_extent()
    low, high = (np.array(side) * 72 / axes.figure.dpi for side in ((frame.x0, frame.y0), (frame.x1, frame.y1)))
    offsets = label_offsets(points_pt, [WIDTH_PT * len(name) for name in names], low, high)
    for name, place, offset in zip(names, places, offsets, strict=True):
        far = np.abs(offset).max() > LEADER_FROM_PT
        leader = {"arrowstyle": "-", "color": MUTED, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2} if far else None
        axes.annotate(
            name, place, offset, textcoords="offset points", fontsize=SIZE_PT, color=INK, va="center",
            arrowprops=leader, zorder=5,
        )  # fmt: skip


def label_offsets(points_pt: Array, widths_pt: Sequence[float], low_pt: Array, high_pt: Array) -> Array:
    """Return the offsets (n, 2) of the middles of labels' left edges from their points (n, 2), in pt.

    The nearest candidate inside the box from ``low_pt`` to ``high_pt`` that is free of points and earlier labels is
    taken; where there is none, the one that covers least.
    """
    dots = np.column_stack([points_pt - DOT_PT, points_pt + DOT_PT])
    taken: list[Array] = []
    offsets = np.zeros((len(points_pt), 2))
    for k, (point, width) in enumerate(zip(points_pt, widths_pt, strict=True)):
        candidates = [_offset(ring, direction, width) for ring in RINGS_PT for direction in DIRECTIONS]
        covers = []
        for offset in candidates:
            box = np.concatenate([point + offset, point + offset]) + (0, -HEIGHT_PT / 2, width, HEIGHT_PT / 2)
            outside = max(0.0, *(low_pt - box[:2]), *(box[2:] - high_pt))
            covers.append(sum(_common(box, other) for other in (*dots, *taken)) + outside * HEIGHT_PT)
        best = int(np.argmin(covers))
        offsets[k] = candidates[best]
        corner = point + candidates[best]
        taken.append(np.concatenate([corner, corner]) + (0, -HEIGHT_PT / 2, width, HEIGHT_PT / 2))
    return offsets


def _offset(ring: float, direction: tuple[int, int], width: float) -> Array:
    """Return the offset of the left edge of a label in a direction from its point, ``ring`` away."""
    x, y = direction
    return np.array([ring if x > 0 else -ring - width if x < 0 else -width / 2, y * (ring + HEIGHT_PT / 2 - 5)])


def _common(one: Array, other: Array) -> float:
    """Return the area that two boxes (low x, low y, high x, high y) have in common."""
    size = np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2])
    return float(size[0] * size[1]) if (size > 0).all() else 0.0
