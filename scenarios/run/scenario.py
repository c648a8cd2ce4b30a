"""One scenario from scene to score: build, calibrate, expose, run the pipeline, compare with the truth."""

import logging
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from mosca.continuous.moving_cameras.body_worn import Worn
from mosca.continuous.reconstruct import Reconstructed
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.files.rig_file import write_rig
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks, table
from mosca.data.truth import Truth, write_truth
from mosca.errors import CalibrationError, InputError
from mosca.machines.identification.identify import IdentifiedModel
from mosca.machines.vibration.analysis import Vibration
from mosca.pipeline import PipelineSettings, Step
from mosca.rigid_bodies.ambiguity import check_bodies
from mosca.rigid_bodies.tracker import body_poses, labelled_by_bodies
from mosca.synchronisation import Assembly
from reports.evidence import Evidence
from reports.record import RunRecord
from reports.viewer import RerunLog
from reports.viewer_result import log_result
from scenarios.build.calibration_faults import with_fault
from scenarios.build.cameras import Calibrated, calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.frame_sources import account, device_notes, patient
from scenarios.build.frame_sources import check_source as check_named_source
from scenarios.build.frame_sources import opened as opened_source
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.build.survey import without_own_camera
from scenarios.build.worn_rig import worn_cameras, worn_rig, worn_settings
from scenarios.flight.loop import RenderedPoses, check_flight_source, pilot_of
from scenarios.flight.pilot import Pilot
from scenarios.flight.predicted import Flown
from scenarios.run.acceptance import acceptance_scores
from scenarios.run.applications import applications
from scenarios.run.calibration_take import calibration_take
from scenarios.run.clinic import clinic_report, verdict
from scenarios.run.continuous import collect_continuous
from scenarios.run.flight import flight_evidence, flight_of
from scenarios.run.identification import check_source
from scenarios.run.kept_calibrations import kept
from scenarios.run.people import FitInputs, Person, show_person
from scenarios.run.pipeline import collected_of, recorded, rerun_log
from scenarios.run.postprocess import with_gaps_filled
from scenarios.run.precompile import PIPELINE, compiling
from scenarios.run.record import evidence_of, position_limit_mm, record_of
from scenarios.run.survey import Survey, surveyed
from scenarios.run.survey import check_source as check_survey_source
from scenarios.run.timed import StageTimes, timed
from scenarios.score.bodies import rigid_bodies
from scenarios.score.continuous import as_worn
from scenarios.score.delivery import camera_frames, expected_sets, frames_complete, sets_complete
from scenarios.score.flight import flight_scores
from scenarios.score.reference import ReferenceTrajectories, requested_truth
from scenarios.score.score_run import scored
from scenarios.score.sensor import sensor_findings, stated_sensors
from scenarios.score.without_truth import self_checks
from scenarios.session.estimated import SessionCalibration, calibrate_in_session, inputs_of
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected, MeasuredTracks, RunOptions, Score, Scored, TruthSource
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Commands, Scene

LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RunResult:
    """Results of a run."""

    record: RunRecord
    evidence: Evidence
    """Data for the page besides the record."""
    tracks: Tracks
    truth: Truth | None
    """The truth; None where there is none."""
    commands: Commands | None = None
    """Commands that drove the subject."""
    calibration: SessionCalibration | None = None
    """The calibration of the scenario's own session."""
    poses: BodyPoses | None = None
    """Poses of the scenario's rigid bodies."""
    person: Person | None = None
    """The scene's person, where the scenario has a skeleton."""
    vibration: Vibration | None = None
    """Vibration of the scene's panel."""
    model: IdentifiedModel | None = None
    """Model of the driven robot, where the scenario identifies one."""
    flight: Flown | None = None
    """Flight in closed loop."""


