"""Results for a certificate: acceptance tests, claims, budgets and runs, read into one form."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from mosca.data.files.toml import check
from mosca.errors import InputError
from reports.acceptance.words import figure_rows
from reports.budget import read_budget
from reports.claim.words import claim_words
from reports.metrics import METRICS
from reports.record import Metric, read_record
from reports.units import figure, shown
from scenarios.studies.acceptance.document import sha256_of
from scenarios.studies.acceptance.record import InputFile, Verdict, json_document, read_acceptance_result

Kind = Literal["acceptance", "claim", "budget", "run"]
FILES: dict[str, str] = {
    "acceptance.json": "acceptance",
    "result.json": "claim",
    "budget.json": "budget",
    "record.json": "run",
}
"""Name of a result's file -> kind of result."""
COVERS_A_CLAIM = "rigs, scenes and light other than those drawn in the claim's conditions"
COVERS_A_RUN = "other seeds, rigs and calibrations than those of the one run"


@dataclass(frozen=True)
class ResultRow:
    """One figure of a result in words; "" for missing values."""

    what: str
    found: str
    interval: str
    limit: str
    decision: str
    share: float = 0.0
    """Share of its limit, for the headline; 0 where there is no limit."""


@dataclass(frozen=True)
class CertifiedResult:
    """One result file."""

    kind: Kind
    name: str
    """Results of one kind and name belong to one thing: the last one counts, earlier ones are its history."""
    title: str
    verdict: Verdict | None
    """The verdict; None for a result that decides nothing: a budget."""
    commit: str
    rows: tuple[ResultRow, ...]
    conditions: tuple[tuple[str, str], ...]
    not_covered: tuple[str, ...]
    file: Path
    sha256: str
    inputs: tuple[InputFile, ...]
    versions: Mapping[str, Any]


