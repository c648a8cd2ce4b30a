"""A certificate as one document, and the test of whether its input files are unchanged."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from mosca.accuracy.acceptance.decision import Decision, overall
from mosca.data.files.toml import check
from mosca.errors import InputError
from scenarios.studies.acceptance.document import plain, sha256_of
from scenarios.studies.acceptance.record import InputFile, json_document
from scenarios.studies.certificate.results import CertifiedResult

KIND = "certificate"


@dataclass(frozen=True)
class CertificateOptions:
    """Entries of a certificate besides the results."""

    title: str = "Certificate of measurement performance"
    customer: str = ""
    issued: str = ""
    """Date of issue, as YYYY-MM-DD."""


@dataclass(frozen=True)
class FileState:
    """A file whose hash was taken, and its present state."""

    file: str
    state: Literal["same", "changed", "not found"]


class _Listed(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)

    file: str
    sha256: str
    inputs: tuple[InputFile, ...]


class _Certificate(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)

    kind: Literal["certificate"]
    digest: str
    results: tuple[_Listed, ...]


def certificate_document(
    results: Sequence[CertifiedResult], options: CertificateOptions, folder: Path
) -> dict[str, Any]:
    """Return the certificate of ``results``, to be written into ``folder``; the last of a kind and name counts.

    An input file of a result that has changed since is named, and the certificate is then undecided.
    """
    if not results:
        raise InputError(
            "certificate: no result given; give the folders of acceptance tests, claims, budgets or runs"
        )
    last = {(one.kind, one.name): one for one in results}
    states = [state for one in results for state in input_states(one.inputs, one.file.parent)]
    changed = sorted({one.file for one in states if one.state == "changed"})
    verdict = overall(one.verdict for one in last.values() if one.verdict is not None)
    if changed and verdict == "conforming":
        verdict = "undecided"
    document = plain(
        {
            "kind": KIND,
            **asdict(options),
            "verdict": verdict,
            "changed": changed,
            "not_found": sorted({one.file for one in states if one.state == "not found"}),
            "results": [_told(one, folder, last[one.kind, one.name] is one) for one in results],
            "history": _history(results),
            "beside": _beside(list(last.values())),
            "not_covered": list(dict.fromkeys(line for one in last.values() for line in one.not_covered)),
        }
    )
    return {**document, "digest": digest_of(document)}


def digest_of(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a certificate's content without its own digest."""
    content = {key: value for key, value in document.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True, ensure_ascii=True).encode()).hexdigest()


def check_certificate(path: Path) -> list[FileState]:
    """Return the state of a certificate and of each file that it names; InputError where it is not a certificate."""
    document = json_document(path, "'mosca certificate'")
    given = check(_Certificate, document, path)
    states = [FileState(str(path), "same" if digest_of(document) == given.digest else "changed")]
    for one in given.results:
        states += input_states((InputFile(what="result", file=one.file, sha256=one.sha256),), path.parent)
        states += input_states(one.inputs, (path.parent / one.file).parent)
    return states


def input_states(inputs: Sequence[InputFile], folder: Path) -> list[FileState]:
    """Return the state of each file or folder, found by its path or beside the result in ``folder``."""
    states = []
    for one in inputs:
        places = [folder / one.file, Path(one.file), folder / Path(one.file).name]
        found = next((place for place in places if place.exists()), None)
        if found is None:
            states.append(FileState(one.file, "not found"))
        else:
            states.append(FileState(one.file, "same" if sha256_of(found) == one.sha256 else "changed"))
    return states


def _told(one: CertifiedResult, folder: Path, counts: bool) -> dict[str, Any]:
    return {
        "kind": one.kind,
        "name": one.name,
        "title": one.title,
        "verdict": one.verdict,
        "counts": counts,
        "commit": one.commit,
        "rows": [asdict(row) for row in one.rows],
        "conditions": one.conditions,
        "file": Path(os.path.relpath(one.file, folder)).as_posix(),
        "sha256": one.sha256,
        "inputs": [given.model_dump() for given in one.inputs],
        "versions": dict(one.versions),
    }


def _history(results: Sequence[CertifiedResult]) -> list[dict[str, Any]]:
    """Return commit, verdict and figure nearest to its limit of each result, for things with several results."""
    groups: dict[tuple[str, str], list[CertifiedResult]] = {}
    for one in results:
        groups.setdefault((one.kind, one.name), []).append(one)
    return [
        {
            "kind": kind,
            "name": name,
            "rows": [
                {"commit": one.commit, "verdict": one.verdict, "worst": _worst(one), "sha256": one.sha256}
                for one in group
            ],
        }
        for (kind, name), group in groups.items()
        if len(group) > 1
    ]


def _worst(one: CertifiedResult) -> str:
    row = max(one.rows, key=lambda row: row.share, default=None)
    return "" if row is None else f"{row.what}: {row.found}" + (f", {row.limit}" if row.limit else "")


def _beside(results: Sequence[CertifiedResult]) -> list[dict[str, Any]]:
    """Return the figures side by side, for each kind with several tested things."""
    tables = []
    for kind in dict.fromkeys(one.kind for one in results):
        group = [one for one in results if one.kind == kind]
        if len(group) < 2:
            continue
        rows = list(dict.fromkeys(row.what for one in group for row in one.rows))
        found = [{row.what: f"{row.found} {row.interval}".strip() for row in one.rows} for one in group]
        tables.append(
            {
                "kind": kind,
                "names": [one.name for one in group],
                "verdicts": [one.verdict for one in group],
                "rows": [{"what": what, "cells": [cells.get(what, "–") for cells in found]} for what in rows],
            }
        )
    return tables


def states_told(states: Sequence[FileState]) -> list[str]:
    """Return a line for each file that has changed or does not exist."""
    return [f"{one.state}: {one.file}" for one in states if one.state != "same"]


def whole(states: Sequence[FileState]) -> Decision:
    """Return "conforming" if all files are unchanged, "not conforming" if one has changed, else "undecided"."""
    found = {one.state for one in states}
    if "changed" in found:
        return "not conforming"
    return "undecided" if "not found" in found else "conforming"
