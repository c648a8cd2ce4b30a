"""A record at rest: what is written is what is read, and nothing else is taken for one."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from reports_examples import example_record

from mosca.errors import InputError
from reports.record import Metric, MetricBlocks, RunRecord, read_record, write_record

finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def metrics(draw: st.DrawFn) -> Metric:
    n = draw(st.integers(0, 4))
    weights = st.lists(st.floats(0, 1e6), min_size=n, max_size=n)
    blocks = MetricBlocks(tuple(draw(st.lists(finite, min_size=n, max_size=n))), tuple(draw(weights)))
    return Metric(
        draw(st.text(max_size=8)), draw(finite), draw(st.sampled_from(["m", "1", "px"])), draw(st.integers(0, 9)),
        draw(st.none() | st.tuples(finite, finite)), "none", draw(st.none() | finite), "at_least",
        draw(st.none() | st.booleans()), draw(st.none() | st.just(blocks)),
        within=draw(st.none() | st.just((1e-4, 2e-4))),
    )  # fmt: skip


@given(st.lists(metrics(), max_size=3), st.text(max_size=30))
def test_what_is_written_is_what_is_read(
    tmp_path_factory: pytest.TempPathFactory, made: list[Metric], text: str
) -> None:
    record = example_record(metrics=tuple(made), title=text, verdict='[1,\n 2] "[\n 3]"' + text)
    path = tmp_path_factory.getbasetemp() / "round.json"
    write_record(record, path)
    assert read_record(path) == record


def test_numbers_of_a_block_stand_on_one_line(tmp_path: Path) -> None:
    record = example_record()
    write_record(record, tmp_path / "record.json")
    lines = (tmp_path / "record.json").read_text().splitlines()
    assert len(lines) < 160  # a number of a block on a line of its own would make thousands
    assert sum('"sums": [' in line and line.count(",") == 20 for line in lines) == 1


def test_a_record_from_before_blocks_is_read(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_record(example_record(), path)
    document = json.loads(path.read_text())
    for metric in document["metrics"]:
        del metric["blocks"]
        metric["breaks"] = metric.pop("within") or [1.0, 2.0]
    path.write_text(json.dumps(document))
    metric = read_record(path).metric("position_rms")
    assert metric is not None
    assert metric.blocks is None
    assert metric.within == (1.0, 2.0)


def test_blocks_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="2 sums and 1 weights"):
        MetricBlocks((1.0, 2.0), (1.0,))
    with pytest.raises(ValueError, match="below 0"):
        MetricBlocks((1.0,), (-1.0,))


def test_a_missing_record_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file") as caught:
        read_record(tmp_path / "none" / "record.json")
    assert "\n" not in str(caught.value)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["metrics", "ci95", "seed"]), inner),
    max_leaves=8,
)


@given(st.binary(max_size=60) | json_values.map(lambda value: json.dumps(value).encode()))
def test_anything_else_is_an_input_error(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "else.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_record(path)
    assert "\n" not in str(caught.value)
    assert isinstance(example_record(), RunRecord)
