"""Pictures of a claim: the estimate over the interim looks, and the values of the runs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from reports.claim.words import claim_words, scale
from reports.plot_style import (
    BLUE,
    DOTTED,
    GREEN,
    HALF,
    INK,
    VERMILION,
    Picture,
    canvas,
    house_style,
    legend_above,
    svg_text,
)

MOST_BINS = 30


def claim_pictures(document: Mapping[str, Any]) -> list[Picture]:
    """Return the pictures of all claims of a result."""
    with house_style():
        return [
            picture
            for k, one in enumerate(document["claims"])
            for picture in (_looks(one, k, document["confidence"]), _values(document, one, k))
        ]


def _looks(one: Mapping[str, Any], number: int, confidence: float) -> Picture:
    drawing = canvas(HALF, 2.9)
    axes = drawing.add_axes((0.15, 0.17, 0.82, 0.68))
    share = one["statistic"] == "quantile"
    factor, unit = (100.0, "%") if share else scale(one)
    looks = one["looks"]
    runs = [look["runs"] for look in looks]

    def line(key: str) -> list[float]:
        return [np.nan if look[key] is None else factor * look[key] for look in looks]

    axes.plot(runs, line("conforming"), color=GREEN, marker=".", lw=0.9, label="conforming beyond")
    axes.plot(runs, line("broken"), color=VERMILION, marker=".", lw=0.9, label="not conforming beyond")
    axes.plot(runs, line("estimate"), color=BLUE, marker="o", ms=3, label="found")
    if one["low"] is not None:
        axes.errorbar(
            runs[-1:], line("estimate")[-1:],
            [[max(0.0, factor * part)] for part in (one["estimate"] - one["low"], one["high"] - one["estimate"])],
            color=BLUE, capsize=3,
        )  # fmt: skip
    axes.axhline(factor * one["target"], color=INK, ls=DOTTED)
    axes.set_xlabel("runs")
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    axes.set_ylabel(f"{'share that keeps the limit' if share else one['metric']} [{unit or '1'}]")
    legend_above(axes)
    words = claim_words(one)
    alt = f"{words.claimed}: found {words.found}, {one['verdict']} after {one['runs']} runs"
    caption = (
        f"Found at each look, and from where on there would have been a verdict. Dotted: what is claimed. Bar: "
        f"{100 * confidence:.4g} % interval, which excludes the dotted line where there is a verdict."
    )
    return Picture(f"looks{number}", "Looks", caption, alt, svg_text(drawing, f"looks{number}", alt), wide=False)


def _values(document: Mapping[str, Any], one: Mapping[str, Any], number: int) -> Picture:
    factor, unit = scale(one)
    values = [
        run["metrics"][one["metric"]] * factor for run in document["each_run"] if one["metric"] in run["metrics"]
    ]
    drawing = canvas(HALF, 2.9)
    axes = drawing.add_axes((0.13, 0.17, 0.84, 0.74))
    if values:
        axes.hist(values, bins=min(MOST_BINS, max(5, round(2 * len(values) ** 0.5))), color=BLUE)
    limit = factor * one["limit"]
    axes.axvline(limit, color=INK, ls=DOTTED)
    axes.set_xlabel(f"{one['metric']} [{unit or '1'}]")
    axes.set_ylabel("runs")
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    gone = len(document["each_run"]) - len(values)
    alt = f"{one['metric']} of {len(values)} runs" + (f"; {gone} failed" if gone else "")
    caption = f"{alt[0].upper()}{alt[1:]}. Dotted: the limit."
    return Picture(f"values{number}", "Runs", caption, alt, svg_text(drawing, f"values{number}", alt), wide=False)
