"""One scenario from scene to score: build, expose, run the pipeline, meet the truth, write the run folder."""

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mosca.assemble import Assembly
from mosca.calibrate.keep import RigKeeper
from mosca.data.arrays import Array
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.rig_file import write_rig
from mosca.data.tracks import Samples, Tracks, table, write_npz
from mosca.data.truth import Truth, read_truth, write_truth
from mosca.errors import CalibrationError, InputError, PremiseError
from mosca.formats.tracks_csv import write_tracks_csv
from mosca.pipeline import PipelineSettings, Step, run
from mosca.recording import RecordingWriter
from reports.calibration_page import write_calibration_page
from reports.evidence import CameraView, ErrorTable, Evidence, FrameCounts
from reports.page import write_page
from reports.record import Blocks, Metric, RunRecord, write_record
from scenarios.build import build_scene, pipeline_settings
from scenarios.cameras import Calibrated, calibrated, deliveries, surroundings, true_rig, virtual_cameras
from scenarios.faults import with_fault
from scenarios.interrupt import between_steps
from scenarios.provenance import provenance
from scenarios.score import Matched, Score, limits_met, metrics, pair
from scenarios.session.estimated import Estimated, estimated
from scenarios.sources import Chosen, Written, recorded
from scenarios.spec import METRICS, Scenario
from scenarios.warm import compile_side_by_side
from twin.source import TwinSource

Progress = Callable[[int, int], None]
VIEW_AT = 0.4
"""Where in the run the picture of a camera is taken: a share of its length."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run's record, what the page shows beside it, its tracks and the truth (None where there is none)."""

    record: RunRecord
    evidence: Evidence
    tracks: Tracks
    truth: Truth | None
    commands: Any = None
    estimated: Estimated | None = None


@dataclass(frozen=True)
class RunOptions:
    """How to run. ``source``: "twin" or "recording:DIR". ``workers``: threads that render. ``rrd``: a Rerun
    file to write while running. ``record_to``: a folder to record the frames into. ``progress``: called with
    pulses done and in all.
    """

    source: str = "twin"
    workers: int = 1
    rrd: Path | None = None
    record_to: Path | None = None
    progress: Progress | None = None


def run_scenario(spec: Scenario, name: str, folder: Path, options: RunOptions | None = None) -> RunResult:
    """Run ``spec``; files that it names are looked for in ``folder``. PremiseError where a premise fails."""
    options = options or RunOptions()
    timings: dict[str, float] = {}
    with ExitStack() as stack, _timed(timings, "total"):
        with _timed(timings, "build"):
            rig = true_rig(spec, folder)
            cameras = virtual_cameras(spec, rig)
            known = calibrated(spec, cameras)
            names = known.rig.names
            settings = pipeline_settings(spec)
            scene = build_scene(spec, folder) if options.source == "twin" else None
        own: Estimated | None = None
        if spec.calibration is not None:
            with _timed(timings, "calibration"):
                try:
                    own = estimated(spec, cameras, known.rig, options.workers)
                except CalibrationError as refusal:
                    if spec.expect != "caught":
                        raise
                    return _refused(
                        spec, name, options, known, timings, ((refusal.code, str(refusal)),), None
                    )
            told = tuple(
                (one.code, one.message) for one in own.calibration.findings if one.severity != "note"
            )
            if spec.expect == "caught":
                return _refused(spec, name, options, known, timings, told, own)
            if own.calibration.refused:
                raise CalibrationError(f"{name}: {told[0][0]}: {told[0][1]}")
        believed = with_fault(known.rig if own is None else own.calibration.rig, spec.fault)
        source: FrameSource
        if scene is not None:
            source = TwinSource(
                scene,
                cameras,
                frame_rate_hz=spec.capture.frame_rate_hz,
                exposure_s=spec.capture.exposure_s,
                pulses=round(spec.capture.duration_s * spec.capture.frame_rate_hz),
                seed=spec.seed,
                workers=options.workers,
                deliveries=deliveries(spec, cameras),
                surroundings=surroundings(spec),
            )
        else:
            source = recorded(options.source, rig)
        stack.enter_context(source)
        if isinstance(source, TwinSource):
            with _timed(timings, "compile"):
                compile_side_by_side(source)
        with _timed(timings, "frames_to_tracks"):
            collected = _collect(source, believed, settings, spec, options, stack)
        if own is not None:
            for k, one in enumerate(f for f in own.calibration.findings if f.severity == "warn"):
                collected.assembly.notes[f"calibration {k + 1}"] = f"{one.code}: {one.message}"
        truth = source.truth() if isinstance(source, TwinSource) else _truth_beside(options.source)
        if isinstance(source, TwinSource) and truth is not None and options.record_to is not None:
            write_truth(truth, options.record_to / "truth.npz")
        with _timed(timings, "score"):
            space = max(spec.working_space.size_m)
            truth = None if truth is None else _as_seen_by(truth, names)
            matched = None if truth is None else pair(collected.tracks, truth, space)
            scores = {} if matched is None else metrics(matched, space)
            scores = {**scores, **({} if own is None else own.scores())}
            premises = {} if truth is None else _premises(spec, truth, name)
    timings |= collected.seconds
    record = _record(spec, name, options, scores, premises, timings, known, collected)
    evidence = _evidence(spec, believed, collected, truth, matched)
    commands = None if scene is None else scene.commands
    return RunResult(record, evidence, collected.tracks, truth, commands, own)


