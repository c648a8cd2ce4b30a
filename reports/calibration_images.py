"""Drawings in the cameras' images: residual vectors, and coverage by the target."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from mosca.data.calibration import Calibration
from mosca.data.calibration_evidence import CalibrationEvidence
from reports.plot_style import BLUE, GRID, HEAT, INK, ORANGE, VERMILION, WIDE, Picture, canvas, strided, svg_text
from reports.units import figure as number

MOST_ARROWS = 700
"""Most residual vectors drawn for each camera."""
MOST_CAMERAS = 12
"""Most cameras with drawn images; the others are in the tables."""
ACROSS = 3
ARROW_SHARE = 0.06
"""Drawn length of the 95 % residual, as a share of the image's width."""


def residuals_picture(calibration: Calibration) -> Picture:
    """Draw each camera's residual vectors where they were observed, magnified; points left out as crosses."""
    see = calibration.sightings
    sizes = np.linalg.norm(calibration.residuals_px[calibration.used], axis=1)
    largest = max(float(np.percentile(sizes, 95)), 1e-9) if len(sizes) else 1.0
    drawing, all_axes = _image_axes(calibration, 0.62)
    for k, axes in enumerate(all_axes):
        width = float(see.sizes[k][0])
        factor = ARROW_SHARE * width / largest
        mine = see.camera == k
        rows = np.flatnonzero(mine & calibration.used)
        rows = rows[strided(len(rows), MOST_ARROWS)]
        start, length = see.xy_px[rows], calibration.residuals_px[rows]
        # an arrow is a line that is thick at the observed point
        segments = np.stack([start, start + factor * length], axis=1)
        colours = HEAT(np.clip(1 - 0.85 * np.linalg.norm(length, axis=1) / largest, 0, 1))
        axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=0.9))
        axes.scatter(start[:, 0], start[:, 1], s=2.5, color=colours, linewidths=0)
        out = np.flatnonzero(mine & ~calibration.used)
        out = out[strided(len(out), MOST_ARROWS)]
        axes.scatter(see.xy_px[out, 0], see.xy_px[out, 1], s=14, marker="x", color=VERMILION, linewidths=0.9)
        x, y = calibration.sigma_px[k]
        axes.set_title(f"{calibration.rig.names[k]}   σx {number(float(x))}, σy {number(float(y))} px")
        if k == 0:
            bar = _nice_below(1.6 * largest)
            at = np.array([0.03 * width, 0.955 * see.sizes[k][1]])
            axes.plot([at[0], at[0] + bar * factor], [at[1]] * 2, color=INK, linewidth=2.0, solid_capstyle="butt")
            axes.text(at[0] + bar * factor + 0.015 * width, at[1], f"{number(bar)} px", va="center", fontsize=8)
    out_count = int((~calibration.used).sum())
    caption = (
        f"Observed minus projected, magnified (the bar in the first image shows how much); darker is larger. "
        f"95 % are below {number(largest)} px. {out_count or 'No'} point{'' if out_count == 1 else 's'} left out"
        f"{' (crosses)' if out_count else ''}. A good calibration shows no pattern: neighbours point anywhere."
    )
    alt = f"Residual vectors of {len(all_axes)} cameras; 95 % are below {number(largest)} px."
    return Picture("residuals", "Residual vectors", caption, alt, svg_text(drawing, "residuals", alt))


def coverage_picture(calibration: Calibration, evidence: CalibrationEvidence) -> Picture:
    """Draw where each image shows the target, and which cells are not covered by it."""
    see = calibration.sightings
    drawing, all_axes = _image_axes(calibration, 0.62)
    shares = []
    for k, axes in enumerate(all_axes):
        covered = evidence.covered[k]
        width, height = (float(v) for v in see.sizes[k])
        rows, columns = covered.shape
        for row, column in np.argwhere(~covered):
            axes.fill_between(
                [column * width / columns - 0.5, (column + 1) * width / columns - 0.5],
                row * height / rows - 0.5, (row + 1) * height / rows - 0.5, color=ORANGE, alpha=0.22, linewidth=0,
            )  # fmt: skip
        mine = np.flatnonzero((see.camera == k) & calibration.used)
        mine = mine[strided(len(mine), 3 * MOST_ARROWS)]
        axes.scatter(see.xy_px[mine, 0], see.xy_px[mine, 1], s=3, color=BLUE, linewidths=0)
        share = 100 * float(covered.mean())
        shares.append(share)
        axes.set_title(f"{calibration.rig.names[k]}   {number(round(share))} % covered")
    caption = "Image points used (blue); the shaded cells have none in or between them: rays there are extrapolated."
    alt = f"Coverage of {len(all_axes)} images: {number(min(shares))} to {number(max(shares))} percent."
    return Picture("coverage", "Where the target was seen", caption, alt, svg_text(drawing, "coverage", alt))


def _image_axes(calibration: Calibration, title_inch: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with an axes in the shape of each camera's image, y down."""
    shown = min(len(calibration.rig.cameras), MOST_CAMERAS)
    across = 2 if shown <= 4 else ACROSS
    sizes = np.asarray(calibration.sightings.sizes, dtype=float)[:shown]
    one = (WIDE - 0.1) / across - 0.15
    tall = one * float(np.max(sizes[:, 1] / sizes[:, 0]))
    lines = -(-shown // across)
    drawing = canvas(WIDE, lines * (tall + 0.45 * title_inch + 0.08) + 0.05)
    width, height = drawing.get_size_inches()
    found = []
    for k in range(shown):
        row, column = divmod(k, across)
        bottom = height - (row + 1) * (tall + 0.45 * title_inch + 0.08) + 0.08
        axes = drawing.add_axes(((0.08 + column * (one + 0.15)) / width, bottom / height, one / width, tall / height))
        axes.set_xlim(-0.5, sizes[k, 0] - 0.5)
        axes.set_ylim(sizes[k, 1] - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(False)
        for spine in axes.spines.values():
            spine.set_visible(True)
            spine.set_color(GRID)
        found.append(axes)
    return drawing, found


def _nice_below(value: float) -> float:
    """Return the largest of 1, 2, 5 x 10^k not above ``value``."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-12)))
    return float(max(m * power for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)))
