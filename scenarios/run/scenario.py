"""One scenario from scene to score: build, calibrate, expose, run the pipeline, meet the truth."""

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks, table
from mosca.data.truth import Truth, write_truth
from mosca.errors import CalibrationError
from mosca.pipeline import PipelineSettings
from mosca.rigid_bodies.ambiguity import check_bodies
from mosca.rigid_bodies.tracker import body_poses, labelled_by_bodies
from mosca.synchronisation import Assembly
from reports.evidence import Evidence
from reports.record import RunRecord
from scenarios.build.calibration_faults import with_fault
from scenarios.build.cameras import Calibrated, calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.run.options import RunOptions
from scenarios.run.pipeline import collected_continuous, collected_of
from scenarios.run.postprocess import with_gaps_filled
from scenarios.run.precompile import compile_side_by_side
from scenarios.run.record import Collected, evidence_of, record_of
from scenarios.run.sources import opened, patient
from scenarios.score.bodies import rigid_bodies
from scenarios.score.reference import reference
from scenarios.score.score_run import Measured, scored
from scenarios.score.without_truth import self_checks
from scenarios.session.estimated import Estimated, estimated
from scenarios.spec.scenario import Scenario
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Scene
from twin.source import TwinSource


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


@dataclass(frozen=True, eq=False)
class _Built:
    """What a scenario describes, made: true rig and cameras, what is known of them, settings, the twin's scene."""

    rig: Rig
    cameras: tuple[VirtualCamera, ...]
    known: Calibrated
    settings: PipelineSettings
    scene: Scene | None


def run_scenario(spec: Scenario, name: str, folder: Path, options: RunOptions | None = None) -> RunResult:
    """Run ``spec``; files that it names are looked for in ``folder``. PremiseError where a premise fails."""
    options = options or RunOptions()
    timings: dict[str, float] = {}
    with ExitStack() as stack, _timed(timings, "total"):
        with _timed(timings, "build"):
            built = _built(spec, folder, options)
        own: Estimated | None = None
        if spec.calibration is not None:
            with _timed(timings, "calibration"):
                own, told = _own_calibration(spec, name, built, options)
            if spec.expect == "caught":
                return _refused(spec, name, options, built.known, timings, told, own)
        believed = with_fault(built.known.rig if own is None else own.calibration.rig, spec.fault)
        source, settings = _opened(spec, built, options)
        stack.enter_context(source)
        if isinstance(source, TwinSource):
            with _timed(timings, "compile"):
                compile_side_by_side(source)
        curves = None
        with _timed(timings, "frames_to_tracks"):
            if spec.continuous is not None:
                collected, curves = collected_continuous(source, believed, settings, spec, options, stack)
            else:
                collected = collected_of(source, believed, settings, spec, options, stack)
        # where its markers sit on a body is the scenario's to say, whoever takes the frames
        bodies = rigid_bodies(built.scene or build_scene(spec, folder)) if spec.pipeline.bodies else ()
        poses = None
        if bodies:
            with _timed(timings, "bodies"):
                collected, poses = _with_bodies(collected, bodies)
        if own is not None:
            for k, one in enumerate(f for f in own.calibration.findings if f.severity == "warn"):
                collected.assembly.notes[f"calibration {k + 1}"] = f"{one.code}: {one.message}"
        truth = source.truth() if isinstance(source, TwinSource) else reference(options)
        if isinstance(source, TwinSource) and isinstance(truth, Truth) and options.record_to is not None:
            write_truth(truth, options.record_to / "truth.npz")

        def synchronous() -> Tracks:
            again = replace(options, record_to=None)
            return collected_of(source, believed, settings, spec, again, stack).tracks

        with _timed(timings, "score"):
            share = None if own is None else own.share_m2
            names = built.known.rig.names
            measured = Measured(collected, believed, names, synchronous, curves, bodies, poses, share)
            worth = scored(spec, name, measured, truth, source, built.scene)
            collected = worth.collected
            own_worth, notes = self_checks(
                spec, collected.tracks, poses, {**timings, **collected.seconds}, collected.assembly.sets
            )
            for k, line in enumerate(notes):
                collected.assembly.notes[f"length {k + 1}"] = line
            # against a truth rays are judged over the points that are there, not over ghosts
            scores = {**own_worth, **worth.scores, **({} if own is None else own.scores())}
        written = collected.tracks
        if spec.pipeline.fill_s is not None:
            # what is scored and counted was measured; what is written has its gaps filled besides
            written, collected.assembly.notes["filled"] = with_gaps_filled(written, spec.pipeline.fill_s)
    timings |= collected.seconds
    record = record_of(
        spec, name, options.source, scores, worth.premises, timings, built.known, collected, worth.not_judged
    )
    evidence = evidence_of(spec, believed, collected, worth.truth, worth.matched)
    if curves is not None:
        from scenarios.run.continuous import as_worn

        evidence = as_worn(evidence, spec, curves)
    commands = None if built.scene is None else built.scene.commands
    return RunResult(record, evidence, written, worth.truth, commands, own, poses)


