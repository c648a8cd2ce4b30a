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
from mosca.bodies import body_poses, labelled_by_bodies
from mosca.bodies_alike import check_bodies
from mosca.calibrate.keep import RigKeeper
from mosca.data.bodies import BodyPoses
from mosca.data.detections import Detections
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.rig_file import write_rig
from mosca.data.tracks import Samples, Tracks, table, write_npz
from mosca.data.truth import Truth, read_truth, write_truth
from mosca.errors import CalibrationError, InputError, PremiseError
from mosca.formats.bodies_csv import write_bodies_csv
from mosca.formats.tracks_csv import write_tracks_csv
from mosca.health import Health, HealthSettings
from mosca.pipeline import PipelineSettings, Step, run
from mosca.recording import RecordingWriter
from reports.calibration_page import write_calibration_page
from reports.evidence import CameraView, Evidence
from reports.page import write_page
from reports.record import RunRecord, write_record
from scenarios.account import Collected, evidence_of, record_of
from scenarios.bodies import body_scores, rigid_bodies
from scenarios.bound import bound, efficiencies, pulses_asked
from scenarios.build import build_scene, pipeline_settings
from scenarios.cameras import Calibrated, calibrated, true_rig, twin_source, virtual_cameras
from scenarios.faults import with_fault
from scenarios.finish import with_gaps_filled
from scenarios.interrupt import between_steps
from scenarios.lab.commanded import write_commands
from scenarios.score import BLOCKS, Matched, Score, metrics, pair
from scenarios.session.estimated import Estimated, estimated
from scenarios.sources import Chosen, Written, opened, patient
from scenarios.spec import Scenario
from scenarios.spec_scenes import RobotScene
from scenarios.warm import compile_side_by_side
from scenarios.zones import tracks_of_all, zone_steps, zones_of
from twin.source import TwinSource

Progress = Callable[[int, int], None]
EFFICIENCIES = {"efficiency", "efficiency_detection"}
"""Metrics that need the bound, which takes seconds: they are scored where a scenario limits them."""
VIEW_AT = 0.4
"""Where in the run the picture of a camera is taken: a share of its length."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run's record, what the page shows beside it, its tracks and the truth (None where there is none).

    ``commands``: what drove the subject; ``estimated``: the calibration of its own; ``poses``: of its rigid bodies.
    """

    record: RunRecord
    evidence: Evidence
    tracks: Tracks
    truth: Truth | None
    commands: Any = None
    estimated: Estimated | None = None
    poses: BodyPoses | None = None


@dataclass(frozen=True)
class RunOptions:
    """How to run.

    ``source``: "twin", "recording:DIR" or "hardware:RIG.toml". ``workers``: threads that render. ``rrd``: a Rerun log
    to write while running. ``record_to``: a folder to record the frames into. ``truth``: what frames that are not
    the twin's are scored against; default: ``truth.npz`` beside a recording. ``progress``: called with pulses done
    and in all.
    """

    source: str = "twin"
    workers: int = 1
    rrd: Path | None = None
    record_to: Path | None = None
    truth: Path | None = None
    progress: Progress | None = None


