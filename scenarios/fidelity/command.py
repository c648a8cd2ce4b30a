"""``mosca twin fidelity``: run the checks and write the report."""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mosca.errors import InputError
from reports.fidelity import Check, Crop, verdict, write_fidelity_json
from reports.fidelity_page import write_documentation, write_fidelity_page
from scenarios.fidelity.checks import CHECKS, run_checks
from scenarios.fidelity.pictures import CROPS, all_crops
from scenarios.run.provenance import provenance

PAGE, FIGURES = "fidelity.html", "fidelity.json"
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Found:
    """Results of the checks, and the pictures if they were wanted."""

    checks: tuple[Check, ...]
    crops: tuple[Crop, ...]

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        return verdict(self.checks)


def look(quick: bool, with_pictures: bool, progress: Progress) -> Found:
    """Run all checks and, where wanted, make the pictures."""
    more = len(CROPS) if with_pictures else 0
    checks = run_checks(quick, lambda done, total: progress(done, total + more))
    crops = all_crops(lambda done, total: progress(done + len(CHECKS), total + len(CHECKS))) if more else []
    return Found(tuple(checks), tuple(crops))


def prepare(folder: Path) -> None:
    """Make the folder for the results; InputError where something else has its name."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out: {folder} is a file; give the name of a folder")
    folder.mkdir(parents=True, exist_ok=True)


def write(found: Found, folder: Path) -> None:
    """Write page and figures into ``folder``."""
    made = provenance()
    write_fidelity_json(folder / FIGURES, found.checks, made)
    write_fidelity_page(folder / PAGE, found.checks, found.crops, made_by())


def document(docs: Path) -> None:
    """Write the documentation's page and its pictures: ``python -m scenarios.fidelity.command`` does it."""
    found = look(quick=False, with_pictures=True, progress=lambda done, total: None)
    write_documentation(docs, found.checks, found.crops, made_by())


def made_by() -> str:
    """Return versions and machine in a sentence."""
    made = provenance()
    versions = made["versions"]
    programs = ", ".join(f"{name} {versions[name]}" for name in ("mosca", "mujoco", "numpy", "numba"))
    return f"Made by {programs}, Python {versions['python']}, {platform.system()} {platform.machine()}."


if __name__ == "__main__":
    document(Path(__file__).resolve().parents[2] / "docs")
