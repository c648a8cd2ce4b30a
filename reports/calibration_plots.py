"""Drawings of a calibration: the rig with its links, accuracy in the volume, held-out lengths, correlations."""

import itertools
from collections.abc import Iterator

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mosca.data.calibration import Calibration
from mosca.data.calibration_evidence import AccuracyGrid, CalibrationEvidence, HeldOutLengths
from reports.calibration_images import ACROSS, MOST_ARROWS, MOST_CAMERAS, coverage_picture, residuals_picture
from reports.calibration_labels import label_points
from reports.plot_style import (
    BLUE,
    DASHED,
    GREEN,
    HALF,
    HEAT,
    INK,
    MUTED,
    ORANGE,
    SKY,
    VERMILION,
    WIDE,
    Picture,
    canvas,
    colour_bar,
    house_style,
    strided,
    svg_text,
)
from reports.units import figure as number

BOTH_SIGNS = LinearSegmentedColormap.from_list("both signs", [VERMILION, "#f2f3f5", BLUE])


def calibration_pictures(calibration: Calibration, evidence: CalibrationEvidence) -> list[Picture]:
    """Return the page's pictures."""
    with house_style():
        return list(_pictures(calibration, evidence))


def _pictures(calibration: Calibration, evidence: CalibrationEvidence) -> Iterator[Picture]:
    yield residuals_picture(calibration)
    yield coverage_picture(calibration, evidence)
    yield rig_picture(calibration, evidence)
    if evidence.accuracy is not None:
        yield accuracy_picture(evidence.accuracy)
    if evidence.lengths is not None and len(evidence.lengths.length_m):
        yield lengths_picture(evidence.lengths)
    if len(calibration.parameters):
        yield correlation_picture(calibration)


def rig_picture(calibration: Calibration, evidence: CalibrationEvidence) -> Picture:
    """Draw cameras and target points in plan and from the side, and the number of points that cameras share."""
    rig = calibration.rig
    points = calibration.points_in_world()[calibration.used]
    points = points[strided(len(points), 4 * MOST_ARROWS)]
    centres = np.array([camera.world_from_camera.translation for camera in rig.cameras])
    axes_z = np.array([camera.world_from_camera.rotation[:, 2] for camera in rig.cameras])
    everything = np.vstack([points, centres])
    spread = max(float(np.ptp(everything, axis=0).max()), 1e-6)
    drawing = canvas(WIDE, 4.3)
    most = max(int(evidence.links.max(initial=0)), 1)
    for column, (title, h, v) in enumerate((("Plan", 0, 1), ("Side", 0, 2))):
        axes = drawing.add_axes((0.06 + 0.49 * column, 0.11, 0.43, 0.8))
        axes.set_aspect("equal", adjustable="datalim")
        axes.scatter(points[:, h], points[:, v], s=2, color=GREEN, alpha=0.5, linewidths=0)
        for i, j in itertools.combinations(range(len(centres)), 2):
            if evidence.links[i, j]:
                share = evidence.links[i, j] / most
                axes.plot(
                    centres[[i, j], h],
                    centres[[i, j], v],
                    color=SKY,
                    linewidth=0.5 + 2.5 * share,
                    alpha=0.55,
                    zorder=1,
                )
        for i, j in evidence.missing:
            axes.plot(centres[[i, j], h], centres[[i, j], v], color=VERMILION, linewidth=1.4, linestyle=DASHED)
        reach = 0.08 * spread * axes_z
        axes.quiver(
            centres[:, h], centres[:, v], reach[:, h], reach[:, v], angles="xy", scale_units="xy", scale=1, color=INK,
            width=0.004, zorder=3,
        )  # fmt: skip
        axes.scatter(centres[:, h], centres[:, v], s=26, color=INK, zorder=4, linewidths=0)
        axes.margins(0.08)
        label_points(axes, centres[:, [h, v]], rig.names)
        axes.set_title(title)
        axes.set_xlabel(f"{'xyz'[h]} [m]")
        axes.set_ylabel(f"{'xyz'[v]} [m]")
    groups = len(np.unique(evidence.groups))
    caption = (
        "Cameras (black, pointing where they look), target points (green), cameras joined by common points "
        "(blue, the "
        f"thicker the more; at most {number(most)})."
    )
    if groups > 1:
        caption += (
            f" {groups} groups see nothing in common: the dashed red links are missing, show the target where the "
            "cameras at their ends both see it."
        )
    alt = f"Rig of {len(rig.cameras)} cameras in plan and from the side, {groups} group{'' if groups == 1 else 's'}."
    return Picture("rig", "The rig and its links", caption, alt, svg_text(drawing, "rig", alt))