@dataclass(frozen=True, eq=False)
class _Built:
    """True rig and cameras of a scenario, its nominal calibration, pipeline settings, and the twin's scene."""

    rig: Rig
    cameras: tuple[VirtualCamera, ...]
    known: Calibrated
    settings: PipelineSettings
    scene: Scene | None
    riding: tuple[VirtualCamera, ...]
    """All cameras, including that of [self_orientation]."""
    pilot: Pilot | None = None
    """Pilot that steers the scene's drone by the arriving poses."""


@dataclass(frozen=True, eq=False)
class _Opened:
    """Source of the frames (``twin``: the same source where it has ground truth), and its settings."""

    source: FrameSource
    twin: TruthSource | None
    settings: PipelineSettings


def run_scenario(spec: Scenario, name: str, folder: Path, options: RunOptions | None = None) -> RunResult:
    """Run ``spec``; its file names are relative to ``folder``. PremiseError where a premise fails."""
    options = options or RunOptions()
    LOG.info("%s: frames of %s", name, options.source)
    given_truth = _given_truth(options)
    timings = StageTimes(options.stage)
    with ExitStack() as stack, timed(timings, "total"), compiling(PIPELINE) as pipeline_compiled:
        with timed(timings, "build"):
            built = _built(spec, folder, options)
        own: SessionCalibration | None = None
        if spec.session is not None:
            with timed(timings, "calibration"):
                own, reported = _own_calibration(spec, name, built, options)
            if spec.expect == "caught":
                return _refused(spec, name, options, built.known, timings, reported, own)
        believed = with_fault(built.known.rig if own is None else own.calibration.rig, spec.fault)
        fit_inputs = _fit_inputs(spec, folder, built, believed, options, timings)
        survey = surveyed(spec, built.riding, own, options.workers, timings)
        opened = _opened(spec, built, options, survey)
        stack.enter_context(opened.source)
        with timed(timings, "compile"):
            next(iter(opened.twin or ()), None)  # compiles the twin's kernels meanwhile
            pipeline_compiled()
        if spec.clinic is not None:
            return _diagnosed(spec, name, options, built, opened, believed, own, timings, stack)
        with timed(timings, "frames_to_tracks"):
            shown = rerun_log(options.rrd, believed, spec, stack)
            collected, continuous = _tracked(opened, believed, spec, options, stack, shown, built)
        collected = _beside_data_sheets(replace(collected, account=account(opened.source)), spec, built)
        if continuous is not None:
            collected = _with_frames(collected, spec, built, opened, continuous)
        if options.source.startswith("hardware:"):
            collected.assembly.notes.update(device_notes(opened.source))
        # the scenario defines the positions of markers on a body, for any source of frames
        bodies = rigid_bodies(built.scene or build_scene(spec, folder)) if spec.pipeline.bodies else ()
        poses = None
        if bodies:
            with timed(timings, "bodies"):
                collected, poses = _with_bodies(collected, bodies)
        collected.assembly.notes.update(_warnings(own))
        truth = given_truth if opened.twin is None else opened.twin.truth()
        if options.record_to is not None:
            _write_beside(options.record_to, believed, None if opened.twin is None else truth)
        done = applications(spec, folder, collected, truth, fit_inputs, bodies, poses, built.scene, timings, shown)
        oriented = None if survey is None or poses is None else survey.scored(poses, bodies, timings)
        flight = flight_of(spec, built.pilot, built.scene, collected, own)
        if done.person is not None:
            show_person(shown, done.person.take.joints, truth if isinstance(truth, Truth) else None)

        def synchronous() -> Tracks:
            again = replace(options, record_to=None)
            return collected_of(opened.source, opened.twin, believed, opened.settings, spec, again, stack).tracks

        with timed(timings, "score"):
            calibration_m2 = None if own is None else own.covariance_m2
            joints, labelled = (None, done.named) if done.person is None else done.person.scored(spec)
            measured = MeasuredTracks(
                collected, believed, built.known.rig.names, synchronous, continuous, bodies, poses, calibration_m2,
                joints, labelled, done.vibration, done.shown, built.known.rig,
            )  # fmt: skip
            worth = scored(spec, name, measured, truth, opened.twin, built.scene)
            collected = worth.collected
            scores = _all_scores(spec, folder, worth, poses, timings, own) | done.model_scores
            scores |= {} if flight is None else flight_scores(flight.path, flight.delay)
            if oriented is not None:
                scores, worth = scores | oriented.scores, oriented.added_to(worth)
        evidence = evidence_of(spec, believed, worth, done.person, done.vibration, done.shown)
        log_result(shown, evidence, position_limit_mm(spec))
        # identities are scored as given by the tracker, since a label may have split a track
        written = _filled(spec, collected, collected.tracks if done.named is None else done.named)
    timings |= collected.seconds
    record = record_of(spec, name, options.source, replace(worth, scores=scores), timings, built.known)
    if oriented is not None:
        evidence = replace(evidence, self_orientation=oriented.evidence)
    if flight is not None:
        evidence = replace(evidence, flight=flight_evidence(flight))
    if continuous is not None:
        evidence = as_worn(evidence, spec, continuous)
    found = (getattr(built.scene, "commands", None), own, poses, done.person, done.vibration, done.model, flight)
    return RunResult(record, evidence, written, worth.truth, *found)