def _refused(
    spec: Scenario,
    name: str,
    options: RunOptions,
    known: Calibrated,
    timings: Mapping[str, float],
    told: tuple[tuple[str, str], ...],
    own: Estimated | None,
) -> RunResult:
    """Return the result of a scenario whose calibration must be refused or warned of; nothing is measured.

    ``told``: codes and messages of what was.
    """
    caught = next((message for code, message in told if code == spec.caught_as), None)
    others = ", ".join(code or message for code, message in told) or "nothing"
    verdict = (
        f"caught as it must be: {spec.caught_as}: {caught.removeprefix(f'{spec.caught_as}: ')}"
        if caught is not None
        else f"not caught: '{spec.caught_as}' should have been told of; told of was {others}"
    )
    nothing = _Collected(table([]), (), -1, Assembly(), {})
    scores = {} if own is None else own.scores()
    record = _record(spec, name, options, scores, {}, timings, known, nothing)
    record = replace(record, passed=caught is not None, verdict=verdict)
    rig = known.rig if own is None else own.calibration.rig
    return RunResult(record, _evidence(spec, rig, nothing, None, None), nothing.tracks, None, None, own)


def check_out(out: Path) -> None:
    """Raise InputError where ``out`` cannot become a run folder; ask before a long run, not after it."""
    if out.is_file():
        raise InputError(f"{out}: is a file; choose a folder with --out")
    if out.exists() and not (out / "record.json").exists() and any(out.iterdir()):
        raise InputError(f"{out}: holds other files and no record.json; choose a new folder with --out")


