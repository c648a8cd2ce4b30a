"""Drawings of space: the rig around its working space, and the error over the volume."""

import itertools

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from mosca.data.arrays import Array
from mosca.data.rig import Camera, FisheyeLens, Rig, principal_distances_px, principal_point_px
from mosca.data.tracks import Tracks
from reports.evidence import Evidence, true_positions
from reports.plot_style import (
    BLUE,
    GRID,
    HALF,
    HEAT,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    WIDE,
    Picture,
    canvas,
    colour_bar,
    nice_step,
    pieces_between_gaps,
    svg_text,
)
from reports.units import figure as number

AZIMUTH_DEG, ELEVATION_DEG = -58.0, 27.0
MOST_POINTS = 6000
"""Most points of all trajectories in a drawing."""


def scene_picture(evidence: Evidence) -> Picture:
    """Draw cameras (pyramids of view), working space and trajectories in parallel projection from above."""
    drawing = canvas(HALF, 3.3)
    axes = drawing.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set_axis_off()
    axes.set_aspect("equal")
    corners = _box_corners(evidence.working_space_center, evidence.working_space_size)
    optical = np.array([c.world_from_camera.translation for c in evidence.rig.cameras]).reshape(-1, 3)
    everything = np.vstack([corners, optical])
    extent = float(np.ptp(everything, axis=0).max())
    step = _draw_floor(axes, everything, float(corners[:, 2].min()))
    _draw_box(axes, corners)
    lines = _trajectories(evidence.tracks)
    flat = [_flat(line) for line in lines]
    axes.add_collection(LineCollection(flat, colors=BLUE, linewidths=0.7, alpha=0.6))
    if flat:
        ends = np.array([line[-1] for line in flat])
        axes.scatter(ends[:, 0], ends[:, 1], s=4, color=BLUE, linewidths=0, zorder=3)
    _draw_cameras(axes, evidence.rig, everything.mean(axis=0), 0.11 * extent)
    axes.autoscale_view()
    n_tracks = len(np.unique(evidence.tracks.track))
    size = " × ".join(number(v) for v in evidence.working_space_size)
    alt = (
        f"Rig of {len(evidence.rig.cameras)} cameras around a working space of {size} m with {n_tracks} trajectories."
    )
    caption = (
        f"{len(evidence.rig.cameras)} cameras, working space {size} m (orange), {n_tracks} reconstructed "
        f"trajectories (blue, dots at their ends). Floor grid {number(step)} m."
    )
    return Picture("scene", "The scene", caption, alt, svg_text(drawing, "scene", alt), wide=False)


def volume_picture(evidence: Evidence) -> Picture | None:
    """Draw the mean error in cells of the volume from above, front and side; None without errors."""
    if evidence.errors is None or len(evidence.errors.frame) == 0:
        return None
    places, errors_mm = true_positions(evidence), 1e3 * evidence.errors.distance_m()
    views = (("Top", 0, 1), ("Front", 0, 2), ("Side", 1, 2))
    cells = [_mean_in_cells(evidence, places, errors_mm, h, v) for _, h, v in views]
    every = np.concatenate([c.ravel() for c in cells])
    smallest, largest = (float(v) for v in np.nanpercentile(every, (2, 98)))
    if largest <= smallest:
        smallest, largest = 0.0, largest or 1.0
    drawing = canvas(WIDE, 3.3)
    for column, ((title, h, v), cell) in enumerate(zip(views, cells, strict=True)):
        axes = drawing.add_axes((0.055 + 0.303 * column, 0.14, 0.245, 0.74))
        low, high = _box_sides(evidence)
        axes.imshow(
            HEAT(np.clip((cell.T - smallest) / (largest - smallest), 0, 1), alpha=np.isfinite(cell.T).astype(float)),
            extent=(low[h], high[h], low[v], high[v]),
            origin="lower",
            interpolation="none",
            aspect="equal",
            zorder=2,
        )
        axes.set_anchor("N")
        axes.plot(
            [low[h], high[h], high[h], low[h], low[h]], [low[v], low[v], high[v], high[v], low[v]],
            color=ORANGE, linewidth=0.9,
        )  # fmt: skip
        _draw_cameras_flat(axes, evidence, h, v)
        axes.set_title(title)
        axes.set_xlabel(f"{'xyz'[h]} [m]")
        axes.set_ylabel(f"{'xyz'[v]} [m]", labelpad=1)
        axes.set_axisbelow(True)
    colour_bar(drawing, smallest, largest, "mm")
    mean = float(errors_mm.mean())
    alt = (
        f"Mean error in the volume from three sides; over all {number(mean)} mm, colour scale from "
        f"{number(smallest)} to {number(largest)} mm."
    )
    caption = (
        f"Mean 3D error of the samples in each cell, seen from above, in front and from the side; "
        f"{number(mean)} mm over all. Triangles are cameras pointing where they look, open where they "
        "stand farther out than drawn."
    )
    return Picture("volume", "Where in the volume", caption, alt, svg_text(drawing, "volume", alt))


def _flat(points: Array) -> Array:
    """Return points (n, 3) projected to the drawing plane (n, 2) along a fixed slanted direction."""
    a, e = np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG)
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    result: Array = np.asarray(points) @ np.column_stack([right, up])
    return result


def _box_corners(center: Array, size: Array) -> Array:
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return np.asarray(center + signs * size)


def _box_sides(evidence: Evidence) -> tuple[Array, Array]:
    half = evidence.working_space_size / 2
    return evidence.working_space_center - half, evidence.working_space_center + half


