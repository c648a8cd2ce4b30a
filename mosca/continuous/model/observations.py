"""Observations of free-running cameras: image points, each with its own instant; and curves estimated from them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from mosca.data.arrays import Array, read_only


@dataclass(frozen=True, eq=False)
class TimedObservations:
    """n image points of named points, each at the instant of its own exposure.

    ``cameras`` and ``points``: their names. For each image point: ``camera`` (n,) and ``point`` (n,) indices;
    ``exposure`` (n,): running number of the camera's frame, rising with time; ``time_s`` (n,): mid-exposure of that
    frame's first row, on the camera's own clock counted from the session's start [s]; ``xy_px`` (n, 2);
    ``covariance_px2`` (n, 2, 2) of its random error.

    Epipoles (second paper, section 3) are ordinary image points: a camera that is seen is a point that a camera
    carries. ``carried_by`` (points,): index of the camera that carries the point, -1 for none; ``carried_at``
    (points, 3): its position in that camera's frame [m], zero for the projection centre itself.
    """

    cameras: tuple[str, ...]
    points: tuple[str, ...]
    camera: Array
    point: Array
    exposure: Array
    time_s: Array
    xy_px: Array
    covariance_px2: Array
    carried_by: Array
    carried_at: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "points", tuple(self.points))
        n, m = len(self.xy_px), len(self.points)
        for name, shape, dtype in (
            ("camera", (n,), np.int64),
            ("point", (n,), np.int64),
            ("exposure", (n,), np.int64),
            ("time_s", (n,), np.float64),
            ("xy_px", (n, 2), np.float64),
            ("covariance_px2", (n, 2, 2), np.float64),
            ("carried_by", (m,), np.int64),
            ("carried_at", (m, 3), np.float64),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name, dtype))
        for name, index, end in (("camera", self.camera, len(self.cameras)), ("point", self.point, len(self.points))):
            if n and (index.min() < 0 or index.max() >= end):
                raise ValueError(f"{name}: {index.min()} to {index.max()} given, 0 to {end - 1} allowed")

    def together(self, slack_s: Array | float = 0.0) -> tuple[Array, Array]:
        """Return begin and end (points,) [s] of the time in which two cameras see each point: empty where never.

        ``slack_s`` (cameras,): time by which each camera's sightings are extended at both ends.
        """
        first = np.full((len(self.points), max(len(self.cameras), 2)), np.inf)
        last, slack = -first, np.broadcast_to(slack_s, len(self.cameras))[self.camera]
        np.minimum.at(first, (self.point, self.camera), self.time_s - slack)
        np.maximum.at(last, (self.point, self.camera), self.time_s + slack)
        return np.sort(first, axis=1)[:, 1], np.sort(last, axis=1)[:, -2]

    def __len__(self) -> int:
        return len(self.xy_px)

    @property
    def free(self) -> Array:
        """Indices of the points that no camera carries: the markers whose curves are estimated."""
        return np.flatnonzero(self.carried_by < 0)

    def only(self, keep: Array) -> "TimedObservations":
        """Return the image points ``keep`` (mask or indices); indices of cameras and points stay the same."""
        columns = ("camera", "point", "exposure", "time_s", "xy_px", "covariance_px2")
        return replace(self, **{name: getattr(self, name)[keep] for name in columns})


def no_carriers(points: Sequence[str]) -> dict[str, Array]:
    """Return ``carried_by`` and ``carried_at`` of points that no camera carries."""
    return {"carried_by": np.full(len(points), -1), "carried_at": np.zeros((len(points), 3))}


class Curves(Protocol):
    """Positions of points as functions of time, world frame [m]; NaN where a point is not known."""

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the points."""

    def at(self, time_s: Array) -> Array:
        """Return the positions (t, points, 3) at the instants ``time_s`` (t,)."""


@runtime_checkable
class UncertainCurves(Curves, Protocol):
    """Curves with covariances."""

    def covariance_at(self, time_s: Array) -> Array:
        """Return the covariances (t, points, 3, 3) [m^2] at the instants ``time_s`` (t,)."""


class CameraPaths(Protocol):
    """Exterior orientations of cameras as functions of time."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return world_from_camera: rotations (t, cameras, 3, 3) and centres (t, cameras, 3) [m]."""
