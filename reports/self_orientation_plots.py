"""Errors over time of a camera's own poses and of those by a rig, and the error budget of their difference."""

import numpy as np

from reports.plot_style import BLUE, INK, MUTED, ORANGE, WIDE, Picture, canvas, house_style, svg_text
from reports.self_orientation_evidence import SelfOrientationEvidence

NAMES = ("X [mm]", "Y [mm]", "Z [mm]", "omega [deg]", "alpha [deg]", "kappa [deg]")


def errors_picture(one: SelfOrientationEvidence) -> Picture:
    """Draw both sides' errors over time with two stated standard deviations to either side."""
    scale = np.array([1e3] * 3 + [180 / np.pi] * 3)
    with house_style():
        drawing = canvas(WIDE, 4.4)
        for k, name in enumerate(NAMES):
            column, row = k // 3, k % 3
            axes = drawing.add_axes((0.075 + 0.5 * column, 0.72 - 0.31 * row, 0.41, 0.24))
            for errors, sigma, colour in (
                (one.own_errors, one.own_sigma, BLUE), (one.rig_errors, one.rig_sigma, ORANGE)
            ):  # fmt: skip
                value, width = scale[k] * errors[:, k], 2 * scale[k] * sigma[:, k]
                axes.fill_between(one.time_s, -width, width, color=colour, alpha=0.15, linewidth=0)
                axes.plot(one.time_s, value, color=colour, linewidth=0.9)
            axes.axhline(0.0, color=MUTED, linewidth=0.5)
            axes.set_title(name, fontsize=7.5, pad=3)
        drawing.text(0.5, 0.015, "time [s]", ha="center", color=MUTED)
        rms = [1e3 * float(np.sqrt(np.mean(np.sum(e[:, :3] ** 2, axis=1)))) for e in (one.own_errors, one.rig_errors)]
        caption = (
            "Measured minus true pose of the camera in the test field's frame. Blue: its own, by resection; orange: "
            "the rig's. Bands: two stated standard deviations, lasting errors included."
        )
        alt = f"Errors over time: own poses {rms[0]:.2f} mm rms, the rig's {rms[1]:.2f} mm rms."
        return Picture(
            "self_orientation", "Both sides against the truth", caption, alt, svg_text(drawing, "selforient", alt)
        )


def budget_picture(one: SelfOrientationEvidence) -> Picture:
    """Draw each source's share of the squared difference in position."""
    names = sorted(one.shares, key=lambda name: one.shares[name])
    values = [100 * one.shares[name] for name in names]
    with house_style():
        drawing = canvas(WIDE, 0.55 + 0.24 * len(names))
        axes = drawing.add_axes((0.33, 0.16, 0.64, 0.8))
        axes.barh(range(len(names)), values, color=BLUE, height=0.6)
        axes.axvline(0.0, color=INK, linewidth=0.6)
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel("share of the squared difference [%]")
        total = sum(values)
        caption = (
            "Each source switched off alone, with the same images: how much of the squared difference between both "
            f"sides goes with it. Together {total:.1f} %; one that opposes the others has a negative share."
        )
        alt = "Error budget: " + ", ".join(
            f"{name} {value:.1f} %" for name, value in zip(reversed(names), reversed(values), strict=True)
        )
        return Picture("error_budget", "Error budget", caption, alt, svg_text(drawing, "budget", alt))
