"""Association of tracks between zones: by position and velocity where both see a target, else by continuation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks

Key = tuple[str, int]
"""A zone's name and the number of one of its tracks."""
Group = tuple[Key, ...]
NEAR_SHARE = 0.5
"""Share of the common instants at which two tracks must be near each other to be compared at all."""
ENDS = 5
"""Samples at a track's end from which its position and velocity there are estimated."""
BRIDGE_CHI2 = 22.5
"""99.9 % quantile of the chi-square distribution with 6 degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two tracks on their common instants."""

    one: int
    two: int
    time_s: Array
    """(n,)"""
    apart: Array
    """(n, 3) second minus first [m]."""
    covariance: Array
    """(n, 3, 3) of that [m^2]."""


def pairs_of(one: Tracks, two: Tracks, gate_m: float, least_common: int) -> list[Pair]:
    """Return the pairs of tracks that are within ``gate_m`` of each other at most of their common instants."""
    one = one.select(one.status == "measured")
    two = two.select(two.status == "measured")
    near: dict[tuple[int, int], int] = {}
    rows_one, rows_two = _by_frame(one), _by_frame(two)
    for frame in sorted(rows_one.keys() & rows_two.keys()):
        i, j = rows_one[frame], rows_two[frame]
        for a, b in zip(*np.nonzero(cdist(one.xyz[i], two.xyz[j]) < gate_m), strict=True):
            key = int(one.track[i[a]]), int(two.track[j[b]])
            near[key] = near.get(key, 0) + 1
    found = []
    for (a, b), count in sorted(near.items()):
        if count < least_common:
            continue
        mine, theirs = np.flatnonzero(one.track == a), np.flatnonzero(two.track == b)
        _, at, beside = np.intersect1d(one.frame[mine], two.frame[theirs], return_indices=True)
        i, j = mine[at], theirs[beside]
        if count >= NEAR_SHARE * len(i):
            found.append(
                Pair(a, b, one.time_ns[i] * 1e-9, two.xyz[j] - one.xyz[i], one.covariance[i] + two.covariance[j])
            )
    return found


def same_target(pair: Pair, gate_sigma: float, gate_m: float, gate_mps: float) -> float:
    """Return the score of a pair as one target, 0 where positions or velocities disagree beyond the covariances."""
    squares = np.einsum("ni,nij,nj->n", pair.apart, np.linalg.inv(pair.covariance), pair.apart)
    typical = float(np.median(squares))
    rms = float(np.sqrt(np.mean(np.median(pair.apart**2, axis=0).sum())))
    if typical > gate_sigma**2 or rms > gate_m:
        return 0.0
    time = pair.time_s - pair.time_s.mean()
    across = float(time @ time)
    if across > 0.0:
        speed = time @ pair.apart / across
        spread = np.einsum("n,nij->ij", time**2, pair.covariance) / across**2
        if speed @ np.linalg.solve(spread + gate_mps**2 * np.eye(3), speed) > gate_sigma**2:
            return 0.0
    return len(pair.apart) * (gate_sigma**2 - typical)


def placed_like(zones: Mapping[str, Tracks], links: Sequence[tuple[float, Key, Key]]) -> list[Group]:
    """Return the targets that ``links`` (score, track, track) join, best first; none has two of a zone at once."""
    frames = {key: rows for name, tracks in zones.items() for key, rows in _frames_of(name, tracks).items()}
    group_of: dict[Key, list[Key]] = {key: [key] for key in frames}
    for _, one, two in sorted(links, key=lambda link: -link[0]):
        _join(group_of, frames, one, two)
    return _ordered(group_of, frames)


def bridged(
    zones: Mapping[str, Tracks], groups: Sequence[Group], bridge_s: float, acceleration_mps2: float, gate_m: float
) -> list[Group]:
    """Return ``groups``, where those that end in one zone and go on in another within ``bridge_s`` are joined."""
    frames = {key: rows for name, tracks in zones.items() for key, rows in _frames_of(name, tracks).items()}
    group_of: dict[Key, list[Key]] = {}
    for group in groups:
        shared = list(group)
        for key in group:
            group_of[key] = shared
    last = {max(group, key=lambda key: frames[key][-1]): group for group in groups}
    first = {min(group, key=lambda key: frames[key][0]): group for group in groups}
    gone = [(key, _end(zones[key[0]], key[1], last=True)) for key in last]
    come = [(key, _end(zones[key[0]], key[1], last=False)) for key in first]
    cost = np.full((len(gone), len(come)), np.inf)
    for i, (key, end) in enumerate(gone):
        for j, (other, start) in enumerate(come):
            step = start.time_s - end.time_s
            if key[0] != other[0] and 0.0 < step <= bridge_s and end.known and start.known:
                cost[i, j] = _chi2(end, start, step, acceleration_mps2, gate_m)
    allowed = cost <= BRIDGE_CHI2
    rows, columns = linear_sum_assignment(np.where(allowed, cost - BRIDGE_CHI2, 0.0))
    for i, j in zip(rows, columns, strict=True):
        if allowed[i, j]:
            _join(group_of, frames, gone[i][0], come[j][0])
    return _ordered(group_of, frames)


