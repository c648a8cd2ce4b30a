"""Errors of virtual objects over time, with and without prediction, and the age of their measurements."""

import numpy as np

from reports.plot_style import BLUE, DASHED, MUTED, ORANGE, VERMILION, WIDE, Picture, canvas, house_style, svg_text
from reports.virtual_evidence import VirtualEvidence


def objects_picture(one: VirtualEvidence) -> Picture:
    """Draw each object's error at its display, that without prediction, the stated one, and the ages."""
    with house_style():
        drawing = canvas(WIDE, 3.4)
        axes = drawing.add_axes((0.075, 0.15, 0.6, 0.75))
        error, late = 1e3 * one.error_m, 1e3 * one.unpredicted_m
        axes.semilogy(one.time_s, late, ".", color=ORANGE, markersize=2.5, label="newest pose as measured")
        axes.semilogy(one.time_s, error, ".", color=BLUE, markersize=2.5, label="predicted to the display")
        axes.semilogy(one.time_s, 1e3 * one.stated_m, color=MUTED, linestyle=DASHED, linewidth=0.8, label="stated")
        if one.unknown.any():
            axes.semilogy(
                one.time_s[one.unknown],
                error[one.unknown],
                "x",
                color=VERMILION,
                markersize=4,
                label="starting, or stale",
            )
        axes.set_xlabel("time [s]")
        axes.set_ylabel("distance from the body [mm]")
        axes.legend(loc="lower right", fontsize=7)
        ages = drawing.add_axes((0.75, 0.15, 0.235, 0.75))
        share, edges = np.histogram(1e3 * one.age_s, bins=min(40, max(5, len(one.age_s) // 10)))
        ages.stairs(100 * share / max(len(one.age_s), 1), edges, fill=True, color=BLUE, alpha=0.35)
        ages.set_xlabel("exposure to display [ms]")
        ages.set_ylabel("share [%]")
        rms, without = (float(np.sqrt(np.nanmean(values[~one.unknown] ** 2))) for values in (error, late))
        p50, p99 = 1e3 * np.quantile(one.age_s, [0.5, 0.99])
        caption = (
            f"Objects are {rms:.3g} mm rms off where their bodies are when they are shown; the newest pose as "
            f"measured would be {without:.3g} mm off. Dashed: the error that the stated covariance lets expect. "
            f"Right: from the middle of the newest exposure to the display, median {p50:.1f} ms, 99 % {p99:.1f} ms."
        )
        alt = f"Errors of virtual objects over time: {rms:.3g} mm rms predicted, {without:.3g} mm unpredicted."
        return Picture("virtual_objects", "Virtual objects", caption, alt, svg_text(drawing, "objects", alt))
