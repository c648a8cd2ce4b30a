"""From frames to tracks in a run: the pipeline to its end, and what record, page and viewer need of it."""

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np

from mosca.calibration.monitoring.rig_keeper import RigKeeper
from mosca.data.detections import Detections
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import Samples, table
from mosca.diagnostics.camera_health import Health, HealthSettings
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, Step, run
from mosca.recording import RecordingWriter
from mosca.synchronisation import Assembly
from reports.evidence import CameraView
from scenarios.lab.commanded import write_commands
from scenarios.run.interrupt import between_steps
from scenarios.run.options import RunOptions
from scenarios.run.record import Collected
from scenarios.run.sources import Chosen, Written
from scenarios.run.zones import tracks_of_all, zone_steps, zones_of
from scenarios.score.cramer_rao import needs_bound, pulses_asked
from scenarios.spec.scenario import Scenario
from scenarios.spec.scenes import RobotScene
from twin.source import TwinSource

VIEW_AT = 0.4
"""Where in the run the picture of a camera is taken: a share of its length."""


def collected_of(
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
    wanted = set(pulses_asked(pulses).tolist()) if needs_bound(spec.limits) else set()
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
        seconds["health"] = sum(health.seconds for health in healths)
        seconds["latency_p99"] = float(np.quantile(latency, 0.99))
        seconds["pipeline_per_set"] = float(np.mean(latency))
    tracks = table(samples)
    if zones:
        tracks = tracks_of_all(tracks, zones, assembly)
    cameras = tuple(one for health in healths for one in health.cameras())
    return Collected(tracks, views, view_pulse, assembly, seconds, asked, cameras)


def collected_continuous(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings,
    spec: Scenario,
    options: RunOptions,
    stack: ExitStack,
) -> tuple[Collected, Any]:
    """Run ``mosca.continuous`` on the frames, which need no pulse in common."""
    from scenarios.run.continuous import collect_continuous

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


def _views(step: Step) -> tuple[CameraView, ...]:
    return tuple(
        CameraView(name, frame.image, step.detections[name])
        for name, frame in step.frame_set.frames.items()
        if frame.image is not None
    )
