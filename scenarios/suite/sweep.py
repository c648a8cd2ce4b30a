"""``mosca sweep``: one scenario with several values of one key, as runs in parallel and one page of all."""

import re
from collections.abc import Sequence
from pathlib import Path

from mosca.errors import InputError
from reports.comparison.page import write_comparison_page
from reports.comparison.series import figures_over
from reports.record import RunRecord
from scenarios.spec.catalog import Entry, find, scenario_name
from scenarios.spec.scenario import load_scenario
from scenarios.suite.suite import Outcome

PAGE = "sweep.html"
_NO_NAME = re.compile(r"[^\w.+-]+")


def swept(scenario: str, key: str, values: Sequence[str], overrides: tuple[str, ...] = ()) -> list[Entry]:
    """Return the scenario once for each value of ``key``, named SCENARIO/KEY=VALUE; other ``overrides`` come first.

    InputError, before anything runs, where a value is given twice or makes no valid scenario.
    """
    path = find(scenario)
    found: list[Entry] = []
    for value in values:
        changes = (*overrides, f"{key}={value}")
        name = f"{scenario_name(path)}/{key}={_NO_NAME.sub('_', value)}"
        if any(entry.name == name for entry in found):
            raise InputError(f"{key}: the value {value} is given twice, or reads like another one; give each once")
        found.append(Entry(path, name, load_scenario(path, changes), changes))
    return found


def write_sweep(key: str, values: Sequence[str], outcomes: Sequence[Outcome], out: Path) -> Path:
    """Write the page of the existing runs into ``out`` and return its path; InputError where there is no run."""
    made = [(value, one, one.record) for value, one in zip(values, outcomes, strict=True) if one.record is not None]
    if not made:
        raise InputError(f"{key}: no value gave a run: {'; '.join(one.error for one in outcomes)}")
    records: list[RunRecord] = [record for _, _, record in made]
    picture = figures_over(key, [value for value, _, _ in made], records)
    labels = [f"{key} = {value}" for value, _, _ in made]
    out.mkdir(parents=True, exist_ok=True)
    pages = [out / one.name / "report.html" for _, one, _ in made]
    write_comparison_page(out / PAGE, records, labels, pages, picture)
    return out / PAGE