@dataclass(frozen=True, eq=False)
class _End:
    """Position and velocity (6,) at a track's end and their covariance (6, 6), from samples over ``span_s``."""

    time_s: float
    span_s: float
    state: Array
    covariance: Array
    known: bool


def _end(tracks: Tracks, track: int, last: bool) -> _End:
    rows = np.flatnonzero((tracks.track == track) & (tracks.status == "measured"))
    if len(rows) < 3:
        return _End(0.0, 0.0, np.zeros(6), np.eye(6), False)
    rows = rows[-ENDS:] if last else rows[:ENDS]
    at_ns = tracks.time_ns[rows[-1] if last else rows[0]]
    time = (tracks.time_ns[rows] - at_ns) * 1e-9
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for t, weight, place in zip(time, np.linalg.inv(tracks.covariance[rows]), tracks.xyz[rows], strict=True):
        design = np.hstack([np.eye(3), t * np.eye(3)])
        normal += design.T @ weight @ design
        right += design.T @ weight @ place
    covariance = np.linalg.inv(normal)
    return _End(float(at_ns) * 1e-9, float(np.ptp(time)), covariance @ right, covariance, True)


def _chi2(end: _End, start: _End, step_s: float, acceleration_mps2: float, gate_m: float) -> float:
    """Return the chi-square of a start as continuation of an end ``step_s`` before, by position and velocity."""
    move = np.eye(6)
    move[:3, 3:] = step_s * np.eye(3)
    away = start.state - move @ end.state
    if np.linalg.norm(away[:3]) > gate_m + acceleration_mps2 * step_s**2 / 2:
        return np.inf
    noise = np.zeros((6, 6))
    noise[:3, :3], noise[3:, 3:] = (step_s**4 / 4) * np.eye(3), (step_s**2) * np.eye(3)
    noise[:3, 3:] = noise[3:, :3] = (step_s**3 / 2) * np.eye(3)
    for span in (end.span_s, start.span_s):
        # a straight line through an accelerated stretch errs at its end by a T^2 / 12, its slope by a T / 2
        noise[:3, :3] += (span**2 / 12) ** 2 * np.eye(3)
        noise[3:, 3:] += (span / 2) ** 2 * np.eye(3)
    spread = move @ end.covariance @ move.T + start.covariance + acceleration_mps2**2 * noise
    return float(away @ np.linalg.solve(spread, away))


def _by_frame(tracks: Tracks) -> dict[int, Array]:
    if not len(tracks):
        return {}
    frames = np.unique(tracks.frame)
    order = np.argsort(tracks.frame, kind="stable")
    cuts = np.searchsorted(np.asarray(tracks.frame)[order], frames[1:])
    return dict(zip(frames.tolist(), np.split(order, cuts), strict=True))


def _frames_of(name: str, tracks: Tracks) -> dict[Key, Array]:
    return {(name, int(k)): np.sort(tracks.frame[tracks.track == k]) for k in np.unique(tracks.track)}


def _join(group_of: dict[Key, list[Key]], frames: Mapping[Key, Array], one: Key, two: Key) -> None:
    mine, theirs = group_of[one], group_of[two]
    if mine is theirs:
        return
    for a in mine:
        for b in theirs:
            if a[0] == b[0] and np.intersect1d(frames[a], frames[b]).size:
                return
    mine += theirs
    for key in theirs:
        group_of[key] = mine


def _ordered(group_of: Mapping[Key, list[Key]], frames: Mapping[Key, Array]) -> list[Group]:
    groups = {id(group): tuple(sorted(group)) for group in group_of.values()}
    return sorted(groups.values(), key=lambda group: (min(int(frames[key][0]) for key in group), group))
