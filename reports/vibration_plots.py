"""Spectra of a vibration with its modes and noise floor, and the shapes of its modes."""

import numpy as np

from reports.plot_style import (
    BLUE,
    DASHED,
    DOTTED,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    WIDE,
    Picture,
    canvas,
    house_style,
    svg_text,
)
from reports.vibration_evidence import VibrationEvidence

_MOST_SHAPES = 6


def spectra_picture(one: VibrationEvidence) -> Picture:
    """Draw density, singular values, measured and expected noise floor, and the frequencies of the modes."""
    with house_style():
        drawing = canvas(WIDE, 3.6)
        axes = drawing.add_axes((0.075, 0.13, 0.91, 0.78))
        f = one.frequency_hz[1:]
        um = 1e12
        for k in range(one.largest.shape[1]):
            axes.semilogy(f, um * one.largest[1:, k], color=(BLUE, ORANGE, GREEN)[k % 3], linewidth=0.8)
        axes.semilogy(f, um * one.density[1:], color=INK, linewidth=1.1)
        axes.axhline(um * one.floor_m2_per_hz, color=MUTED, linestyle=DASHED)
        if np.isfinite(one.expected_m2_per_hz):
            axes.axhline(um * one.expected_m2_per_hz, color=MUTED, linestyle=DOTTED)
        top = um * float(one.largest[1:].max())
        for hz, line in zip(one.modes_hz, one.lines, strict=True):
            axes.axvline(hz, color=MUTED, linewidth=0.5)
            axes.text(hz, 1.3 * top, f"{hz:.2f}" + (" line" if line else ""), ha="center", fontsize=7, color=INK)
        axes.axvspan(0.4 * one.rate_hz, 0.5 * one.rate_hz, color=MUTED, alpha=0.12, linewidth=0)
        axes.set_xlim(0, 0.5 * one.rate_hz)
        axes.set_ylim(0.2 * um * one.floor_m2_per_hz, 3 * top)
        axes.set_xlabel("frequency [Hz]")
        axes.set_ylabel("density [um^2/Hz]")
        named = ", ".join(f"{hz:.2f}" for hz in one.modes_hz) or "none"
        low, high = one.interval95
        caption = (
            "Black: mean over the targets; colours: largest singular values of the cross spectra; modes [Hz] on "
            "top. Dashed: noise floor as measured, dotted: as the tracks' covariances state it. 95 % interval of a "
            f"density: {low:.2f} to {high:.2f} times the value. Shaded: above 0.4 of the frame rate."
        )
        alt = f"Spectra of displacement up to {0.5 * one.rate_hz:.4g} Hz with modes at {named} Hz."
        return Picture("vibration_spectra", "Spectra of vibration", caption, alt, svg_text(drawing, "spectra", alt))


def shapes_picture(one: VibrationEvidence) -> Picture:
    """Draw the shapes of the lowest modes: targets at their positions, with deflection as size and colour."""
    count = min(len(one.modes_hz), _MOST_SHAPES)
    if not count:
        raise ValueError("shapes: no mode to draw")
    plane = np.linalg.svd(one.place - one.place.mean(axis=0), full_matrices=False)[2][:2]
    xy = (one.place - one.place.mean(axis=0)) @ plane.T
    with house_style():
        drawing = canvas(WIDE, 1.9)
        for k in range(count):
            axes = drawing.add_axes((0.01 + 0.98 * k / count, 0.02, 0.98 / count - 0.01, 0.8))
            shape = one.shapes[k]
            colours = [ORANGE if value > 0 else BLUE for value in shape]
            axes.scatter(xy[:, 0], xy[:, 1], s=4 + 70 * np.abs(shape), c=colours, linewidths=0)
            axes.set_title(f"{one.modes_hz[k]:.2f} Hz", fontsize=8, pad=3)
            axes.set_aspect("equal")
            axes.margins(0.15)
            axes.axis("off")
        caption = "Area: size of the deflection; orange up, blue down. Targets in their plane."
        alt = f"Shapes of {count} modes at {', '.join(f'{hz:.2f}' for hz in one.modes_hz[:count])} Hz."
        return Picture("mode_shapes", "Mode shapes", caption, alt, svg_text(drawing, "shapes", alt))
