"""Writes the page of a plan: one self-contained HTML file that opens offline."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reports.page import write_rendered
from reports.plan.plots import plan_pictures
from reports.units import figure

SCRIPTS = {"sort": "sort.js"}


def write_plan_page(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page of a result to ``path``, whole or not at all; the same result gives the same bytes."""
    write_rendered(
        path,
        "plan/plan.html.j2",
        title=document["title"],
        sentence=plan_sentence(document),
        tiles=_tiles(document),
        pictures=plan_pictures(document),
        cameras=[
            {
                "name": one["name"],
                "model": one["model"],
                "focal": f"{one['focal_mm']:g}",
                "place": ", ".join(f"{value:.3f}" for value in one["position_m"]),
                "pan": f"{one['pan_deg']:.1f}",
                "tilt": f"{one['tilt_deg']:.1f}",
                "price": f"{one['price']:g}",
            }
            for one in document["cameras"]
        ],
        curve=[
            {"cameras": one["cameras"], "price": f"{one['price']:g}", "cells": curve_cells(one)}
            for one in document["curve"]
        ],
        verified=verified_rows(document),
        conditions=json.dumps(document["conditions"], indent=2, ensure_ascii=False),
        scripts=SCRIPTS,
    )


def plan_sentence(document: Mapping[str, Any]) -> str:
    """Return the result of a plan in words."""
    found, even = document["predicted"], document["evenly_spaced"]
    share, count = 100 * document["quantile"], len(document["cameras"])
    if found["sigma_quantile_m"] is None:
        return (
            f"{count} cameras: less than {share:.0f} % of the markers are measured "
            f"({100 * found['unseen_share']:.1f} % are seen by fewer than two); allow more cameras or wider lenses."
        )
    text = f"{count} cameras: {share:.0f} % of the markers have a standard deviation of {_mm(found)} mm or less"
    if even["sigma_quantile_m"] is not None:
        return f"{text} ({_mm(even)} mm with cameras evenly spaced)."
    return f"{text} (cameras evenly spaced measure fewer than {share:.0f} %)."


def curve_cells(one: Mapping[str, Any]) -> list[str]:
    """Return quantile, rms and the calibration's share [mm], and the share seen by fewer than two [%], as texts."""
    lengths = [one[key] for key in ("sigma_quantile_m", "sigma_rms_m", "calibration_rms_m")]
    texts = ["∞" if value is None else figure(1e3 * value) for value in lengths]
    return [*texts, f"{100 * one['unseen_share']:.1f}"]


def verified_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return rows of predicted and simulated values; none where nothing was simulated."""
    found = document.get("verified")
    if found is None:
        return []
    interval = ", ".join(figure(1e3 * found[f"simulated_{end}_m"]) for end in ("low", "high"))
    rms, p95 = (
        [figure(1e3 * found[f"{how}_{what}_m"]) for how in ("predicted", "simulated")] for what in ("rms", "p95")
    )
    return [
        ("rms error [mm]", rms[0], f"{rms[1]} ({interval})"),
        ("95 % of the errors below [mm]", p95[0], p95[1]),
        (
            "seen by fewer than two cameras [%]", f"{100 * found['predicted_unseen']:.1f}",
            f"{100 * found['simulated_unseen']:.1f}",
        ),
    ]  # fmt: skip


def _mm(one: Mapping[str, Any]) -> str:
    return figure(1e3 * one["sigma_quantile_m"])


def _tiles(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the figures at the top of the page and their names."""
    found = document["predicted"]
    cells = curve_cells(found)
    return [
        (f"{cells[0]} mm", f"predicted, {100 * document['quantile']:.0f} % of the markers"),
        (f"{cells[1]} mm", "predicted rms of those measured"),
        (f"{cells[2]} mm", "of it the calibration"),
        (f"{cells[3]} %", "seen by fewer than two cameras"),
        (f"{document['price']:g}", "price"),
    ]
