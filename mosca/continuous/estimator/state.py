"""State vector: curves of points, cameras' poses and clocks; and the index of each unknown."""

from dataclasses import dataclass, field, replace

import numpy as np

from mosca.continuous.estimator.motion_prior import Smoothness
from mosca.continuous.model.bspline import Knots
from mosca.continuous.model.camera_paths import StillCameras
from mosca.continuous.model.estimated import SplinePaths
from mosca.data.arrays import Array
from mosca.data.rotations import rotation_from_vector


@dataclass(frozen=True, eq=False)
class TrajectoryState:
    """Current values. ``xyz`` (count, points, 3): coefficients of all points, those of carried ones unused; cameras
    are either ``still`` or ``moving``; ``clocks`` (cameras, 3): offset [s], drift, row time [s]. ``pace`` (pieces,):
    variance of the acceleration relative to its mean; None: constant.
    """

    knots: Knots
    xyz: Array
    still: StillCameras
    moving: SplinePaths | None
    clocks: Array
    smooth: Smoothness = field(default_factory=Smoothness)
    pace: Array | None = None

    @property
    def pace_at_knots(self) -> Array:
        """``pace`` (pieces + 1,) at the knots: the mean of the adjacent pieces."""
        pace = np.ones(self.knots.pieces) if self.pace is None else self.pace
        result: Array = (np.append(pace[0], pace) + np.append(pace, pace[-1])) / 2
        return result

    @property
    def paths(self) -> StillCameras | SplinePaths:
        """The cameras' paths."""
        return self.still if self.moving is None else self.moving


@dataclass(frozen=True, eq=False)
class StateLayout:
    """Index layout of the unknowns.

    ``groups``: coupled points, each group a band of 3 columns per point; with ``moving`` cameras there is one group,
    with 6 more columns per camera. Unknowns that do not depend on time: 6 per camera where ``still_free``, then the
    free clock unknowns with indices ``clock`` (cameras, 3), -1 where held; ``shared``: their total number.
    """

    groups: tuple[Array, ...]
    cameras: int
    moving: bool
    still_free: bool
    clock: Array
    shared: int

    def width(self, group: int) -> int:
        """Return the number of columns of a group."""
        return 3 * len(self.groups[group]) + (6 * self.cameras if self.moving else 0)

    def column(self, group: int, points: int) -> Array:
        """Return the first column of each of all ``points`` in a group, -1 for points that are not in it."""
        at = np.full(points, -1)
        at[self.groups[group]] = 3 * np.arange(len(self.groups[group]))
        return at


def layout(groups: tuple[Array, ...], cameras: int, kind: str, clock_free: Array) -> StateLayout:
    """Return the layout for cameras of ``kind`` ("known", "fixed", "moving") and the mask of free clock unknowns."""
    still_free = kind == "fixed"
    base = 6 * cameras if still_free else 0
    clock = np.where(clock_free, base + np.cumsum(clock_free.ravel()).reshape(clock_free.shape) - 1, -1)
    return StateLayout(groups, cameras, kind == "moving", still_free, clock, base + int(clock_free.sum()))


def unknowns(state: TrajectoryState, places: StateLayout, group: int) -> Array:
    """Return the group's coefficients as one vector (count * width,)."""
    parts = [state.xyz[:, places.groups[group]].reshape(state.knots.count, -1)]
    if state.moving is not None:
        parts.append(state.moving.coefficients.reshape(state.knots.count, -1))
    return np.concatenate(parts, axis=1).ravel()


def replaced(
    state: TrajectoryState, places: StateLayout, coefficients: list[Array], shared: Array
) -> TrajectoryState:
    """Return the state with new ``coefficients`` of each group, and ``shared`` added to time-independent unknowns."""
    xyz, moving = np.array(state.xyz), state.moving
    for g, (points, vector) in enumerate(zip(places.groups, coefficients, strict=True)):
        table = vector.reshape(state.knots.count, places.width(g))
        xyz[:, points] = table[:, : 3 * len(points)].reshape(state.knots.count, -1, 3)
        if moving is not None:
            poses = table[:, 3 * len(points) :].reshape(state.knots.count, -1, 6)
            moving = replace(moving, coefficients=poses)
    still = state.still
    if places.still_free:
        step = shared[: 6 * places.cameras].reshape(-1, 6)
        turned = [r @ rotation_from_vector(s[:3]) for r, s in zip(still.rotations, step, strict=True)]
        still = StillCameras(still.cameras, np.array(turned), still.centres + step[:, 3:])
    clocks = state.clocks + np.where(places.clock >= 0, np.append(shared, 0.0)[places.clock], 0.0)
    return replace(state, xyz=xyz, still=still, moving=moving, clocks=clocks)
