"""Plots of a recording without ground truth."""

import numpy as np

from mosca.data.tracks import Tracks
from reports.plot_style import (
    AXIS_COLOURS,
    BLUE,
    DASHED,
    HALF,
    INK,
    MOST_STEPS,
    ORANGE,
    WIDE,
    Picture,
    canvas,
    legend_above,
    strided,
    svg_text,
)
from reports.units import figure as number


def residuals_picture(tracks: Tracks) -> Picture:
    """Draw the distribution of reprojection residuals of a recording without ground truth."""
    values = tracks.residual_px[np.isfinite(tracks.residual_px)]
    rms, p95 = float(np.sqrt(np.mean(values**2))), float(np.percentile(values, 95))
    edges = np.linspace(0, max(2.0 * p95, 1e-6), 48)
    share = 100 * np.histogram(np.minimum(values, edges[-1]), edges)[0] / len(values)
    drawing = canvas(HALF, 3.3)
    axes = drawing.add_axes((0.115, 0.135, 0.865, 0.735))
    axes.stairs(share, edges, fill=True, color=BLUE, alpha=0.35)
    axes.stairs(share, edges, color=BLUE, linewidth=0.9)
    axes.axvline(rms, color=INK, linewidth=1.4, label=f"rms {number(rms)}")
    axes.axvline(p95, color=ORANGE, linewidth=1.4, linestyle=DASHED, label=f"95 % {number(p95)}")
    axes.set_xlim(0, edges[-1])
    axes.set_xlabel("reprojection residual [px]")
    axes.set_ylabel("share of samples [%]")
    axes.grid(axis="x", visible=False)
    legend_above(axes)
    alt = f"Histogram of {len(values)} reprojection residuals, rms {number(rms)} px."
    caption = f"How well the rays of {number(len(values))} points meet. No truth is known here: this is not "
    caption += "an error in space."
    return Picture("residuals", "Reprojection residuals", caption, alt, svg_text(drawing, "residuals", alt), False)


def longest_tracks_picture(tracks: Tracks) -> Picture:
    """Draw x, y, z over time of the three longest tracks."""
    names, lengths = np.unique(tracks.track, return_counts=True)
    chosen = names[np.argsort(-lengths, kind="stable")][:3]
    drawing = canvas(WIDE, 2.9)
    for column, track in enumerate(chosen):
        axes = drawing.add_axes((0.062 + 0.322 * column, 0.15, 0.272, 0.68))
        rows = np.flatnonzero(tracks.track == track)
        label = str(tracks.label[rows[0]])
        rows = rows[strided(len(rows), MOST_STEPS)]
        for axis, colour in enumerate(AXIS_COLOURS):
            axes.plot(1e-9 * tracks.time_ns[rows], tracks.xyz[rows, axis], ".", color=colour, markersize=2.2,
                      markeredgewidth=0, label="xyz"[axis])  # fmt: skip
        axes.set_title(f"Track {track}" + (f" ({label[:20]})" if label else ""))
        axes.set_xlabel("time [s]")
        if column == 0:
            axes.set_ylabel("position [m]")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, markerscale=4, handlelength=0.8)
    alt = f"Positions over time of the {len(chosen)} longest of {len(names)} tracks."
    caption = f"The {len(chosen)} longest of {number(len(names))} tracks."
    return Picture("tracks", "Trajectories", caption, alt, svg_text(drawing, "tracks", alt))


def points_picture(tracks: Tracks) -> Picture:
    """Draw the number of measured points in each frame."""
    measured = tracks.status == "measured"
    there, first = np.unique(tracks.frame, return_index=True)
    frames = np.arange(there[0], there[-1] + 1)  # frames without points count as 0
    count = np.bincount(tracks.frame[measured] - frames[0], minlength=len(frames))
    time_s = np.interp(frames, there, 1e-9 * tracks.time_ns[first])
    thin = strided(len(frames), 2 * MOST_STEPS)
    drawing = canvas(WIDE, 1.9)
    axes = drawing.add_axes((0.062, 0.24, 0.928, 0.68))
    axes.plot(time_s[thin], count[thin], color=BLUE, linewidth=0.9, drawstyle="steps-mid")
    axes.set_ylim(0, 1.1 * max(1, int(count.max())))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("points")
    low, high = int(count.min()), int(count.max())
    alt = f"Measured points in {len(frames)} frames: between {low} and {high}."
    caption = f"Measured points frame by frame: {low} to {high}, {number(float(count.mean()))} on average."
    return Picture("points", "Points over time", caption, alt, svg_text(drawing, "points", alt))
