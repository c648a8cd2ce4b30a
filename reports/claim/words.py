"""A claim and its result in words, in the unit that reads best."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from reports.units import figure, shown

STATISTICS = {"mean": "mean of {metric}", "rms": "rms of {metric}"}


class ClaimWords(NamedTuple):
    """The words of one claim."""

    claimed: str
    found: str
    interval: str
    guard_band: str


def claim_words(one: Mapping[str, Any]) -> ClaimWords:
    """Return one entry of a result's ``claims`` in words."""
    sign = "≤" if one["sense"] == "at_most" else "≥"
    limit = value_text(one, one["limit"])
    if one["statistic"] == "quantile":
        wanted = f"{figure(100 * one['quantile'])} %"
        ends = [None if one[key] is None else 100 * one[key] for key in ("estimate", "low", "high", "guard_band")]
        texts = ["–" if end is None else f"{figure(float(f'{end:.4g}'))}" for end in ends]
        return ClaimWords(
            f"{one['metric']} {sign} {limit} in {wanted} of the runs",
            f"{texts[0]} %",
            f"{texts[1]} … {texts[2]} %",
            "none yet" if ends[3] is None else f"{texts[3]} %",
        )
    low, high = (value_text(one, one[key]) for key in ("low", "high"))
    return ClaimWords(
        f"{STATISTICS[one['statistic']].format(metric=one['metric'])} {sign} {limit}",
        value_text(one, one["estimate"]),
        "–" if one["low"] is None else f"{low} … {high}",
        "none yet" if one["guard_band"] is None else value_text(one, one["guard_band"]),
    )


def scale(one: Mapping[str, Any]) -> tuple[float, str]:
    """Return the factor to the unit in which a claim's metric is shown, and the unit."""
    (factor,), unit = shown((one["limit"] or 1.0,), one["unit"], one["metric"])
    return factor / (one["limit"] or 1.0), unit


def value_text(one: Mapping[str, Any], value: float | None) -> str:
    """Return a value of a claim's metric in the unit of its limit."""
    if value is None:
        return "–"
    factor, unit = scale(one)
    return f"{figure(float(f'{value * factor:.4g}'))} {unit}".rstrip()
