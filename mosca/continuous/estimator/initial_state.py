"""Initial state of an estimate: its points, knots and groups, and the cameras' assumed poses."""

import numpy as np
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform
from scipy.spatial.transform import Rotation

from mosca.continuous.estimator.motion_prior import DEGREE
from mosca.continuous.estimator.state import StateLayout, TrajectoryState
from mosca.continuous.model.bspline import Knots, fitted, knots_over, values
from mosca.continuous.model.camera_paths import PosedCameras, StillCameras
from mosca.continuous.model.estimated import ContinuousSettings, SplinePaths
from mosca.continuous.model.observations import CameraPaths, TimedObservations
from mosca.data.arrays import Array
from mosca.errors import InputError

FEWEST_SIGHTINGS = 6
MOST_UNKNOWNS = 600_000
"""Most coefficients; knots are spaced wider where there would be more."""
LARGEST_ROTATION_RAD = 0.7
"""Largest rotation about a camera's mean rotation for which it is described by rotation vectors about the mean
[rad]."""
CAMERA_START = (3.0, 1.0)
"""A-priori accelerations of a moving camera: rad/s^2 and m/s^2 in a band of one hertz."""


def enough(observations: TimedObservations, findings: list[str]) -> Array:
    """Return the free points that two cameras see often enough, and report those that are left out."""
    points = []
    for p in observations.free:
        own = observations.point == p
        seen_by = len(np.unique(observations.camera[own]))
        if own.sum() >= FEWEST_SIGHTINGS and seen_by >= 2:
            points.append(int(p))
        else:
            findings.append(
                f"point '{observations.points[p]}' is left out: {own.sum()} image points by {seen_by} cameras, "
                f"{FEWEST_SIGHTINGS} by 2 are needed"
            )
    if not points:
        raise InputError(
            f"continuous: no point is seen {FEWEST_SIGHTINGS} times and by two cameras; record longer or turn the "
            "cameras so that they see the same markers"
        )
    return np.array(points)


def seen_from_to(observations: TimedObservations, time_s: Array) -> Array:
    """Return the first and last instant (points, 2) [s] at which each point was seen, NaN where never.

    ``time_s`` (n,): instant of exposure of each image point.
    """
    spans = np.full((len(observations.points), 2), np.nan)
    for p in np.unique(observations.point):
        own = time_s[observations.point == p]
        spans[p] = own.min(), own.max()
    return spans


def first_knots(observations: TimedObservations, settings: ContinuousSettings) -> Knots:
    """Return knots with the mean spacing of the exposures of all cameras.

    Cameras that expose together count once: they see the same instant.
    """
    one = np.unique(np.column_stack([observations.camera, observations.exposure]), axis=0, return_index=True)[1]
    when = np.sort(observations.time_s[one])
    duration = float(when[-1] - when[0])
    instants_seen = 1 + int((np.diff(when) > 1e-4).sum())
    spacing = duration / max(instants_seen - 1, 1)
    width = 3 * len(observations.points) + 6 * len(observations.cameras)
    finest = duration * width / MOST_UNKNOWNS
    room = max(settings.reach_s, 0.0 if settings.clocks == "known" else spacing)
    return knots_over(when[0] - room, when[-1] + room, settings.knot_s or max(spacing, finest), DEGREE)


def moving_start(
    settings: ContinuousSettings, still: StillCameras, paths: CameraPaths | None, knots: Knots
) -> SplinePaths | None:
    """Return the cameras' initial paths as curves, None where cameras are stationary."""
    if settings.cameras != "moving":
        return None
    time = np.linspace(knots.start_s, knots.end_s, 2 * knots.count + 1)
    rotation, centre = still.at(time)
    if paths is not None:
        given = paths.at(time)
        for c, name in enumerate(still.cameras):
            if name not in paths.cameras:
                raise InputError(f"continuous: no path to begin with for camera '{name}'; give one for each camera")
            k = paths.cameras.index(name)
            good = np.flatnonzero(np.isfinite(given[1][:, k]).all(axis=1))
            if not len(good):
                raise InputError(f"continuous: the path to begin with of camera '{name}' is empty; leave it out")
            # before and after the given poses, and in gaps: the nearest pose
            nearest = good[np.abs(time[good][None, :] - time[:, None]).argmin(axis=1)]
            rotation[:, c], centre[:, c] = given[0][nearest, k], given[1][nearest, k]
    turns = np.zeros_like(centre)
    for c in range(len(still.cameras)):
        # about one rotation, so that the variance of the rotation is estimated, not the initial path's roughness
        each = Rotation.from_matrix(rotation[:, c])
        away = (each.mean().inv() * each).as_rotvec()
        if np.linalg.norm(away, axis=1).max() < LARGEST_ROTATION_RAD:
            rotation[:, c], turns[:, c] = each.mean().as_matrix(), away
    begin = PosedCameras(still.cameras, time, rotation, centre, "cubic")
    coefficients = np.concatenate([fitted(knots, time, turns), fitted(knots, time, centre)], axis=2)
    return SplinePaths(still.cameras, begin, knots, coefficients, coefficients)


def grouped(state: TrajectoryState, points: Array, settings: ContinuousSettings) -> tuple[Array, ...]:
    """Return the groups of points that are estimated together: neighbours, so that points of a limb share a group."""
    if settings.cameras == "moving" or len(points) <= settings.most_together:
        return (points,)
    at = values(state.knots, state.xyz[:, points], state.knots.breaks_s[:: max(1, state.knots.pieces // 50)])
    apart = np.linalg.norm(at[:, :, None] - at[:, None], axis=3).mean(axis=0)
    order = leaves_list(linkage(squareform(apart, checks=False), "average"))
    parts = np.array_split(points[order], -(-len(points) // settings.most_together))
    return tuple(np.sort(part) for part in parts)


def first_covariances(points: Array, strength: Array, places: StateLayout) -> list[Array]:
    """Return the initial covariance of each group's prior: diagonal, for points from their log ``strength``."""
    of_point = dict(zip(points.tolist(), strength, strict=True))
    rotation, centre = CAMERA_START
    of_cameras = np.tile([rotation**2] * 3 + [centre**2] * 3, places.cameras if places.moving else 0)
    own = [np.repeat([np.exp(-of_point[p]) for p in group.tolist()], 3) for group in places.groups]
    return [np.diag(np.concatenate([of_points, of_cameras])) for of_points in own]
