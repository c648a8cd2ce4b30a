"""Image points of one camera alone, just before two cameras see a point and just after.

They determine two of three coordinates where the curve would be extrapolated. Their names are taken from their
tracklets: there a curve's prediction is as uncertain as points are apart, and nearest ones would be exchanged.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mosca.continuous.association.coarse_sync import ClockTie
from mosca.continuous.association.correspondence import WORST_PX
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.model.observations import TimedObservations
from mosca.data.arrays import Array
from mosca.data.detections import MERGED

LONE_FRAMES = 8
"""Most frames used before the second camera's first image point, and after the last but one camera's last one."""


def with_lone(
    found: TimedObservations,
    row: Array,
    known: tuple[Array, Array],
    seen: Sequence[CameraDetections],
    tracklet: Sequence[Array],
    ties: Sequence[ClockTie],
    sigma_px: Array,
) -> tuple[TimedObservations, Array]:
    """Return the observations with lone image points added, and their indices among their cameras' image points.

    ``known``: begin and end (points,) [s] of each point's known curve; between them the curve decided what belongs to
    it. ``tracklet``: tracklet of each camera's image points; ``sigma_px`` (c,): as in ``observed``.
    """
    from_s, to_s = found.together()
    parts, numbers = [], [row]
    for c, (one, of, tie) in enumerate(zip(seen, tracklet, ties, strict=True)):
        times, far = tie.common_s(one.time_s(tie.origin_ns)), LONE_FRAMES * one.period_s
        name = np.full(len(times), -1)
        name[row[found.camera == c]] = found.point[found.camera == c]
        before, after = _neighbours(name, of, times)
        early = (before >= 0) & (times < known[0][before]) & (times > from_s[before] - far)
        late = (after >= 0) & (times > known[1][after]) & (times < to_s[after] + far)
        usable = ((one.flags & MERGED) == 0) & (one.covariance_px2.trace(axis1=1, axis2=2) / 2 < WORST_PX**2)
        new = np.flatnonzero((early | late) & usable)
        point = np.where(early, before, after)[new]
        # where two tracklets of one frame belong to one point, neither is used
        _, which, count = np.unique(
            np.column_stack([one.frame[new], point]), axis=0, return_inverse=True, return_counts=True
        )
        new, point = new[count[which.ravel()] == 1], point[count[which.ravel()] == 1]
        spread = one.covariance_px2[new] + sigma_px[c] ** 2 * np.eye(2)
        parts.append((np.full(len(new), c), point, one.frame[new], times[new], one.xy_px[new], spread))
        numbers.append(new)
    had = (found.camera, found.point, found.exposure, found.time_s, found.xy_px, found.covariance_px2)
    camera, named, exposure, time_s, xy, covariance = (
        np.concatenate(column) for column in zip(had, *parts, strict=True)
    )
    whole = replace(
        found, camera=camera, point=named, exposure=exposure, time_s=time_s, xy_px=xy, covariance_px2=covariance
    )
    return whole, np.concatenate(numbers)


def _neighbours(name: Array, tracklet: Array, time_s: Array) -> tuple[Array, Array]:
    """Return for each image point before its tracklet's first named one the name of that one (n,), and for each
    after the last named one the name of that one (n,); -1 elsewhere.
    """
    before, after = np.full((2, len(name)), -1)
    order = np.lexsort((time_s, tracklet))
    for part in np.split(order, np.flatnonzero(np.diff(tracklet[order])) + 1):
        named = np.flatnonzero(name[part] >= 0)
        if len(named):
            before[part[: named[0]]] = name[part[named[0]]]
            after[part[named[-1] + 1 :]] = name[part[named[-1]]]
    return before, after