class _Fields(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _Claim(_Fields):
    metric: str
    unit: str
    statistic: Literal["mean", "rms", "quantile"]
    limit: float
    sense: Literal["at_most", "at_least"]
    quantile: float | None
    verdict: Verdict
    runs: int
    estimate: float | None
    low: float | None
    high: float | None
    guard_band: float | None


class _ClaimResult(_Fields):
    title: str
    verdict: Verdict
    claims: tuple[_Claim, ...]
    runs: int
    failed: int
    confidence: float
    conditions: dict[str, Any]
    provenance: dict[str, Any]


def read_result(path: Path) -> CertifiedResult:
    """Read a result from its folder or its file. InputError where it is none, or no kind that a certificate holds."""
    if path.is_dir():
        found = [name for name in FILES if (path / name).is_file()]
        if not found:
            raise InputError(f"{path}: holds none of {', '.join(FILES)}; give the folder of a result")
        path = path / found[0]
    kind = FILES.get(path.name) or _kind_inside(path)
    return _READERS[kind](path)


def _kind_inside(path: Path) -> str:
    """Return the kind of a result's file with another name, by its keys."""
    document = json_document(path, "'mosca accept', 'mosca claim' or 'mosca budget'")
    if document.get("kind") == "acceptance":
        return "acceptance"
    for keys, kind in (
        ({"claims", "looks"}, "claim"),
        ({"contributions"}, "budget"),
        ({"scenario", "metrics"}, "run"),
    ):
        if keys <= set(document):
            return kind
    raise InputError(f"{path}: is no result of mosca accept, claim, budget or run; give one of {', '.join(FILES)}")


def _acceptance(path: Path) -> CertifiedResult:
    given = read_acceptance_result(path)
    rows = tuple(
        ResultRow(
            row.what, row.found, "" if row.expanded == "–" else f"± {row.expanded}", row.limit, row.decision, row.key
        )
        for row in figure_rows(given.model_dump())
    )
    conditions = (("tested", given.name), ("source", given.source), ("manner", given.manner))
    notes = tuple(
        f"premise not met: {one.text}"
        for part in (given.lengths, given.clusters)
        if part is not None
        for one in part.premises
        if not one.met
    )
    return _made(
        "acceptance", given.name, given.title, given.verdict, given.provenance, rows,
        (*conditions, *(("note", note) for note in (*notes, *given.notes))), given.not_covered, path, given.inputs,
    )  # fmt: skip


def _claim(path: Path) -> CertifiedResult:
    given = check(_ClaimResult, json_document(path, "'mosca claim'"), path)
    rows = []
    for one in given.claims:
        words = claim_words(one.model_dump())
        rows.append(ResultRow(words.claimed, words.found, words.interval, "as claimed", one.verdict))
    conditions = [
        ("scenario", str(given.conditions.get("scenario", ""))),
        ("runs", f"{given.runs}, {given.failed} of them failed"),
        ("intervals", f"{100 * given.confidence:.4g} %, whatever the looks"),
    ]
    for key, value in (given.conditions.get("set") or {}).items() if _table(given.conditions.get("set")) else ():
        conditions.append((str(key), f"{value}, in all runs"))
    for one in given.conditions.get("vary") or ():
        if _table(one):
            rest = ", ".join(f"{k} {v}" for k, v in one.items() if k not in ("key", "kind"))
            conditions.append((str(one.get("key", "")), f"drawn: {one.get('kind', '')}: {rest}"))
    return _made(
        "claim", given.title, given.title, given.verdict, given.provenance, tuple(rows), tuple(conditions),
        (COVERS_A_CLAIM,), path, (),
    )  # fmt: skip


def _table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _budget(path: Path) -> CertifiedResult:
    given = read_budget(path)
    rows = tuple(
        ResultRow(
            one.told, f"{100 * given.share(one.square):.1f} %",
            f"{one.ci95[0]:.3g} … {one.ci95[1]:.3g} {given.unit}", "", "",
        )
        for one in given.contributions
    )  # fmt: skip
    total = max(given.total, 0.0) ** 0.5
    conditions = (
        ("figure", f"{given.metric}: {figure(float(f'{total:.3g}'))} {given.unit.removesuffix('^2')}".rstrip()),
        ("runs", f"{given.runs}, {len(given.seeds)} seeds of {given.duration_s:g} s; {given.method}"),
    )
    title = f"Error budget of {given.scenario}"
    return _made(
        "budget",
        f"{given.scenario}, {given.metric}",
        title,
        None,
        {"git": given.commit},
        rows,
        conditions,
        (),
        path,
        (),
    )


def _run(path: Path) -> CertifiedResult:
    given = read_record(path)
    rows = tuple(_metric_row(one) for one in given.metrics if one.limit is not None or one.within is not None)
    verdict: Verdict | None = "conforming" if given.passed else "not conforming"
    if not given.passed and given.not_judged and all(one.passed is not False for one in given.metrics):
        verdict = "undecided"
    if given.expect != "pass":
        verdict = None  # a control shows that a fault is found, not that a limit is kept
    conditions = (
        ("verdict of the run", given.verdict),
        ("scenario", given.scenario),
        ("seed", str(given.seed)),
        ("source", given.source),
        ("rig", given.rig),
    )
    gone = tuple(f"not judged: {name}" for name in given.not_judged)
    return _made(
        "run",
        given.scenario,
        given.title,
        verdict,
        given.provenance,
        rows,
        conditions,
        (COVERS_A_RUN, *gone),
        path,
        (),
    )


def _metric_row(one: Metric) -> ResultRow:
    ends = list(one.ci95 or ())
    limits = list(one.within) if one.within is not None else [float(one.limit or 0.0)]
    values, unit = shown([one.value, *ends, *limits], one.unit, one.name)
    texts = [figure(float(f"{value:.4g}")) for value in values]
    kind = METRICS.get(one.name)
    sign = "≥" if kind is not None and kind.sense == "at_least" else "≤"
    limit = " … ".join(texts[-2:]) if one.within is not None else f"{sign} {texts[-1]}"
    interval = f"{texts[1]} … {texts[2]}" if ends else ""
    decision = {True: "met", False: "broken", None: "not judged"}[one.passed]
    return ResultRow(one.name, f"{texts[0]} {unit}".strip(), interval, f"{limit} {unit}".strip(), decision)


def _made(
    kind: Kind,
    name: str,
    title: str,
    verdict: Verdict | None,
    provenance: Mapping[str, Any],
    rows: tuple[ResultRow, ...],
    conditions: tuple[tuple[str, str], ...],
    not_covered: tuple[str, ...],
    path: Path,
    inputs: tuple[InputFile, ...],
) -> CertifiedResult:
    versions = {
        key: value for key, value in provenance.items() if key in ("versions", "platform", "processor", "code")
    }
    commit = str(provenance.get("git", "unknown"))
    return CertifiedResult(
        kind, name, title, verdict, commit, rows, conditions, not_covered, path, sha256_of(path), inputs, versions
    )


_READERS: dict[str, Callable[[Path], CertifiedResult]] = {
    "acceptance": _acceptance,
    "claim": _claim,
    "budget": _budget,
    "run": _run,
}
