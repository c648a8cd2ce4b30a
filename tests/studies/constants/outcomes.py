"""What changes of constants have done to headline figures, kept beside the code (``outcomes.json``)."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.studies.constants.screen import Departure, Figures, Question, Screened, departures

OUTCOMES = Path(__file__).with_name("outcomes.json")
SHOWN = 2
"""Departures that are kept of one constant and factor, the largest."""


@dataclass
class Outcomes:
    """``single``: by key and factor what moved (empty: nothing by more than is flat; None: no figure at all, not in
    the last digit).
    """

    date: str = ""
    commit: str = ""
    takes: list[str] = field(default_factory=list)
    single: dict[str, dict[str, list[str] | None]] = field(default_factory=dict)
    matters: dict[str, list[str]] = field(default_factory=dict)
    """Keys that a screen found to matter, by factor; groups are joined by " + "."""
    flat: dict[str, list[list[str]]] = field(default_factory=dict)
    """Groups in which nothing matters, by factor."""

    def add_single(self, question: Question, base: Figures, figures: Figures) -> None:
        """Add what one constant did."""
        (key,), factor = question
        same = all(dict(base[take]) == dict(figures.get(take, {})) for take in base)
        moved = [str(one) for one in departures(base, figures)[:SHOWN]]
        self.single.setdefault(key, {})[f"{factor:g}"] = None if same else moved

    def add_screen(self, found: Screened, factors: Sequence[float]) -> None:
        """Replace what a screen found at its factors."""
        for factor in factors:
            self.matters[f"{factor:g}"] = sorted(" + ".join(keys) for keys, f in found.matters if f == factor)
            self.flat[f"{factor:g}"] = sorted(list(keys) for keys, f in found.flat if f == factor)

    def questions(self, groups: Sequence[Sequence[str]], factor: float, afresh: bool = False) -> list[Question]:
        """Return what a screen of constants in ``groups`` asks first: are those groups flat that were?

        What is known to matter is left out, and what is new asked with its own group; ``afresh``: all groups whole.
        """
        if afresh:
            return [(tuple(group), factor) for group in groups]
        there = {key for group in groups for key in group}
        flat = [tuple(k for k in of if k in there) for of in self.flat.get(f"{factor:g}", [])]
        old = {*(k for of in flat for k in of), *self.known(factor)}
        fresh = [tuple(k for k in group if k not in old) for group in groups]
        return [(keys, factor) for keys in (*flat, *fresh) if keys]

    def known(self, factor: float) -> set[str]:
        """Return keys and groups that are known to matter at a factor."""
        return set(self.matters.get(f"{factor:g}", []))


def read_outcomes(path: Path = OUTCOMES) -> Outcomes:
    """Return what is kept; nothing where there is no file."""
    if not path.is_file():
        return Outcomes()
    values: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return Outcomes(**values)


def write_outcomes(outcomes: Outcomes, path: Path = OUTCOMES) -> None:
    """Write what is kept."""
    path.write_text(json.dumps(vars(outcomes), indent=1, sort_keys=True) + "\n", encoding="utf-8")


def surprises(found: Screened, known: Outcomes) -> list[tuple[Question, tuple[Departure, ...]]]:
    """Return what matters though it was not known to."""
    return [(question, moved) for question, moved in found.matters.items() if " + ".join(question[0]) not in
            known.known(question[1])]  # fmt: skip
