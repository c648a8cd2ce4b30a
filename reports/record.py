"""RunRecord: the stored result of one run."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from mosca.data.files.bounded import parse_json, read_bytes
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError


@dataclass(frozen=True)
class MetricBlocks:
    """A metric's sums by blocks of consecutive frames, for paired comparison of runs.

    ``sums`` (b,): sum over each block; ``weights`` (b,): weight of each block. sum(sums) / sum(weights) is the
    metric, or its square where the metric is a root mean square; ``reports.metrics`` states both for each name.
    Blocks are cut by frame number alone, so that two runs of a scenario have the same cuts; 20 to 40 blocks serve
    well.
    """

    sums: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "sums", tuple(float(v) for v in self.sums))
        object.__setattr__(self, "weights", tuple(float(v) for v in self.weights))
        if len(self.sums) != len(self.weights):
            raise ValueError(f"blocks: {len(self.sums)} sums and {len(self.weights)} weights given")
        if any(weight < 0 for weight in self.weights):
            raise ValueError("blocks: a weight below 0 given")


@dataclass(frozen=True)
class Metric:
    """One figure with all that is needed to interpret it."""

    name: str
    value: float
    unit: str
    """Unit of value, ci95 and limit ("1" for a ratio)."""
    n: int
    """Number of independent items."""
    ci95: tuple[float, float] | None = None
    """95 % interval from a block bootstrap, or None."""
    aligned_by: str = "none"
    """Alignment fitted before the comparison ("none" for an unaligned comparison)."""
    limit: float | None = None
    """Limit in the scenario, in the direction of ``sense``."""
    sense: Literal["at_most", "at_least"] = "at_most"
    passed: bool | None = None
    """Whether the limit is met; None where there is no limit."""
    blocks: MetricBlocks | None = None
    """Sums by blocks of time, or None."""
    spread: float | None = None
    """In a baseline: the largest change of the value among runs of the same product with other processor features
    (last digits), or None where that was not measured."""
    within: tuple[float, float] | None = None
    """Range in which the value must lie: that of a limit with two ends, or in a control one beyond its limit."""

    @property
    def as_it_must(self) -> bool | None:
        """Whether the value lies in ``within`` or, without that, within its limit; None without either."""
        return self.passed if self.within is None else self.allows(self.value)

    def allows(self, value: float) -> bool:
        """Return whether ``value`` would lie in ``within`` or, without that, within the limit; True without both."""
        if self.within is not None:
            return self.within[0] <= value <= self.within[1]
        if self.limit is None:
            return True
        return value <= self.limit if self.sense == "at_most" else value >= self.limit


@dataclass(frozen=True)
class RunRecord:
    """The result of one run of one scenario."""

    scenario: str
    title: str
    seed: int
    source: str
    model_gap: str
    expect: str
    passed: bool
    """Whether every limit is met; for ``expect = "fail"``, whether the fault shows where it must and all other limits
    are met."""
    verdict: str
    metrics: tuple[Metric, ...]
    premises: Mapping[str, Any] = field(default_factory=dict)
    """Name -> {value, minimum or maximum, holds}."""
    counts: Mapping[str, Any] = field(default_factory=dict)
    """Frames, sets, drops and the like."""
    source_account: Mapping[str, Any] = field(default_factory=dict)
    """Reports of devices and trigger about the take, or statements of a recording about itself; else empty."""
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Name -> residual, error besides detection noise, shares connected and missing, clock offset, counts of
    frames; for a continuous run only the counts."""
    joints: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Joint of a person -> rms error of its centre [m] and of its rotation's three components [rad], NEES, share of
    the errors in the 95 % ellipsoid, share of the frames in which it was found; empty where there is none."""
    modes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """True mode of a panel -> true frequency [Hz] and damping, relative bounds, found values, errors, MAC."""
    self_orientation: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Row of the table of a camera's own poses against those by a rig -> ``mean`` and ``rms`` of X, Y, Z [m], omega,
    alpha, kappa [rad], None where unknown; number of ``frames``; ``nees_band``: 95 % band of the mean NEES."""
    error_budget: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Source of error -> its share of the squared difference in position and angle, and its changes of ``mean`` and
    ``rms``, in the units of ``self_orientation``."""
    enough_alone: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Source of error -> the size of ``what``, in ``unit``, that alone gives the paper's 27 mm in ``depth`` or
    ``height``."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds, the only part that differs between two runs of the same seed and code."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Versions, platform, git, parameters."""
    rig: str = ""
    """Source of the calibration: "true", or what it was estimated from; "" in older records."""
    not_judged: tuple[str, ...] = ()
    """Metrics with limits in the scenario that this source of frames cannot give: such a run has not passed."""

    def metric(self, name: str) -> Metric | None:
        """Return the metric called ``name``, or None."""
        return next((m for m in self.metrics if m.name == name), None)


def write_record(record: RunRecord, path: Path) -> None:
    """Write ``record`` as JSON, whole or not at all."""
    text = _numbers_on_one_line(json.dumps(asdict(record), indent=2, allow_nan=False)) + "\n"
    write_text(path, text)


def read_record(path: Path) -> RunRecord:
    """Return the record in a file of ``write_record``; InputError where it is missing or another kind of file."""
    try:
        document = parse_json(read_bytes(path))
        unknown = tuple(document.pop("not_judged", ()))
        metrics = tuple(_metric(m) for m in document.pop("metrics"))
        return RunRecord(metrics=metrics, not_judged=unknown, **document)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a run folder holds a record.json") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a run record: {error}; give a run folder's record.json") from None


def _metric(fields: Mapping[str, Any]) -> Metric:
    """Return the metric of a JSON object; older records hold no blocks, and ``within`` as ``breaks``."""
    fields = dict(fields)
    before = fields.pop("breaks", None)
    ci95, blocks, within = fields["ci95"], fields.get("blocks"), fields.get("within", before)
    return Metric(
        **{
            **fields,
            "ci95": ci95 if ci95 is None else _pair(*ci95),
            "within": within if within is None else _pair(*within),
            "blocks": None if blocks is None else MetricBlocks(**blocks),
        }
    )


def _pair(low: float, high: float) -> tuple[float, float]:
    return float(low), float(high)


def _numbers_on_one_line(text: str) -> str:
    """Return JSON ``text`` with each list of bare numbers on one line, so that diffs of baselines are readable."""
    numbers = re.compile(r"\[\n\s*(-?\d[^\]\[{}\"]*?)\s*\]")
    return numbers.sub(lambda found: "[" + re.sub(r"\s*\n\s*", " ", found[1]) + "]", text)
