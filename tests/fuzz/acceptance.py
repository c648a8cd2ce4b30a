"""Readers of acceptance tests and certificates, and what ``tomllib`` and ``json`` say is in their files."""

import csv
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from acceptance_takes import bar_file, seven_lines
from fuzz.reader import Reader
from fuzz.toml_files import as_given, document, toml_seed

from mosca.accuracy.acceptance.artefact import read_acceptance
from mosca.accuracy.acceptance.latency import read_arrivals
from scenarios.studies.acceptance.document import acceptance_document
from scenarios.studies.acceptance.record import read_acceptance_result
from scenarios.studies.acceptance.take import Take
from scenarios.studies.certificate.document import CertificateOptions, certificate_document, check_certificate
from scenarios.studies.certificate.results import read_result

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "scenarios" / "library" / "acceptance"


def _toml(folder: Path) -> Any:
    return as_given(read_acceptance(folder / "a.toml").model_dump(), document(folder / "a.toml"))


def _artefact(name: str) -> Callable[[Path], None]:
    return toml_seed((LIBRARY / f"{name}.acceptance").read_text(encoding="utf-8"))


def _arrivals_seed(folder: Path) -> None:
    rows = [f"{k},{k * 10_000_000 + 7_000_123 + k}" for k in range(20)]
    (folder / "arrivals.csv").write_text("\n".join(["frame,available_ns", *rows]) + "\n")


def _arrivals(folder: Path) -> Any:
    read = read_arrivals(folder / "arrivals.csv")
    return {"frame": read.frame, "available_ns": read.available_ns}


def _arrivals_expected(folder: Path) -> Any:
    from fuzz.tables import whole

    with open(folder / "arrivals.csv", encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file, strict=True)
    column = {name: whole([row[k] for row in rows]) for k, name in enumerate(header)}
    if len(np.unique(column["frame"])) < len(column["frame"]):
        raise ValueError("a frame stands twice")
    return column


def _result_seed(folder: Path) -> None:
    take = Take("take", "tracks", seven_lines(), bar_file(), (), None)
    (folder / "acceptance.json").write_text(json.dumps(acceptance_document(take, folder)))


def _json(folder: Path, name: str) -> Any:
    def refuse(text: str) -> None:
        raise ValueError(text)

    return json.loads((folder / name).read_bytes().decode("utf-8"), parse_constant=refuse)


def _known(values: Any, given: Any) -> Any:
    """Return the part of ``given`` that the reader looks at."""
    if isinstance(values, Mapping) and isinstance(given, Mapping):
        return {key: _known(values[key], one) for key, one in given.items() if key in values}
    if isinstance(values, list | tuple) and isinstance(given, list) and len(values) == len(given):
        return [_known(a, b) for a, b in zip(values, given, strict=True)]
    return given


def _result(folder: Path) -> Any:
    values = read_acceptance_result(folder / "acceptance.json").model_dump()
    read_result(folder / "acceptance.json")
    return as_given(values, _known(values, _json(folder, "acceptance.json")))


def _certificate_seed(folder: Path) -> None:
    _result_seed(folder)
    made = certificate_document(
        [read_result(folder / "acceptance.json")], CertificateOptions(issued="2026-11-28"), folder
    )
    (folder / "certificate.json").write_text(json.dumps(made))


def _certificate(folder: Path) -> Any:
    own, *others = check_certificate(folder / "certificate.json")
    return {"same": own.state == "same", "files": len(others)}


def _certificate_expected(folder: Path) -> Any:
    import hashlib

    given = _json(folder, "certificate.json")
    content = json.dumps({key: value for key, value in given.items() if key != "digest"}, sort_keys=True)
    files = sum(1 + len(one["inputs"]) for one in given["results"])
    return {"same": hashlib.sha256(content.encode()).hexdigest() == given["digest"], "files": files}


def _claim_seed(folder: Path) -> None:
    claim = {
        "metric": "position_rms", "unit": "m", "statistic": "rms", "limit": 5e-4, "sense": "at_most",
        "quantile": None, "verdict": "conforming", "runs": 30, "estimate": 4.2e-4, "low": 3.9e-4, "high": 4.5e-4,
        "guard_band": 3e-5,
    }  # fmt: skip
    made = {
        "title": "rigs", "verdict": "conforming", "runs": 30, "failed": 1, "confidence": 0.95, "looks": [20],
        "claims": [claim], "conditions": {"scenario": "a/b", "set": {}, "vary": []}, "provenance": {"git": "abc"},
    }  # fmt: skip
    (folder / "result.json").write_text(json.dumps(made))


def _claim(folder: Path) -> Any:
    read = read_result(folder / "result.json")
    return {"title": read.title, "verdict": read.verdict, "decisions": [row.decision for row in read.rows]}


def _claim_expected(folder: Path) -> Any:
    given = _json(folder, "result.json")
    decisions = [one["verdict"] for one in given["claims"]]
    return {"title": given["title"], "verdict": given["verdict"], "decisions": decisions}


READERS = (
    Reader(
        "acceptance file",
        tuple(map(_artefact, ("ball_bar", "cluster_bar"))),
        ("a.toml",),
        lambda folder: _toml(folder)[0],
        lambda folder: _toml(folder)[1],
    ),
    Reader("arrivals.csv", (_arrivals_seed,), ("arrivals.csv",), _arrivals, _arrivals_expected),
    Reader(
        "acceptance.json",
        (_result_seed,),
        ("acceptance.json",),
        lambda folder: _result(folder)[0],
        lambda folder: _result(folder)[1],
    ),
    Reader("certificate.json", (_certificate_seed,), ("certificate.json",), _certificate, _certificate_expected),
    Reader("claim result", (_claim_seed,), ("result.json",), _claim, _claim_expected),
)
