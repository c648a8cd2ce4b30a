"""The nearest-neighbour tracker of the guide: the baseline that trackers are compared with.

Guide, section "Marker Tracking": a thresholded nearest neighbour calculation from one frame to the next. Each marker
takes the point nearest to where it was last seen, within a threshold; nothing is predicted, and two markers may take
the same point, as the guide's hand and shoulder do. A point that no marker took begins a new one.
"""

import numpy as np
from pydantic.dataclasses import dataclass
from scipy.spatial import cKDTree

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.rays import Predicted
from mosca.data.tracks import Points, Samples


@dataclass(frozen=True, config=SETTINGS)
class NearestSettings:
    """How far markers move."""

    threshold_m: Positive = 0.08
    """How far a marker may move between two frames."""
    keep_s: NotNegative = 0.25
    """How long a marker without a point is kept where it was last seen."""


class NearestTracker:
    """Same interface as ``mosca.tracking.tracker.Tracker``."""

    def __init__(self, settings: NearestSettings | None = None) -> None:
        self.settings = NearestSettings() if settings is None else settings
        self._identity: Array = np.empty(0, np.int64)
        self._place: Array = np.empty((0, 3))
        self._seen_s: Array = np.empty(0)
        self._next = 0
        self._time_s: float | None = None

    def scale_to(self, edge_m: float) -> None:
        """Do nothing: the settings leave nothing open."""

    def predict(self, time_s: float) -> Predicted:
        """Note the time [s]; nothing is predicted."""
        if self._time_s is not None and time_s < self._time_s:
            raise ValueError(f"time {time_s} s lies before {self._time_s} s: points must come in order")
        self._time_s = time_s
        return Predicted.nothing()

    @property
    def waiting(self) -> int:
        """No sample waits for a name: each marker has one at once."""
        return 0

    def update(self, points: Points, frame: int, time_ns: int, jitter_s: float = 0.0) -> Samples:
        """Give each marker its nearest point; return a sample for each marker seen. ``jitter_s`` changes nothing."""
        n, time_s = len(points), time_ns * 1e-9
        waiting = time_s - self._seen_s <= self.settings.keep_s
        identity, place, seen_s = self._identity[waiting], self._place[waiting], self._seen_s[waiting]
        row = np.full(len(identity), n)
        if n and len(identity):
            away, nearest = cKDTree(points.xyz).query(place)
            row = np.where(away <= self.settings.threshold_m, nearest, n)
        seen = row < n
        place[seen], seen_s[seen] = points.xyz[row[seen]], time_s
        new = np.setdiff1d(np.arange(n), row)
        names = self._next + np.arange(len(new))
        self._next += len(new)
        self._identity = np.concatenate([identity, names])
        self._place = np.concatenate([place, points.xyz[new]])
        self._seen_s = np.concatenate([seen_s, np.full(len(new), time_s)])
        rows = np.concatenate([row[seen], new])
        k = len(rows)
        return Samples(
            np.full(k, frame), np.full(k, time_ns), np.concatenate([identity[seen], names]), points.xyz[rows],
            points.covariance[rows], points.n_cameras[rows], points.residual_px[rows], np.zeros(k, np.int8),
        )  # fmt: skip