def _given_truth(options: RunOptions) -> Truth | ReferenceTrajectories | None:
    """Return the truth for frames from other sources than the twin; InputError where one is given for the twin."""
    if options.source != "twin":
        return requested_truth(options)
    if options.truth is not None:
        raise InputError(f"--truth {options.truth}: the twin has its own truth; leave --truth out, or give --source")
    return None


def _filled(spec: Scenario, collected: Collected, tracks: Tracks) -> Tracks:
    """Return the tracks to write, with filled gaps; scores and counts are of the measured samples only."""
    if spec.pipeline.fill_s is None:
        return tracks
    tracks, collected.assembly.notes["filled"] = with_gaps_filled(tracks, spec.pipeline.fill_s)
    return tracks


def _warnings(own: SessionCalibration | None) -> dict[str, str]:
    """Return the warnings of the scenario's own calibration, as notes."""
    found = () if own is None else [one for one in own.calibration.findings if one.severity == "warn"]
    return {f"calibration {k + 1}": f"{one.code}: {one.message}" for k, one in enumerate(found)}


def _attending(spec: Scenario, built: _Built, rig: Rig) -> Callable[[Step], None] | None:
    """Return a function that passes the pipeline's steps to the pilot of a flight in closed loop; None without one.

    ``rig``: the rig that measures the steps.
    """
    if built.scene is None or built.pilot is None:
        return None
    return RenderedPoses(spec, built.scene, built.pilot, rigid_bodies(built.scene), rig).attend


def _with_frames(
    collected: Collected, spec: Scenario, built: _Built, opened: _Opened, continuous: Reconstructed | Worn
) -> Collected:
    """Return the collected results with the account of each free-running camera's frames."""
    gathered = (continuous.reconstructed if isinstance(continuous, Worn) else continuous).gathered
    frames = camera_frames(spec, gathered, built.cameras, opened.twin is not None, collected.account)
    return replace(collected, frames=frames)


def _built(spec: Scenario, folder: Path, options: RunOptions) -> _Built:
    check_named_source(options.source)
    check_source(spec, options.source)
    check_survey_source(spec, options.source)
    check_flight_source(spec, options.source)
    rig = true_rig(spec, folder)
    riding = virtual_cameras(spec, rig)
    cameras = without_own_camera(spec, riding)
    if spec.continuous is not None and spec.continuous.worn_on is not None:
        cameras = worn_cameras(spec, cameras)
        known, settings = worn_rig(spec, cameras), worn_settings(spec)
    else:
        known, settings = calibrated(spec, cameras), pipeline_settings(spec)
    pilot = None if spec.flight is None else pilot_of(spec)
    scene = build_scene(spec, folder, pilot) if options.source == "twin" else None
    return _Built(rig, cameras, known, settings, scene, riding, pilot)


