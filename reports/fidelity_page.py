"""The page of the cameras' witnesses: one HTML file that opens offline, and the same for the documentation."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2

from reports.fidelity import Check, Crop, Row, all_met, cells, verdict
from reports.page import write_rendered

SCENARIOS = "../scenarios/library"
"""Address of the scenario files from the documentation's page."""


def png(crop: Crop) -> bytes:
    """Return a picture as a PNG file; the same picture gives the same bytes."""
    done, data = cv2.imencode(".png", crop.image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done
    return bytes(data)


def write_fidelity_page(path: Path, checks: Sequence[Check], crops: Sequence[Crop], made_by: str) -> None:
    """Write the page to ``path``, whole or not at all. ``made_by``: versions and machine, in a line."""
    good = all_met(checks)
    write_rendered(
        path,
        "fidelity.html.j2",
        sentence=verdict(checks),
        badge={"text": "All bars met", "sign": "✓", "tone": "good"}
        if good
        else {"text": "A bar is broken", "sign": "✗", "tone": "bad"},
        checks=[_summary(check) for check in checks],
        crops=[
            {
                "crop": crop,
                "wide": len(crop.labels) > 2,
                "data": base64.b64encode(png(crop)).decode("ascii"),
                "alt": f"{crop.title}: {'; '.join(crop.labels)}",
                "width": crop.image.shape[1],
                "height": crop.image.shape[0],
            }
            for crop in crops
        ],
        made_by=made_by,
    )


def write_documentation(folder: Path, checks: Sequence[Check], crops: Sequence[Crop], made_by: str) -> None:
    """Write ``fidelity.md`` into ``folder`` and the pictures into ``pictures/fidelity`` below it."""
    pictures = folder / "pictures" / "fidelity"
    pictures.mkdir(parents=True, exist_ok=True)
    for crop in crops:
        (pictures / f"{crop.name}.png").write_bytes(png(crop))
    write_rendered(
        folder / "fidelity.md",
        "fidelity.md.j2",
        checks=[_summary(check) for check in checks],
        crops=crops,
        scenarios=SCENARIOS,
        sentence=verdict(checks),
        made_by=made_by,
    )


def _summary(check: Check) -> dict[str, Any]:
    """Return a check for the templates: its rows as texts, and the figure closest to its bar."""
    figures = [row for row in check.rows if not row.control]
    faults = [row for row in check.rows if row.control]
    nearest = max(figures, key=lambda row: row.value / row.bar) if figures else None
    return {
        "title": check.title,
        "compared": check.compared,
        "witness": check.witness,
        "own_error": check.own_error,
        "absent": check.absent,
        "met": check.met,
        "outcome": "not looked at" if check.absent else _share(figures, "met"),
        "caught": "–" if check.absent else _share(faults, "caught"),
        "nearest": "–" if nearest is None else nearest.name,
        "nearest_figure": "" if nearest is None else _figure_and_bar(nearest),
        "rows": [
            dict(
                zip(("figure", "unit", "bar", "outcome"), cells(row), strict=True),
                name=row.name,
                met=row.met,
                control=row.control,
            )
            for row in check.rows
        ],
    }


def _share(rows: Sequence[Row], word: str) -> str:
    return f"{sum(row.met for row in rows)} of {len(rows)} {word}"


def _figure_and_bar(row: Row) -> str:
    figure, unit, bar, _outcome = cells(row)
    return " ".join(part for part in (figure, unit, f"({bar})") if part)
