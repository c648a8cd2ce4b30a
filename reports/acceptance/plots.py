"""Picture of an acceptance test: each length's error with its expanded uncertainty, and the permitted error."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from reports.plot_style import BLUE, DOTTED, INK, VERMILION, Picture, canvas, house_style, legend_above, svg_text

WIDE = 9.6


def acceptance_pictures(document: Mapping[str, Any]) -> list[Picture]:
    """Return the pictures of a result; none where no length was measured."""
    lengths = document["lengths"]
    measured = [] if lengths is None else [one for one in lengths["errors"] if one["error_m"] is not None]
    if not measured:
        return []
    with house_style():
        return [_errors(measured, document["limits"]["length_error"])]


def _errors(measured: list[Mapping[str, Any]], limits: Mapping[str, float]) -> Picture:
    drawing = canvas(WIDE, 3.2)
    axes = drawing.add_axes((0.08, 0.16, 0.9, 0.7))
    longest = max(one["calibrated_m"] for one in measured)
    along = np.linspace(0.0, 1.05 * longest, 50)
    permitted = 1e3 * np.minimum(limits["A_m"] + limits["K"] * along, limits["B_m"])
    for sign in (1, -1):
        axes.plot(along, sign * permitted, color=INK, ls=DOTTED, label="permitted" if sign == 1 else None)
    lines = list(dict.fromkeys(one["line"] for one in measured))
    step = 0.004 * longest
    for kind, colour in (("conforming", BLUE), ("other", VERMILION)):
        mine = [one for one in measured if (one["decided"]["decision"] == "conforming") == (kind == "conforming")]
        if mine:
            # measuring lines are shifted, or all bars of one length would overlap
            at = [one["calibrated_m"] + step * (lines.index(one["line"]) - len(lines) / 2) for one in mine]
            axes.errorbar(
                at, [1e3 * one["error_m"] for one in mine], [2e3 * one["sigma_m"] for one in mine],
                fmt="o", ms=3, lw=0.9, color=colour, label=kind if kind == "conforming" else "not, or undecided",
            )  # fmt: skip
    axes.set_xlabel("calibrated length [m]")
    axes.set_ylabel("measured - calibrated [mm]")
    legend_above(axes)
    alt = f"errors of {len(measured)} lengths on {len(lines)} lines, and what is permitted"
    caption = "Error of each length with its expanded uncertainty (k = 2); those of one length stand side by side."
    return Picture("lengths", "Length errors", caption, alt, svg_text(drawing, "lengths", alt), wide=True)
