"""Curves -> tracks on a grid of instants: positions, covariances, and whether image points support them.

A sample is "measured" where two or more cameras have an image point of it within one frame period before or after. It
is "filled" where the curve continues between such instants, over at most LONGEST_FILL_S, and at the ends where only
one camera sees the point: depth is extrapolated there. Beyond a point's first and last image point there are no
samples.
"""

from collections.abc import Sequence

import numpy as np

from mosca.continuous.association.tracklet_merging import parts_in_time
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations, UncertainCurves
from mosca.continuous.model.rig_at_time import images_of
from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks

LONGEST_FILL_S = 1.0
"""Longest gap in a curve's observations [s] over which it is sampled."""
BEYOND = 0.1
"""Largest time, in frame periods, beyond the second camera's image points at which a sample still counts as measured:
triggered cameras do not expose at exactly the same instant."""
CHUNK = 1000
"""Number of instants whose covariances are computed at a time."""


def residuals_px(
    curves: Curves, observations: TimedObservations, rig: Rig, cameras: CameraPaths | None = None
) -> Array:
    """Return the offsets (n, 2) [px] of image points from their curves' images; NaN where the curve is unknown.

    ``cameras``: the rig's poses where they change. Curves and observations are of one clock; within a frame with a
    rolling shutter images follow a parabola in time.
    """
    rest = np.full((len(observations), 2), np.nan)
    for c, camera in enumerate(rig.cameras):
        own = np.flatnonzero(observations.camera == c)
        if not len(own):
            continue
        times = observations.time_s[own]
        frames, at = np.unique(observations.exposure[own], return_inverse=True)
        first = np.full(len(frames), np.inf)
        last = np.full(len(frames), -np.inf)
        np.minimum.at(first, at, times)
        np.maximum.at(last, at, times)
        point = observations.point[own]
        if (last - first).max() <= 1e-9:
            image = images_of(curves, camera, c, cameras, first)[at, point]
        else:
            instants = (first, 0.5 * (first + last), last)
            a, b, e = (images_of(curves, camera, c, cameras, t)[at, point] for t in instants)
            u = ((times - first[at]) / np.maximum((last - first)[at], 1e-12))[:, None]
            image = a * (1 - u) * (1 - 2 * u) + b * 4 * u * (1 - u) + e * u * (2 * u - 1)
        rest[own] = observations.xy_px[own] - image
    return rest


def tracks_on_grid(
    curves: UncertainCurves,
    observations: TimedObservations,
    rig: Rig,
    instants_s: Array,
    time_ns: Array,
    near_s: Sequence[float],
    cameras: CameraPaths | None = None,
) -> Tracks:
    """Return samples of all points at ``instants_s`` (t,) on the curves' clock, with stamps ``time_ns`` (t,).

    ``observations``: of these points, on the curves' clock; ``near_s``: each camera's frame period [s]; ``cameras``:
    the rig's poses where they change. Covariances are the curves' own.
    """
    t, m = len(instants_s), len(curves.points)
    rest = residuals_px(curves, observations, rig, cameras)
    squared = np.nan_to_num((rest**2).sum(axis=1))
    seen_by, images, total = np.zeros((t, m), int), np.zeros((t, m), int), np.zeros((t, m))
    inside = np.zeros((t, m), dtype=bool)
    from_s, to_s = observations.together(BEYOND * np.asarray(near_s))
    together = (instants_s[:, None] >= from_s) & (instants_s[:, None] <= to_s)
    order = np.lexsort((observations.time_s, observations.camera, observations.point))
    point, camera = observations.point[order], observations.camera[order]
    times, squared = observations.time_s[order], squared[order]
    for p in range(m):
        low, high = np.searchsorted(point, [p, p + 1])
        for begin, end in parts_in_time(np.sort(times[low:high]), LONGEST_FILL_S):
            inside[:, p] |= (instants_s >= begin) & (instants_s <= end)
        for c, near in enumerate(near_s):
            a, b = low + np.searchsorted(camera[low:high], [c, c + 1])
            first = np.searchsorted(times[a:b], instants_s - near, "left")
            last = np.searchsorted(times[a:b], instants_s + near, "right")
            sums = np.concatenate([[0.0], np.cumsum(squared[a:b])])
            seen_by[:, p] += last > first
            images[:, p] += last - first
            total[:, p] += sums[last] - sums[first]
    parts = []
    for begin in range(0, t, CHUNK):
        some = slice(begin, begin + CHUNK)
        place, its = curves.at(instants_s[some]), curves.covariance_at(instants_s[some])
        at, which = np.nonzero(inside[some] & np.isfinite(place).all(axis=2))
        parts.append((at + begin, which, place[at, which], its[at, which]))
    instant, number, xyz, covariance = (np.concatenate(part) for part in zip(*parts, strict=True))
    views = seen_by[instant, number]
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = np.sqrt(total[instant, number] / (2 * images[instant, number]))
    return Tracks(
        instant, np.asarray(time_ns)[instant], number, np.array(curves.points)[number], xyz, covariance, views,
        residual, np.where((views >= 2) & together[instant, number], "measured", "filled")
    )  # fmt: skip
