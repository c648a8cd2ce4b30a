"""The gallery: every built-in scenario with its description, its committed figures, its file and a picture.

Pictures are made by ``docs/site/pictures.py`` (once: they are kept in ``runs/site_pictures``); without them the pages
have none.
"""

import json
import tomllib
from pathlib import Path
from typing import Any

from markdown_text import plain_cell

from reports.units import figure, shown

LIBRARY = "scenarios/library"
PICTURES = "runs/site_pictures"
FOLDERS = {
    "acceptance": "Acceptance tests by certified bars, and faults that must not pass them.",
    "calibration": "Calibrations of the whole rig from rendered images of a target, then a measurement with it.",
    "calibration_faults": "Calibrations with a planted fault: each must be refused, or warned of.",
    "clinic": "Faults that users report: `mosca clinic` must name the right cause first.",
    "continuous": "Cameras that run freely: no common trigger.",
    "controls": "Planted faults: each must put metrics beyond their limits, into the range that the fault explains.",
    "delivery": "Frames that are lost, late, out of order; a camera that dies and returns.",
    "flight": "A drone that flies on the poses that the pipeline measures.",
    "lenses": "What lenses do: models, defocus, coma, vignetting, and what no model expresses.",
    "light": "Stray light, mirrors, dust, bright clothing, uneven backgrounds.",
    "machines": "Robots, a vibrating panel, a camera that finds its own pose, virtual objects.",
    "mounts": "Cameras that shake, drift, are bumped, or are worn.",
    "people": "Bones and joints of people, faces, running.",
    "rigs": "Few and many cameras, many markers, zones, rigs of other programs.",
    "sensors": "What EMVA 1288 says of sensors.",
    "spaces": "Rooms of 0.1 m to 10 m as they are, and the paper's 0.01 % in each.",
    "subjects": "A person, a drone, a robot, and your own model.",
    "targets": "Spheres, flat and lit markers, boards, wands, test fields.",
    "timing": "Triggers, delays, rolling shutters, strobes, windows.",
}
"""Folders of the library, in a sentence each."""


def pages(root: Path) -> dict[str, str | bytes]:
    """Return the gallery's pages and pictures (uri -> content)."""
    made: dict[str, str | bytes] = {}
    rows = [
        "# Gallery\n",
        "Every scenario runs by its name: `mosca run subjects/actor`, or `mosca run actor` where the last",
    ]
    rows += ["part is enough. Figures are those of the committed baselines.\n", '<div class="gallery" markdown>\n']
    folders = sorted(path for path in (root / LIBRARY).iterdir() if path.is_dir())
    for folder in folders:
        files = sorted(path for path in folder.glob("*.toml"))
        text = [f"# {folder.name.replace('_', ' ').capitalize()}\n", f"{FOLDERS[folder.name]}\n"]
        for path in files:
            picture = root / PICTURES / folder.name / f"{path.stem}.webp"
            if picture.exists():
                made[f"gallery/{folder.name}/{path.stem}.webp"] = picture.read_bytes()
            text += _section(root, path, picture.exists())
        made[f"gallery/{folder.name}.md"] = "\n".join(text)
        rows.append(_card(root, folder, len(files)))
    made["gallery/index.md"] = "\n".join([*rows, "\n</div>\n"])
    return made


def _card(root: Path, folder: Path, count: int) -> str:
    first = next(iter(sorted((root / PICTURES / folder.name).glob("*.webp"))), None)
    picture = f"[![]({folder.name}/{first.name})]({folder.name}.md)\n\n" if first is not None else ""
    title = folder.name.replace("_", " ").capitalize()
    return f"<div markdown>\n\n{picture}[**{title}**]({folder.name}.md) ({count}): {FOLDERS[folder.name]}\n\n</div>\n"


def _section(root: Path, path: Path, picture: bool) -> list[str]:
    """Return a scenario's part of its folder's page."""
    text = path.read_text(encoding="utf-8")
    spec = tomllib.loads(text)
    name = f"{path.parent.name}/{path.stem}"
    tier, expect = spec.get("tier", "full"), spec.get("expect", "pass")
    facts = [f"`mosca run {name}`", f"tier *{tier}*"]
    if expect != "pass":
        facts.append(
            "a control: it must fail" if expect == "fail" else "the calibration must be refused or warned of"
        )
    lines = [f"## {path.stem} {{ #{path.stem} }}\n", f"**{plain_cell(spec['title'])}**\n"]
    if picture:
        lines.append(f"![What the first cameras see]({path.parent.name}/{path.stem}.webp)\n")
    lines += [f"{plain_cell(spec.get('description', ''))}\n", f"{', '.join(facts)}\n", *_figures(root, name)]
    block = "\n".join(f"    {line}".rstrip() for line in f"```toml\n{text}```".splitlines())
    return [*lines, f'??? note "{path.stem}.toml"\n{block}\n']


def _figures(root: Path, name: str) -> list[str]:
    """Return a table of the committed figures that have a limit."""
    path = root / "reports" / "baselines" / f"{name}.json"
    if not path.exists():
        return []
    rows = [_figure(one) for one in json.loads(path.read_text(encoding="utf-8"))["metrics"] if _is_judged(one)]
    return ["| metric | value | 95 % | limit |", "|---|---|---|---|", *rows, ""] if rows else []


def _is_judged(metric: dict[str, Any]) -> bool:
    return metric["limit"] is not None or metric["within"] is not None


def _figure(metric: dict[str, Any]) -> str:
    ends = metric["ci95"] or ()
    limits = metric["within"] or [metric["limit"]]
    values, unit = shown([metric["value"], *ends, *limits], metric["unit"], metric["name"])
    value, low_high, limit = values[0], values[1 : 1 + len(ends)], values[1 + len(ends) :]
    sign = "≤" if metric["sense"] == "at_most" else "≥"
    told = " to ".join(map(figure, limit)) if metric["within"] else f"{sign} {figure(limit[0])}"
    cells = (
        f"[`{metric['name']}`](../reference/metrics.md#{metric['name'].split('.')[0]})",
        figure(value),
        " to ".join(map(figure, low_high)),
        told,
    )
    return f"| {cells[0]} | {cells[1]} {unit} | {cells[2]} | {told} {unit} |".replace(" 1 |", " |")
