"""Budgets cached by scenario, settings and commit, so that a run's page can show them."""

from collections.abc import Mapping
from pathlib import Path

from mosca.errors import InputError
from reports.budget import ErrorBudget, read_budget, write_budget
from reports.content import budget_content
from reports.margins import budget_wanted
from reports.record import RunRecord
from scenarios.run.kept_calibrations import cache_folder

MOST_KEPT = 50
"""Most budgets that are cached, the last ones made (5 kB each)."""


def keep_budget(budget: ErrorBudget, folder: Path | None = None) -> None:
    """Cache a budget; where the folder cannot be written, it is not cached."""
    folder = folder or _folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_budget(budget, folder / f"{_key(budget.scenario, budget.content, budget.commit, budget.metric)}.json")
        last_made = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
        for path in last_made[:-MOST_KEPT]:
            path.unlink(missing_ok=True)
    except (OSError, InputError):
        return


def kept_budget(record: RunRecord, folder: Path | None = None) -> ErrorBudget | None:
    """Return the budget for a run's page, of the same scenario, settings and commit; None where there is none."""
    metric, parameters = budget_wanted(record), record.provenance.get("parameters")
    if metric is None or not isinstance(parameters, Mapping):
        return None
    commit = str(record.provenance.get("git"))
    path = (folder or _folder()) / f"{_key(record.scenario, budget_content(parameters), commit, metric)}.json"
    try:
        return read_budget(path)
    except InputError:
        return None


def _folder() -> Path:
    return cache_folder("budgets")


def _key(name: str, content: str, commit: str, metric: str) -> str:
    return f"{name.replace('/', '-')}-{content}-{commit}-{metric}"
