"""``mosca plan``: a folder with rig, scenario, result and page from a plan file."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import check_folder, whole_folder, write_text
from mosca.errors import InputError
from reports.plan.page import write_plan_page
from scenarios.run.folder import write_run
from scenarios.spec.plan import load_plan
from scenarios.studies.plan.map import predicted_map
from scenarios.studies.plan.plan import PlanSettings, make_plan, result_document
from scenarios.studies.plan.scenario import write_scenario
from scenarios.studies.plan.verify import verify

RESULT_FILE, PAGE_FILE, RUN_FOLDER = "result.json", "plan.html", "run"


@dataclass(frozen=True)
class PlanOptions:
    """The options of ``mosca plan``."""

    volume: Path
    out: Path
    evaluations: int
    curve: bool
    verify: bool
    workers: int

    def run(
        self, progress: Callable[[int, int | None], None], stage: Callable[[str], None] | None = None
    ) -> dict[str, Any]:
        """Plan, write the folder whole or not at all, and return the result."""
        spec = load_plan(self.volume)
        if self.out.exists():
            raise InputError(f"{self.out}: is there already; choose a new folder with --out")
        check_folder(self.out.parent)
        plan = make_plan(spec, PlanSettings(self.evaluations, self.curve), progress)
        document = result_document(plan) | {"map": predicted_map(plan)}
        with whole_folder(self.out) as folder:
            write_scenario(plan, folder)
            if self.verify:
                verified, run = verify(plan, folder, self.workers, stage)
                document["verified"] = verified.document()
                write_run(run, folder / RUN_FOLDER)
            write_text(folder / RESULT_FILE, json.dumps(document, indent=2, ensure_ascii=False) + "\n")
            write_plan_page(folder / PAGE_FILE, document)
        return document