def _write_beside(frames: Path, believed: Rig, truth: object) -> None:
    """Write the rig that the pipeline used, and the twin's truth, beside recorded frames."""
    write_rig(believed, frames / "rig.toml")
    if isinstance(truth, Truth):
        write_truth(truth, frames / "truth.npz")


def _fit_inputs(
    spec: Scenario, folder: Path, built: _Built, believed: Rig, options: RunOptions, timings: dict[str, float]
) -> FitInputs | None:
    """Return the inputs of the skeleton's fit; None where the scenario has no skeleton."""
    if spec.skeleton is None:
        return None
    if spec.skeleton.fit_to == "take":
        return FitInputs(None, believed)
    with timed(timings, "calibration_take"):
        movement = calibration_take(spec, folder, built.cameras, believed, built.settings, options)
    return FitInputs(movement, believed)


def _own_calibration(
    spec: Scenario, name: str, built: _Built, options: RunOptions
) -> tuple[SessionCalibration | None, tuple[tuple[str, str], ...]]:
    """Return the calibration of the scenario's own session, and codes and messages of its findings.

    CalibrationError where it is refused and the scenario does not expect this; where it does, the refusal is the
    finding.
    """
    try:
        inputs = inputs_of(spec, built.cameras, built.known.rig)
        own = kept(inputs, lambda: calibrate_in_session(spec, built.cameras, built.known.rig, options.workers))
    except CalibrationError as refusal:
        if spec.expect != "caught":
            raise
        return None, ((refusal.code, str(refusal)),)
    reported = tuple((one.code, one.message) for one in own.calibration.findings if one.severity != "note")
    if own.calibration.refused and spec.expect != "caught":
        raise CalibrationError(f"{name}: {reported[0][0]}: {reported[0][1]}")
    return own, reported


def _beside_data_sheets(collected: Collected, spec: Scenario, built: _Built) -> Collected:
    """Return the estimated sensors with the values that the scenario states; disagreements are added to the notes.

    A scenario states the sensors of its virtual cameras; of real cameras it states only those that it names.
    """
    named = {one.name for one in spec.camera if one.sensor.name is not None}
    sheets = {
        one.camera.name: one.sensor
        for one in built.cameras
        if built.scene is not None or spec.sensor.name is not None or one.camera.name in named
    }
    stated = stated_sensors(collected.sensors, sheets)
    for k, line in enumerate(sensor_findings(collected.sensors, stated)):
        collected.assembly.notes[f"sensor {k + 1}"] = line
    return replace(collected, stated=stated)


def _opened(spec: Scenario, built: _Built, options: RunOptions, survey: Survey | None) -> _Opened:
    if built.scene is not None:
        twin = twin_source(spec, built.scene, built.cameras, options.workers)
        return _Opened(twin if survey is None else survey.watched(twin), twin, built.settings)
    source = opened_source(options.source, built.rig, spec.capture.frame_rate_hz, spec.capture.pulses)
    settings = built.settings
    if options.source.startswith("hardware:"):
        settings = replace(settings, assembly=patient(settings.assembly, source))
    return _Opened(source, None, settings)


def _tracked(
    opened: _Opened,
    rig: Rig,
    spec: Scenario,
    options: RunOptions,
    stack: ExitStack,
    shown: RerunLog | None,
    built: _Built,
) -> tuple[Collected, Reconstructed | Worn | None]:
    """Return the pipeline's result, and the continuous reconstruction where the scenario has one."""
    if spec.continuous is None:
        read, twin, attend = opened.source, opened.twin, _attending(spec, built, rig)
        return collected_of(read, twin, rig, opened.settings, spec, options, stack, shown, attend), None
    read = recorded(opened.source, opened.twin, options, spec, stack)
    return collect_continuous(read, rig, opened.settings, spec, options.progress)


