"""A claim from its file to its verdict."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mosca.errors import InputError
from reports.metrics import METRICS
from scenarios.run.kept_calibrations import digest_of
from scenarios.run.provenance import provenance
from scenarios.spec.claim import ClaimedStatistic, ClaimFile, load_claim
from scenarios.studies.campaign.collect import KeptRuns, collect
from scenarios.studies.campaign.engine import Engine
from scenarios.studies.campaign.statistics.boundaries import Looks, default_looks
from scenarios.studies.campaign.statistics.judge import judge
from scenarios.studies.campaign.statistics.questions import Judgement, Question, Verdict
from scenarios.studies.campaign.tasks import RunTask, command, run_tasks, scenario_path
from scenarios.studies.campaign.worker import RunOutcome, Work, code_stamp, run_task

CLAIMS = Path(__file__).with_name("claims")


@dataclass(frozen=True)
class CampaignResult:
    """Result of a campaign."""

    verdict: Verdict
    document: Mapping[str, Any]
    """The whole result, as in the result file."""


def find_claim(name: str) -> Path:
    """Return the claim file for ``name``: a path, or the name of a built-in claim; InputError for neither."""
    path = Path(name)
    if path.is_file() or path.suffix == ".toml":
        return path
    there = sorted(one.stem for one in CLAIMS.glob("*.toml"))
    short = name.removeprefix("claims/")
    if short in there:
        return CLAIMS / f"{short}.toml"
    import difflib

    near = difflib.get_close_matches(short, there, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise InputError(f"{name}: no such claim or file; {hint}there are {', '.join(there)}")


def run_claim(
    path: Path,
    engine: Engine,
    *,
    told: Callable[[int, int], None] = lambda done, most: None,
    stopped: Callable[[], bool] = lambda: False,
    work: Work = run_task,
    kept: KeptRuns | None = None,
) -> CampaignResult:
    """Make as many runs of the claim file at ``path`` as its verdict needs, and return the result.

    Parameters
    ----------
    path:
        The claim file.
    engine:
        Engine that makes the runs.
    told:
        Called with the number of runs done and the largest number of runs.
    stopped:
        Called between runs; true: KeyboardInterrupt, and completed runs are kept.
    work:
        Function that makes a run.
    kept:
        Outcomes of earlier runs; default: the user's.
    """
    claim = load_claim(path)
    tasks = run_tasks(claim, path)
    looks = looks_of(claim)
    questions = [question_of(one) for one in claim.claim]
    judged = _Judged(claim, questions, looks)
    outcomes = collect(
        tasks, engine, judged.enough, work=work, kept=kept, told=lambda done: told(done, claim.runs), stopped=stopped
    )
    found = judged.all(outcomes)
    return CampaignResult(overall(found), _document(claim, path, tasks, outcomes, questions, found, looks))


def looks_of(claim: ClaimFile) -> Looks:
    """Return the looks of a claim; each of several claims has an equal part of the error rate (Bonferroni)."""
    return Looks(claim.looks or default_looks(claim.runs), claim.error_rate / len(claim.claim))


def question_of(claimed: ClaimedStatistic) -> Question:
    """Return the question on the runs' values of the claimed metric."""
    return Question(claimed.statistic, claimed.limit_value, claimed.upper, claimed.quantile, claimed.failed_share)


def overall(found: Sequence[Judgement]) -> Verdict:
    """Return the verdict on all claims of a file: conforming if each is, not conforming if one is not."""
    verdicts = {one.verdict for one in found}
    if "not conforming" in verdicts:
        return "not conforming"
    return "undecided" if "undecided" in verdicts else "conforming"


@dataclass
class _Judged:
    claim: ClaimFile
    questions: Sequence[Question]
    looks: Looks
    taken: int = 0
    """Number of looks taken without all claims being settled."""

    def all(self, outcomes: Sequence[RunOutcome]) -> list[Judgement]:
        """Return the verdict on each claim from the outcomes so far."""
        return [
            judge(question, [one.metrics.get(claimed.metric) for one in outcomes], self.looks)
            for question, claimed in zip(self.questions, self.claim.claim, strict=True)
        ]

    def enough(self, outcomes: Sequence[RunOutcome]) -> int:
        """Return the number of runs at which every claim was settled, or one more than there are."""
        for k, runs in enumerate(self.looks.at):
            if runs > len(outcomes):
                break
            if k < self.taken:
                continue
            self.taken = k + 1
            if all(one.done for one in self.all(outcomes[:runs])):
                return runs
        return len(outcomes) + 1


def _document(
    claim: ClaimFile,
    path: Path,
    tasks: Sequence[RunTask],
    outcomes: Sequence[RunOutcome],
    questions: Sequence[Question],
    found: Sequence[Judgement],
    looks: Looks,
) -> dict[str, Any]:
    """Return the result file's content, which depends neither on the number of workers nor on the time."""
    scenario = scenario_path(claim, path.parent)
    metrics = list(dict.fromkeys(one.metric for one in claim.claim))
    made = provenance()
    processors = sorted({one.processor for one in outcomes})
    return {
        "title": claim.title,
        "verdict": overall(found),
        "claims": [
            _claimed(one, question, judgement)
            for one, question, judgement in zip(claim.claim, questions, found, strict=True)
        ],
        "runs": len(outcomes),
        "failed": sum(bool(one.failed) for one in outcomes),
        "error_rate": claim.error_rate,
        "confidence": 1 - looks.error,
        "looks": list(looks.at),
        "conditions": claim.model_dump(mode="json", exclude={"claim", "title"}),
        "each_run": [
            {
                "run": task.number,
                "seed": task.seed,
                "set": dict(task.drawn),
                "metrics": {name: one.metrics[name] for name in metrics if name in one.metrics},
                "failed": one.failed or _missing(one, metrics),
                "command": command(claim, task, scenario),
            }
            for task, one in zip(tasks, outcomes, strict=False)
        ],
        "provenance": {
            **{key: value for key, value in made.items() if key != "processor"},
            "processors": processors,
            "code": code_stamp(),
            "inputs": digest_of(tuple((one.document, one.files.digests) for one in tasks)),
        },
    }


def _missing(outcome: RunOutcome, metrics: Sequence[str]) -> str:
    gone = [name for name in metrics if name not in outcome.metrics]
    return f"its record has no {', '.join(gone)}" if gone and outcome.metrics else ""


def _claimed(claimed: ClaimedStatistic, question: Question, found: Judgement) -> dict[str, Any]:
    kind = METRICS[claimed.metric]
    share = claimed.statistic == "quantile"
    return {
        "metric": claimed.metric,
        "unit": kind.unit,
        "statistic": claimed.statistic,
        "limit": question.limit,
        "sense": "at_most" if question.upper else "at_least",
        "quantile": question.quantile if share else None,
        "failed_share": None if share else question.failed_share,
        **{key: value for key, value in asdict(found).items() if key not in ("done", "looks")},
        "looks": [asdict(one) for one in found.looks],
    }
