"""``mosca live``: a run at the pace of its source that reports each second and writes tracks while it runs."""

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.whole_file import check_writable
from mosca.data.tracks import Samples
from mosca.diagnostics.camera_health import Health
from mosca.diagnostics.sensor import Sensors
from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import TracksLog
from mosca.live import run_live
from mosca.pipeline import Step
from mosca.precompile import warm_up
from mosca.skeleton.live import LivePose
from mosca.smoothing.fixed_lag import FixedLag, LagSettings
from mosca.synchronisation import Assembly
from reports.record import RunRecord, write_record
from scenarios.commands.live_skeleton import LivePerson, LiveShow, check_show
from scenarios.commands.live_sources import LiveOptions, LiveSource, opened_live
from scenarios.commands.live_stream import LiveStream
from scenarios.commands.live_virtual import LiveVirtual, check_virtual, live_virtual
from scenarios.run.interrupt import first_ctrl_c
from scenarios.run.priority import before_others, prompt
from scenarios.run.provenance import provenance
from scenarios.run.record import health_record, sensor_record

EVERY_S = 1.0


@dataclass
class _Second:
    """Counts since the last line."""

    start: float
    sets: int = 0
    points: int = 0
    skipped: int = 0
    latency: list[float] = field(default_factory=list)
    tracks: set[int] = field(default_factory=set)

    def line(self, now: float, elapsed: float, skipped: int) -> str:
        """Return the counts as a line; ``skipped``: frame sets left out so far."""
        if not self.sets:
            return f"{elapsed:4.0f} s: nothing came, {skipped - self.skipped} sets dropped"
        p50, p99 = 1e3 * np.quantile(self.latency, [0.5, 0.99])
        return (
            f"{elapsed:4.0f} s: {self.sets / (now - self.start):6.1f} sets/s, latency {p50:.1f} ms, "
            f"p99 {p99:.1f} ms, {skipped - self.skipped} sets dropped, {self.points / self.sets:.1f} points, "
            f"{len(self.tracks)} tracks"
        )


def run_live_command(options: LiveOptions, report: Callable[[str], None]) -> list[str]:
    """Run live until the source ends, ``seconds`` are over or Ctrl-C; return the lines of the summary.

    ``report`` is called with a line each second. Tracks are written during the run; the record has each stage's
    times.
    """
    if options.record is not None and options.record.suffix.lower() != ".json":
        raise InputError(f"{options.record}: suffix '{options.record.suffix}' given; a record is a .json file")
    if options.record is not None:
        check_writable(options.record)
    check_show(options)
    check_virtual(options)
    if options.lag is not None and options.stream and options.skeleton is not None:
        raise InputError(f"--lag {options.lag}: excludes --stream with --skeleton, whose poses would come late")
    smoother = None if options.lag is None else FixedLag(LagSettings(lag=options.lag))
    with ExitStack() as stack:
        log = None if options.out is None else stack.enter_context(_log(options.out, stack))
        person = None if options.skeleton is None else LivePerson(options.skeleton, options.joints, stack)
        source = opened_live(options, stack)
        if person is not None:
            person.measured_by(source.rig)
        show = LiveShow(options, source.rig, stack) if options.rrd is not None or options.view else None
        virtual = live_virtual(options, source, () if show is None else show.logs, stack)
        stream = stack.enter_context(LiveStream(options, source, person)) if options.stream else None
        for note in (*source.notes, *(() if stream is None else (stream.where,))):
            report(note)
        warm_up()  # compilation would count as latency
        if smoother is not None:
            FixedLag(LagSettings(lag=1)).step(0, _one_sample())
        assembly, health = (Assembly(), Health.of(source.rig, source.settings.match))
        sensors = Sensors(source.frames.cameras, source.settings.detection)
        steps = stack.enter_context(_Steps(source, assembly, health, sensors, options))
        sinks = _Sinks(smoother, person, show, log, virtual, stream)
        stack.enter_context(prompt())
        stack.enter_context(before_others())
        if virtual is not None:
            virtual.start()
        stages, elapsed = _follow(steps, assembly, sinks, options, report)
        lines = _summary(steps.count, elapsed, stages, assembly)
        if log is not None:
            tracks = log.finish(source.frames.cameras[0].frame_rate_hz)
            lines.append(f"{tracks} tracks with {log.samples} samples in {options.out}")
        if person is not None:
            lines += person.finish()
        moved: dict[str, Any] = {}
        if virtual is not None:
            more, moved = virtual.finish()
            lines += more
        if stream is not None:
            lines += stream.finish()
        if show is not None:
            lines += show.finish()
        lines += [*health.findings(), *sensors.lines(), *sensors.findings()]
        if options.record is not None:
            record = _record(options, steps.count, elapsed, stages, assembly, (health, sensors), log)
            write_record(replace(record, counts={**record.counts, **moved}), options.record)
            lines.append(f"{options.record}")
    return lines


