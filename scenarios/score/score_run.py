"""A run's tracks meet the truth: each metric that the scenario can be scored on, and its premises."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from scenarios.run.record import Collected
from scenarios.score.bodies import body_scores
from scenarios.score.cramer_rao import bound, efficiencies, needs_bound, pulses_asked
from scenarios.score.premises import premises_met
from scenarios.score.reference import JUDGED, Reference
from scenarios.score.tracks import BLOCKS, Matched, Score, metrics, pair
from scenarios.score.without_truth import NEED_NO_TRUTH
from scenarios.spec.scenario import Scenario
from twin.scenes.scene import Scene
from twin.source import TwinSource


@dataclass(frozen=True, eq=False)
class Scored:
    """What a run is worth: its metrics and premises, and the tracks and the truth that were held together.

    ``collected`` and ``truth`` are as they were scored: in the body's frame where cameras are worn. ``matched`` and
    ``truth`` are None where there is no truth. ``not_judged``: limited metrics that need more than there is.
    """

    scores: Mapping[str, Score]
    premises: Mapping[str, Any]
    collected: Collected
    truth: Truth | None
    matched: Matched | None
    not_judged: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Measured:
    """What is scored: the tracks, the rig that they were reconstructed with, and what else was found.

    ``cameras``: names of those whose sight counts. ``synchronous``: runs the synchronous pipeline on the same frames
    and returns its tracks. ``curves``: the continuous reconstruction, None for frame sets. ``bodies``, ``poses``:
    rigid bodies and where they were found. ``share_m2``: the covariance (n, 3, 3) [m^2] that the error of the run's
    own calibration gives to points (n, 3) [m]; None where it has none.
    """

    collected: Collected
    rig: Rig
    cameras: tuple[str, ...]
    synchronous: Callable[[], Tracks]
    curves: Any = None
    bodies: tuple[RigidBody, ...] = ()
    poses: BodyPoses | None = None
    share_m2: Callable[[Array], Array] | None = None


def scored(
    spec: Scenario,
    name: str,
    measured: Measured,
    truth: Truth | Reference | None,
    source: object,
    scene: Scene | None,
) -> Scored:
    """Return the scores of ``measured`` against ``truth`` (as the twin or a file tells it; None: there is none).

    ``source``: where the frames came from; what the light allows is known of the twin's alone. PremiseError where a
    premise does not hold.
    """
    collected = measured.collected
    if truth is None:
        return Scored({}, {}, collected, None, None, not_judged(spec, NEED_NO_TRUTH))
    if isinstance(truth, Reference):
        return _beside_reference(spec, measured, truth)
    more: dict[str, Score] = {}
    if measured.curves is not None:
        from scenarios.run.continuous import scored_apart

        collected, truth, more = scored_apart(spec, collected, measured.curves, truth, scene)
    truth = _as_seen_by(truth, measured.cameras)
    space = max(spec.working_space.size_m)
    matched = pair(collected.tracks, truth, space, measured.share_m2)
    scores = metrics(matched, space) | more
    if "over_synchronous" in spec.limits:
        from scenarios.run.continuous import over_synchronous

        scores |= over_synchronous(matched, measured.synchronous(), truth, space)
    if measured.poses is not None:
        scores |= body_scores(measured.poses, measured.bodies, truth)
    if isinstance(source, TwinSource) and needs_bound(spec.limits):
        scores |= _efficiencies(source, spec, truth, measured.rig, matched, collected)
    return Scored(scores, premises_met(spec, truth, name), collected, truth, matched)


def not_judged(spec: Scenario, judged: Collection[str]) -> tuple[str, ...]:
    """Return the metrics that the scenario limits and that are not among those that can be judged here."""
    return tuple(name for name in spec.limits if name not in judged)


def _beside_reference(spec: Scenario, measured: Measured, given: Reference) -> Scored:
    """Return what a user's own reference can judge: where the markers are that it tells of, not which were missed."""
    collected = measured.collected
    space = max(spec.working_space.size_m)
    truth = given.at(np.unique(collected.tracks.time_ns))
    matched = pair(collected.tracks, truth, space, given.share(measured.share_m2))
    if not len(matched.frame) and len(collected.tracks):
        collected.assembly.notes["reference"] = (
            f"no measured point lies within {1e3 * float(matched.gate_m.max()):.3g} mm of {given.path} at the same "
            "time: are its x, y, z in metres and in the rig's world frame, its time_ns on the session's clock?"
        )
    scores = {key: score for key, score in metrics(matched, space).items() if key in JUDGED}
    return Scored(scores, {}, collected, truth, matched, not_judged(spec, (*NEED_NO_TRUTH, *JUDGED)))


def _efficiencies(
    source: TwinSource, spec: Scenario, truth: Truth, rig: Rig, matched: Matched, collected: Collected
) -> dict[str, Score]:
    """Return how near the run came to what its frames allow."""
    errors = {v.camera.name: (v.mount, v.timing) for v in source.virtual}
    pulses = pulses_asked(len(truth.time_ns))
    least = bound(source.expected, truth, rig, errors, pulses)
    return efficiencies(least, matched, truth, collected.asked, BLOCKS)


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
