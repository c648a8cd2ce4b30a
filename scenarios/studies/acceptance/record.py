"""Reads the result of an acceptance test back; fields that are not shown elsewhere are ignored."""

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from mosca.data.files.bounded import MOST_TABLE_BYTES, parse_json, read_bytes
from mosca.data.files.toml import check
from mosca.errors import InputError

Verdict = Literal["conforming", "not conforming", "undecided"]


class _Fields(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False, strict=False)


class _Decided(_Fields):
    decision: Verdict
    probability: float
    expanded: float


class _Length(_Fields):
    line: str
    markers: tuple[str, str]
    calibrated_m: float
    permitted_m: float
    samples: int
    error_m: float | None
    sigma_m: float | None
    decided: _Decided | None


class _Premise(_Fields):
    text: str
    met: bool


class _Spread(_Fields):
    samples: int
    rms_m: float
    largest_m: float
    decided: _Decided | None


class _Lengths(_Fields):
    errors: tuple[_Length, ...]
    premises: tuple[_Premise, ...]
    spread: _Spread | None


class _Figure(_Fields):
    group: str
    quantity: Literal["distance", "angle", "frames"]
    statistic: Literal["rms", "p997", "max", "missing"]
    value: float | None
    sigma: float | None
    samples: int
    limit: float | None
    decided: _Decided | None


class _Clusters(_Fields):
    figures: tuple[_Figure, ...]
    premises: tuple[_Premise, ...]


class _Latency(_Fields):
    samples: int
    p99_s: float
    sigma_p99_s: float
    decided: _Decided | None


class _Limits(_Fields):
    length_error: dict[str, float] | None
    probing: dict[str, float] | None
    latency: dict[str, float] | None


class InputFile(_Fields):
    """An input file."""

    what: str
    file: str
    sha256: str


class AcceptanceRecord(_Fields):
    """Contents of ``acceptance.json``."""

    kind: Literal["acceptance"]
    title: str
    name: str
    source: str
    verdict: Verdict
    lengths: _Lengths | None
    clusters: _Clusters | None
    latency: _Latency | None
    limits: _Limits
    notes: tuple[str, ...]
    not_covered: tuple[str, ...]
    manner: str
    inputs: tuple[InputFile, ...]
    provenance: dict[str, Any]


def read_acceptance_result(path: Path) -> AcceptanceRecord:
    """Return the result in a file of ``mosca accept``; InputError where it is missing or another kind of file."""
    return check(AcceptanceRecord, json_document(path, "'mosca accept'"), path)


def json_document(path: Path, maker: str) -> dict[str, Any]:
    """Return the JSON object in a file; InputError where there is none. ``maker``: command that writes such files."""
    try:
        document = parse_json(read_bytes(path, MOST_TABLE_BYTES))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {maker} writes one") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        raise InputError(f"{path}: is no JSON: {error}; {maker} writes such a file") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds no result; {maker} writes one")
    return document
