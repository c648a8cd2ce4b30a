"""The picture of an error budget: bars that step from the remainder to the total, with intervals."""

import numpy as np

from reports.budget import ErrorBudget
from reports.plot_style import BLUE, INK, MUTED, ORANGE, WIDE, Picture, canvas, house_style, svg_text


def error_budget_picture(budget: ErrorBudget) -> Picture:
    """Draw a waterfall: each source's bar begins where the last one ended; whiskers are 95 % intervals."""
    rows = budget.contributions
    names = [*(one.told for one in rows), "remainder", "together"]
    squares = np.array([*(one.square for one in rows), budget.remainder])
    starts = np.concatenate([[0.0], np.cumsum(squares)[:-1]])
    place = np.arange(len(names))
    with house_style():
        drawing = canvas(WIDE, 0.75 + 0.26 * len(names))
        bottom = 0.5 / (0.75 + 0.26 * len(names))
        axes = drawing.add_axes((0.36, bottom, 0.6, 0.97 - bottom))
        colours = [*(BLUE if one >= 0 else ORANGE for one in squares[:-1]), MUTED]
        axes.barh(place[:-1], squares, left=starts, color=colours, height=0.6)
        axes.barh(place[-1:], [budget.total], color=INK, height=0.6)
        intervals = [*(one.ci95 for one in rows), budget.remainder_ci95, budget.total_ci95]
        for k, (low, high) in enumerate(intervals):
            start = starts[k] if k < len(starts) else 0.0
            axes.plot([start + low, start + high], [k, k], color=INK, linewidth=0.8, marker="|", markersize=5)
        axes.axvline(0.0, color=INK, linewidth=0.6)
        axes.set_yticks(place, names)
        axes.invert_yaxis()
        axes.set_xlabel(f"mean square [{budget.unit}]")
        caption = (
            f"What each source adds to the mean square of {budget.metric} (Shapley values; whiskers: 95 % over "
            f"{len(budget.seeds)} seeds and {budget.blocks} blocks of the take). Orange: errors are smaller with it. "
            "Remainder: what is left with all of them off."
        )
        alt = "Error budget: " + ", ".join(f"{one.told} {100 * budget.share(one.square):.1f} %" for one in rows)
        return Picture("budget", "Error budget", caption, alt, svg_text(drawing, "waterfall", alt))