def write_run(result: RunResult, out: Path, rrd: Path | None = None) -> None:
    """Write the run folder; it appears whole or not at all. An earlier run folder there is replaced."""
    check_out(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
    try:
        write_record(result.record, part / "record.json")
        write_npz(result.tracks, part / "tracks.npz")
        write_tracks_csv(result.tracks, part / "tracks.csv")
        write_page(part / "report.html", result.record, result.evidence)
        if result.commands is not None:
            _write_commands(result.commands, part / "commands.csv")
        if result.estimated is not None:
            write_rig(result.estimated.calibration.rig, part / "rig.toml")
            write_calibration_page(
                part / "calibration.html", result.estimated.calibration, result.estimated.evidence
            )
        if rrd is not None:
            shutil.move(rrd, part / "run.rrd")
        part.chmod(0o755)
        if out.exists():
            shutil.rmtree(out)
        os.replace(part, out)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


@dataclass(frozen=True, eq=False)
class _Collected:
    tracks: Tracks
    views: tuple[CameraView, ...]
    view_pulse: int
    assembly: Assembly
    seconds: Mapping[str, float]


def _collect(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings,
    spec: Scenario,
    options: RunOptions,
    stack: ExitStack,
) -> _Collected:
    """Run the pipeline to its end and keep what the record, the page and the viewer need."""
    assembly = Assembly()
    samples: list[Samples] = []
    views: tuple[CameraView, ...] = ()
    view_pulse, pulses = -1, round(spec.capture.duration_s * spec.capture.frame_rate_hz)
    seconds: dict[str, float] = {}
    latency: list[float] = []
    log = None
    if options.rrd is not None:
        from reports.viewer import RerunLog

        space = spec.working_space
        log = stack.enter_context(
            RerunLog(options.rrd, rig, (np.array(space.center_m), np.array(space.size_m)))
        )
    read: FrameSource = source
    if options.record_to is not None:
        read = Written(source, stack.enter_context(RecordingWriter(options.record_to, source.cameras)))
    if any(info.name not in rig.names for info in read.cameras):
        read = Chosen(read, rig.names)
    stop = stack.enter_context(between_steps())
    keeper = RigKeeper(rig) if spec.pipeline.watch else None
    for done, step in enumerate(run(read, rig, settings, assembly, keeper=keeper), start=1):
        stop()
        samples.append(step.samples)
        for stage, value in step.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + value
        latency.append(sum(step.seconds.values()))
        if done == max(1, round(VIEW_AT * pulses)):
            views, view_pulse = _views(step), step.frame_set.pulse
        if log is not None:
            images = {n: f.image for n, f in step.frame_set.frames.items() if f.image is not None}
            tracked = step.samples.select(step.samples.frame == step.frame_set.pulse)
            log.log_step(
                step.frame_set.pulse, step.frame_set.time_ns, images, step.detections,
                tracked.xyz, tracked.track,
            )  # fmt: skip
            if isinstance(source, TwinSource) and step.frame_set.pulse < len(source.truth_xyz):
                log.log_truth(
                    step.frame_set.pulse, step.frame_set.time_ns, source.truth_xyz[step.frame_set.pulse]
                )
        if options.progress is not None:
            options.progress(done, max(done, pulses))
    if keeper is not None:
        keeper.close()
        for k, incident in enumerate(keeper.incidents):
            assembly.notes[f"rig {k + 1}"] = incident.message
    if latency:
        seconds["latency_p99"] = float(np.quantile(latency, 0.99))
        seconds["pipeline_per_set"] = float(np.mean(latency))
    return _Collected(table(samples), views, view_pulse, assembly, seconds)


def _as_seen_by(truth: Truth, names: tuple[str, ...]) -> Truth:
    """Return the truth of the named cameras alone: what others see does not make a marker measurable."""
    if truth.cameras == names:
        return truth
    rows = [truth.cameras.index(name) for name in names]
    return replace(
        truth,
        cameras=names,
        visible=truth.visible[:, :, rows],
        image_xy_px=truth.image_xy_px[:, :, rows],
        diameter_px=truth.diameter_px[:, :, rows],
        exposure_mid_ns=truth.exposure_mid_ns[:, rows],
        camera_rotation=None if truth.camera_rotation is None else truth.camera_rotation[:, rows],
        camera_position=None if truth.camera_position is None else truth.camera_position[:, rows],
        frames=None,
    )


def _views(step: Step) -> tuple[CameraView, ...]:
    return tuple(
        CameraView(name, frame.image, step.detections[name])
        for name, frame in step.frame_set.frames.items()
        if frame.image is not None
    )


def _truth_beside(source: str) -> Truth | None:
    path = Path(source.partition(":")[2]) / "truth.npz"
    return read_truth(path) if path.exists() else None


def _premises(spec: Scenario, truth: Truth, name: str) -> dict[str, Any]:
    """Return what must hold for the score to mean anything, and whether it does; PremiseError where it does not."""
    diameter = truth.diameter_px[truth.visible >= 0.5]
    moved = np.linalg.norm(np.diff(truth.image_xy_px, axis=0), axis=-1)
    share = spec.capture.exposure_s * spec.capture.frame_rate_hz
    blur = moved[np.isfinite(moved)] * share
    wanted = spec.premises
    views = float((truth.visible >= 0.5).sum(axis=2).mean()) if truth.visible.size else 0.0
    found: dict[str, Any] = {
        "marker_px": _at_least(float(np.median(diameter)) if diameter.size else 0.0, wanted.marker_px),
        "blur_px": _at_most(float(np.quantile(blur, 0.95)) if blur.size else 0.0, wanted.blur_px),
        "views": _at_least(views, wanted.views),
    }
    for key, premise in found.items():
        if not premise["holds"]:
            bound = "minimum" if "minimum" in premise else "maximum"
            raise PremiseError(
                f"{name}: premise '{key}' does not hold: {premise['value']:.3g}, {bound} {premise[bound]:g}; the "
                f"score would mean nothing. Change the cameras or the markers, or premises.{key}"
            )
    return found


def _at_least(value: float, minimum: float) -> dict[str, Any]:
    return {"value": value, "minimum": minimum, "holds": value >= minimum}


def _at_most(value: float, maximum: float) -> dict[str, Any]:
    return {"value": value, "maximum": maximum, "holds": value <= maximum}


def _record(
    spec: Scenario,
    name: str,
    options: RunOptions,
    scores: Mapping[str, Score],
    premises: Mapping[str, Any],
    timings: Mapping[str, float],
    known: Any,
    collected: _Collected,
) -> RunRecord:
    met = limits_met(scores, spec.limits, lambda metric: METRICS[metric][1])
    rows = tuple(
        _metric(metric, score, spec, met) for metric, score in scores.items() if np.isfinite(score.value)
    )
    broken = [metric for metric, ok in met.items() if not ok]
    passed, verdict = _verdict(spec, broken, bool(scores))
    return RunRecord(
        scenario=name,
        title=spec.title,
        seed=spec.seed,
        source=options.source,
        model_gap=spec.model_gap,
        expect=spec.expect,
        passed=passed,
        verdict=verdict,
        metrics=rows,
        premises=premises,
        counts=_counts(collected),
        timings={key: float(value) for key, value in timings.items()},
        provenance={
            **provenance(),
            "model_gap_rms_px": round(known.gap_rms_px, 6),
            "model_gap_max_px": round(known.gap_max_px, 6),
            "parameters": spec.model_dump(mode="json"),
        },
    )


def _metric(name: str, score: Score, spec: Scenario, met: Mapping[str, bool]) -> Metric:
    unit, sense = METRICS[name]
    return Metric(
        name, score.value, unit, score.n, score.ci95, "none", spec.limits.get(name),
        "at_most" if sense == "at_most" else "at_least", met.get(name),
        Blocks(score.sums, score.weights) if score.sums else None,
    )  # fmt: skip


def _verdict(spec: Scenario, broken: list[str], scored: bool) -> tuple[bool, str]:
    if not scored:
        return True, "no truth to score against: tracks only"
    if spec.expect == "pass":
        return not broken, "every limit is met" if not broken else f"broken: {', '.join(broken)}"
    missing = [name for name in spec.fails_on if name not in broken]
    if missing:
        return False, f"the control was not caught: {', '.join(missing)} should have broken"
    return True, f"fails as it must: {', '.join(spec.fails_on)} broken"


def _counts(collected: _Collected) -> dict[str, Any]:
    assembly = collected.assembly
    tracks = collected.tracks
    return {
        "frames": assembly.frames,
        "frame_sets": assembly.sets,
        "complete_sets": assembly.complete_sets,
        "empty_sets": assembly.empty_sets,
        "dropped": sum(c.dropped for c in assembly.cameras.values()),
        "corrupt": sum(c.corrupt for c in assembly.cameras.values()),
        "late": sum(c.late for c in assembly.cameras.values()),
        "tracks": len(np.unique(tracks.track)),
        "samples": len(tracks),
        "notes": dict(assembly.notes),
    }


def _evidence(
    spec: Scenario, rig: Rig, collected: _Collected, truth: Truth | None, matched: Matched | None
) -> Evidence:
    base = Evidence(
        rig,
        np.array(spec.working_space.center_m),
        np.array(spec.working_space.size_m),
        collected.tracks,
        collected.views,
    )
    if truth is None or matched is None:
        return base
    time_s = truth.time_ns * 1e-9
    pulse = min(max(collected.view_pulse, 0), len(truth.time_ns) - 1)
    return replace(
        base,
        views=tuple(_with_truth(v, truth, pulse) for v in collected.views),
        truth_time_ns=truth.time_ns,
        truth_xyz=truth.xyz,
        truth_names=truth.names,
        marker_seen=matched.seen_mask.sum(axis=0),
        errors=ErrorTable(matched.frame, time_s[matched.frame], matched.marker, matched.error_m),
        counts=FrameCounts(time_s, matched.seen, matched.seen - matched.missed, matched.ghosts),
    )


def _with_truth(view: CameraView, truth: Truth, pulse: int) -> CameraView:
    c = truth.cameras.index(view.camera)
    xy: Array = truth.image_xy_px[pulse, :, c]
    return replace(view, true_xy_px=xy[np.isfinite(xy).all(axis=1) & (truth.visible[pulse, :, c] > 0)])


def _write_commands(commands: Any, path: Path) -> None:
    lines = [",".join(("time_ns", *commands.names))]
    lines += [
        ",".join((str(int(t)), *(repr(float(v)) for v in row)))
        for t, row in zip(commands.time_ns, commands.values, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


class _timed:
    """Adds the seconds of a block to a dictionary."""

    def __init__(self, timings: dict[str, float], name: str) -> None:
        self._timings, self._name = timings, name

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *exc: object) -> None:
        self._timings[self._name] = time.perf_counter() - self._start
