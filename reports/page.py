"""The page of a run: one self-contained HTML file that opens offline."""

import json
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mosca.data.files.whole_file import write_text
from reports.budget import HEADINGS, ErrorBudget, budget_rows, budget_words
from reports.budget_plot import error_budget_picture
from reports.error_tables import Cell, marker_table, number_cell
from reports.evidence import Evidence
from reports.glossary import COLUMNS, term
from reports.margins import NEAR, budget_wanted, near_limits, share_of_limit
from reports.playback.data import played
from reports.playback.player import SCRIPTS, camera_cells, player
from reports.plots import limit_mm, pictures
from reports.record import Metric, RunRecord
from reports.units import duration, figure, shown

TILES = {
    "position_rms": "Position error, rms",
    "relative_accuracy": "Of the working space",
    "completeness": "Completeness",
    "ghosts_per_frame": "Ghosts per frame",
    "length_rms": "Certified length, rms",
    "static_noise": "Scatter at rest, rms",
    "reprojection_rms": "Reprojection residual, rms",
    "frame_rate": "Speed",
}
"""The headline figures of a page and their names there."""
OF_EVERY_RUN = ("sets_complete", "frames_complete")
"""Limits that every run has."""
ERRORS = ("_rms", "relative_accuracy")
"""Ends of the names of metrics that are errors."""
MOST_TILES = 4


def write_page(path: Path, record: RunRecord, evidence: Evidence, squares: ErrorBudget | None = None) -> None:
    """Write the page of one run to ``path``, whole or not at all; ``squares``: the error budget of its scenario.

    The same record and evidence give the same bytes (timings are part of the record). Nothing is loaded
    from outside: pictures are inline SVG, and the library of the player is in the page.
    """
    shown = played(evidence)
    of_cameras = {} if shown is None else camera_cells(evidence, shown)
    write_rendered(
        path,
        "template.html.j2",
        record=record,
        badge=badge(record),
        sentence=sentence(record),
        tiles=_tiles(record),
        changed=_changed(record),
        near=near_limits(record, evidence),
        squares=_squares(record, squares),
        metrics=[
            *(_metric_row(metric) for metric in record.metrics),
            *(_not_judged_row(name) for name in record.not_judged),
        ],
        columns=COLUMNS,
        markers=marker_table(evidence),
        premises=[_premise_row(name, value) for name, value in record.premises.items()],
        pictures=pictures(record, evidence),
        player=None if shown is None else player(evidence, shown, limit_mm(record, "position_rms")),
        scripts=SCRIPTS,
        joints=[_joint_row(name, one) for name, one in record.joints.items()],
        modes=[_mode_row(name, one) for name, one in record.modes.items()],
        orientation=[row for name, one in record.self_orientation.items() for row in _orientation_rows(name, one)],
        budget=[_budget_row(name, one) for name, one in record.error_budget.items()],
        enough=[
            (one["what"], *(f"{one[key]:.3g} {one['unit']}" for key in ("depth", "height")))
            for one in record.enough_alone.values()
        ],
        counts=[(_words(name), _plain(value)) for name, value in {**record.counts, **record.source_account}.items()],
        cameras=[
            {
                "name": name,
                "cells": (
                    *_camera_cells(one, record.counts.get("expected_sets")),
                    *of_cameras.get(name, (number_cell(None),) * 4),
                ),
            }
            for name, one in record.cameras.items()
            if "residual_px" in one
        ],
        sensors=[_sensor_row(name, one["sensor"]) for name, one in record.cameras.items() if one.get("sensor")],
        free_cameras=[
            (name, f"{one['arrived']} of {one['expected']}", str(one["unusable"]), f"{one['span_s']:.2f} s")
            for name, one in record.cameras.items()
            if "arrived" in one
        ],
        timings=[(_words(name), duration(float(value))) for name, value in record.timings.items()],
        provenance=json.dumps(record.provenance, indent=2, default=str, ensure_ascii=False),
    )


def _squares(record: RunRecord, made: ErrorBudget | None) -> dict[str, Any] | None:
    """Return the scenario's error budget for the page, or the command that makes it; None far from the limits."""
    metric = budget_wanted(record)
    if metric is None:
        return None
    changed = [(key, pair[1]) for key, pair in record.provenance.get("changed", {}).items() if key != "seed"]
    sets = "".join(f" --set {shlex.quote(f'{key}={json.dumps(value)}')}" for key, value in changed)
    command = f"mosca budget {record.scenario} --metric {metric}{sets}"
    if made is None:
        return {"metric": metric, "command": command, "rows": None}
    picture = error_budget_picture(made)
    return {"metric": metric, "rows": budget_rows(made), "headings": HEADINGS, "words": budget_words(made),
            "svg": Markup(picture.svg), "caption": picture.caption}  # fmt: skip


