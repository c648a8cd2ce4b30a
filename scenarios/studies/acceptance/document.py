"""The result of an acceptance test as one document, for ``acceptance.json`` and the page."""

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mosca.accuracy.acceptance.evaluate import AcceptanceResult, accept_tracks
from mosca.data.files.bounded import open_file
from scenarios.run.provenance import provenance
from scenarios.studies.acceptance.take import Take

KIND = "acceptance"
SECONDARY = (
    "The texts of VDI/VDE 2634 part 1, ASTM E3064 and ASTM E3124 were not at hand: this is a test in the manner of "
    "them, not one per them, and no number of a clause of theirs is cited. From accounts by others: number and place "
    "of the measuring lines, number of test lengths, E = A + K L <= B, and that a length that set the scale tests "
    "nothing (VDI/VDE 2634 part 1); two clusters 300 mm apart, two paths, three orientations, the statistics (ASTM "
    "E3064, withdrawn in 2025: its abstract, Bostelman et al. 2016, NIST's announcement); what latency is (ASTM "
    "E3124: its abstract). Our own reading: what counts as a corner, the decision rule at the limit (JCGM 106, 8.3), "
    "the scatter of a point at rest in place of a probing error of a sphere."
)
CHUNK = 1 << 20


def acceptance_document(take: Take, folder: Path) -> dict[str, Any]:
    """Return the acceptance test of a take as plain values, to be written into ``folder``.

    The same take gives the same document.
    """
    result = accept_tracks(take.tracks, take.given, take.arrivals, take.name)
    document: dict[str, Any] = plain(
        {
            "kind": KIND,
            "title": take.given.title,
            "description": take.given.description.strip(),
            "name": take.name,
            "source": take.source,
            "verdict": result.decision,
            "lengths": None if result.lengths is None else asdict(result.lengths),
            "clusters": None if result.clusters is None else asdict(result.clusters),
            "latency": None if result.latency is None else asdict(result.latency),
            "limits": take.given.model_dump(mode="json", include={"length_error", "probing", "latency"}),
            "volume": take.given.volume.model_dump(mode="json"),
            "notes": [*take.notes, *result.notes],
            "not_covered": not_covered(result),
            "manner": SECONDARY,
            "inputs": inputs(take.files, folder),
            "provenance": provenance(),
        }
    )
    return document


def not_covered(result: AcceptanceResult) -> list[str]:
    """Return lines on the parts that were not tested."""
    lines = []
    if result.lengths is None:
        lines.append("length measurement errors on measuring lines")
    elif result.lengths.spread is None:
        lines.append("scatter of points at rest: no line was measured at rest")
    lines.append("probing error of a sphere: no sphere was probed")
    if result.clusters is None:
        lines.append("distance and angle of two clusters on a bar")
    if result.latency is None:
        lines.append("latency: nothing told when results were available")
    lines.append("temperature, vibration and light other than those of the take; drift after it")
    return lines


def inputs(files: Sequence[tuple[str, Path]], folder: Path) -> list[dict[str, str]]:
    """Return each file's role, its path relative to ``folder``, and its SHA-256."""
    return [
        {"what": what, "file": Path(os.path.relpath(path, folder)).as_posix(), "sha256": sha256_of(path)}
        for what, path in files
    ]


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, read piece by piece; InputError where it cannot be read.

    For a folder it is that of the lines "SHA-256 PLACE" of all files in it, sorted by place, as written by sha256sum.
    """
    digest = hashlib.sha256()
    if path.is_dir():
        files = sorted((one.relative_to(path).as_posix(), one) for one in path.rglob("*") if one.is_file())
        for place, one in files:
            digest.update(f"{sha256_of(one)}  {place}\n".encode())
        return digest.hexdigest()
    with open_file(path) as file:
        while piece := file.read(CHUNK):
            digest.update(piece)
    return digest.hexdigest()


def plain(value: Any) -> Any:
    """Return nested values in JSON's types: lists, and None for NaN."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value.item() if hasattr(value, "item") else value