def run_scenario(spec: Scenario, name: str, folder: Path, options: RunOptions | None = None) -> RunResult:
    """Run ``spec``; files that it names are looked for in ``folder``. PremiseError where a premise fails."""
    options = options or RunOptions()
    timings: dict[str, float] = {}
    with ExitStack() as stack, _timed(timings, "total"):
        with _timed(timings, "build"):
            rig = true_rig(spec, folder)
            cameras = virtual_cameras(spec, rig)
            worn = spec.continuous is not None and spec.continuous.worn_on is not None
            if worn:
                from scenarios.continuous_worn import worn_cameras, worn_rig, worn_settings

                cameras = worn_cameras(spec, cameras)
                known, settings = worn_rig(spec, cameras), worn_settings(spec)
            else:
                known, settings = calibrated(spec, cameras), pipeline_settings(spec)
            names = known.rig.names
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
            source = twin_source(spec, scene, cameras, options.workers)
        else:
            source = opened(options.source, rig, spec.capture.frame_rate_hz, spec.capture.pulses)
        stack.enter_context(source)
        if options.source.startswith("hardware:"):
            settings = replace(settings, assembly=patient(settings.assembly, source))
        if isinstance(source, TwinSource):
            with _timed(timings, "compile"):
                compile_side_by_side(source)
        curves = None
        with _timed(timings, "frames_to_tracks"):
            if spec.continuous is not None:
                collected, curves = _collect_continuous(source, believed, settings, spec, options, stack)
            else:
                collected = _collect(source, believed, settings, spec, options, stack)
        bodies = rigid_bodies(scene) if scene is not None and spec.pipeline.bodies else ()
        poses = None
        if bodies:
            with _timed(timings, "bodies"):
                check_bodies(bodies)
                poses = body_poses(collected.tracks, bodies)
                collected = replace(collected, tracks=labelled_by_bodies(collected.tracks, bodies))
        if own is not None:
            for k, one in enumerate(f for f in own.calibration.findings if f.severity == "warn"):
                collected.assembly.notes[f"calibration {k + 1}"] = f"{one.code}: {one.message}"
        truth = source.truth() if isinstance(source, TwinSource) else _reference(options)
        if isinstance(source, TwinSource) and truth is not None and options.record_to is not None:
            write_truth(truth, options.record_to / "truth.npz")
        with _timed(timings, "score"):
            space = max(spec.working_space.size_m)
            more: dict[str, Score] = {}
            if curves is not None and truth is not None:
                from scenarios.continuous_run import scored_apart

                collected, truth, more = scored_apart(spec, collected, curves, truth, scene)
            truth = None if truth is None else _as_seen_by(truth, names)
            matched = None if truth is None else pair(collected.tracks, truth, space)
            scores = {} if matched is None else metrics(matched, space)
            scores = {**scores, **({} if own is None else own.scores()), **more}
            if matched is not None and truth is not None and "over_synchronous" in spec.limits:
                from scenarios.continuous_run import over_synchronous

                again = _collect(source, believed, settings, spec, replace(options, record_to=None), stack)
                scores |= over_synchronous(matched, again.tracks, truth, space)
            if poses is not None and truth is not None:
                scores |= body_scores(poses, bodies, truth)
            if (
                matched is not None
                and truth is not None
                and isinstance(source, TwinSource)
                and EFFICIENCIES & set(spec.limits)
            ):
                scores = {**scores, **_efficiencies(source, spec, truth, believed, matched, collected)}
            premises = {} if truth is None else _premises(spec, truth, name)
        written = collected.tracks
        if spec.pipeline.fill_s is not None:
            # what is scored and counted was measured; what is written has its gaps filled besides
            written, collected.assembly.notes["filled"] = with_gaps_filled(written, spec.pipeline.fill_s)
    timings |= collected.seconds
    record = record_of(spec, name, options.source, scores, premises, timings, known, collected)
    evidence = evidence_of(spec, believed, collected, truth, matched)
    commands = None if scene is None else scene.commands
    return RunResult(record, evidence, written, truth, commands, own, poses)


def _efficiencies(
    source: TwinSource, spec: Scenario, truth: Truth, rig: Rig, matched: Matched, collected: Collected
) -> dict[str, Score]:
    """Return how near the run came to what its frames allow."""
    errors = {v.camera.name: (v.mount, v.timing) for v in source.virtual}
    pulses = pulses_asked(len(truth.time_ns))
    least = bound(source.expected, truth, rig, errors, pulses)
    return efficiencies(least, matched, truth, collected.asked, BLOCKS)


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
    nothing = Collected(table([]), (), -1, Assembly(), {}, {})
    scores = {} if own is None else own.scores()
    record = record_of(spec, name, options.source, scores, {}, timings, known, nothing)
    record = replace(record, passed=caught is not None, verdict=verdict)
    rig = known.rig if own is None else own.calibration.rig
    return RunResult(record, evidence_of(spec, rig, nothing, None, None), nothing.tracks, None, None, own)


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
        if result.poses is not None:
            write_bodies_csv(result.poses, part / "bodies.csv")
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