def accuracy_picture(grid: AccuracyGrid) -> Picture:
    """Draw the predicted standard deviation in the middle planes of the volume."""
    sigma = 1e3 * grid.sigma_m
    x, y, z = (np.asarray(axis) for axis in (grid.x, grid.y, grid.z))
    at = [len(axis) // 2 for axis in (x, y, z)]
    slices = (
        (f"Plan, z = {_place(z[at[2]])} m", sigma[:, :, at[2]], (x, y), "xy"),
        (f"Front, y = {_place(y[at[1]])} m", sigma[:, at[1], :], (x, z), "xz"),
        (f"Side, x = {_place(x[at[0]])} m", sigma[at[0], :, :], (y, z), "yz"),
    )
    finite = sigma[np.isfinite(sigma)]
    low, high = (float(v) for v in np.percentile(finite, (1, 98))) if len(finite) else (0.0, 1.0)
    high = high if high > low else low + 1e-9
    drawing = canvas(WIDE, 3.3)
    for column, (title, values, (h, v), names) in enumerate(slices):
        axes = drawing.add_axes((0.055 + 0.303 * column, 0.14, 0.245, 0.74))
        half_h, half_v = (0.5 * (axis[-1] - axis[0]) / max(len(axis) - 1, 1) for axis in (h, v))
        axes.imshow(
            HEAT(np.clip((values.T - low) / (high - low), 0, 1), alpha=np.isfinite(values.T).astype(float)),
            extent=(h[0] - half_h, h[-1] + half_h, v[0] - half_v, v[-1] + half_v),
            origin="lower", interpolation="none", aspect="equal", zorder=2,
        )  # fmt: skip
        axes.set_anchor("N")
        axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.set_title(title)
        axes.set_xlabel(f"{names[0]} [m]")
        axes.set_ylabel(f"{names[1]} [m]", labelpad=1)
    colour_bar(drawing, low, high, "mm")
    nothing = float(np.mean(~np.isfinite(sigma)))
    parts = [1e3 * float(np.nanmedian(part)) if len(finite) else float("nan")
             for part in (grid.detection_m, grid.calibration_m)]  # fmt: skip
    caption = (
        "Predicted standard deviation in space of a point measured in every camera that looks there: "
        f"{number(parts[0])} "
        f"mm from detection ({number(grid.detection_sigma_px)} px an axis) and {number(parts[1])} mm from the "
        "calibration, "
        "which does not average out (medians). "
    )
    caption += f"{number(round(100 * nothing))} % of the volume is seen by fewer than two cameras." if nothing else ""
    middle = number(float(np.median(finite))) if len(finite) else "–"
    alt = f"Predicted accuracy in three planes of the volume: median {middle} mm."
    return Picture("accuracy", "How well it measures where", caption.strip(), alt, svg_text(drawing, "accuracy", alt))


def lengths_picture(lengths: HeldOutLengths) -> Picture:
    """Draw the errors of lengths that the calibration did not use."""
    error, sigma = 1e3 * (lengths.length_m - lengths.true_m), 1e3 * lengths.sigma_m
    keep = strided(len(error), MOST_ARROWS)
    drawing = canvas(HALF, 3.3)
    axes = drawing.add_axes((0.15, 0.135, 0.83, 0.77))
    at = np.arange(len(error))
    axes.errorbar(at[keep], error[keep], sigma[keep], fmt="none", ecolor=SKY, elinewidth=0.8, zorder=2)
    axes.scatter(at[keep], error[keep], s=7, color=BLUE, linewidths=0, zorder=3)
    mean, common = 1e3 * lengths.scale_error * lengths.true_m, 1e3 * lengths.scale_sigma * lengths.true_m
    axes.axhline(0, color=MUTED, linewidth=0.8)
    axes.axhline(mean, color=ORANGE, linewidth=1.4)
    axes.fill_between([-0.5, len(error) - 0.5], mean - common, mean + common, color=ORANGE, alpha=0.2, linewidth=0)
    axes.set_xlim(-0.5, len(error) - 0.5)
    axes.set_xlabel("picture")
    axes.set_ylabel("measured less true [mm]")
    rms = float(np.sqrt(np.mean(error**2)))
    caption = (
        f"{len(error)} lengths of {number(lengths.true_m)} m that took no part: {number(rms)} mm rms; scale "
        f"{100 * lengths.scale_error:+.4f} % ± {100 * lengths.scale_sigma:.4f} % (orange)."
    ).replace("-", "−")
    alt = f"Errors of {len(error)} held-out lengths: {number(rms)} mm rms."
    return Picture("lengths", "Held-out lengths", caption, alt, svg_text(drawing, "lengths", alt), wide=False)


def correlation_picture(calibration: Calibration) -> Picture:
    """Draw the correlations of each camera's own parameters."""
    root = np.sqrt(np.maximum(np.diag(calibration.covariance), 1e-300))
    every = np.clip(calibration.covariance / np.outer(root, root), -1, 1)
    own = [
        [k for k, name in enumerate(calibration.parameters) if name.rpartition(".")[0] == camera]
        for camera in calibration.rig.names
    ]
    shown = [k for k, mine in enumerate(own) if len(mine) > 1][:MOST_CAMERAS] or [0]
    across = min(ACROSS, len(shown))
    lines = -(-len(shown) // across)
    side = (WIDE - 0.5) / ACROSS - 0.8
    drawing = canvas(WIDE if across > 1 else HALF, lines * (side + 1.15) + 0.1)
    width, height = drawing.get_size_inches()
    strongest = 0.0
    for place, k in enumerate(shown):
        row, column = divmod(place, across)
        left, bottom = 0.75 + column * (side + 0.8), height - (row + 1) * (side + 1.15) + 0.8
        axes = drawing.add_axes((left / width, bottom / height, side / width, side / height))
        block = every[np.ix_(own[k], own[k])]
        off = block[~np.eye(len(block), dtype=bool)]
        strongest = max(strongest, float(np.abs(off).max(initial=0.0)))
        axes.imshow(BOTH_SIGNS((block + 1) / 2), interpolation="none", zorder=2)
        axes.grid(False)
        names = [
            calibration.parameters[i].rpartition(".")[2].rsplit("_", 1)[0].replace("turn_", "turn ") for i in own[k]
        ]
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=6.5)
        axes.set_yticks(range(len(names)), names, fontsize=6.5)
        axes.set_title(calibration.rig.names[k])
    _colour_bar_signed(drawing)
    caption = (
        "Correlations of each camera's parameters, −1 (red) to +1 (blue); the strongest is "
        f"{number(round(strongest, 4))}. "
        "Principal point and turn always look alike; a principal distance that looks like the distance (X, Y, Z) "
        "needs "
        "a target with more depth."
    )
    alt = f"Correlation matrices of {len(shown)} cameras; the strongest correlation is {number(round(strongest, 3))}."
    return Picture(
        "correlation",
        "What looks alike to the images",
        caption,
        alt,
        svg_text(drawing, "correlation", alt),
        across > 1,
    )


def _colour_bar_signed(drawing: Figure) -> None:
    width, height = drawing.get_size_inches()
    bar = drawing.add_axes(((width - 0.55) / width, (height - 1.75) / height, 0.1 / width, 1.4 / height))
    bar.imshow(
        BOTH_SIGNS(np.linspace(0, 1, 64))[:, None], extent=(0, 1, -1, 1), origin="lower", aspect="auto",
        interpolation="none",
    )  # fmt: skip
    bar.grid(False)
    bar.set_xticks([])
    bar.yaxis.tick_right()


def _place(value_m: float) -> str:
    """Return a coordinate to the millimetre."""
    return f"{value_m + 0.0:.3f}".replace("-0.000", "0.000").replace("-", "−")
