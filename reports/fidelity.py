"""Results of the checks of the virtual cameras, as a table, as JSON and as plain numbers."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from mosca.data.arrays import Array
from mosca.data.files.whole_file import write_text
from reports.units import figure


@dataclass(frozen=True)
class Row:
    """One figure: ``value`` must be at most ``bar``; for a ``control`` (a planted fault) it must exceed ``bar``."""

    name: str
    value: float
    unit: str
    bar: float
    control: bool = False

    @property
    def met(self) -> bool:
        """Whether the figure meets its condition; never for NaN."""
        return bool(self.value > self.bar if self.control else self.value <= self.bar)


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    title: str
    compared: str
    """The compared quantities of the twin, and the quantities of the reference."""
    witness: str
    """The reference."""
    own_error: str
    """The reference's own error."""
    rows: tuple[Row, ...]
    absent: str = ""
    """Reason why the check was not run; "" where it was."""

    @property
    def met(self) -> bool:
        """Whether every row meets its condition."""
        return all(row.met for row in self.rows)


@dataclass(frozen=True, eq=False)
class Crop:
    """A picture of one disturbance: panels side by side."""

    name: str
    title: str
    labels: tuple[str, ...]
    """One over each panel."""
    image: Array
    """(H, W) uint8, all panels."""
    caption: str
    scenario: str
    """Name of the scenario that shows the effect on a measurement."""


def all_met(checks: Sequence[Check]) -> bool:
    """Return whether every bar is met and every planted fault caught."""
    return all(check.met for check in checks)


def verdict(checks: Sequence[Check]) -> str:
    """Return the outcome in one sentence."""
    figures = [row for check in checks for row in check.rows if not row.control]
    faults = [row for check in checks for row in check.rows if row.control]
    met, caught = sum(row.met for row in figures), sum(row.met for row in faults)
    text = f"{met} of {len(figures)} bars met, {caught} of {len(faults)} planted faults caught"
    away = [check.title for check in checks if check.absent]
    return text + (f"; not looked at: {', '.join(away)}." if away else ".")


def fidelity_table(checks: Sequence[Check]) -> Group:
    """Return the table for a terminal."""
    parts: list[RenderableType] = []
    for check in checks:
        parts.append(Text(check.title, style="bold"))
        if check.absent:
            parts += [Padding(Text(check.absent, style="dim"), (0, 0, 1, 2))]
            continue
        told = f"{check.compared}. Witness: {check.witness}; its own error: {check.own_error}."
        parts.append(Padding(Text(told, style="dim"), (0, 0, 0, 2)))
        shown = Table(box=None, pad_edge=False, show_header=False)
        for width, side in ((56, "left"), (9, "right"), (8, "left"), (9, "right"), (8, "left")):
            shown.add_column(width=width, justify=side)  # type: ignore[arg-type]
        for row in check.rows:
            shown.add_row(*(escape(text) for text in (row.name, *cells(row))))
        parts.append(Padding(shown, (0, 0, 1, 2)))
    return Group(*parts)


def cells(row: Row) -> tuple[str, str, str, str]:
    """Return figure, unit, bar and outcome of a row as texts."""
    sign = ">" if row.control else "≤"
    outcome = ("caught" if row.met else "MISSED") if row.control else ("met" if row.met else "BROKEN")
    return small(row.value), row.unit, f"{sign} {small(row.bar)}", outcome


def small(value: float) -> str:
    """Return a figure with two digits, in powers of ten where it is tiny."""
    return f"{value:.1e}".replace("e-0", "e-") if 0 < abs(value) < 1e-4 else figure(float(f"{value:.2g}"))


def write_fidelity_json(path: Path, checks: Sequence[Check], provenance: Mapping[str, Any]) -> None:
    """Write all results of the checks, whole or not at all."""
    document = {
        "met": all_met(checks),
        "checks": [
            {**asdict(check), "rows": [{**asdict(row), "met": row.met} for row in check.rows]} for check in checks
        ],
        "provenance": dict(provenance),
    }
    write_text(path, json.dumps(document, indent=2, ensure_ascii=False) + "\n")