def _collect(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings,
    spec: Scenario,
    options: RunOptions,
    stack: ExitStack,
) -> Collected:
    """Run the pipeline to its end and keep what the record, the page and the viewer need."""
    assembly = Assembly()
    samples: list[Samples] = []
    views: tuple[CameraView, ...] = ()
    view_pulse, pulses = -1, spec.capture.pulses
    seconds: dict[str, float] = {}
    latency: list[float] = []
    wanted = set(pulses_asked(pulses).tolist()) if EFFICIENCIES & set(spec.limits) else set()
    asked: dict[int, Mapping[str, Detections]] = {}
    log = None
    if options.rrd is not None:
        from reports.viewer import RerunLog

        space = spec.working_space
        log = stack.enter_context(
            RerunLog(options.rrd, rig, (np.array(space.center_m), np.array(space.size_m)))
        )
    read = _recorded(source, options, spec, stack)
    if any(info.name not in rig.names for info in read.cameras):
        read = Chosen(read, rig.names)
    stop = stack.enter_context(between_steps())
    keeper = RigKeeper(rig) if spec.pipeline.watch else None
    zones = zones_of(spec, rig)
    healths = [
        Health(one, HealthSettings(start_px=settings.match.camera_sigma_px))
        for one in ([zone.rig for zone in zones] or [rig])
    ]
    if zones:
        steps = zone_steps(read, zones, rig, settings, assembly, healths)
    else:
        steps = run(read, rig, settings, assembly, keeper=keeper, health=healths[0])
    for done, step in enumerate(steps, start=1):
        stop()
        samples.append(step.samples)
        for stage, value in step.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + value
        latency.append(sum(step.seconds.values()))
        if step.frame_set.pulse in wanted:
            asked[step.frame_set.pulse] = step.detections
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
    if nameless := sum(health.nameless for health in healths):
        assembly.notes["nameless"] = f"{nameless} samples at the end had no identity yet and are left out"
    for k, line in enumerate(line for health in healths for line in health.findings()):
        assembly.notes[f"camera {k + 1}"] = line
    if latency:
        seconds["latency_p99"] = float(np.quantile(latency, 0.99))
        seconds["pipeline_per_set"] = float(np.mean(latency))
    tracks = table(samples)
    if zones:
        tracks = tracks_of_all(tracks, zones, assembly)
    cameras = tuple(one for health in healths for one in health.cameras())
    return Collected(tracks, views, view_pulse, assembly, seconds, asked, cameras)


def _collect_continuous(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings,
    spec: Scenario,
    options: RunOptions,
    stack: ExitStack,
) -> tuple[Collected, Any]:
    """Run ``mosca.continuous`` on the frames, which need no pulse in common."""
    from scenarios.continuous_run import collect_continuous

    if options.rrd is not None:
        raise InputError("--rrd shows frame sets, which a [continuous] scenario has none of; leave it out")
    read = _recorded(source, options, spec, stack)
    return collect_continuous(read, rig, settings, spec, options.progress)


def _recorded(source: FrameSource, options: RunOptions, spec: Scenario, stack: ExitStack) -> FrameSource:
    """Return ``source``, written down on its way through where that is asked for, with what drove its subject."""
    if options.record_to is None:
        return source
    writer = stack.enter_context(RecordingWriter(options.record_to, source.cameras))
    if isinstance(source, TwinSource) and source.scene.commands is not None:
        target = spec.scene.target if isinstance(spec.scene, RobotScene) else "robot"
        write_commands(writer, source.scene.commands, target)
    return Written(source, writer)


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


def _reference(options: RunOptions) -> Truth | None:
    """Return the truth that was asked for, else the one beside a recording, else None."""
    if options.truth is not None:
        return read_truth(options.truth)
    path = Path(options.source.partition(":")[2]) / "truth.npz"
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
