"""Joining of tracks of one marker: one camera followed it while the others did not see it or the tracker lost it.

A tracklet is a point followed in one camera. If its image points were assigned to one track first and to another one
later, both tracks are of one marker, provided that the first ends before the second begins and that a motion leads
from one to the other.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mosca.continuous.association.interpolated_tracks import SampledCurves
from mosca.continuous.model.observations import TimedObservations
from mosca.data.arrays import Array
from mosca.data.tracks import Tracks

LONGEST_S = 1.0
"""Longest gap without two cameras [s]; after it a marker is a new one."""
SLACK_M = 0.02
"""Largest distance of the two ends, extrapolated to the middle of the gap, that acceleration does not explain [m]."""


def joined(
    tracks: Tracks,
    curves: SampledCurves,
    found: TimedObservations,
    tracklet: Sequence[Array],
    row: Array,
    acceleration_mps2: float,
) -> Tracks:
    """Return ``tracks`` in which those of one marker have the same number.

    ``found``: image points assigned to ``curves``; ``tracklet``: tracklet of each camera's image points; ``row``
    (n,): index of each of ``found`` among its camera's image points.
    """
    votes = _votes(found, tracklet, row)
    into: dict[int, int] = {}
    left, right = set(), set()
    for (a, b), _count in sorted(votes.items(), key=lambda vote: (-vote[1], vote[0])):
        if a in left or b in right or not _leads(curves, a, b, acceleration_mps2):
            continue
        left.add(a)
        right.add(b)
        into[b] = a
    number = curves.track
    heir = {}
    for b in into:
        first = b
        while first in into:
            first = into[first]
        heir[int(number[b])] = int(number[first])
    track = np.array([heir.get(t, t) for t in tracks.track.tolist()], dtype=np.int64)
    return replace(tracks, track=track)


def _votes(found: TimedObservations, tracklet: Sequence[Array], row: Array) -> Counter[tuple[int, int]]:
    """Return the number of tracklets that change from one curve to another, for each pair of curves."""
    votes: Counter[tuple[int, int]] = Counter()
    for c in range(len(found.cameras)):
        own = np.flatnonzero(found.camera == c)
        of_tracklet = tracklet[c][row[own]]
        order = np.lexsort((found.time_s[own], of_tracklet))
        own, of_tracklet = own[order], of_tracklet[order]
        changes = (of_tracklet[1:] == of_tracklet[:-1]) & (found.point[own[1:]] != found.point[own[:-1]])
        for k in np.flatnonzero(changes):
            votes[int(found.point[own[k]]), int(found.point[own[k + 1]])] += 1
    return votes


def _leads(curves: SampledCurves, a: int, b: int, acceleration_mps2: float) -> bool:
    """Return whether curve ``a`` ends before ``b`` begins and a motion leads from one to the other."""
    end, begin = curves.start[a + 1] - 1, curves.start[b]
    gap = curves.time_s[begin] - curves.time_s[end]
    if not 0.0 < gap <= LONGEST_S:
        return False
    ahead = curves.xyz[end] + 0.5 * gap * curves.speed[end]
    back = curves.xyz[begin] - 0.5 * gap * curves.speed[begin]
    return bool(np.linalg.norm(ahead - back) <= SLACK_M + acceleration_mps2 * (0.5 * gap) ** 2)


def parts_in_time(times_s: Array, longest_s: float) -> list[tuple[float, float]]:
    """Return the intervals (begin, end) of rising instants that are at most ``longest_s`` [s] apart."""
    if not len(times_s):
        return []
    cut = np.flatnonzero(np.diff(times_s) > longest_s)
    edges = np.concatenate([[0], cut + 1, [len(times_s)]])
    return [(float(times_s[a]), float(times_s[b - 1])) for a, b in pairwise(edges)]
