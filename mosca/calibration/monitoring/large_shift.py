"""Bumps too large for the matching: all images of a camera are displaced by one common shift."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.data.tracks import Points

REACH_PX = 80.0
"""Largest shift that is searched for [px]: the histogram's cost grows with its square."""
BIN_PX = 2.0
"""Width of the bins of the histogram of shifts [px]; the shift is refined afterwards."""
LEAST_EXPECTED = 20
"""Fewest points that a camera must be expected to see in the frames examined before missing ones count."""
LEAST_VOTES = 8.0
"""Least votes for the common shift, relative to an average bin."""


@dataclass(frozen=True)
class LargeShift:
    """A camera whose images are displaced by ``shift_px`` since a frame; ``chi_square`` of its votes."""

    camera: str
    since: int
    shift_px: float
    chi_square: float


class LargeShiftDetector:
    """Counts the points that each camera should see and does not, and the places of its unused images."""

    def __init__(self, rig: Rig, lost_share: float, frames: int) -> None:
        self._rig, self._share, self._frames = rig, lost_share, frames
        self._seen: list[deque[tuple[int, int, int, Array]]] = [deque(maxlen=frames) for _ in rig.cameras]

    def update(self, frame: int, detections: Mapping[str, Detections], points: Points) -> LargeShift | None:
        """Take a frame; return the camera that lost its points to one common shift, if any."""
        for k, camera in enumerate(self._rig.cameras):
            found = detections.get(camera.name)
            if found is None:
                continue
            matched = points.rays[:, k] >= 0
            others = (points.rays >= 0).sum(axis=1) - matched
            met, missed = int((matched & (others >= 2)).sum()), ~matched & (others >= 2)
            if met >= 2 * self._share * (met + int(missed.sum())):
                self._seen[k].append((frame, met, met, np.empty((0, 2))))  # nothing is missing
                continue
            with np.errstate(invalid="ignore"):
                xy = project(camera, points.xyz[missed])
                xy = xy[((xy > 0) & (xy < (camera.width - 1, camera.height - 1))).all(axis=1)]
            free = np.setdiff1d(np.arange(len(found)), points.rays[matched, k])
            self._seen[k].append((frame, met + len(xy), met, _displacements(xy, found.xy_px[free])))
        return next((lost for k in range(len(self._seen)) if (lost := self._checked(k)) is not None), None)

    def _checked(self, k: int) -> LargeShift | None:
        recent = self._seen[k]
        expected, met = sum(one[1] for one in recent), sum(one[2] for one in recent)
        if len(recent) < self._frames or expected < LEAST_EXPECTED or met >= self._share * expected:
            return None
        votes = np.concatenate([one[3] for one in recent])
        if len(votes) == 0:
            return None
        edges = np.arange(-REACH_PX, REACH_PX + BIN_PX, BIN_PX)
        table = np.histogram2d(votes[:, 0], votes[:, 1], (edges, edges))[0]
        # a shift seldom falls into the middle of a bin: sum the counts of two by two bins
        table = table[:-1, :-1] + table[1:, :-1] + table[:-1, 1:] + table[1:, 1:]
        best = np.unravel_index(int(np.argmax(table)), table.shape)
        top, mean = float(table[best]), float(table.mean())
        if top < max(0.4 * (expected - met), LEAST_VOTES * max(mean, 1.0)):
            return None
        near = np.abs(votes - [edges[best[0] + 1], edges[best[1] + 1]]).max(axis=1) <= BIN_PX
        shift = float(np.linalg.norm(np.median(votes[near], axis=0)))
        since = next(one[0] for one in recent if one[2] < self._share * max(one[1], 1))
        return LargeShift(self._rig.names[k], since, shift, (top - mean) ** 2 / max(mean, 1.0))


def _displacements(points: Array, images: Array) -> Array:
    """Return images minus points (v, 2) [px] of all pairs within REACH_PX."""
    if len(points) == 0 or len(images) == 0:
        return np.empty((0, 2))
    pairs = cKDTree(points).query_ball_tree(cKDTree(images), REACH_PX)
    one = np.repeat(np.arange(len(points)), [len(p) for p in pairs])
    other = np.array([j for p in pairs for j in p], dtype=np.int64)
    return np.asarray(images[other] - points[one])
