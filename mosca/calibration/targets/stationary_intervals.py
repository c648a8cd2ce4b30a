"""Stationary intervals of the target: frame sets between which no mark moved share one pose."""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.sightings import Sightings

LEAST_MOVE_PX = 0.35
"""Largest shake of a camera's body between two exposures: ten times the usual 0.03 px."""
SIGMAS = 6.0
"""Motion from which a target has moved, in standard deviations of the noise of the mean position."""


def stationary_intervals(sightings: Sightings) -> Array:
    """Return the stationary interval (frames,) of each frame set, counted from 0; -1 where nothing was seen.

    A new one begins where the marks of any camera moved by more than ``LEAST_MOVE_PX`` and their noise, against
    the interval's first frame set: a slow creep is also a motion.
    """
    order = np.argsort(sightings.frame, kind="stable")
    bounds = np.searchsorted(sightings.frame[order], np.arange(sightings.frames + 1))
    out = np.full(sightings.frames, -1, dtype=np.int64)
    first: Array | None = None
    stand = -1
    for frame in range(sightings.frames):
        here = order[bounds[frame] : bounds[frame + 1]]
        if len(here) == 0:
            continue
        if first is None or _moved(sightings, first, here):
            stand, first = stand + 1, here
        out[frame] = stand
    return out


def _moved(sightings: Sightings, before: Array, now: Array) -> bool:
    """Return whether any camera saw its marks move; no mark in common counts as motion."""
    mark, camera = sightings.mark, sightings.camera
    key = camera * (int(mark.max(initial=0)) + 2) + mark
    _, i, j = np.intersect1d(key[before], key[now], return_indices=True)
    if len(i) == 0:
        return True
    one, two = before[i], now[j]
    by = sightings.xy_px[two] - sightings.xy_px[one]
    noise = np.hypot(sightings.sigma_px[one], sightings.sigma_px[two])
    for c in np.unique(camera[one]):
        mine = camera[one] == c
        limit = LEAST_MOVE_PX + SIGMAS * float(np.median(noise[mine])) / np.sqrt(mine.sum())
        if np.linalg.norm(np.median(by[mine], axis=0)) > limit or np.median(
            np.linalg.norm(by[mine], axis=1)
        ) > limit + 2 * float(np.median(noise[mine])):
            return True
    return False
