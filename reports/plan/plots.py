"""Pictures of a plan: cameras from above, map of the predicted standard deviation, accuracy over their number."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D

from mosca.data.arrays import Array
from reports.plot_style import (
    BLUE,
    DOTTED,
    GRID,
    HALF,
    HEAT,
    INK,
    MUTED,
    ORANGE,
    VERMILION,
    Picture,
    canvas,
    house_style,
    legend_above,
    svg_text,
)
from reports.units import figure


def plan_pictures(document: Mapping[str, Any]) -> list[Picture]:
    """Return the pictures of a plan's result."""
    with house_style():
        pictures = [_from_above(document), _map(document)]
        return [*pictures, _curve(document)] if len(document["curve"]) > 1 else pictures


def _from_above(document: Mapping[str, Any]) -> Picture:
    drawing = canvas(HALF, HALF)
    axes = drawing.add_axes((0.12, 0.1, 0.85, 0.85))
    _room(axes, document)
    middle, size = (np.array(document["volume"][key]) for key in ("center_m", "size_m"))
    for one in document["cameras"]:
        place, ahead = np.array(one["position_m"]), np.array(one["direction"])
        pan = np.arctan2(ahead[1], ahead[0])
        far = float(np.linalg.norm(middle - place) + np.linalg.norm(size[:2]) / 2)
        half = np.arctan(one["size_px"][0] * one["pitch_mm"] / 2 / one["focal_mm"])
        rays = [place[:2] + far * np.array([np.cos(pan + k * half), np.sin(pan + k * half)]) for k in (-1, 1)]
        axes.add_patch(Polygon([place[:2], *rays], closed=True, facecolor=BLUE, alpha=0.1, edgecolor="none"))
        tip = place[:2] + 0.08 * far * ahead[:2]
        axes.plot([place[0], tip[0]], [place[1], tip[1]], color=BLUE, lw=1.2)
        axes.plot(place[0], place[1], "o", color=BLUE, ms=4)
        axes.annotate(
            f"{one['name'].removeprefix('cam')}", (float(place[0]), float(place[1])), textcoords="offset points",
            xytext=(5, 4), color=INK, fontsize=8,
        )  # fmt: skip
    caption = (
        "Cameras from above, by number, and what each sees horizontally; the volume is outlined in orange, "
        "obstacles are grey."
    )
    alt = f"{len(document['cameras'])} cameras around the volume, from above"
    return Picture("above", "Cameras from above", caption, alt, svg_text(drawing, "above", alt), wide=False)


def _map(document: Mapping[str, Any]) -> Picture:
    drawing = canvas(HALF, HALF)
    axes = drawing.add_axes((0.15, 0.1, 0.66, 0.85))
    _room(axes, document, walls=False)
    there = document["map"]
    values = 1e3 * np.array([[np.nan if v is None else v for v in row] for row in there["sigma_m"]])
    x, y = np.array(there["x_m"]), np.array(there["y_m"])
    low, high = _range(values)
    steps = [(x[1] - x[0]) / 2, (y[1] - y[0]) / 2]
    colours = HEAT((np.clip(values, low, high) - low) / (high - low))
    unseen = np.isnan(values) & np.array(there["inside"])
    for j, k in zip(*np.nonzero(np.isfinite(values) | unseen), strict=True):
        # there are few cells, so rectangles give a small and sharp picture
        colour: Any = VERMILION if unseen[j, k] else colours[j, k]
        axes.add_patch(Rectangle((x[k] - steps[0], y[j] - steps[1]), 2 * steps[0], 2 * steps[1], color=colour, lw=0))
    center, size = document["volume"]["center_m"], document["volume"]["size_m"]
    axes.set_xlim(center[0] - 0.55 * size[0], center[0] + 0.55 * size[0])
    axes.set_ylim(center[1] - 0.55 * size[1], center[1] + 0.55 * size[1])
    bar = drawing.add_axes((0.86, 0.2, 0.03, 0.6))
    bar.imshow(HEAT(np.linspace(0, 1, 64))[:, None], extent=(0, 1, low, high), origin="lower", aspect="auto")
    bar.grid(False)
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.set_title("mm", loc="left", fontsize=8, color=MUTED)
    share = 100 * document["quantile"]
    caption = (
        f"Predicted standard deviation of a measured point, from above: what {share:.0f} % of the markers of a cell "
        "do not exceed, over all heights and directions in which they face. Red: fewer than that are measured at all."
    )
    alt = f"Predicted standard deviation over the volume, {figure(low)} to {figure(high)} mm"
    return Picture("map", "Predicted standard deviation", caption, alt, svg_text(drawing, "map", alt), wide=False)


