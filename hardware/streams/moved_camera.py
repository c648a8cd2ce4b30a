"""The effect of a turned camera on a stream: points in its view are displaced by its share in them.

The camera stands beside the volume, along x, and is turned about the streamed z by an angle w. In its images this is
as if each point p were displaced by ``w z x (p - c)``, c being its centre. For a point that four cameras see with
equal weight, a quarter of that remains (least squares; the other three hold it). The nearer half of the volume is in
view, so that distances between points of both halves change. The remaining displacement shows in residuals, too.
"""

from dataclasses import replace

import numpy as np

from hardware.streams.turns import product
from hardware.streams.values import StreamFrame
from mosca.data.arrays import Array

SHARE = 0.25


class MovedCamera:
    """A camera beside the volume that the markers (or else bodies) of ``first`` fill, turned by ``angle_rad``."""

    def __init__(self, first: StreamFrame, angle_rad: float) -> None:
        there = (first.markers if len(first.markers) else first.bodies)["position"].reshape(-1, 3)
        low, high = (there.min(axis=0), there.max(axis=0)) if len(there) else (np.zeros(3), np.zeros(3))
        self._middle: Array = 0.5 * (low + high)
        self._centre: Array = self._middle + [max(float(np.linalg.norm(high - low)), 1.0), 0.0, 0.0]
        self._turn = SHARE * angle_rad
        self._quaternion: Array = np.array([np.cos(self._turn / 2), 0.0, 0.0, np.sin(self._turn / 2)])

    def seen(self, frame: StreamFrame) -> StreamFrame:
        """Return a frame as it is measured with the turned camera."""
        markers = frame.markers.copy()
        away = self._displaced(markers["position"])
        markers["position"] += away
        markers["residual"] = np.hypot(markers["residual"], np.linalg.norm(away, axis=1))
        return replace(
            frame,
            markers=markers,
            other=frame.other + self._displaced(frame.other),
            marker_sets=tuple((name, xyz + self._displaced(xyz)) for name, xyz in frame.marker_sets),
            bodies=self._posed(frame.bodies),
            skeletons=tuple((number, self._posed(bones)) for number, bones in frame.skeletons),
        )

    def _displaced(self, xyz: Array) -> Array:
        """Return how far points (n, 3) [m] are displaced, 0 out of view."""
        x, y, _ = (xyz - self._centre).T
        away = self._turn * np.stack([-y, x, np.zeros_like(x)], axis=1)
        return np.asarray(np.where((xyz[:, 0] > self._middle[0])[:, None], away, 0.0), np.float32)

    def _posed(self, bodies: Array) -> Array:
        """Return bodies (n,) BODY displaced and turned, those out of view as they are."""
        made = bodies.copy()
        away = self._displaced(bodies["position"])
        moved = bodies["position"][:, 0] > self._middle[0]
        made["position"] += away
        made["error"] = np.hypot(made["error"], np.linalg.norm(away, axis=1))
        turned = product(self._quaternion, bodies["quaternion"][moved][:, [3, 0, 1, 2]].T)
        made["quaternion"][moved] = np.stack(turned, axis=1)[:, [1, 2, 3, 0]]
        return made
