"""Compares what a run told with what really was; it shares no line with the code under test.

``checked`` returns one line for each frame set that is not of one pulse, each time off by more than 1 ms that is not
said to be uncertain, each loss that is not told, and a verdict that the true number of complete sets does not give.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

TIME_LIMIT_NS = 1_000_000
TOGETHER = 0.5
"""Frames of one pulse are exposed less than this share of a period apart."""


@dataclass(frozen=True)
class Exposure:
    """``start_ns``: when it began (monotonic); ``trigger``: number of the pulse on the line, None without a line."""

    start_ns: int
    trigger: int | None = None


@dataclass(frozen=True)
class Truth:
    """What the emulator logged: camera -> number of the exposure -> exposure; ``pulses``: those wanted.

    ``begin_ns``: when pulse 0 rose, None where the run cannot know which pulse was the first.
    """

    rate_hz: float
    pulses: int
    limit: float
    exposure_ns: int
    exposures: Mapping[str, Mapping[int, Exposure]]
    begin_ns: int | None = None


@dataclass(frozen=True)
class Seen:
    """A frame of a set: camera and exposure as its image shows them, stated mid-exposure [ns], what is in doubt."""

    camera: int
    serial: int
    time_ns: int
    doubt: str = ""


@dataclass(frozen=True)
class SeenSet:
    """A frame set as the pipeline received it."""

    pulse: int
    time_ns: int
    frames: Mapping[str, Seen]


@dataclass(frozen=True)
class Outcome:
    """What a run left: its sets, its record (None where it was not judged), exit code and stderr."""

    sets: Sequence[SeenSet]
    record: Mapping[str, Any] | None
    code: int
    stderr: str = ""


@dataclass
class Figures:
    """Of a campaign: sets expected, those truly complete, wrong ones, largest error of a stated time [ms]."""

    expected: int
    complete: int = 0
    doubtful: int = 0
    wrong: int = 0
    worst_ms: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.expected} sets expected, {self.complete} complete, {self.expected - self.complete} lost, "
            f"{self.doubtful} in doubt, {self.wrong} wrong, times off by {self.worst_ms:.3f} ms at most"
        )


def checked(truth: Truth, outcome: Outcome) -> tuple[Figures, list[str]]:
    """Return the figures of a campaign, and one line for each wrong."""
    figures = Figures(truth.pulses)
    wrongs = list(_images(truth, outcome))
    if not wrongs:
        wrongs = [*_sets(truth, outcome, figures), *_times(truth, outcome, figures)]
    figures.wrong = len(wrongs)
    return figures, [*wrongs, *_verdict(truth, outcome, figures)]


def _images(truth: Truth, outcome: Outcome) -> Iterator[str]:
    """Each frame is a whole image of its camera, was exposed, and comes once."""
    numbers = {name: k + 1 for k, name in enumerate(truth.exposures)}
    came = set()
    for one in outcome.sets:
        for name, seen in one.frames.items():
            if seen.camera != numbers[name] or seen.serial not in truth.exposures[name]:
                yield f"set {one.pulse}: {name} shows exposure {seen.serial} of camera {seen.camera}"
            if (name, seen.serial) in came:
                yield f"set {one.pulse}: exposure {seen.serial} of {name} came before"
            came.add((name, seen.serial))


def _true(truth: Truth, one: SeenSet) -> dict[str, Exposure]:
    return {name: truth.exposures[name][seen.serial] for name, seen in one.frames.items()}


def _sets(truth: Truth, outcome: Outcome, figures: Figures) -> Iterator[str]:
    """Frames that are not in doubt are of one pulse; sets are as many pulses apart as they were exposed."""
    period_ns = 1e9 / truth.rate_hz
    first: tuple[int, float] | None = None
    for one in outcome.sets:
        sure = {name: true for name, true in _true(truth, one).items() if not one.frames[name].doubt}
        starts = [true.start_ns for true in sure.values()]
        wrong = False
        if starts and max(starts) - min(starts) > TOGETHER * period_ns:
            wrong = True
            yield f"set {one.pulse}: its frames were exposed {(max(starts) - min(starts)) / 1e6:.1f} ms apart"
        elif len({true.trigger for true in sure.values()}) > 1:
            wrong = True
            yield f"set {one.pulse}: its frames are of pulses {sorted({str(t.trigger) for t in sure.values()})}"
        if starts:
            at = statistics.median(starts)
            first = first or (one.pulse, at)
            off = (at - first[1]) / period_ns - (one.pulse - first[0])
            if abs(off) > 0.75:
                wrong = True
                yield f"set {one.pulse}: exposed {off:.2f} periods after its pulse"
        full = len(one.frames) == len(truth.exposures)
        figures.complete += full and len(sure) == len(one.frames) and not wrong
        figures.doubtful += full and len(sure) < len(one.frames)


def _times(truth: Truth, outcome: Outcome, figures: Figures) -> Iterator[str]:
    """Stated times differ from the true ones by one constant: the session's beginning."""
    half_ns = truth.exposure_ns // 2
    rows = [
        (one.pulse, name, seen.time_ns - half_ns, truth.exposures[name][seen.serial].start_ns)
        for one in outcome.sets
        for name, seen in one.frames.items()
        if not seen.doubt
    ]
    if not rows:
        return
    begin_ns = truth.begin_ns
    if begin_ns is None:
        begin_ns = round(statistics.median(true - stated for _, _, stated, true in rows))
    for pulse, name, stated, true in rows:
        off = stated - (true - begin_ns)
        figures.worst_ms = max(figures.worst_ms, abs(off) / 1e6)
        if abs(off) > TIME_LIMIT_NS:
            yield f"set {pulse}: the time of {name} is off by {off / 1e6:.3f} ms"
    for one in outcome.sets:
        if one.frames and not any(seen.doubt for seen in one.frames.values()):
            at = statistics.median(true.start_ns for true in _true(truth, one).values())
            off = one.time_ns - half_ns - (at - begin_ns)
            if abs(off) > TIME_LIMIT_NS:
                yield f"set {one.pulse}: its time is off by {off / 1e6:.3f} ms"


