"""Cached rows, so that a stopped run continues where it was.

A row is used again only where all its inputs are the same: all sources of this project for images, adapters and
scores, the set's file and seed, all entrants' requirements and settings on it, the limit.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from mosca.data.files.bounded import parse_json, read_bytes, read_text
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from scenarios.studies.benchmark.entrant import ENTRANTS, Entrant, read_entrants, settings_for
from scenarios.types import Score

ROOT = Path(__file__).resolve().parents[3]
SOURCES = (
    "mosca",
    "twin",
    "witness",
    "scenarios/studies/benchmark",
    "scenarios/build",
    "scenarios/score",
    "scenarios/spec",
)


@cache
def sources_digest() -> str:
    """Return SHA-256 of all sources on which a row depends."""
    found = hashlib.sha256()
    for room in SOURCES:
        for path in sorted((ROOT / room).rglob("*.py")):
            found.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + read_bytes(path) + b"\0")
    return found.hexdigest()


def row_key(entrant: Entrant, set_file: Path, seed: int, *more: Any) -> str:
    """Return the digest of all inputs of an entrant's rows on a set."""
    # an entrant may get the image points of another
    settings = {one.name: settings_for(one, set_file.stem) for one in read_entrants()}
    files = [hashlib.sha256(read_bytes(path)).hexdigest() for path in (ENTRANTS, set_file)]
    told = [sources_digest(), *files, seed, entrant.name, settings, *more]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def kept_rows(path: Path, key: str) -> list[dict[str, Any]] | None:
    """Return the rows cached under ``key``, their scores as ``Score``; None where there are none."""
    try:
        document = parse_json(read_text(path, "kept rows"))
        if document["key"] != key:
            return None
        return [
            {**row, "scores": {name: _score(one) for name, one in row["scores"].items()}} for row in document["rows"]
        ]
    except (InputError, ValueError, KeyError, TypeError, AttributeError):
        return None


def keep_rows(path: Path, key: str, rows: Sequence[Any]) -> None:
    """Cache rows (dataclasses) under ``key``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps({"key": key, "rows": [asdict(row) for row in rows]}) + "\n")


def _score(given: dict[str, Any]) -> Score:
    ends = given["ci95"]
    return Score(
        given["value"],
        given["n"],
        None if ends is None else tuple(ends),
        tuple(given["sums"]),
        tuple(given["weights"]),
    )