def _curve(document: Mapping[str, Any]) -> Picture:
    drawing = canvas(HALF, 2.9)
    axes = drawing.add_axes((0.14, 0.17, 0.83, 0.68))
    rows = [one for one in document["curve"] if one["sigma_quantile_m"] is not None]
    count = [one["cameras"] for one in rows]
    axes.plot(count, [1e3 * one["sigma_quantile_m"] for one in rows], color=BLUE, marker="o", ms=4, label="quantile")
    axes.plot(count, [1e3 * one["sigma_rms_m"] for one in rows], color=ORANGE, marker=".", label="rms")
    every = [one["cameras"] for one in document["curve"]]
    for one in every:
        if one not in count:
            axes.axvline(one, color=VERMILION, ls=DOTTED)
    axes.set_xlim(min(every) - 0.5, max(every) + 0.5)
    if rows:
        axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("cameras")
    axes.set_ylabel("predicted [mm]")
    legend_above(axes)
    share = 100 * document["quantile"]
    caption = (
        f"Best plan for each number of cameras: the standard deviation that {share:.0f} % of the markers do not "
        "exceed, and the rms of those that are measured. Dotted: so few cameras measure less than that share."
    )
    alt = "Predicted standard deviation over the number of cameras: " + ", ".join(
        f"{one['cameras']}: {figure(1e3 * one['sigma_quantile_m'])} mm" for one in rows
    )
    return Picture("curve", "How many cameras", caption, alt, svg_text(drawing, "curve", alt), wide=False)


def _room(axes: Axes, document: Mapping[str, Any], walls: bool = True) -> None:
    """Draw room, volume and obstacles from above."""
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    given = document["conditions"]
    if walls:
        if given["room"] is not None:
            axes.add_patch(Polygon(given["room"]["corners_m"], closed=True, fill=False, edgecolor=INK, lw=1.2))
        for one in (*given["rail"], *given["wall"]):
            axes.plot(*np.array([one["from_m"][:2], one["to_m"][:2]]).T, color=MUTED, lw=2.5, solid_capstyle="butt")
    for one in given["obstacle"]:
        axes.add_patch(_obstacle(one))
    axes.add_patch(Polygon(_outline(document["volume"]), closed=True, fill=False, edgecolor=ORANGE, lw=1.2))
    axes.autoscale_view()


def _obstacle(one: Mapping[str, Any]) -> Any:
    x, y = one["center_m"][:2]
    w, h = one["size_m"][:2]
    if one["kind"] == "cylinder":
        return Circle((x, y), w / 2, facecolor=GRID, edgecolor=MUTED)
    turned = Affine2D().rotate_deg(one["yaw_deg"]).translate(x, y)
    corners = np.array([(-w / 2, -h / 2), (w / 2, -h / 2), (w / 2, h / 2), (-w / 2, h / 2)])
    return Polygon(turned.transform(corners), closed=True, facecolor=GRID, edgecolor=MUTED)


def _outline(volume: Mapping[str, Any]) -> Sequence[Sequence[float]]:
    if volume["corners_m"] is not None:
        return list(volume["corners_m"])
    (x, y), (w, h) = volume["center_m"][:2], volume["size_m"][:2]
    return [[x - w / 2, y - h / 2], [x + w / 2, y - h / 2], [x + w / 2, y + h / 2], [x - w / 2, y + h / 2]]


def _range(values: Array) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(np.quantile(finite, 0.98))
    return (low, high) if high > low else (low, low + 1e-3)
