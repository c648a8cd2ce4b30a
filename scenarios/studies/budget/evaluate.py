"""One run with some sources of error off: squared errors by blocks of the take, and their prediction by covariances.

Common parts are made once. A take is rendered and its targets are detected once for all rigs used with it. A
calibration is cached by its inputs (``scenarios.run.kept_calibrations``). The images of a camera that is not on a
body do not depend on the other cameras, so that takes in which single cameras are without errors are combined from
two takes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections, Seen
from mosca.data.frames import FrameSet
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks, table
from mosca.data.truth import Truth
from mosca.detection.scheduler import FrameSetDetector, detect_ahead
from mosca.pipeline import PipelineSettings, run_seen
from mosca.synchronisation import assemble
from scenarios.build.calibration_faults import with_fault
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.run.kept_calibrations import kept
from scenarios.score.tracks import metrics, pair
from scenarios.session.estimated import SessionCalibration, calibrate_in_session, inputs_of
from scenarios.spec.scenario import Scenario
from scenarios.spec.switches import switch, switched_off
from scenarios.studies.budget.quiet import quiet_cameras, unhidden
from scenarios.types import TruthPairs

REPROJECTION = "reprojection_rms"


@dataclass(frozen=True, eq=False)
class DetectedTake:
    """A take as its detections, without images, and its truth."""

    seen: tuple[Seen, ...]
    truth: Truth
    settings: PipelineSettings


@dataclass(frozen=True, eq=False)
class Believed:
    """The rig that a run uses, and the session from which it was estimated; None: the true rig."""

    rig: Rig
    session: SessionCalibration | None


class Squares(NamedTuple):
    """Sums of squares (b,) and weights (b,) of one run by blocks of the take, in the metric's unit squared."""

    sums: Array
    weights: Array
    random: float = 0.0
    """Mean square predicted from the stated random covariance."""
    calibration: float = 0.0
    """Mean square predicted from the calibration's stated covariance; 0 with the true rig."""


def evaluate(
    spec: Scenario, folder: Path, off: Sequence[str], metric: str, take: DetectedTake | None = None
) -> Squares:
    """Return the squares of one run of ``spec`` with the sources ``off``: the value of a coalition in a budget.

    ``take``: the detected take with these sources off, where it is known already.
    """
    take = detected_take(spec, folder, off) if take is None else take
    return squares_of(spec, take, believed_rig(spec, folder, off), metric)


def detected_take(
    spec: Scenario, folder: Path, off: Sequence[str], cameras: Sequence[str] | None = None
) -> DetectedTake:
    """Render the take without the sources ``off`` (only of ``cameras`` where they are named), and detect in it."""
    taken = off_in_take(spec, off, cameras)
    virtual = virtual_cameras(taken, true_rig(taken, folder))
    if "noise" in off:
        virtual = quiet_cameras(virtual, cameras)
    scene = build_scene(taken, folder)
    if "occlusion" in off:
        scene = unhidden(scene)
    settings = pipeline_settings(taken)
    with twin_source(taken, scene, virtual, workers=1) as source:
        detector = FrameSetDetector(settings.detection, {one.name: one.bit_depth for one in source.cameras}, {})
        sets = assemble(source, source.cameras, settings.assembly)
        found = detect_ahead(detector, sets, 0, lookahead=settings.lookahead)
        seen = tuple((FrameSet(one.pulse, one.time_ns), detections, 0.0) for one, detections, _ in found)
        return DetectedTake(seen, source.truth(), settings)


def mixed(on: DetectedTake, off: DetectedTake, without: Iterable[str]) -> DetectedTake:
    """Return ``on`` with the images of the cameras ``without`` from ``off``, pulse by pulse."""
    gone = frozenset(without)
    beside = {one.pulse: found for one, found, _ in off.seen}
    seen = []
    for one, detections, seconds in on.seen:
        other = beside.get(one.pulse, {})
        chosen: dict[str, Detections] = {
            name: other.get(name, mine) if name in gone else mine for name, mine in detections.items()
        }
        seen.append((one, chosen, seconds))
    return replace(on, seen=tuple(seen))


def believed_rig(spec: Scenario, folder: Path, off: Sequence[str]) -> Believed:
    """Return the rig that the run with the sources ``off`` uses.

    A session is that of the scenario as written, except for the lens: sources are switched off in the take only.
    CalibrationError where the session is insufficient.
    """
    taken = off_in_take(spec, off)
    cameras = virtual_cameras(taken, true_rig(taken, folder))
    nominal = calibrated(taken, cameras).rig
    if spec.session is None or "calibration" in off:
        return Believed(with_fault(nominal, taken.fault), None)
    session = switched_off(spec, [name for name in off if switch(name).acts_on == "lens"])
    fixed = virtual_cameras(session, true_rig(session, folder))
    earlier = calibrated(session, fixed).rig
    own = kept(inputs_of(session, fixed, earlier), lambda: calibrate_in_session(session, fixed, earlier, 1))
    return Believed(with_fault(own.calibration.rig, taken.fault), own)


def squares_of(spec: Scenario, take: DetectedTake, believed: Believed, metric: str) -> Squares:
    """Reconstruct a detected take and return its squares."""
    rig = believed.rig
    seen = ((one, {name: found[name] for name in rig.names if name in found}, s) for one, found, s in take.seen)
    tracks = table([step.samples for step in run_seen(seen, rig, take.settings)])
    space_m = max(spec.working_space.size_m)
    pairs = pair(tracks, take.truth, space_m)
    score = metrics(pairs, space_m).get(metric)
    if score is None:
        return Squares(np.zeros(1), np.zeros(1))
    random, calibration = _stated(tracks, pairs, believed.session, metric, space_m)
    return Squares(np.array(score.sums), np.array(score.weights), random, calibration)


def off_in_take(spec: Scenario, off: Sequence[str], cameras: Sequence[str] | None = None) -> Scenario:
    """Return the scenario whose take is rendered without the sources ``off``, only of ``cameras`` where named."""
    names = [name for name in off if switch(name).acts_on != "rig"]
    for camera in (None,) if cameras is None else cameras:
        spec = switched_off(spec, names, camera)
    return spec


def _stated(
    tracks: Tracks, pairs: TruthPairs, session: SessionCalibration | None, metric: str, space_m: float
) -> tuple[float, float]:
    """Return the mean squares predicted from the paired samples' covariances: random, and of the calibration."""
    if metric == REPROJECTION or not len(pairs.row):
        return 0.0, 0.0
    unit = space_m**2 if metric == "relative_accuracy" else 1.0
    random = float(np.trace(tracks.covariance[pairs.row], axis1=1, axis2=2).mean()) / unit
    if session is None:
        return random, 0.0
    common = session.covariance_m2(np.asarray(tracks.xyz)[pairs.row[::THINNED]])
    return random, float(np.trace(common, axis1=1, axis2=2).mean()) / unit


THINNED = 10
"""The calibration's share is computed for one of this many samples, since it changes slowly in space."""