def _draw_floor(axes: Axes, everything: Array, height: float) -> float:
    """Draw a grid on the floor below everything, with the axes' names; return its step [m]."""
    low, high = everything.min(axis=0)[:2], everything.max(axis=0)[:2]
    step = nice_step(float((high - low).max()), 6)
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    lines = [[[x, low[1], height], [x, high[1], height]] for x in np.arange(low[0], high[0] + step / 2, step)] + [
        [[low[0], y, height], [high[0], y, height]] for y in np.arange(low[1], high[1] + step / 2, step)
    ]
    axes.add_collection(LineCollection([_flat(np.array(s)) for s in lines], colors=GRID, linewidths=0.6))
    origin = np.array([low[0], low[1], height])
    for direction, name in zip(np.eye(3), "xyz", strict=True):
        arrow = _flat(np.array([origin, origin + 1.0 * step * direction, origin + 1.25 * step * direction]))
        axes.plot(arrow[:2, 0], arrow[:2, 1], color=MUTED, linewidth=1.1, solid_capstyle="round")
        axes.text(arrow[2, 0], arrow[2, 1], name, color=MUTED, fontsize=8, ha="center", va="center")
    return step


def _draw_box(axes: Axes, corners: Array) -> None:
    """Draw the working space's edges; those behind it dashed."""
    a, e = np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG)
    towards_eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    hidden = int(np.argmin(corners @ towards_eye))
    flat = _flat(corners)
    pairs = [(i, j) for i, j in itertools.combinations(range(8), 2) if bin(i ^ j).count("1") == 1]
    for behind in (True, False):
        segments = [flat[[i, j]] for i, j in pairs if (hidden in (i, j)) == behind]
        dashes = (0, (3, 3)) if behind else "solid"
        axes.add_collection(LineCollection(segments, colors=ORANGE, linewidths=0.9, linestyles=dashes))


def _trajectories(tracks: Tracks) -> list[Array]:
    """Return the tracks' positions, thinned and cut where frames are missing."""
    order = np.argsort(tracks.track, kind="stable")
    stride = max(1, -(-len(order) // MOST_POINTS))
    lines = []
    cuts = np.flatnonzero(np.diff(tracks.track[order])) + 1
    for rows in np.split(order, cuts) if len(order) else []:
        kept = rows[::stride]
        gaps = np.flatnonzero(np.diff(pieces_between_gaps(tracks.frame[rows])[::stride])) + 1
        lines += [tracks.xyz[part] for part in np.split(kept, gaps)]
    return lines


def _draw_cameras(axes: Axes, rig: Rig, middle: Array, length: float) -> None:
    names = len(rig.cameras) <= 16
    for camera in rig.cameras:
        corners = camera_corners(camera, length)
        apex = camera.world_from_camera.translation
        edges = [[apex, c] for c in corners] + [[corners[i], corners[(i + 1) % 4]] for i in range(4)]
        axes.add_collection(LineCollection([_flat(np.array(s)) for s in edges], colors=INK, linewidths=0.8, zorder=4))
        place = _flat(apex) + 0.65 * length * _unit(_flat(apex) - _flat(middle))
        axes.plot(*_flat(apex), marker="o", markersize=2.2, color=INK, zorder=4)
        if names:
            axes.text(
                place[0], place[1], camera.name, fontsize=7.5, color=INK, ha="center", va="center", zorder=5,
            )  # fmt: skip


def camera_corners(camera: Camera, depth_m: float) -> Array:
    """Return the corners (4, 3) of the camera's image at a depth, world frame [m]."""
    return camera.world_from_camera.transform(depth_m * _corner_rays(camera))


def _unit(vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else vector


def _corner_rays(camera: Camera) -> Array:
    """Return rays (4, 3) to the image's corners at depth 1, camera frame; distortion is left out in this sketch."""
    lens = camera.lens
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]]) - 0.5
    across = (corners - principal_point_px(lens)) / principal_distances_px(lens)
    if isinstance(lens, FisheyeLens):
        angle = np.linalg.norm(across, axis=1, keepdims=True)
        across = across / angle * np.tan(np.minimum(angle, 1.1))
    return np.column_stack([across, np.ones(4)])


def _mean_in_cells(evidence: Evidence, places: Array, errors_mm: Array, h: int, v: int) -> Array:
    """Return the mean error (nh, nv) [mm] of samples in square cells of one projection; NaN in cells without any."""
    low, high = _box_sides(evidence)
    step = float((high - low).max()) / 28
    bins = [np.linspace(low[i], high[i], max(1, round((high[i] - low[i]) / step)) + 1) for i in (h, v)]
    count, _, _ = np.histogram2d(places[:, h], places[:, v], bins=bins)
    total, _, _ = np.histogram2d(places[:, h], places[:, v], bins=bins, weights=errors_mm)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _draw_cameras_flat(axes: Axes, evidence: Evidence, h: int, v: int) -> None:
    """Draw cameras as triangles from one side; distant ones are open and at the edge of the drawing."""
    low, high = _box_sides(evidence)
    margin = 0.4 * float((high - low).max())
    for camera in evidence.rig.cameras:
        at = camera.world_from_camera.translation[[h, v]]
        looks = camera.world_from_camera.rotation[[h, v], 2]
        held = np.clip(at, (low - margin)[[h, v]], (high + margin)[[h, v]])
        angle = float(np.degrees(np.arctan2(looks[1], looks[0]))) - 90.0
        axes.plot(
            *held, marker=(3, 0, angle), markersize=6, markeredgecolor=INK, markeredgewidth=0.8,
            markerfacecolor=INK if np.allclose(at, held) else PAPER, zorder=4,
        )  # fmt: skip
