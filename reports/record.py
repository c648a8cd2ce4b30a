"""RunRecord: the result of one run at rest, looked at many times."""

import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from mosca.errors import InputError


@dataclass(frozen=True)
class Metric:
    """One figure with everything that is needed to read it.

    ``unit``: of value, ci95 and limit ("1" for a ratio). ``n``: how many independent items it is
    made of. ``ci95``: 95 % interval from a block bootstrap, or None. ``aligned_by``: what was fitted
    before comparing ("none" for an unaligned comparison). ``limit`` and ``sense``: what the
    scenario allows, at most or at least; ``passed`` is None where there is no limit.
    """

    name: str
    value: float
    unit: str
    n: int
    ci95: tuple[float, float] | None = None
    aligned_by: str = "none"
    limit: float | None = None
    sense: Literal["at_most", "at_least"] = "at_most"
    passed: bool | None = None


@dataclass(frozen=True)
class RunRecord:
    """What one run of one scenario gave.

    ``passed``: every limit met; for ``expect = "fail"``, that it failed for the stated reason.
    ``premises``: name -> {value, minimum or maximum, holds}. ``counts``: frames, sets, drops and the
    like. ``timings``: seconds, the only part that differs between two runs of the same seed and code.
    ``provenance``: versions, platform, git, parameters.
    """

    scenario: str
    title: str
    seed: int
    source: str
    model_gap: str
    expect: str
    passed: bool
    verdict: str
    metrics: tuple[Metric, ...]
    premises: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, Any] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def metric(self, name: str) -> Metric | None:
        """Return the metric called ``name``, or None."""
        return next((m for m in self.metrics if m.name == name), None)


def write_record(record: RunRecord, path: Path) -> None:
    """Write ``record`` as JSON, whole or not at all."""
    write_whole(path, json.dumps(asdict(record), indent=2, allow_nan=False) + "\n")


def read_record(path: Path) -> RunRecord:
    """Read what ``write_record`` wrote; InputError where it is missing or something else."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        metrics = tuple(
            Metric(**{**m, "ci95": tuple(m["ci95"]) if m["ci95"] is not None else None})
            for m in document.pop("metrics")
        )
        return RunRecord(metrics=metrics, **document)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a run folder holds a record.json") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a run record: {error}") from None


def write_whole(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` through a temporary file beside it, so that no half file remains."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