@dataclass(frozen=True)
class _Sinks:
    """Consumers of the samples of a live run.

    Their order is: stream, virtual objects, smoother, person, viewer, log; a stream with a person comes after it.
    """

    smoother: FixedLag | None
    person: LivePerson | None
    show: LiveShow | None
    log: TracksLog | None
    virtual: LiveVirtual | None = None
    stream: LiveStream | None = None

    def take(self, step: Step) -> tuple[Step, Samples]:
        """Pass a step on; return it with the times that this took, and the samples that left the smoother."""
        seconds, start = dict(step.seconds), time.perf_counter()
        samples = step.samples
        poses: list[LivePose] = []
        label_of: Mapping[tuple[int, int], str] = {}

        def timed(stage: str) -> None:
            nonlocal start
            now = time.perf_counter()
            seconds[stage], start = now - start, now

        if self.stream is not None and self.person is None:
            self.stream.step(step.frame_set.pulse, step.frame_set.time_ns, samples)
            timed("stream")
        if self.virtual is not None:
            self.virtual.step(step.frame_set.pulse, step.frame_set.time_ns, samples)
            timed("virtual")
        if self.smoother is not None:
            samples = self.smoother.step(step.frame_set.pulse, samples)
            timed("smooth")
        if self.person is not None:
            poses, label_of = self.person.step(samples)
            timed("skeleton")
            if self.stream is not None:
                self.stream.step(step.frame_set.pulse, step.frame_set.time_ns, samples, poses, label_of)
                timed("stream")
        if self.show is not None:
            self.show.show(step.frame_set.pulse, step.frame_set.time_ns, step.samples, poses, step)
            timed("show")
        if self.log is not None:
            self.log.write(samples, label_of)
        return replace(step, seconds=seconds), samples

    def flush(self) -> None:
        """Flush written data to the operating system."""
        if self.log is not None:
            self.log.flush()

    def rest(self) -> None:
        """Take the samples that the smoother still holds."""
        if self.smoother is None:
            return
        samples = self.smoother.rest()
        label_of = {} if self.person is None else self.person.step(samples)[1]
        if self.log is not None:
            self.log.write(samples, label_of)


class _Steps:
    """The steps of a live run; a context that ends the source, also after Ctrl-C."""

    def __init__(
        self, source: LiveSource, assembly: Assembly, health: Health, sensors: Sensors, options: LiveOptions
    ) -> None:
        self._source = source
        self.over = threading.Event()
        self.count = 0
        self.steps = run_live(
            source.frames, source.rig, source.settings, assembly, None, None, health, options.queued, sensors
        )

    def __enter__(self) -> "_Steps":
        self._ctrl_c = first_ctrl_c(self.end)
        self._ctrl_c.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.end()
        self.steps.close()  # type: ignore[attr-defined]
        self._ctrl_c.__exit__(None, None, None)

    def end(self) -> None:
        """End the source; frames already sent are still followed unless the caller checks ``over``."""
        self.over.set()
        self._source.stop()


