"""Scores of a continuous reconstruction: its clocks, and its error compared with that of the synchronous pipeline."""

from dataclasses import replace

import numpy as np

from mosca.continuous.comparison_methods.compare import reconstruct_by
from mosca.continuous.moving_cameras.body_worn import Worn
from mosca.continuous.reconstruct import EstimatedClock, Reconstructed
from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from reports.evidence import Evidence
from scenarios.score.tracks import pair
from scenarios.score.worn_cameras import lamp_positions, lamp_scores, reasons, relative_truth, without_lamps
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected, Score, TruthPairs
from twin.scenes.scene import Scene


def scored_apart(
    spec: Scenario, collected: Collected, found: Reconstructed | Worn, truth: Truth, scene: Scene | None
) -> tuple[Collected, Truth, dict[str, Score]]:
    """Return the tracks and truth to be scored as in all runs, and the scores of clocks and lamps of worn cameras."""
    assert spec.continuous is not None
    if isinstance(found, Worn):
        from scenarios.score.worn_cameras import moving_scores

        return moving_scores(spec, collected, found, truth, scene)
    scores = clock_scores(found, truth)
    if spec.continuous.worn_on is None or scene is None:
        return collected, truth, scores

    truth = relative_truth(truth, scene, spec.continuous.worn_on)
    places = lamp_positions(spec, found.rig)
    tracks = without_lamps(collected.tracks, places)
    collected.assembly.notes.update(reasons(truth))
    return (replace(collected, tracks=tracks), truth, scores | lamp_scores(found.gathered.seen, found.rig, places))


def clock_scores(found: Reconstructed, truth: Truth) -> dict[str, Score]:
    """Return the clock errors of free-running cameras, each for the worst camera.

    ``clock_frames``: the larger of the errors at the two ends of the camera's run, as a share of its frame period.
    The first camera's clock, to which all times refer, has no error.
    """
    if truth.frames is None:
        return {}
    true = {}
    for c, name in enumerate(truth.cameras):
        rows = truth.frames.camera == c
        # such values for each frame exist only for free-running cameras
        if rows.sum() >= 2 and name in found.rig.names:
            true[name] = (truth.frames.stamp_ns[rows], truth.frames.exposure_mid_ns[rows])
    first = found.clocks[0]
    offsets, drifts = [], []
    seen = found.gathered.seen
    session = (first.origin_ns * 1e-9, 1.0)  # the stamps of a triggered camera are on the session's clock
    if first.camera in true:
        session = _line(first, seen[0].frame_ns[0], *true[first.camera])
    for one, clock in zip(seen[1:], found.clocks[1:], strict=True):
        if clock.camera not in true:
            continue
        at, rate = _line(clock, one.frame_ns[0], *true[clock.camera])
        ends = (np.array([one.frame_ns[0], one.frame_ns[-1]]) - clock.origin_ns) * 1e-9
        wanted = (at + rate * ends - session[0]) / session[1]
        own = clock.offset_s + (1.0 + clock.drift) * ends
        given = (own - first.offset_s) / (1.0 + first.drift)
        offsets.append(float(np.abs(given - wanted).max()) / one.period_s)
        drifts.append(abs((1.0 + clock.drift) / (1.0 + first.drift) - rate / session[1]) * 1e6)
    n = len(offsets)
    if not n:
        return {}
    return {"clock_frames": Score(max(offsets), n), "clock_drift_ppm": Score(max(drifts), n)}


def _line(clock: EstimatedClock, first_ns: int, stamp_ns: Array, true_ns: Array) -> tuple[float, float]:
    """Return true session time as offset and rate over a camera's own seconds since its origin.

    ``first_ns``: mid-exposure of its first frame by its own stamp.
    """
    half = first_ns - int(stamp_ns[0])
    own = (stamp_ns - clock.origin_ns + half) * 1e-9
    middle = float(own.mean())
    rate, at = np.polyfit(own - middle, true_ns * 1e-9, 1)
    return float(at - rate * middle), float(rate)


def as_worn(evidence: Evidence, spec: Scenario, found: Reconstructed | Worn) -> Evidence:
    """Return the data for the page, for worn cameras in the frame of the body that carries them.

    Moving cameras are drawn at their poses in the middle of the recording.
    """
    assert spec.continuous is not None
    if spec.continuous.worn_on is None:
        return evidence
    rig = evidence.rig
    if isinstance(found, Worn):
        from scenarios.score.worn_cameras import rig_in_the_middle

        rig = rig_in_the_middle(found)
    reach = spec.continuous.reach_m
    return replace(evidence, rig=rig, working_space_center=np.zeros(3), working_space_size=np.full(3, 2.0 * reach))


def over_synchronous(ours: TruthPairs, synchronous: Tracks, truth: Truth, working_space_m: float) -> dict[str, Score]:
    """Return our rms error over that of the synchronous pipeline, for markers and instants that both measured."""
    theirs = pair(synchronous, truth, working_space_m)
    known = {(f, m): k for k, (f, m) in enumerate(zip(theirs.frame.tolist(), theirs.marker.tolist(), strict=True))}
    at = np.array([known.get(key, -1) for key in zip(ours.frame.tolist(), ours.marker.tolist(), strict=True)], int)
    both = at >= 0
    if not both.any():
        return {}
    mine, other = (ours.distance_m[both] ** 2).mean(), (theirs.distance_m[at[both]] ** 2).mean()
    return {"over_synchronous": Score(float(np.sqrt(mine / other)), int(both.sum()))}


def comparison_scores(spec: Scenario, found: Reconstructed, truth: Truth, working_space_m: float) -> dict[str, Score]:
    """Return the rms errors [m] of other trajectory models on the same image points, at the truth's instants."""
    assert spec.continuous is not None
    scores = {}
    for method in spec.continuous.compare:
        pairs = pair(reconstruct_by(method, found, truth.time_ns), truth, working_space_m)
        if len(pairs.frame):
            rms_m = float(np.sqrt((pairs.distance_m**2).mean()))
            scores[f"rms_{method}"] = Score(rms_m, len(pairs.frame))
    return scores
