"""``mosca budget``: contribution of each source of error."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mosca.data.files.whole_file import check_folder, write_text
from reports.budget import ErrorBudget, write_budget
from reports.budget_plot import error_budget_picture
from reports.plot_style import svg_file
from scenarios.run.kept_budgets import keep_budget
from scenarios.spec.catalog import find, scenario_name
from scenarios.spec.scenario import load_scenario
from scenarios.studies.budget.budget import BudgetSettings, error_budget

JSON_FILE, PICTURE_FILE = "budget.json", "budget.svg"


@dataclass(frozen=True)
class BudgetOptions:
    """The options of ``mosca budget``; ``settings`` are those of the budget itself."""

    scenario: str
    overrides: tuple[str, ...]
    out: Path | None
    settings: BudgetSettings

    def run(self, progress: Callable[[int, int | None], None]) -> tuple[ErrorBudget, Path]:
        """Make the budget, write table and picture, and return it with its folder."""
        path = find(self.scenario)
        spec, name = load_scenario(path, self.overrides), scenario_name(path)
        out = self.out or Path("runs") / "budgets" / name
        check_folder(out)
        made = error_budget(spec, name, path, self.settings, progress)
        out.mkdir(parents=True, exist_ok=True)
        write_budget(made, out / JSON_FILE)
        write_text(out / PICTURE_FILE, svg_file(error_budget_picture(made)))
        if made.by == "source":
            keep_budget(made)
        return made, out
