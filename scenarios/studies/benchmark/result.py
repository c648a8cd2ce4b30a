"""The result of a benchmark as plain values: ``result.json``, from which the page is made, and overall figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mosca.data.files.whole_file import write_text
from reports.units import figure
from scenarios.run.provenance import provenance
from scenarios.score.tracks import RESAMPLES
from scenarios.studies.benchmark.benchmark import Benchmarked, BenchmarkJob, BenchmarkRow
from scenarios.studies.benchmark.entrant import Entrant, installed_versions
from scenarios.studies.benchmark.scoring import CUT_OFF_M
from scenarios.studies.benchmark.seeds import Passphrase
from scenarios.types import Score

FORMAT = 1


def document_of(
    found: Benchmarked, entrants: Sequence[Entrant], passphrase: Passphrase, job: BenchmarkJob
) -> dict[str, Any]:
    """Return the whole result of a benchmark."""
    pythons = found.pythons
    rows = [_plain_row(row) for row in found.rows]
    boards = {board: _overall(found.rows, entrants, board) for board in ("images", "matched")}
    return {
        "format": FORMAT,
        "passphrase": passphrase.text,
        "commitment_sha256": passphrase.sha256,
        "told": passphrase.told,
        "limit_s": job.limit_s,
        "twice": job.twice,
        "cut_off_m": CUT_OFF_M,
        "sets": [one.model_dump(mode="json") for one in found.sets.values()],
        "left_out": found.left_out,
        "entrants": [
            {
                **one.model_dump(mode="json", include={"name", "title", "note", "requirements", "tables", "tried"}),
                "installed": installed_versions(pythons[one.name]) if one.name in pythons else [],
            }
            for one in entrants
        ],
        "overall": boards,
        "rows": rows,
        "provenance": provenance(),
    }


def write_result(document: Mapping[str, Any], path: Path) -> None:
    """Write ``result.json``, whole or not at all."""
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False) + "\n")


def plain_scores(scores: Mapping[str, Score]) -> dict[str, dict[str, Any]]:
    """Return metrics in the form of ``result.json``."""
    return {
        name: {"value": one.value, "ci95": None if one.ci95 is None else list(one.ci95), "n": one.n}
        for name, one in scores.items()
    }


class Overall(NamedTuple):
    """An entrant over all sets of a table: means of the sets' figures, lengths in m."""

    entrant: str
    title: str
    ospa_m: float
    ospa_ci95_m: tuple[float, float]
    rms_m: float | None
    """Mean over the sets on which it found anything; None where there is none."""
    completeness: float
    ghosts_per_frame: float
    best: int
    """Number of sets on which its OSPA is the least."""
    failed: int
    """Number of sets on which it gave no result."""
    sets: int

    def words(self) -> tuple[str, ...]:
        """Return the row of the terminal's table."""
        low, high = (figure(1e3 * end) for end in self.ospa_ci95_m)
        rms = "–" if self.rms_m is None else figure(1e3 * self.rms_m)
        return (
            self.title, f"{figure(1e3 * self.ospa_m)} ({low} .. {high})", rms, f"{100 * self.completeness:.2f} %",
            figure(self.ghosts_per_frame), f"{self.best} of {self.sets}", str(self.failed or "–"),
        )  # fmt: skip


def overall(document: Mapping[str, Any], board: str) -> list[Overall]:
    """Return the overall rows of a table of a result, the least OSPA first."""
    return [Overall(**{**row, "ospa_ci95_m": tuple(row["ospa_ci95_m"])}) for row in document["overall"][board]]


def _overall(rows: Sequence[BenchmarkRow], entrants: Sequence[Entrant], board: str) -> list[dict[str, Any]]:
    on_board = [row for row in rows if row.table == board]
    least = {
        name: min(r.scores["ospa"].value for r in on_board if r.set == name) for name in {r.set for r in on_board}
    }
    made = []
    for entrant in entrants:
        own = [row for row in on_board if row.entrant == entrant.name]
        if not own:
            continue
        rms = [row.scores["position_rms"].value for row in own if "position_rms" in row.scores]
        ospa = [row.scores["ospa"] for row in own]
        made.append(
            Overall(
                entrant.name,
                entrant.title,
                float(np.mean([one.value for one in ospa])),
                mean_interval(ospa),
                float(np.mean(rms)) if rms else None,
                float(np.mean([row.scores["completeness"].value for row in own])),
                float(np.mean([row.scores["ghosts_per_frame"].value for row in own])),
                sum(not row.error and row.scores["ospa"].value == least[row.set] for row in own),
                sum(bool(row.error) for row in own),
                len(own),
            )._asdict()
        )
    return sorted(made, key=lambda row: (row["ospa_m"], row["entrant"]))


def mean_interval(scores: Sequence[Score]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of several roots of ratios, by resampling blocks of frames in each."""
    rng = np.random.default_rng(0)
    drawn = np.zeros(RESAMPLES)
    for one in scores:
        above, below = np.array(one.sums), np.array(one.weights)
        if len(above) == 0:
            drawn += one.value
            continue
        chosen = rng.integers(0, len(above), (RESAMPLES, len(above)))
        bottom = below[chosen].sum(axis=1)
        drawn += np.sqrt(above[chosen].sum(axis=1) / np.where(bottom > 0, bottom, 1.0))
    low, high = np.quantile(drawn / len(scores), [0.025, 0.975])
    return float(low), float(high)


def _plain_row(row: BenchmarkRow) -> dict[str, Any]:
    return {
        "table": row.table,
        "set": row.set,
        "entrant": row.entrant,
        "metrics": plain_scores(row.scores),
        "error": row.error,
        "again": row.again,
        "seconds": round(row.seconds, 2),
        "peak_mb": None if row.peak_mb is None else round(row.peak_mb, 1),
        "settings": row.settings,
    }
