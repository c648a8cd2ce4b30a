"""An error budget: the contribution of each source of error to a mean square, with intervals; its file, its lines."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mosca.data.files.bounded import parse_json, read_bytes
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError

FILE_KIND = "mosca error budget"


@dataclass(frozen=True)
class Contribution:
    """Contribution of a source to the mean square, in the metric's unit squared (position: mm^2)."""

    name: str
    told: str
    """The source in words."""
    square: float
    """Shapley value of the source; below 0 where errors are smaller with the source."""
    ci95: tuple[float, float]
    alone: float | None
    """Increase of the mean square by this source when all others are off; None where that was not run."""
    last: float | None
    """Decrease of the mean square when only this source is switched off; None where that was not run."""


@dataclass(frozen=True)
class PredictedSquare:
    """A mean square predicted from stated covariances, and the measured one of the budget."""

    told: str
    predicted: float
    measured: float
    ci95: tuple[float, float]

    @property
    def parts(self) -> bool:
        """Whether the prediction lies outside the measured interval."""
        return not self.ci95[0] <= self.predicted <= self.ci95[1]


@dataclass(frozen=True)
class ErrorBudget:
    """The budget of a scenario; contributions and remainder sum to ``total``."""

    scenario: str
    metric: str
    unit: str
    """Unit of the squares."""
    by: str
    """"source" or "camera"."""
    content: str
    """Digest of the scenario's settings that affect figures, without seed and length."""
    commit: str
    seeds: tuple[int, ...]
    duration_s: float
    blocks: int
    total: float
    total_ci95: tuple[float, float]
    remainder: float
    """Mean square with all sources off: the part that cannot be switched off."""
    remainder_ci95: tuple[float, float]
    contributions: tuple[Contribution, ...]
    """Largest first."""
    predicted: tuple[PredictedSquare, ...]
    method: str
    """"exact", or how orders were drawn."""
    runs: int
    seconds: float

    def share(self, square: float) -> float:
        """Return a square as a share of the total."""
        return square / self.total if self.total > 0 else math.nan


def write_budget(budget: ErrorBudget, path: Path) -> None:
    """Write a budget as JSON, whole or not at all."""
    write_text(path, json.dumps({"kind": FILE_KIND, **asdict(budget)}, indent=2, allow_nan=False) + "\n")


def read_budget(path: Path) -> ErrorBudget:
    """Return the budget in a file of ``write_budget``; InputError where it is missing or another kind of file."""
    try:
        document = parse_json(read_bytes(path))
        if document.pop("kind") != FILE_KIND:
            raise ValueError("another kind of file")
        rows = tuple(Contribution(**_tuples(one)) for one in document.pop("contributions"))
        beside = tuple(PredictedSquare(**_tuples(one)) for one in document.pop("predicted"))
        return ErrorBudget(contributions=rows, predicted=beside, **_tuples(document))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; 'mosca budget' writes such a file") from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: no error budget ({error}); 'mosca budget' writes one") from None


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def budget_rows(budget: ErrorBudget) -> list[tuple[str, ...]]:
    """Return the table's rows: source, square, its interval, share, alone, last; remainder and total at the end."""
    rows: list[tuple[str, ...]] = [
        (one.told, *_square(budget, one.square, one.ci95), _or_dash(one.alone), _or_dash(one.last))
        for one in budget.contributions
    ]
    rest = "remainder: all of these off"
    rows.append((rest, *_square(budget, budget.remainder, budget.remainder_ci95), "", ""))
    rows.append(("together", *_square(budget, budget.total, budget.total_ci95), "", ""))
    return rows


HEADINGS = ("source", "square", "95 %", "share", "alone", "last")


def _or_dash(square: float | None) -> str:
    return "-" if square is None else f"{square:.3g}"


def _square(budget: ErrorBudget, square: float, ci95: Sequence[float]) -> tuple[str, str, str]:
    return f"{square:.3g}", f"{ci95[0]:.3g} .. {ci95[1]:.3g}", f"{100 * budget.share(square):.1f} %"


def budget_words(budget: ErrorBudget) -> list[str]:
    """Return lines that describe the table, and name where covariances and measured squares disagree."""
    root = math.sqrt(max(budget.total, 0.0))
    unit = budget.unit.removesuffix("^2")
    lines = [
        f"{budget.scenario}: {budget.metric} {root:.4g} {unit}".rstrip() + f", squares in {budget.unit}; "
        f"{len(budget.seeds)} seeds of {budget.duration_s:g} s, {budget.runs} runs, {budget.method}"
    ]
    for one in budget.predicted:
        state = "they part" if one.parts else "they agree"
        lines.append(
            f"{one.told}: stated covariances predict {one.predicted:.3g}, measured {one.measured:.3g} "
            f"({one.ci95[0]:.3g} .. {one.ci95[1]:.3g}): {state}"
        )
    return lines
