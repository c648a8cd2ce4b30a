"""Metrics of a run that need no ground truth, and are defined for rigs and recordings as well as for the twin.

- ``reprojection_rms``: reprojection error of the points' rays [px];
- ``length_rms``, ``length_max``: measured minus certified lengths of a scale bar or wand, ``[[length]]`` in the
  scenario (the length measurement error of VDI/VDE 2634 part 1);
- ``rigidity_rms``: distance of the markers of rigid bodies from their positions in the body [m];
- ``static_noise``: scatter of samples about the mean of their own track, where nothing moves [m];
- ``latency_p99`` [s], ``frame_rate`` [frame sets/s]: of the computation.

They do not replace a truth: a rig with a wrong scale passes all but the lengths.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses
from mosca.data.tracks import Tracks
from scenarios.score.tracks import BLOCKS, ratio_of_sums
from scenarios.spec.scenario import LengthSpec, Scenario
from scenarios.types import Score

NEED_NO_TRUTH = (
    "sets_complete", "frames_complete", "reprojection_rms", "length_rms", "length_max",
    "length_error_share", "cluster_error_share", "rigidity_rms", "static_noise", "latency_p99", "frame_rate",
)  # fmt: skip
FEWEST = 10
"""Least number of frames with two markers together for which their distance can be taken as a known length."""
STEADY = 0.95
"""Share of those frames in which the distance must be near the length."""


def self_checks(
    spec: Scenario, tracks: Tracks, poses: BodyPoses | None, seconds: Mapping[str, float], sets: int
) -> tuple[dict[str, Score], list[str]]:
    """Return the metrics that need no truth, and notes on those that could not be determined, one line each.

    ``seconds``: computing times, of which ``latency_p99`` and ``frames_to_tracks`` are used; ``sets``: number of
    processed frame sets. Times and the noise of still markers are scored only where the scenario limits them.
    """
    measured = tracks.select(np.asarray(tracks.status) == "measured")
    scores: dict[str, Score] = {}
    notes: list[str] = []
    if not len(measured):
        return scores, notes
    blocks = _Blocks(measured.frame)
    residual = np.isfinite(measured.residual_px)
    if residual.any():
        scores["reprojection_rms"] = blocks.rms(measured.frame[residual], measured.residual_px[residual])
    if spec.length:
        frames, errors = [], []
        for one in spec.length:
            at, distance_m, note = lengths_found(measured, one)
            frames.append(at)
            errors.append(distance_m - one.length_m)
            if note:
                notes.append(note)
        frame, error = np.concatenate(frames), np.concatenate(errors)
        if len(error):
            scores["length_rms"] = blocks.rms(frame, error)
            scores["length_max"] = Score(float(np.abs(error).max()), len(error))
    if poses is not None:
        found = poses.select((np.asarray(poses.status) == "measured") & np.isfinite(poses.residual_m))
        if len(found):
            scores["rigidity_rms"] = blocks.rms(found.frame, found.residual_m)
    if "static_noise" in spec.limits:
        frame, away_m = about_own_mean(measured)
        if len(frame):
            scores["static_noise"] = blocks.rms(frame, away_m)
    if "latency_p99" in spec.limits and "latency_p99" in seconds:
        scores["latency_p99"] = Score(seconds["latency_p99"], sets)
    if "frame_rate" in spec.limits and seconds.get("frames_to_tracks"):
        scores["frame_rate"] = Score(sets / seconds["frames_to_tracks"], sets)
    return scores, notes


def lengths_found(tracks: Tracks, wanted: LengthSpec) -> tuple[Array, Array, str]:
    """Return the frames (n,) in which a known length was seen, its measured lengths (n,) [m], and a note or "".

    Where the scenario names its two markers, they are those with these labels. Otherwise they are two tracks whose
    distance stays near the length as long as both are seen; this excludes two tracks that only pass each other at
    that distance. Where several such pairs are seen in one frame, the right one is unknown, and the frame is left
    out.
    """
    if wanted.markers is not None:
        a, b = (np.flatnonzero(np.asarray(tracks.label) == name) for name in wanted.markers)
        frame, distance_m = _distances(tracks, a, b)
        note = "" if len(frame) else f"length '{wanted.name}': {' and '.join(wanted.markers)} were not seen together"
        return frame, distance_m, note
    rows = {int(one): np.flatnonzero(tracks.track == one) for one in np.unique(tracks.track)}
    frames, distances = [np.empty(0, int)], [np.empty(0)]
    for first, second, near in _near_pairs(tracks, wanted):
        frame, distance_m = _distances(tracks, rows[first], rows[second])
        if near >= max(FEWEST, STEADY * len(frame)):
            frames.append(frame)
            distances.append(distance_m)
    frame, distance_m = np.concatenate(frames), np.concatenate(distances)
    every, of, times = np.unique(frame, return_inverse=True, return_counts=True)
    alone = times[of] == 1
    note = ""
    if not len(frame):
        note = f"length '{wanted.name}': no two markers stay {wanted.length_m:g} m apart"
    elif not alone.all():
        note = (
            f"length '{wanted.name}': in {int((times > 1).sum())} of {len(every)} frames several pairs of markers "
            f"are {wanted.length_m:g} m apart; they are left out; name its two markers, or use another length"
        )
    return frame[alone], distance_m[alone], note


def about_own_mean(tracks: Tracks) -> tuple[Array, Array]:
    """Return frames (n,) and distances (n,) [m] of samples from the mean of their track; their squares are unbiased.

    Tracks of fewer than FEWEST samples are left out.
    """
    _, of, count = np.unique(tracks.track, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(of, weights=tracks.xyz[:, k]) / count for k in range(3)], axis=1)
    away_m = np.linalg.norm(tracks.xyz - mean[of], axis=1) * np.sqrt(count / np.maximum(count - 1, 1))[of]
    enough = (count >= FEWEST)[of]
    return tracks.frame[enough], away_m[enough]


class _Blocks:
    """Blocks of consecutive frames, as in ``scenarios.score.tracks``."""

    def __init__(self, frames: Array) -> None:
        self._first = int(frames.min())
        self._n = int(frames.max()) - self._first + 1

    def rms(self, frame: Array, values: Array) -> Score:
        """Return the root mean square of values (n,) of frames (n,)."""
        blocks = min(BLOCKS, self._n)
        block = np.clip((frame - self._first) * blocks // self._n, 0, blocks - 1)
        squares = np.bincount(block, weights=values**2, minlength=blocks)
        return ratio_of_sums(squares, np.bincount(block, minlength=blocks), len(values), np.sqrt)


def _distances(tracks: Tracks, first: Array, second: Array) -> tuple[Array, Array]:
    """Return the frames (n,) that rows of two markers share, and their distance there (n,) [m]."""
    frame, a, b = np.intersect1d(tracks.frame[first], tracks.frame[second], return_indices=True)
    return frame, np.linalg.norm(tracks.xyz[first[a]] - tracks.xyz[second[b]], axis=1)


def _near_pairs(tracks: Tracks, wanted: LengthSpec) -> list[tuple[int, int, int]]:
    """Return each pair of tracks whose distance is ever near the length, and the number of frames where it is."""
    order = np.lexsort((tracks.track, tracks.frame))
    frame, track, xyz = tracks.frame[order], tracks.track[order].astype(np.int64), tracks.xyz[order]
    starts = np.flatnonzero(np.diff(frame, prepend=frame[:1] - 1))
    seen: Counter[tuple[int, int]] = Counter()
    for begin, end in zip(starts, [*starts[1:], len(frame)], strict=True):
        i, j = np.triu_indices(end - begin, 1)
        away_m = np.linalg.norm(xyz[begin:end][i] - xyz[begin:end][j], axis=1)
        near = np.abs(away_m - wanted.length_m) <= wanted.within * wanted.length_m
        own = track[begin:end]
        seen.update(zip(own[i[near]].tolist(), own[j[near]].tolist(), strict=True))
    return [(a, b, count) for (a, b), count in seen.items() if count >= FEWEST]
