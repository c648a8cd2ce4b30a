"""Tracks compared with the truth. Pure: no files, no clocks, no twin.

In each frame the measured points and the true markers are paired one to one with the least total distance, within
``min(half the smallest distance between true markers, 1 % of the working space)``. A measured point without a pair is
a ghost. A true marker without a pair is a miss if it was *seen*: at least half of its disc visible in two cameras,
from the truth alone. Filled and predicted samples never count. Nothing is aligned. Intervals come from a bootstrap
over blocks of frames, since neighbouring frames are correlated.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist, pdist

from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from scenarios.types import Score, TruthPairs

SEEN_SHARE, SEEN_CAMERAS = 0.5, 2
BLOCKS = 40
RESAMPLES = 2000
ALPHAS = np.arange(0.05, 0.96, 0.05)
NO_COVARIANCE = 1e9
"""NEES of a sample whose covariance is not positive definite: beyond any limit."""


def pair(
    tracks: Tracks, truth: Truth, working_space_m: float, calibration: Callable[[Array], Array] | None = None
) -> TruthPairs:
    """Pair measured samples with true markers, frame by frame.

    ``working_space_m``: the longest edge of the working space [m]. A sample whose time is farther than half a period
    from every true instant is a ghost of the nearest one. ``calibration``: the covariance (n, 3, 3) [m^2] that an
    estimated calibration's own error gives to points (n, 3) [m]; NEES is computed with the sum.
    """
    of_measured = np.flatnonzero(np.asarray(tracks.status) == "measured")
    measured = tracks.select(of_measured)
    frames = len(truth.time_ns)
    at = nearest(truth.time_ns, measured.time_ns)
    timely = in_time(truth.time_ns, measured.time_ns, at)
    views = (truth.visible >= SEEN_SHARE).sum(axis=2)
    seen_mask = views >= SEEN_CAMERAS
    order = np.argsort(at, kind="stable")
    starts = np.searchsorted(at[order], np.arange(frames + 1))
    rows_of_pairs, markers_of_pairs, frames_of_pairs = [], [], []
    ghosts, missed, gate = np.zeros(frames, int), np.zeros(frames, int), np.zeros(frames)
    for f in range(frames):
        rows = order[starts[f] : starts[f + 1]]
        known = np.flatnonzero(np.isfinite(truth.xyz[f]).all(axis=1))
        gate[f] = _gate(truth.xyz[f, known], working_space_m)
        usable = rows[timely[rows]]
        mine, theirs = _assign(measured.xyz[usable], truth.xyz[f, known], gate[f])
        theirs = known[theirs]
        ghosts[f] = len(rows) - len(mine)
        missed[f] = seen_mask[f].sum() - seen_mask[f, theirs].sum()
        rows_of_pairs.append(usable[mine])
        markers_of_pairs.append(theirs)
        frames_of_pairs.append(np.full(len(mine), f))
    rows, marker, frame = (
        np.concatenate(parts).astype(int) if parts else np.empty(0, int)
        for parts in (rows_of_pairs, markers_of_pairs, frames_of_pairs)
    )
    error = measured.xyz[rows] - _true_at(truth, frame, marker, measured.time_ns[rows])
    covariance = measured.covariance[rows]
    if calibration is not None:
        covariance = covariance + calibration(measured.xyz[rows])
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    nees = np.where(np.linalg.eigvalsh(covariance)[:, 0] > 0.0, nees, NO_COVARIANCE)
    return TruthPairs(
        of_measured[rows], frame, marker, measured.track[rows], error, nees, measured.residual_px[rows],
        measured.n_cameras[rows],
        views[frame, marker], seen_mask.sum(axis=1), missed, ghosts, gate, seen_mask,
    )  # fmt: skip


def block_of(n: int) -> Array:
    """Return the block (n,) of each of ``n`` rows in order of time; there are BLOCKS blocks, or ``n`` if fewer."""
    return np.asarray(np.arange(n) * min(BLOCKS, n) // max(n, 1))


def metrics(matched: TruthPairs, working_space_m: float) -> dict[str, Score]:
    """Return all metrics of a pairing, by name (``reports.metrics``); lengths in m, image errors in px."""
    frames = len(matched.seen)
    if frames == 0:
        return {}
    k = len(matched.frame)
    block = block_of(frames)
    count = int(block.max()) + 1

    def of_pairs(values: Array) -> Array:
        return np.bincount(block[matched.frame], weights=values, minlength=count)

    def of_frames(values: Array) -> Array:
        return np.bincount(block, weights=values, minlength=count)

    distance = matched.distance_m
    pairs = of_pairs(np.ones(k))
    seen, missed = of_frames(matched.seen), of_frames(matched.missed)
    result: dict[str, Score] = {}
    if k:
        squares = of_pairs(distance**2)
        rms = ratio_of_sums(squares, pairs, k, np.sqrt)
        result["position_rms"] = rms
        by_block = [distance[block[matched.frame] == b] for b in range(count)]
        p95 = [float(np.quantile(d, 0.95)) * len(d) if len(d) else 0.0 for d in by_block]
        largest = [float(d.max(initial=0.0)) for d in by_block]
        filled = tuple(float(len(d) > 0) for d in by_block)
        result["position_p95"] = Score(float(np.quantile(distance, 0.95)), k, None, tuple(p95), tuple(pairs.tolist()))
        result["position_max"] = Score(float(distance.max()), k, None, tuple(largest), filled)
        result["relative_accuracy"] = ratio_of_sums(squares, pairs * working_space_m**2, k, np.sqrt)
        result["nees"] = ratio_of_sums(of_pairs(matched.nees), pairs, k)
        inside = matched.nees <= chi2.ppf(0.95, 3)
        result["coverage95"] = ratio_of_sums(of_pairs(inside), pairs, k)
        result["reprojection_rms"] = ratio_of_sums(of_pairs(matched.residual_px**2), pairs, k, np.sqrt)
        if matched.views.any():
            used = of_pairs(np.minimum(matched.n_cameras, matched.views))
            result["rays_used"] = ratio_of_sums(used, of_pairs(matched.views), k)
    result["completeness"] = ratio_of_sums(seen - missed, seen, int(matched.seen.sum()))
    result["ghosts_per_frame"] = ratio_of_sums(of_frames(matched.ghosts), of_frames(np.ones(frames)), frames)
    result["identity_switches"] = Score(float(identity_switches(matched)), k)
    result["hota"] = Score(hota(matched), k)
    return result


def identity_switches(matched: TruthPairs) -> int:
    """Return how often a marker is followed by another track than before."""
    switches = 0
    for marker in np.unique(matched.marker):
        ids = matched.track[matched.marker == marker]
        switches += int(np.count_nonzero(ids[1:] != ids[:-1]))
    return switches


def hota(matched: TruthPairs) -> float:
    """Return HOTA (Luiten et al. 2021) with similarity ``max(0, 1 - d/d0)``, d0 the pairing's gate.

    The pairing of ``pair`` is used for every alpha; the mean is over alpha = 0.05 ... 0.95. Misses count for seen
    markers only.
    """
    similarity = np.maximum(0.0, 1.0 - matched.distance_m / matched.gate_m[matched.frame])
    ghosts, missed = int(matched.ghosts.sum()), int(matched.missed.sum())
    key = matched.marker.astype(np.int64) * (int(matched.track.max(initial=0)) + 1) + matched.track
    markers = matched.seen_mask.shape[1]
    values = []
    for alpha in ALPHAS:
        good = similarity >= alpha
        tp = int(good.sum())
        rest = len(good) - tp
        fn, fp = missed + rest, ghosts + rest
        if tp == 0:
            values.append(0.0)
            continue
        _, where, together = np.unique(key[good], return_inverse=True, return_counts=True)
        tpa = together[where]
        per_marker = np.bincount(matched.marker, minlength=markers) + _missed_of_marker(matched)
        per_track = np.bincount(matched.track)
        fna = per_marker[matched.marker[good]] - tpa
        fpa = per_track[matched.track[good]] - tpa
        association = float(np.mean(tpa / (tpa + fna + fpa)))
        detection = tp / (tp + fn + fp)
        values.append(np.sqrt(detection * association))
    return float(np.mean(values))


def limits_met(
    scores: Mapping[str, Score], limits: Mapping[str, float | tuple[float, float]], sense: Callable[[str], str]
) -> dict[str, bool]:
    """Return for each limited metric whether its limit is met; a metric without a value does not meet it."""
    met = {}
    for name, limit in limits.items():
        score = scores.get(name)
        value = np.nan if score is None else score.value
        if isinstance(limit, tuple):
            met[name] = bool(limit[0] <= value <= limit[1])
        else:
            met[name] = bool(value <= limit if sense(name) == "at_most" else value >= limit)
    return met


def _missed_of_marker(matched: TruthPairs) -> Array:
    """Return the number of frames in which each marker was seen but not found (m,)."""
    found = np.zeros_like(matched.seen_mask)
    found[matched.frame, matched.marker] = True
    result: Array = (matched.seen_mask & ~found).sum(axis=0)
    return result


def _gate(true_xyz: Array, working_space_m: float) -> float:
    nearest = pdist(true_xyz).min() if len(true_xyz) > 1 else np.inf
    return float(min(0.5 * nearest, 0.01 * working_space_m))


def _assign(measured: Array, true: Array, gate: float) -> tuple[Array, Array]:
    if len(measured) == 0 or len(true) == 0:
        return np.empty(0, int), np.empty(0, int)
    distance = cdist(measured, true)
    allowed = distance <= gate
    # all pairs beyond the gate cost the same, more than any sum of allowed pairs
    rows, columns = linear_sum_assignment(np.where(allowed, distance, gate * (1 + min(distance.shape))))
    good = allowed[rows, columns]
    return rows[good], columns[good]


def _true_at(truth: Truth, frame: Array, marker: Array, time_ns: Array) -> Array:
    """Return the positions (k, 3) [m] of markers (k,) at ``time_ns`` (k,); ``frame``: the nearest true instants.

    They are cubic through the four true instants about the time (Lagrange), and exact where one is the time itself.
    Where not all four are known, they are linear between the neighbours in time, or those of the nearest instant.
    """
    found: Array = truth.xyz[frame, marker].copy()
    moved = np.flatnonzero(truth.time_ns[frame] != time_ns)
    for count in (2, 4):
        if len(moved) == 0 or len(truth.time_ns) < count:
            break
        after = np.searchsorted(truth.time_ns, time_ns[moved])
        used = np.clip(after - count // 2, 0, len(truth.time_ns) - count)[:, None] + np.arange(count)
        seconds = (truth.time_ns[used] - time_ns[moved, None]) * 1e-9
        at = np.einsum("nk,nki->ni", _lagrange_weights(seconds), truth.xyz[used, marker[moved, None]])
        known = np.isfinite(at).all(axis=1)
        found[moved[known]] = at[known]
    return found


def _lagrange_weights(seconds: Array) -> Array:
    """Return the weights (n, k) for a polynomial's value at 0 from its values at ``seconds`` (n, k)."""
    columns = range(seconds.shape[1])
    weights = np.ones_like(seconds)
    for i in columns:
        for j in columns:
            if i != j:
                weights[:, i] *= seconds[:, j] / (seconds[:, j] - seconds[:, i])
    return weights


