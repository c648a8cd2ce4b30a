"""The verdict on a question, for any statistic."""

from collections.abc import Sequence

from scenarios.studies.campaign.statistics.boundaries import Looks
from scenarios.studies.campaign.statistics.means import judge_mean
from scenarios.studies.campaign.statistics.questions import Judgement, Question
from scenarios.studies.campaign.statistics.shares import judge_share


def judge(question: Question, values: Sequence[float | None], looks: Looks) -> Judgement:
    """Return the verdict on ``question`` from the runs' ``values`` so far, in the order of the runs.

    None stands for a failed run. The error rate of ``looks`` holds over all of them together.
    """
    return (judge_share if question.statistic == "quantile" else judge_mean)(question, values, looks)
