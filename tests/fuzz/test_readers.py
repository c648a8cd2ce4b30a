"""Every reader of files that users give: a mutant is refused in one line, or read as an independent reader reads it.

The night takes 1,000 mutants a reader, others each night; ``FUZZ_SEED`` and ``FUZZ_MUTANTS`` repeat one or take more.
A failure is repeated by the command that it names.
"""

import datetime
import os

import numpy as np
import pytest
from fuzz.planted import READERS as PLANTED
from fuzz.pool import Report, fuzzed
from fuzz.readers import READERS
from fuzz.values import difference

SEED = os.environ.get("FUZZ_SEED", str(datetime.date.today()))
COUNT = int(os.environ.get("FUZZ_MUTANTS", "1000"))
SAMPLE = ("tracks.csv", "tracks.npz", "rig")
"""Of the quick tests: the files that nearly every run reads or writes."""


def said(report: Report) -> str:
    """Return the counts, and some of the failures with how to repeat them."""
    lines = [str(report)]
    for number, kind, text in report.failures[:10]:
        again = f"python -m fuzz.worker readers '{report.reader}' {report.seed} {number} {number + 1}"
        lines.append(f"mutant {number}: {kind}: {text}\n  PYTHONPATH=tests {again}")
    return "\n".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_mutants_of_every_file(name, capsys):
    report = fuzzed(name, SEED, 0, COUNT)
    with capsys.disabled():
        print(f"\n{report}")
    assert not report.failures, said(report)
    assert sum(report.counts.values()) == COUNT


@pytest.mark.parametrize("name", SAMPLE)
def test_some_mutants(name):
    report = fuzzed(name, "sample", 0, 25)
    assert not report.failures, said(report)
    assert sum(report.counts.values()) == 25
    assert report.counts["refused"] > 0


@pytest.mark.parametrize("kind", PLANTED)
def test_each_kind_of_failure_is_found(kind):
    """Control: readers that do what must not happen; the mutants behind a hang or a death are read all the same."""
    report = fuzzed(kind, "planted", 0, 2, table="planted", limit_s=1.0 if kind == "hang" else 20.0)
    assert report.counts == {kind: 2}, said(report)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (1.0, True), ([1, 2], [1, 2, 3]), ({"a": 1}, {"b": 1}), (np.nan, 0.0), ("a", "b"), (None, 0.0),
        (np.arange(3), np.arange(4)), (2**62, 2**62 + 1), ([1.0, 2.0], [1.0, 2.0 + 1e-8]),
    ],
)  # fmt: skip
def test_differences_are_seen(ours, theirs):
    assert difference(ours, theirs) != ""
    assert difference(ours, ours) == difference(theirs, theirs) == ""