def _camera_cells(one: Mapping[str, Any], expected: int | None) -> tuple[Cell, ...]:
    """Return cells of a camera: residual, extra error, connected, frames out of all, clock offset."""
    late, sigma = one.get("late_s"), one.get("late_sigma_s")
    clock = Cell("not known", "")
    if late is not None and sigma is not None:
        clock = Cell(f"{1e3 * late:+.3f} ± {2e3 * sigma:.3f} ms", late)
    frames = f"{100 * one['missing']:.1f} % missing" if expected is None else f"{one['delivered']} of {expected}"
    return (
        Cell(f"{one['residual_px']:.3f} px", one["residual_px"]),
        Cell(f"{one['extra_px']:.3f} px", one["extra_px"]),
        Cell(f"{100 * one['connected']:.1f} %", one["connected"]),
        Cell(frames, -one["missing"] if expected is None else one["delivered"]),
        clock,
    )


def _joint_row(name: str, one: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a row of the joints' table: name, centre, its NEES, rotation about x, y, z, its NEES, both found."""
    place, turn = one.get("center_rms_m"), one.get("angle_rms_rad")
    return (
        _words(name),
        "–" if place is None else f"{1e3 * place:.2f} mm",
        _plain(one.get("center_nees")),
        "–" if turn is None else ", ".join(f"{math.degrees(value):.2f}" for value in turn) + " deg",
        _plain(one.get("angle_nees")),
        *(f"{100 * one[key]:.1f} %" if key in one else "–" for key in ("center_completeness", "angle_completeness")),
    )


def _mode_row(name: str, one: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a row of the modes' table: name, true frequency, error, its bound, true damping, error, bound, MAC."""
    found = "mac" in one
    return (
        name,
        f"{one['true_hz']:.3f} Hz",
        f"{100 * one['frequency_error']:+.4f} %" if found else "not found",
        f"{100 * one['frequency_bound']:.4f} %",
        f"{100 * one['true_damping']:.3f} %",
        f"{100 * one['damping_error']:+.1f} %" if found else "–",
        f"{100 * one['damping_bound']:.1f} %",
        f"{one['mac']:.4f}" if found else "–",
    )


def _orientation_rows(name: str, one: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the rows, mean and rms, of one side's differences: name, X, Y, Z, omega, alpha, kappa, frames."""
    frames = "" if one.get("frames") is None else str(one["frames"])
    rows = []
    for what in ("mean", "rms"):
        values = one.get(what)
        if values is not None:
            place = (f"{1e3 * value:.2f} mm" for value in values[:3])
            # the paper states no unit of its angles
            unit = "" if one.get("rms") is None else " deg"
            turn = (f"{value if not unit else math.degrees(value):.4f}{unit}" for value in values[3:])
            rows.append((f"{name}, {what}", *place, *turn, frames))
    return rows


def _budget_row(name: str, one: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a row of the error budget: name, shares, changes of the means of X, Y, Z."""
    shares = (f"{100 * one[key]:.1f} %" for key in ("position_share", "angle_share"))
    return (name, *shares, *(f"{1e3 * value:+.2f} mm" for value in one["mean"][:3]))


def _sensor_row(name: str, one: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a row of the sensors' table: name, noise, gain, blur, saturation, images, targets left out."""
    stated = one["stated"] or {}
    left_out = [f"{n} {reason}" for reason, n in one["left_out"].items() if n]
    most = "saturates at" if one["saturation_dn"] is not None else "largest"
    return (
        name,
        _interval(one["noise_dn"], stated.get("noise_dn")),
        _interval(one["gain_dn_per_e"], stated.get("gain_dn_per_e")),
        _interval(one["blur_px"]),
        f"{one['bits']} bits, {most} {one['largest_dn']}",
        f"{one['images']} images, {one['targets']} targets",
        f"{one['found']} found" + (f"; left out: {', '.join(left_out)}" if left_out else ""),
    )


def _interval(estimate: Sequence[float] | None, stated: float | None = None) -> str:
    """Return value, 95 % interval and stated value in words; an upper bound where the interval begins at zero."""
    if estimate is None:
        return "not learned"
    value, low, high = estimate
    text = f"below {high:.3g}" if low == 0.0 else f"{value:.3g} ({low:.3g} to {high:.3g})"
    return text if stated is None else f"{text}, stated {stated:.3g}"


def badge(record: RunRecord) -> dict[str, str]:
    """Return text, sign and tone of the record's verdict."""
    if record.passed and record.expect in ("fail", "caught"):
        return {"text": "Fails as it must", "sign": "✓", "tone": "good"}
    if record.expect == "diagnosed":
        return (
            {"text": "Diagnosed", "sign": "✓", "tone": "good"}
            if record.passed
            else {"text": "Not diagnosed", "sign": "✗", "tone": "bad"}
        )
    if record.not_judged and not any(metric.passed is False for metric in record.metrics):
        return {"text": "Not judged", "sign": "–", "tone": ""}
    if record.passed and all(metric.limit is None for metric in record.metrics):
        return {"text": "Nothing claimed", "sign": "–", "tone": ""}
    if record.passed:
        return {"text": "Claim holds", "sign": "✓", "tone": "good"}
    if record.expect in ("fail", "caught"):
        return {"text": "Control broken" if record.expect == "fail" else "Not caught", "sign": "✗", "tone": "bad"}
    return {"text": "Claim broken", "sign": "✗", "tone": "bad"}


def sentence(record: RunRecord) -> str:
    """Return the claim and the result in words."""
    found = []
    rms, relative = record.metric("position_rms"), record.metric("relative_accuracy")
    if rms is not None:
        found.append(f"positions are right to {_with_unit(rms)} rms")
    if relative is not None:
        found.append(f"{_with_unit(relative)} of the working space")
    complete = record.metric("completeness")
    if complete is not None:
        found.append(f"{_with_unit(complete)} of the visible markers are found")
    claims = [f"{_words(m.name)} {bound(m)}" for m in record.metrics if m.limit is not None]
    text = ""
    if claims:
        more = f" and {len(claims) - 3} more" if len(claims) > 3 else ""
        text = f"Claimed: {', '.join(claims[:3])}{more}. "
    residual = record.metric("reprojection_rms")
    if rms is None and residual is not None:
        found.append(f"rays meet to {_with_unit(residual)} rms")
    if found:
        text += f"Found: {', '.join(found)}. "
    return text + _ended(record.verdict)


def relative_address(target: Path, page: Path) -> str:
    """Return the address of a file or folder for a link on ``page``."""
    return quote(os.path.relpath(target, page.parent).replace(os.sep, "/"))


def write_rendered(path: Path, template: str, **values: Any) -> None:
    """Write a template of the pages, filled with ``values``, to ``path``, whole or not at all."""
    templates = Environment(
        loader=PackageLoader("reports", package_path=""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    if "scripts" in values:
        loader = templates.loader
        assert loader is not None
        # our own files, and the library as it was published
        values["scripts"] = {
            key: Markup(loader.get_source(templates, file)[0]) for key, file in values["scripts"].items()
        }
    write_text(path, templates.get_template(template).render(**values))


def _headlines(record: RunRecord) -> list[Metric]:
    """Return the metrics of the cards: those that are judged, errors first, then the rest of ``TILES``."""
    order = {name: k for k, name in enumerate(TILES)}
    judged = [
        metric for metric in record.metrics if metric.as_it_must is not None and metric.name not in OF_EVERY_RUN
    ]
    judged.sort(key=lambda one: (not one.name.endswith(ERRORS), order.get(one.name, len(order))))
    left = [metric for name in TILES if (metric := record.metric(name)) is not None and metric.as_it_must is None]
    return [*judged, *left][:MOST_TILES]


def _tiles(record: RunRecord) -> list[dict[str, str]]:
    tiles = []
    for metric in _headlines(record):
        (value,), unit = shown((metric.value,), metric.unit, metric.name)
        note = f"limit {bound(metric)}" if metric.limit is not None else "no limit"
        verdict = {True: "✓ as it must be", False: "✗ not as it must be", None: ""}[metric.as_it_must]
        if metric.within is None:
            verdict = {True: "✓ limit met", False: "✗ limit broken", None: ""}[metric.passed]
        share = share_of_limit(metric)
        near = metric.passed is True and share is not None and share >= NEAR
        tone = {True: "near" if near else "good", False: "bad", None: ""}[metric.as_it_must]
        verdict += ", nearly missed" if near else ""
        tiles.append(
            {
                "name": TILES.get(metric.name, _words(metric.name).capitalize()),
                "value": figure(value),
                "unit": unit,
                "note": note,
                "verdict": verdict,
                "tone": tone,
            }
        )
    return tiles


def _metric_row(metric: Metric) -> dict[str, Any]:
    interval, limit = metric.ci95, metric.limit
    values = (metric.value, *(interval or ()), *(() if limit is None else (limit,)))
    numbers, unit = shown(values, metric.unit, metric.name)
    mark = {True: "✓ yes", False: "✗ no", None: "–"}[metric.passed]
    if metric.within is not None:
        ends, _ = shown((metric.value, *metric.within), metric.unit, metric.name)
        where = f"[{figure(ends[1])}, {figure(ends[2])}]"
        broken = "" if metric.passed else "broken, "
        mark = f"✓ {broken}in {where}" if metric.as_it_must else f"✗ outside {where}"
    share = share_of_limit(metric)
    return {
        "name": metric.name,
        "term": term(metric.name),
        "share": Cell("–", "") if share is None else Cell(f"{figure(float(f'{100 * share:.3g}'))} %", share),
        "value": figure(numbers[0]),
        "unit": unit,
        "interval": f"{figure(numbers[1])} … {figure(numbers[2])}" if interval else "–",
        "limit": f"{_sign(metric)} {figure(numbers[-1])}" if limit is not None else "–",
        "passed": metric.as_it_must,
        "mark": mark,
        "tone": {True: "good", False: "bad", None: ""}[metric.as_it_must],
        "n": figure(metric.n),
        "aligned_by": metric.aligned_by,
    }


def _changed(record: RunRecord) -> list[tuple[str, str, str]]:
    """Return the settings that differ from the scenario's file: key, value there, value of this run."""
    changed = record.provenance.get("changed", {})
    return [(key, *(_plain(value) for value in pair)) for key, pair in changed.items()]


def _not_judged_row(name: str) -> dict[str, Any]:
    empty = dict.fromkeys(("value", "unit", "interval", "limit", "n", "aligned_by"), "–")
    return {
        **empty,
        "name": name,
        "term": term(name),
        "share": Cell("–", ""),
        "passed": None,
        "mark": "not judged",
        "tone": "",
    }


def _premise_row(name: str, premise: Any) -> dict[str, Any]:
    """Return one premise: {value, minimum or maximum, holds}, or a bare value."""
    fields = premise if isinstance(premise, Mapping) else {"value": premise}
    bounds = [f"{sign} {_plain(fields[key])}" for key, sign in (("minimum", "≥"), ("maximum", "≤"))
              if fields.get(key) is not None]  # fmt: skip
    holds = fields.get("holds")
    return {
        "name": name,
        "value": _plain(fields.get("value")),
        "bound": ", ".join(bounds) or "–",
        "holds": holds,
        "mark": "–" if holds is None else ("✓ yes" if holds else "✗ no"),
        "tone": "" if holds is None else ("good" if holds else "bad"),
    }


def _sign(metric: Metric) -> str:
    return "≤" if metric.sense == "at_most" else "≥"


def bound(metric: Metric) -> str:
    """Return the limit in the unit in which the value is shown: ≤ 0.3 mm; a limit with two ends: 1.5 to 6."""
    assert metric.limit is not None
    if metric.within is not None and metric.limit in metric.within:  # not a control's range, which is beyond it
        ends, unit = shown((metric.value, *metric.within), metric.unit, metric.name)
        return f"{figure(ends[1])} to {figure(ends[2])} {unit}".rstrip()
    numbers, unit = shown((metric.value, metric.limit), metric.unit, metric.name)
    return f"{_sign(metric)} {figure(numbers[1])} {unit}".rstrip()


def _with_unit(metric: Metric) -> str:
    (value,), unit = shown((metric.value,), metric.unit, metric.name)
    return f"{figure(value)} {unit}".rstrip()


def _words(name: str) -> str:
    return name.replace("_", " ")


def _plain(value: Any) -> str:
    """Return a count or a premise's value as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return figure(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) for item in value)
    return "–" if value is None else str(value)


def _ended(text: str) -> str:
    text = text.strip()
    text = text[:1].upper() + text[1:]
    return text if not text or text[-1] in ".!?" else text + "."