def _built(spec: Scenario, folder: Path, options: RunOptions) -> _Built:
    rig = true_rig(spec, folder)
    cameras = virtual_cameras(spec, rig)
    if spec.continuous is not None and spec.continuous.worn_on is not None:
        from scenarios.score.worn_cameras import worn_cameras, worn_rig, worn_settings

        cameras = worn_cameras(spec, cameras)
        known, settings = worn_rig(spec, cameras), worn_settings(spec)
    else:
        known, settings = calibrated(spec, cameras), pipeline_settings(spec)
    scene = build_scene(spec, folder) if options.source == "twin" else None
    return _Built(rig, cameras, known, settings, scene)


def _own_calibration(
    spec: Scenario, name: str, built: _Built, options: RunOptions
) -> tuple[Estimated | None, tuple[tuple[str, str], ...]]:
    """Return the calibration of the scenario's own session, and codes and messages of what it told of.

    CalibrationError where it is refused and the scenario does not expect that it is; where it does, the refusal is
    what was told.
    """
    try:
        own = estimated(spec, built.cameras, built.known.rig, options.workers)
    except CalibrationError as refusal:
        if spec.expect != "caught":
            raise
        return None, ((refusal.code, str(refusal)),)
    told = tuple((one.code, one.message) for one in own.calibration.findings if one.severity != "note")
    if own.calibration.refused and spec.expect != "caught":
        raise CalibrationError(f"{name}: {told[0][0]}: {told[0][1]}")
    return own, told


def _opened(spec: Scenario, built: _Built, options: RunOptions) -> tuple[FrameSource, PipelineSettings]:
    """Return where the frames come from, and settings that are patient with it."""
    if built.scene is not None:
        return twin_source(spec, built.scene, built.cameras, options.workers), built.settings
    source = opened(options.source, built.rig, spec.capture.frame_rate_hz, spec.capture.pulses)
    settings = built.settings
    if options.source.startswith("hardware:"):
        settings = replace(settings, assembly=patient(settings.assembly, source))
    return source, settings


def _with_bodies(collected: Collected, bodies: tuple[RigidBody, ...]) -> tuple[Collected, BodyPoses]:
    """Return the tracks labelled by the rigid bodies that they belong to, and the bodies' poses."""
    check_bodies(bodies)
    poses = body_poses(collected.tracks, bodies)
    return replace(collected, tracks=labelled_by_bodies(collected.tracks, bodies)), poses


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


class _timed:
    """Adds the seconds of a block to a dictionary."""

    def __init__(self, timings: dict[str, float], name: str) -> None:
        self._timings, self._name = timings, name

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *exc: object) -> None:
        self._timings[self._name] = time.perf_counter() - self._start