def _follow(
    steps: _Steps, assembly: Assembly, sinks: _Sinks, options: LiveOptions, report: Callable[[str], None]
) -> tuple[dict[str, list[float]], float]:
    """Follow the run to its end; return each stage's times, ``latency`` their sum, and the duration."""
    stages: dict[str, list[float]] = {"latency": []}
    begin = time.perf_counter()
    second = _Second(begin)
    for step in steps.steps:
        if steps.count == 0:  # the start of the source took time
            begin = second.start = time.perf_counter()
        steps.count += 1
        step, samples = sinks.take(step)
        for stage, seconds in step.seconds.items():
            stages.setdefault(stage, []).append(seconds)
        latency = sum(step.seconds.values())
        stages["latency"].append(latency)
        second.sets += 1
        second.points += len(step.points)
        second.latency.append(latency)
        second.tracks.update(samples.track.tolist())
        now = time.perf_counter()
        if now - second.start >= EVERY_S:
            report(second.line(now, now - begin, assembly.skipped_sets))
            second = _Second(now, skipped=assembly.skipped_sets)
            sinks.flush()
        if steps.over.is_set() or (options.seconds is not None and now - begin >= options.seconds):
            break
    sinks.rest()
    return stages, time.perf_counter() - begin


def _one_sample() -> Samples:
    one = np.zeros(1, np.int64)
    return Samples(one, one, one, np.zeros((1, 3)), np.eye(3)[None], one, np.zeros(1), np.zeros(1, np.int8))


def _log(out: Path, stack: ExitStack) -> TracksLog:
    """Return the log of the tracks; an empty one is removed when the run ends without any."""
    log = TracksLog(out)

    def remove_if_empty() -> None:
        log.close()
        if log.samples == 0:
            log.part.unlink(missing_ok=True)

    stack.callback(remove_if_empty)
    return log


def _summary(sets: int, elapsed: float, stages: Mapping[str, list[float]], assembly: Assembly) -> list[str]:
    latency: Array = np.array(stages["latency"])
    lines = [
        f"{sets} frame sets in {elapsed:.1f} s, {assembly.skipped_sets} dropped whole, "
        f"{assembly.sets - assembly.complete_sets} incomplete"
    ]
    if sets:
        p50, p99, most = 1e3 * np.array([*np.quantile(latency, [0.5, 0.99]), latency.max()])
        lines.append(f"latency {p50:.1f} ms, p99 {p99:.1f} ms, at most {most:.1f} ms")
        means = {stage: 1e3 * float(np.mean(v)) for stage, v in stages.items() if stage != "latency"}
        lines.append("a set takes " + ", ".join(f"{stage} {value:.2f}" for stage, value in means.items()) + " ms")
        if skeleton := stages.get("skeleton"):
            p50, p99 = 1e3 * np.quantile(skeleton, [0.5, 0.99])
            lines.append(f"skeleton {p50:.1f} ms, p99 {p99:.1f} ms")
    return lines + [f"{kind}: {note}" for kind, note in assembly.notes.items()]


def _record(
    options: LiveOptions,
    sets: int,
    elapsed: float,
    stages: Mapping[str, list[float]],
    assembly: Assembly,
    watched: tuple[Health, Sensors],
    log: TracksLog | None,
) -> RunRecord:
    """Return the record: counts, health of each camera, and mean, 99 % and largest of each stage's times [s]."""
    health, sensors = watched
    learned = {one.name: sensor_record(one) for one in sensors.cameras()}
    timings = {"total": elapsed, "health_mean": health.seconds / max(sets, 1)}
    for stage, values in stages.items():
        if values:
            timings |= {
                f"{stage}_mean": float(np.mean(values)),
                f"{stage}_p99": float(np.quantile(values, 0.99)),
                f"{stage}_max": float(np.max(values)),
            }
    return RunRecord(
        scenario=options.source,
        title="live run",
        seed=0,
        source=options.source,
        model_gap="none",
        expect="pass",
        passed=True,
        verdict="a live run claims nothing",
        metrics=(),
        counts={
            "frames": assembly.frames,
            "frame_sets": assembly.sets,
            "tracked_sets": sets,
            "complete_sets": assembly.complete_sets,
            "empty_sets": assembly.empty_sets,
            "skipped_sets": assembly.skipped_sets,
            "dropped": sum(c.dropped for c in assembly.cameras.values()),
            "corrupt": sum(c.corrupt for c in assembly.cameras.values()),
            "late": sum(c.late for c in assembly.cameras.values()),
            "samples": 0 if log is None else log.samples,
            "queued": options.queued,
            "notes": dict(assembly.notes),
        },
        cameras={one.name: health_record(one) | {"sensor": learned.get(one.name)} for one in health.cameras()},
        timings=timings,
        provenance=provenance(),
    )
