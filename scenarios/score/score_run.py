"""A run's tracks compared with the truth: all metrics that are defined for the scenario, and its premises."""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np

from mosca.continuous.reconstruct import Reconstructed
from mosca.data.rig import Rig
from mosca.data.truth import Truth
from scenarios.score.bodies import body_scores
from scenarios.score.continuous import comparison_scores, over_synchronous, scored_apart
from scenarios.score.cramer_rao import bound, efficiencies, needs_bound, pulses_asked
from scenarios.score.disturbances import disturbances
from scenarios.score.people import centre_errors, joint_scores, joint_table, label_scores, rotation_errors
from scenarios.score.premises import premises_met
from scenarios.score.reference import JUDGED, ReferenceTrajectories
from scenarios.score.tracks import BLOCKS, metrics, pair
from scenarios.score.vibration import vibration_scores
from scenarios.score.virtual_objects import ObjectErrors, object_errors, object_scores, shown_words
from scenarios.score.without_truth import NEED_NO_TRUTH
from scenarios.spec.scenario import Scenario
from scenarios.spec.virtual import METRICS as VIRTUAL
from scenarios.types import Collected, MeasuredTracks, Score, Scored, TruthPairs, TruthSource
from twin.scenes.scene import Scene


def scored(
    spec: Scenario,
    name: str,
    measured: MeasuredTracks,
    truth: Truth | ReferenceTrajectories | None,
    twin: TruthSource | None,
    scene: Scene | None,
) -> Scored:
    """Return the scores of ``measured`` against ``truth`` (that of the twin or of a file; None: there is none).

    ``twin``: the source of the frames if it is the twin; only then is the Cramer-Rao bound known. PremiseError where
    a premise does not hold.
    """
    collected = measured.collected
    if truth is None:
        return Scored({}, {}, collected, None, None, not_judged=not_judged(spec, NEED_NO_TRUTH))
    if isinstance(truth, ReferenceTrajectories):
        return _beside_reference(spec, measured, truth)
    disturbed = None
    if twin is not None and measured.nominal is not None:
        disturbed = disturbances(truth, twin.virtual, measured.nominal, spec.model_gap)
    more: dict[str, Score] = {}
    if measured.continuous is not None:
        collected, truth, more = scored_apart(spec, collected, measured.continuous, truth, scene)
    truth = _as_seen_by(truth, measured.cameras)
    space = max(spec.working_space.size_m)
    pairs = pair(collected.tracks, truth, space, measured.calibration_m2)
    scores = metrics(pairs, space) | more
    if "over_synchronous" in spec.limits:
        scores |= over_synchronous(pairs, measured.synchronous(), truth, space)
    if isinstance(measured.continuous, Reconstructed):
        scores |= comparison_scores(spec, measured.continuous, truth, space)
    if measured.poses is not None:
        scores |= body_scores(measured.poses, measured.bodies, truth)
    joints: dict[str, dict[str, Any]] = {}
    if measured.joints is not None and truth.joints is not None:
        centres = centre_errors(measured.joints, truth, measured.calibration_m2)
        rotations = rotation_errors(measured.joints, truth)
        scores |= joint_scores(centres, rotations)
        joints = joint_table(centres, rotations)
    if measured.labelled is not None:
        scores |= label_scores(measured.labelled, truth, space)
    modes: dict[str, dict[str, Any]] = {}
    if measured.vibration is not None and scene is not None and scene.modes is not None:
        own, modes = vibration_scores(measured.vibration, scene.modes, truth.xyz.mean(axis=0))
        scores |= own
    objects: ObjectErrors | None = None
    if measured.shown is not None and scene is not None:
        objects = object_errors(measured.shown, measured.bodies, scene)
        collected.assembly.notes["virtual"] = shown_words(measured.shown, objects)
        scores |= object_scores(measured.shown, objects, measured.calibration_m2)
    if twin is not None and needs_bound(spec.limits):
        scores |= _efficiencies(twin, truth, measured.rig, pairs, collected)
    # a truth of an older file has no joints
    unjudged = tuple(name for name in spec.limits if name.startswith("joint_") and truth.joints is None)
    if scene is None:  # only the twin's scene has the poses of bodies between exposures
        unjudged += tuple(name for name in spec.limits if name in VIRTUAL)
    met = premises_met(spec, truth, name, disturbed)
    return Scored(scores, met, collected, truth, pairs, joints, modes, unjudged, objects=objects)


def not_judged(spec: Scenario, judged: Collection[str]) -> tuple[str, ...]:
    """Return the metrics that the scenario limits and that are not among those that can be judged here."""
    return tuple(name for name in spec.limits if name not in judged)


def _beside_reference(spec: Scenario, measured: MeasuredTracks, given: ReferenceTrajectories) -> Scored:
    """Return the scores against a user's own reference: errors of the markers in it, but not which were missed."""
    collected = measured.collected
    space = max(spec.working_space.size_m)
    truth = given.at(np.unique(collected.tracks.time_ns))
    pairs = pair(collected.tracks, truth, space, given.share(measured.calibration_m2))
    if not len(pairs.frame) and len(collected.tracks):
        collected.assembly.notes["reference"] = (
            f"no measured point lies within {1e3 * float(pairs.gate_m.max()):.3g} mm of {given.path} at the same "
            "time: are its x, y, z in metres and in the rig's world frame, its time_ns on the session's clock?"
        )
    scores = {key: score for key, score in metrics(pairs, space).items() if key in JUDGED}
    unjudged = not_judged(spec, (*NEED_NO_TRUTH, *JUDGED))
    return Scored(scores, {}, collected, truth, pairs, not_judged=unjudged)


def _efficiencies(
    twin: TruthSource, truth: Truth, rig: Rig, pairs: TruthPairs, collected: Collected
) -> dict[str, Score]:
    """Return the efficiencies of the run: the Cramer-Rao bounds of its frames over the errors reached."""
    errors = {v.camera.name: (v.mount, v.timing) for v in twin.virtual}
    pulses = pulses_asked(len(truth.time_ns))
    least = bound(twin.expected, truth, rig, errors, pulses)
    return efficiencies(least, pairs, truth, collected.detections, BLOCKS)


def _as_seen_by(truth: Truth, names: tuple[str, ...]) -> Truth:
    """Return the truth of the named cameras only: visibility to others does not make a marker measurable."""
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