def nearest(times: Array, wanted: Array) -> Array:
    """Return for each wanted time (n,) the index of the nearest of ``times`` (k,), which rise."""
    if len(times) == 0:
        return np.zeros(len(wanted), int)
    right = np.clip(np.searchsorted(times, wanted), 1, max(1, len(times) - 1))
    left = right - 1
    right = np.minimum(right, len(times) - 1)
    return np.where(np.abs(times[left] - wanted) <= np.abs(times[right] - wanted), left, right)


def in_time(times: Array, wanted: Array, at: Array) -> Array:
    """Return whether each wanted time (n,) is within half a period of ``times[at]``."""
    if len(times) < 2:
        return np.ones(len(wanted), bool)
    result: Array = np.abs(times[at] - wanted) <= 0.5 * np.median(np.diff(times))
    return result


def ratio_of_sums(above: Array, below: Array, n: int, finish: Callable[[Array], Array] = lambda x: x) -> Score:
    """Return the score of a ratio of block sums, with its block bootstrap."""
    above, below = np.asarray(above, dtype=float), np.asarray(below, dtype=float)
    if below.sum() == 0:
        return Score(1.0 if above.sum() == 0 else float("nan"), n)
    value = float(finish(np.array(above.sum() / below.sum())))
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(above), (RESAMPLES, len(above)))
    bottom = below[chosen].sum(axis=1)
    drawn = finish(above[chosen].sum(axis=1)[bottom > 0] / bottom[bottom > 0])
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Score(value, n, (float(low), float(high)), tuple(above.tolist()), tuple(below.tolist()))
