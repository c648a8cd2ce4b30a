"""An acceptance test's figures in words and in the units that read best."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from reports.units import figure

STATISTICS = {"rms": "rms", "p997": "99.7th percentile", "max": "largest"}
QUANTITIES = {"distance": "error of the distance", "angle": "error of the angle"}
UNITS = {"distance": (1e3, "mm"), "angle": (1.0, "deg"), "frames": (100.0, "%")}
NOT_MEASURED = "not measured"


class FigureRow(NamedTuple):
    """One figure beside its expanded uncertainty and limit."""

    what: str
    found: str
    expanded: str
    limit: str
    probability: str
    decision: str
    key: float
    """Share of the limit, for sorting; 0 where there is no limit."""


def figure_rows(document: Mapping[str, Any], worst_only: bool = False) -> list[FigureRow]:
    """Return all figures with limits of a result; ``worst_only``: only the worst length of each measuring line."""
    lengths = [] if document["lengths"] is None else list(document["lengths"]["errors"])
    if worst_only:
        lines = dict.fromkeys(one["line"] for one in lengths)
        lengths = [max((one for one in lengths if one["line"] == line), key=_share) for line in lines]
    rows = [length_row(one) for one in lengths]
    if document["clusters"] is not None:
        rows += [cluster_row(one) for one in document["clusters"]["figures"]]
    spread = None if document["lengths"] is None else document["lengths"]["spread"]
    if spread is not None:
        limit = (document["limits"]["probing"] or {}).get("spread_m")
        rows.append(
            _row(
                "largest scatter of a point at rest", spread["largest_m"], _expanded(spread), limit, spread, 1e3, "mm"
            )
        )
    late = document["latency"]
    if late is not None:
        limit = (document["limits"]["latency"] or {}).get("p99_s")
        rows.append(_row("latency, 99th percentile", late["p99_s"], 2 * late["sigma_p99_s"], limit, late, 1e3, "ms"))
    return rows


def length_row(one: Mapping[str, Any]) -> FigureRow:
    """Return one test length of a result in words."""
    what = f"{one['line']}: {one['markers'][0]} to {one['markers'][1]}, {figure(1e3 * one['calibrated_m'])} mm"
    expanded = None if one["sigma_m"] is None else 2 * one["sigma_m"]
    return _row(what, one["error_m"], expanded, one["permitted_m"], one, 1e3, "mm")


def cluster_row(one: Mapping[str, Any]) -> FigureRow:
    """Return one statistic of two clusters in words."""
    factor, unit = UNITS[one["quantity"]]
    if one["statistic"] == "missing":
        what = f"{one['group']}: frames without both clusters"
    else:
        what = f"{one['group']}: {STATISTICS[one['statistic']]} {QUANTITIES[one['quantity']]}"
    expanded = None if one["sigma"] is None or one["statistic"] == "missing" else 2 * one["sigma"]
    return _row(what, one["value"], expanded, one["limit"], one, factor, unit)


def note_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the premises that are not met and the notes, one line each."""
    premises = [
        one for part in ("lengths", "clusters") if document[part] is not None for one in document[part]["premises"]
    ]
    return [f"not met: {one['text']}" for one in premises if not one["met"]] + list(document["notes"])


def _row(
    what: str,
    value: float | None,
    expanded: float | None,
    limit: float | None,
    one: Mapping[str, Any],
    factor: float,
    unit: str,
) -> FigureRow:
    def text(number: float | None, none: str) -> str:
        return none if number is None else f"{figure(float(f'{factor * number:.3g}'))} {unit}"

    judged = one["decided"]
    if judged is None:
        decision = "undecided" if limit is not None else "no limit"
        probability = "–"
    else:
        decision, probability = judged["decision"], _percent(judged["probability"])
    share = abs(value) / limit if value is not None and limit else 0.0
    return FigureRow(
        what, text(value, NOT_MEASURED), text(expanded, "–"), text(limit, "none"), probability, decision, share
    )


def _percent(probability: float) -> str:
    if 0.0005 < probability < 0.9995:
        return f"{100 * probability:.1f} %"
    return "> 99.9 %" if probability > 0.5 else "< 0.1 %"


def _expanded(one: Mapping[str, Any]) -> float | None:
    return None if one["decided"] is None else one["decided"]["expanded"]


def _share(one: Mapping[str, Any]) -> float:
    return float("inf") if one["error_m"] is None else abs(one["error_m"]) / one["permitted_m"]