def _verdict(truth: Truth, outcome: Outcome, figures: Figures) -> Iterator[str]:
    """The run passes if enough sets are complete in truth; what came and what is told to be lost are all pulses."""
    record = outcome.record
    if record is None:
        yield f"exit code {outcome.code} and no record: {outcome.stderr[-500:]}"
        return
    share = figures.complete / truth.pulses
    told = {one["name"]: one for one in record["metrics"]}["sets_complete"]
    if abs(told["value"] - share) > 1e-9:
        yield f"sets_complete = {told['value']:.4f}, in truth {share:.4f}"
    if record["passed"] != (share >= truth.limit):
        yield f"passed: {record['passed']}, though {share:.4f} of the sets are complete; limit {truth.limit}"
    if outcome.code != (0 if record["passed"] else 1):
        yield f"exit code {outcome.code}, passed: {record['passed']}"
    counts = record["counts"]
    if counts["expected_sets"] != truth.pulses or counts["frame_sets"] != len(outcome.sets):
        yield f"{counts['frame_sets']} of {counts['expected_sets']} sets told; in truth {len(outcome.sets)}"
    unsent = truth.pulses - len(outcome.sets)
    if unsent < 0:
        yield f"{-unsent} sets more than pulses"
    for name in truth.exposures:
        camera = record["cameras"].get(name, {})
        came = sum(name in one.frames for one in outcome.sets)
        if camera.get("delivered", 0) != came:
            yield f"{name}: {camera.get('delivered')} frames told, {came} came"
        lost = sum(camera.get(kind, 0) for kind in ("dropped", "corrupt", "late"))
        if came + lost + unsent != truth.pulses:
            yield f"{name}: {came} came, {lost} told to be lost, {unsent} after the end: not {truth.pulses} pulses"
        doubtful = sum(name in one.frames and bool(one.frames[name].doubt) for one in outcome.sets)
        if camera.get("unproven", 0) != doubtful:
            yield f"{name}: {camera.get('unproven')} frames told to be in doubt, {doubtful} came"
