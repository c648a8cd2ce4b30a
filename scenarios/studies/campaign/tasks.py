"""The runs of a claim: values of each run, drawn from streams that no other run and no other key changes."""

import copy
import operator
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from mosca.data.files.toml import check, read_toml
from mosca.errors import InputError
from scenarios.spec.catalog import find, scenario_name
from scenarios.spec.claim import ChoiceDraw, ClaimFile, Draw, LognormalDraw, NormalDraw, WholeDraw
from scenarios.spec.scenario import Scenario, set_key
from scenarios.studies.campaign.files import FileSet, gathered
from twin.streams import rng

DIGITS = 6
"""Significant digits of a draw, so that a command that repeats the run is short."""


@dataclass(frozen=True)
class RunTask:
    """One run of a claim: all its inputs besides the code."""

    number: int
    """Number among the runs of the claim, from 0 on."""
    name: str
    """Name of the scenario."""
    seed: int
    drawn: Mapping[str, Any]
    """Key -> its value in this run, for the keys that vary."""
    document: Mapping[str, Any]
    """The scenario file with all changes."""
    files: FileSet
    """Files named in the document."""


def scenario_path(claim: ClaimFile, folder: Path) -> Path:
    """Return the scenario's file: beside the claim file in ``folder``, or a built-in one."""
    beside = folder / claim.scenario
    return beside if beside.is_file() else find(claim.scenario)


def run_tasks(claim: ClaimFile, where: Path) -> list[RunTask]:
    """Return all runs of the claim file at ``where``; InputError where one of them is not a valid scenario."""
    path = scenario_path(claim, where.parent)
    base = read_toml(path)
    for key, value in claim.set.items():
        set_key(base, key, value, f"{where}: [set] '{key}'")
    files = gathered(base, path.parent)
    tasks = []
    for number in range(claim.runs):
        document = copy.deepcopy(base)
        drawn = {one.key: _drawn(one, _of_file(base, one, path, where), claim.seed, number) for one in claim.vary}
        for key, value in drawn.items():
            set_key(document, key, value, f"{where}: [[vary]] '{key}'")
        document["seed"] = claim.seed + number
        of_run = files
        if any(isinstance(value, str) for value in drawn.values()):
            of_run = gathered(document, path.parent)
        check(Scenario, document, f"{where}: run {number}, {drawn or 'nothing drawn'}: {path}")
        tasks.append(RunTask(number, scenario_name(path), claim.seed + number, drawn, document, of_run))
    return tasks


def command(claim: ClaimFile, task: RunTask, path: Path) -> str:
    """Return the command line that repeats one run of the scenario at ``path``."""
    name = claim.scenario if scenario_name(path) == claim.scenario else str(path)
    changes = {**claim.set, **task.drawn}
    words = [f"{key}={_toml(value)}" for key, value in changes.items()]
    return shlex.join(
        ["mosca", "run", name, "--seed", str(task.seed), *(part for word in words for part in ("--set", word))]
    )


def _toml(value: Any) -> str:
    """Return a value in TOML, on one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + "}"
    return tomli_w.dumps({"x": value})[len("x = ") :].strip()


def _of_file(base: Mapping[str, Any], draw: Draw, path: Path, where: Path) -> Any:
    """Return the key's value before the draw; None where the draw replaces it."""
    if isinstance(draw, ChoiceDraw) or draw.by == "set":
        return None
    here: Any = base
    for part in draw.key.split("."):
        here = here.get(part) if isinstance(here, Mapping) else None
    if here is None:  # a default of the scenario's tables
        here = check(Scenario, dict(base), path)
        for part in draw.key.split("."):
            here = getattr(here, part, None)
    numbers = here if isinstance(here, list | tuple) else [here]
    if any(isinstance(one, bool) or not isinstance(one, int | float) for one in numbers):
        raise InputError(
            f"{where}: [[vary]] '{draw.key}': by = '{draw.by}' needs a number, or a list of numbers, in {path}; "
            f"there is {here!r}: say by = 'set', or give the number in [set]"
        )
    return here


def _drawn(draw: Draw, before: Any, seed: int, number: int) -> Any:
    """Return a key's value in a run, drawn from a stream of its own for each key and run."""
    stream = rng(seed, f"claim/{draw.key}", number)
    if isinstance(draw, ChoiceDraw):
        value = draw.values[int(stream.integers(len(draw.values)))]
        return list(value) if isinstance(value, tuple) else value
    if draw.by == "set":
        return _number(draw, stream)
    change: Callable[[float, float], float] = operator.add if draw.by == "add" else operator.mul
    if isinstance(before, list | tuple):
        return [_short(change(one, _number(draw, stream))) for one in before]
    return _short(change(before, _number(draw, stream)))


def _number(draw: Any, stream: np.random.Generator) -> float | int:
    if isinstance(draw, WholeDraw):
        return int(stream.integers(draw.low, draw.high, endpoint=True))
    if isinstance(draw, NormalDraw):
        return _short(stream.normal(draw.mean, draw.sigma))
    if isinstance(draw, LognormalDraw):
        return _short(draw.median * draw.factor ** stream.standard_normal())
    return _short(stream.uniform(draw.low, draw.high))


def _short(value: float | int) -> float | int:
    return value if isinstance(value, int) else float(f"{value:.{DIGITS}g}")