def _all_scores(
    spec: Scenario,
    folder: Path,
    worth: Scored,
    poses: BodyPoses | None,
    timings: Mapping[str, float],
    own: SessionCalibration | None,
) -> dict[str, Score]:
    """Return the scores with and without truth, and those of acceptance test and session; notes are added."""
    collected = worth.collected
    seconds = {**timings, **collected.seconds}
    without_truth, notes = self_checks(spec, collected.tracks, poses, seconds, collected.assembly.sets)
    for k, line in enumerate(notes):
        collected.assembly.notes[f"length {k + 1}"] = line
    accepted, notes = acceptance_scores(spec, folder, collected.tracks)
    for k, line in enumerate(notes):
        collected.assembly.notes[f"acceptance {k + 1}"] = line
    if collected.frames:
        complete = {"frames_complete": frames_complete(collected.frames)}
    else:
        expected = expected_sets(collected.assembly, spec.capture.pulses, collected.account)
        complete = {"sets_complete": sets_complete(collected.assembly, expected)}
    # with a truth, ray residuals are those of existing points, not of ghosts: the later mapping wins
    return {**complete, **without_truth, **accepted, **worth.scores, **({} if own is None else own.scores())}


def _with_bodies(collected: Collected, bodies: tuple[RigidBody, ...]) -> tuple[Collected, BodyPoses]:
    """Return the tracks labelled by the rigid bodies to which they belong, and the bodies' poses."""
    check_bodies(bodies)
    poses = body_poses(collected.tracks, bodies)
    return replace(collected, tracks=labelled_by_bodies(collected.tracks, bodies)), poses


def _diagnosed(
    spec: Scenario,
    name: str,
    options: RunOptions,
    built: _Built,
    opened: _Opened,
    believed: Rig,
    own: SessionCalibration | None,
    timings: Mapping[str, float],
    stack: ExitStack,
) -> RunResult:
    """Return the result of a scenario whose fault the clinic must name; no accuracy is scored."""
    found = clinic_report(spec, opened.source, opened.twin, believed, opened.settings, options, stack)
    if options.record_to is not None:
        _write_beside(options.record_to, believed, None)
    passed, told = verdict(spec, found)
    nothing = Collected(table([]), (), -1, Assembly(), {}, {})
    for k, one in enumerate(found.causes):
        nothing.assembly.notes[f"cause {k + 1}"] = f"{one.code}: {'; '.join(one.evidence)}"
    worth = Scored({}, {}, nothing, None, None)
    record = replace(record_of(spec, name, options.source, worth, timings, built.known), passed=passed, verdict=told)
    return RunResult(record, evidence_of(spec, believed, worth), nothing.tracks, None, None, own)


def _refused(
    spec: Scenario,
    name: str,
    options: RunOptions,
    known: Calibrated,
    timings: Mapping[str, float],
    reported: tuple[tuple[str, str], ...],
    own: SessionCalibration | None,
) -> RunResult:
    """Return the result of a scenario whose calibration must be refused or give a warning; nothing is measured.

    ``reported``: codes and messages of the calibration's findings.
    """
    caught = next((message for code, message in reported if code == spec.caught_as), None)
    others = ", ".join(code or message for code, message in reported) or "nothing"
    verdict = (
        f"caught as it must be: {spec.caught_as}: {caught.removeprefix(f'{spec.caught_as}: ')}"
        if caught is not None
        else f"not caught: '{spec.caught_as}' should have been told of; told of was {others}"
    )
    nothing = Collected(table([]), (), -1, Assembly(), {}, {})
    worth = Scored({} if own is None else own.scores(), {}, nothing, None, None)
    record = record_of(spec, name, options.source, worth, timings, known)
    record = replace(record, passed=caught is not None, verdict=verdict)
    rig = known.rig if own is None else own.calibration.rig
    return RunResult(record, evidence_of(spec, rig, worth), nothing.tracks, None, None, own)
