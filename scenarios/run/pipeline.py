"""Tracks from the frames of a run: the pipeline to its end, with the data for record, page and viewer."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from mosca.calibration.monitoring.rig_keeper import RigKeeper
from mosca.data.detections import Detections
from mosca.data.files.whole_file import check_folder
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import Samples, table
from mosca.diagnostics.camera_health import Health
from mosca.diagnostics.sensor import Sensors
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, Step, run
from mosca.recording import RecordingWriter
from mosca.synchronisation import Assembly
from reports.evidence import CameraView
from reports.playback.keeper import VIEW_AT, PageKeeper
from reports.viewer import RerunLog
from scenarios.build.frame_sources import Recorded, SelectedCameras
from scenarios.build.robot_commands import write_commands
from scenarios.run.interrupt import between_steps
from scenarios.run.zones import tracks_of_all, zone_steps, zones_of
from scenarios.score.cramer_rao import needs_bound, pulses_asked
from scenarios.spec.scenario import Scenario
from scenarios.spec.scenes import RobotScene
from scenarios.types import Collected, RunOptions, TruthSource


def collected_of(
    source: FrameSource,
    twin: TruthSource | None,
    rig: Rig,
    settings: PipelineSettings,
    spec: Scenario,
    options: RunOptions,
    stack: ExitStack,
    shown: RerunLog | None = None,
    attend: Callable[[Step], None] | None = None,
) -> Collected:
    """Run the pipeline to its end and keep the data for the record, the page and the viewer.

    ``twin``: the same source if it has ground truth; ``shown``: log for each step; ``attend``: called with each step
    before the next frames are read.
    """
    assembly = Assembly()
    samples: list[Samples] = []
    views: tuple[CameraView, ...] = ()
    view_pulse, pulses = -1, spec.capture.pulses
    seconds: dict[str, float] = {}
    latency: list[float] = []
    bound_pulses = set(pulses_asked(pulses).tolist()) if needs_bound(spec.limits) else set()
    detections: dict[int, Mapping[str, Detections]] = {}
    log = _step_log(shown, twin, pulses, options.rrd_images)
    read = recorded(source, twin, options, spec, stack)
    if any(info.name not in rig.names for info in read.cameras):
        read = SelectedCameras(read, rig.names)
    stop = stack.enter_context(between_steps())
    keeper = RigKeeper(rig) if spec.pipeline.watch else None
    zones = zones_of(spec, rig)
    healths = [Health.of(one, settings.match) for one in ([zone.rig for zone in zones] or [rig])]
    kept = PageKeeper(pulses, 0 if zones else len(rig.cameras), options.page)
    sensors = Sensors(read.cameras, settings.detection)
    if zones:
        steps = zone_steps(read, zones, rig, settings, assembly, healths, sensors)
    else:
        steps = run(read, rig, settings, assembly, keeper=keeper, health=healths[0], sensors=sensors)
    if options.progress is not None:
        options.progress(0, pulses)
    for done, step in enumerate(steps, start=1):
        stop()
        if attend is not None:
            attend(step)
        samples.append(step.samples)
        for stage, value in step.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + value
        latency.append(sum(step.seconds.values()))
        if step.frame_set.pulse in bound_pulses:
            detections[step.frame_set.pulse] = step.detections
        if done == max(1, round(VIEW_AT * pulses)):
            views, view_pulse = _views(step), step.frame_set.pulse
        images = {name: frame.image for name, frame in step.frame_set.frames.items()}
        kept.attend(step.frame_set.pulse, images, step.detections, step.points)
        log(step)
        if options.progress is not None:
            options.progress(done, max(done, pulses))
    if keeper is not None:
        keeper.close()
        for k, incident in enumerate(keeper.incidents):
            assembly.notes[f"rig {k + 1}"] = incident.message
    for k, health in enumerate(healths):
        assembly.notes |= {f"{kind} {k + 1}" if zones else kind: line for kind, line in health.left_out().items()}
    found = [line for health in healths for line in health.findings()]
    for k, line in enumerate((*found, *sensors.findings())):
        assembly.notes[f"camera {k + 1}"] = line
    if latency:
        seconds["health"] = sum(health.seconds for health in healths)
        seconds["latency_p99"] = float(np.quantile(latency, 0.99))
        seconds["pipeline_per_set"] = float(np.mean(latency))
    tracks = table(samples)
    if zones:
        tracks = tracks_of_all(tracks, zones, assembly)
    cameras = tuple(one for health in healths for one in health.cameras())
    return Collected(
        tracks, views, view_pulse, assembly, seconds, detections, cameras, sensors.cameras(),
        kept_sets=kept.sets(), measured_by=kept.measured_by(),
    )  # fmt: skip


def rerun_log(path: Path | None, rig: Rig, spec: Scenario, stack: ExitStack) -> RerunLog | None:
    """Return the Rerun log at ``path``, which ends with the stack; None without a path."""
    if path is None:
        return None
    if spec.continuous is not None:
        raise InputError("--rrd shows frame sets, which a [continuous] scenario has none of; leave it out")
    space = spec.working_space
    return stack.enter_context(RerunLog(path, rig, (np.array(space.center_m), np.array(space.size_m))))


def _step_log(
    log: RerunLog | None, twin: TruthSource | None, pulses: int, most_images: int
) -> Callable[[Step], None]:
    """Return a function that writes a step's images, detections and truth into a Rerun log; without a log, a no-op.

    Detections are shown with their images, since an image stays until the next one. Points follow at the end of the
    run, when their errors are known.
    """
    if log is None:
        return lambda step: None
    chosen = set(np.linspace(0, pulses - 1, min(most_images, pulses)).round().astype(int).tolist())

    def write(step: Step) -> None:
        pulse, time_ns = step.frame_set.pulse, step.frame_set.time_ns
        if pulse in chosen or most_images >= pulses:
            images = {n: f.image for n, f in step.frame_set.frames.items() if f.image is not None}
            log.log_step(pulse, time_ns, images, step.detections)
        else:
            log.set_time(pulse, time_ns)
            log.log_plots({f"detections/{name}": len(found) for name, found in step.detections.items()})
        if twin is not None and pulse < len(twin.truth_xyz):
            log.log_truth(pulse, time_ns, twin.truth_xyz[pulse])

    return write


def recorded(
    source: FrameSource, twin: TruthSource | None, options: RunOptions, spec: Scenario, stack: ExitStack
) -> FrameSource:
    """Return ``source``, recorded if requested, with the commands that drove its subject."""
    if options.record_to is None:
        return source
    needs = spec.capture.pulses * sum(info.image_bytes for info in source.cameras)
    check_folder(options.record_to, needs)
    writer = stack.enter_context(RecordingWriter(options.record_to, source.cameras))
    if twin is not None and twin.scene.commands is not None:
        target = spec.scene.target if isinstance(spec.scene, RobotScene) else "robot"
        write_commands(writer, twin.scene.commands, target)
    return Recorded(source, writer)


def _views(step: Step) -> tuple[CameraView, ...]:
    return tuple(
        CameraView(name, frame.image, step.detections[name])
        for name, frame in step.frame_set.frames.items()
        if frame.image is not None
    )
