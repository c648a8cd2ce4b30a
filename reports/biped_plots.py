"""Stick figures of a person at some instants of a take, with the truth."""

import numpy as np
from matplotlib.axes import Axes

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.data.tracks import Tracks
from reports.bones import strips
from reports.plot_style import BLUE, GRID, INK, MUTED, ORANGE, WIDE, Picture, canvas, house_style, svg_text
from reports.units import figure as number

INSTANTS = 6
"""Number of figures side by side."""
TURNED = np.deg2rad(50.0)
"""Angle from the person's viewing direction to the observer, so that both sides of the body are visible."""
MARGIN_M, NEAR_M = 0.12, 1.3
"""Margin around all figures, and largest distance of a drawn marker from the middle of the joints [m]."""


def biped_picture(joints: JointMotion, truth: JointMotion | None = None, tracks: Tracks | None = None) -> Picture:
    """Draw the joints at INSTANTS evenly spread instants with a pose, from a side; ``truth`` in a light colour.

    ``truth``: joints at instants of its own, of which the nearest one is drawn; ``tracks``: their points at the drawn
    instants become dots. ValueError where no instant has a bone.
    """
    posed = [k for k in range(len(joints)) if strips(joints.joints, joints.centre[k])]
    if not posed:
        raise ValueError("biped: no instant with two joints in a line")
    spread = np.linspace(0, len(posed) - 1, min(INSTANTS, len(posed))).round().astype(int)
    chosen = np.array([posed[k] for k in np.unique(spread)])
    with house_style():
        views = [_seen(joints, truth, tracks, int(k)) for k in chosen]
        everything = np.concatenate([line for view in views for group in view[:2] for line in group])
        low, high = everything.min(axis=0) - MARGIN_M, everything.max(axis=0) + MARGIN_M
        width, height = high - low
        drawn = min(4.2, WIDE / INSTANTS * height / width)
        drawing = canvas(WIDE, drawn + 0.35)
        for column, (k, view) in enumerate(zip(chosen.tolist(), views, strict=True)):
            axes = drawing.add_axes((column / INSTANTS, 0.0, 1 / INSTANTS, drawn / (drawn + 0.35)))
            _draw(axes, *view)
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
            axes.set_aspect("equal")
            axes.axis("off")
            time_s = 1e-9 * float(joints.time_ns[k] - joints.time_ns[0])
            axes.set_title(f"{time_s:.2f} s", loc="center", fontsize=8.0, color=MUTED)
        alt, caption = _text(joints, truth, tracks, chosen)
        return Picture("biped", "The person", caption, alt, svg_text(drawing, "biped", alt))


_View = tuple[list[Array], list[Array], Array, list[str]]
"""Lines (k, 2) of the estimate and of the truth, dots (n, 2), colours of the estimate's lines."""


def _seen(joints: JointMotion, truth: JointMotion | None, tracks: Tracks | None, k: int) -> _View:
    """Return the lines and dots of one instant, about the middle of the joints, upwards from the ground."""
    lines = strips(joints.joints, joints.centre[k])
    middle = np.concatenate(lines).mean(axis=0) * [1, 1, 0]
    right = _to_the_right(joints, k)
    flat = np.stack([right, [0.0, 0.0, 1.0]], axis=1)
    true: list[Array] = []
    if truth is not None and len(truth):
        nearest = int(np.abs(truth.time_ns - joints.time_ns[k]).argmin())
        true = strips(truth.joints, truth.centre[nearest])
    dots = np.empty((0, 3))
    if tracks is not None:
        dots = tracks.xyz[(tracks.frame == joints.frame[k]) & np.isfinite(tracks.xyz).all(axis=1)]
        dots = dots[np.linalg.norm((dots - middle) * [1, 1, 0], axis=1) < NEAR_M]
    colours = [_side(joints, k, line) for line in lines]
    return (
        [(line - middle) @ flat for line in lines],
        [(line - middle) @ flat for line in true],
        (dots - middle) @ flat,
        colours,
    )


def _to_the_right(joints: JointMotion, k: int) -> Array:
    """Return the horizontal direction (3,) that points to the right in the picture, from the person's hips."""
    place = dict(zip(joints.joints, joints.centre[k], strict=True))
    for left, right in (("l_hip", "r_hip"), ("l_shoulder", "r_shoulder")):
        across = (place.get(right, np.full(3, np.nan)) - place.get(left, np.full(3, np.nan))) * [1, 1, 0]
        if np.linalg.norm(across) > 0:
            break
    else:
        across = np.array([0.0, -1.0, 0.0])
    # a person who faces the observer has the right side at the picture's left
    angle = np.arctan2(-across[1], -across[0]) - TURNED
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _side(joints: JointMotion, k: int, line: Array) -> str:
    """Return the colour of a line by the side of its last joint."""
    ends = np.flatnonzero((joints.centre[k] == line[-1]).all(axis=1))
    name = joints.joints[int(ends[0])] if len(ends) else ""
    return {"l_": ORANGE, "r_": BLUE}.get(name[:2], INK)


def _draw(axes: Axes, lines: list[Array], true: list[Array], dots: Array, colours: list[str]) -> None:
    axes.axhline(0.0, color=GRID, linewidth=0.8)
    axes.plot(dots[:, 0], dots[:, 1], ".", color=MUTED, markersize=1.8, alpha=0.6)
    for line in true:
        axes.plot(line[:, 0], line[:, 1], color=MUTED, alpha=0.35, linewidth=5.0, solid_capstyle="round")
    for line, colour in zip(lines, colours, strict=True):
        axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=1.6, marker="o", markersize=3.0)


def _text(joints: JointMotion, truth: JointMotion | None, tracks: Tracks | None, chosen: Array) -> tuple[str, str]:
    """Return the main result in words, and the caption."""
    alt = f"A person's joints at {len(chosen)} instants"
    caption = "Lines between the centres of joints, left orange, right blue, seen from in front of the person's side."
    if tracks is not None:
        caption += " Dots: measured points."
    if truth is not None and len(truth):
        rows = [int(np.abs(truth.time_ns - joints.time_ns[k]).argmin()) for k in chosen]
        common = [name for name in joints.joints if name in truth.joints]
        ours = joints.centre[chosen][:, [joints.joints.index(name) for name in common]]
        away = np.linalg.norm(ours - truth.centre[rows][:, [truth.joints.index(name) for name in common]], axis=2)
        if np.isfinite(away).any():
            alt += f", {number(1e3 * float(np.sqrt(np.nanmean(away**2))))} mm rms from the truth"
        caption += " Grey bands: the truth."
    return alt + ".", caption
