"""Which constants matter: groups are changed together, and a group in which headline figures move is bisected."""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

Figures = Mapping[str, Mapping[str, float]]
"""Figures by take."""
Question = tuple[tuple[str, ...], float]
"""Keys of the constants that are changed, and the factor."""
Answers = Callable[[Sequence[Question]], Iterator[tuple[Question, Figures]]]
"""Evaluates questions, and yields them in any order; stops early where time is up."""
ABSOLUTE = {
    "completeness": 0.01, "coverage95": 0.02, "ghosts_per_frame": 0.05, "identity_switches": 0.5, "recovered": 0.02,
    "used_share": 0.01,
    "contradicted": 0.01,
}  # fmt: skip
"""Flat is what moves by no more than this."""
RELATIVE = {"nees": 0.15, "nees_99": 0.15}
"""Or by no more than this share of itself; all other figures ``OTHERS``."""
OTHERS = 0.05


@dataclass(frozen=True)
class Departure:
    """A figure that moved by more than is flat."""

    take: str
    figure: str
    before: float
    after: float

    @property
    def size(self) -> float:
        """How far it moved, in units of what is flat."""
        return abs(self.after - self.before) / allowed(self.figure, self.before)

    def __str__(self) -> str:
        return f"{self.take} {self.figure} {self.before:.3g} -> {self.after:.3g}"


def allowed(figure: str, before: float) -> float:
    """Return by how much a figure may move and be flat."""
    return ABSOLUTE.get(figure) or max(RELATIVE.get(figure, OTHERS) * abs(before), 1e-12)


def departures(before: Figures, after: Figures) -> list[Departure]:
    """Return what is not flat, the largest first; a figure that is not there any more is one."""
    found = []
    for take, figures in before.items():
        there = after.get(take, {})
        for figure, value in figures.items():
            one = Departure(take, figure, value, there.get(figure, float("nan")))
            if not abs(one.after - value) <= allowed(figure, value):
                found.append(one)
    return sorted(found, key=lambda one: (one.after == one.after, -one.size if one.after == one.after else 0.0))


class Kept:
    """Answers on disk, one a line, of one state of the code; those of others are passed over."""

    def __init__(self, path: Path | None, code: str) -> None:
        self.path, self.code = path, code
        self.there: dict[Question, Figures] = {}
        if path is not None and path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                one = json.loads(line)
                if one["code"] == code:
                    self.there[tuple(one["keys"]), one["factor"]] = one["figures"]

    def add(self, question: Question, figures: Figures) -> None:
        """Keep an answer."""
        self.there[question] = figures
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            keys, factor = question
            with self.path.open("a", encoding="utf-8") as file:
                line = {"code": self.code, "keys": keys, "factor": factor, "figures": figures}
                file.write(json.dumps(line) + "\n")


def all_answers(questions: Sequence[Question], answers: Answers, kept: Kept) -> dict[Question, Figures]:
    """Return the answers to questions that are kept or come in time."""
    wanted = [one for one in dict.fromkeys(questions) if one not in kept.there]
    for question, figures in answers(wanted):
        kept.add(question, figures)
    return {one: kept.there[one] for one in questions if one in kept.there}


@dataclass(frozen=True)
class Screened:
    """What a screen found: ``matters``, single constants, or groups of which no half matters alone, by question;
    ``unasked``: questions for which there was no time."""

    matters: Mapping[Question, tuple[Departure, ...]]
    flat: tuple[Question, ...]
    unasked: tuple[Question, ...]


def screen(questions: Iterable[Question], base: Figures, answers: Answers, kept: Kept) -> Screened:
    """Ask the questions; bisect groups in which figures move, until single constants are found.

    Effects of one group that cancel are not found; those that only come about together are found as a group.
    """
    wave = [(keys, factor) for keys, factor in questions if keys]
    matters: dict[Question, tuple[Departure, ...]] = {}
    flat: list[Question] = []
    unasked: list[Question] = []
    split: list[tuple[Question, Question, Question]] = []
    moved: dict[Question, tuple[Departure, ...]] = {}
    while wave:
        there = all_answers(wave, answers, kept)
        following: list[Question] = []
        for question in wave:
            keys, factor = question
            if question not in there:
                unasked.append(question)
                continue
            moved[question] = tuple(departures(base, there[question]))
            if not moved[question]:
                flat.append(question)
            elif len(keys) == 1:
                matters[question] = moved[question]
            else:
                half = len(keys) // 2
                halves = (keys[:half], factor), (keys[half:], factor)
                split.append((question, *halves))
                following += halves
        wave = following
    for question, first, second in split:
        if moved.get(first) == () and moved.get(second) == ():
            matters[question] = moved[question]
    return Screened(matters, tuple(flat), tuple(unasked))


def code_stamp(root: Path) -> str:
    """Return a digest of all sources whose change may change figures."""
    digest = hashlib.sha256()
    for room in ("mosca", "twin", "scenarios"):
        for path in sorted((root / room).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    digest.update(Path(__file__).with_name("headlines.py").read_bytes())
    return digest.hexdigest()[:16]
