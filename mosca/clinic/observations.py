"""Images of points in all cameras, matched with tolerances so wide that a faulty rig still has points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from mosca.camera.projection import lens_pixels, project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import EVERYWHERE, match
from mosca.data.arrays import Array
from mosca.data.detections import Seen
from mosca.data.rays import Predicted, RayTable
from mosca.data.rig import Rig
from mosca.data.settings import MatchSettings, TrackSettings
from mosca.data.tracks import Points, Samples
from mosca.tracking.tracker import Tracker

LADDER_PX = (0.3, 1.0, 4.0)
"""Errors of image points [px, an axis] that matching tries, smallest first, until all cameras are connected."""
CONNECTED = 0.95
"""A camera is connected if this share of its detections belongs to points; then no larger error is tried."""
ADOPT_SHARE = 0.35
"""A free detection belongs to a point if it lies nearer than this share of the distance to other detections."""
ADOPT_PX = 40.0
"""Largest distance of such a free detection from the point's projection [px]."""
SMOOTH = 2
"""Samples to each side that the parabola for a sample's velocity is fitted to."""


@dataclass(frozen=True, eq=False)
class PointImages:
    """n points at instants, with their images in c cameras."""

    frame: Array
    """(n,) number of the frame set."""
    time_s: Array
    """(n,) time since the first frame set [s]."""
    track: Array
    """(n,) number of the track."""
    xyz: Array
    """(n, 3) world [m]."""
    velocity: Array
    """(n, 3) [m/s]; NaN where a track is too short."""
    xy_px: Array
    """(n, c, 2) image points corrected for their target's eccentricity, NaN where a camera has no image."""
    sigma_px: Array
    """(n, c) standard deviation of the detection, an axis."""
    index: Array
    """(n, c) index of the detection in its image, -1 for none."""
    connected: Array
    """(c,) share of each camera's detections that belong to points."""
    matched_px: float
    """Error of image points with which rays were matched, an axis."""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: Array) -> "PointImages":
        """Return the points of a boolean mask or index array."""
        names = ("frame", "time_s", "track", "xyz", "velocity", "xy_px", "sigma_px", "index")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


class _Row(NamedTuple):
    frame: int
    time_s: float
    track: int
    xyz: Array
    rays: Array


def observe(seen: Sequence[Seen], rig: Rig, ladder_px: Sequence[float] = LADDER_PX) -> PointImages:
    """Return the points of all frame sets, matched with the smallest error at which all cameras are connected.

    Where no error connects all cameras, the one that connects most is used.
    """
    best: PointImages | None = None
    for sigma in ladder_px:
        found = _observed(seen, rig, sigma)
        if len(found) and found.connected.min() >= CONNECTED:
            return found
        if best is None or found.connected.sum() > best.connected.sum() + 0.02 * len(rig.cameras):
            best = found
    assert best is not None
    return best


def _observed(seen: Sequence[Seen], rig: Rig, sigma_px: float) -> PointImages:
    cameras = len(rig.cameras)
    settings = MatchSettings(camera_sigma_px=sigma_px, minimum_cameras=min(3, cameras), judge_sizes=False)
    tracker, rows = Tracker(TrackSettings()), []
    points_of: dict[int, Points] = {}
    index_of: dict[int, Array] = {}
    freed: dict[int, list[Array]] = {}
    begin_ns = seen[0][0].time_ns if seen else 0
    found, used = np.zeros(cameras), np.zeros(cameras)
    for frame_set, detections, _ in seen:
        table = make_ray_table(rig, detections, np.full(cameras, sigma_px), settings.target)
        points = match(table, Predicted.nothing(), settings, EVERYWHERE)
        index = np.array(points.rays)
        for k, camera in enumerate(rig.cameras):
            if (one := detections.get(camera.name)) is not None:
                index[:, k] = _adopted(project(camera, points.xyz), one.xy_px, index[:, k])
                found[k] += len(one)
                used[k] += int((index[:, k] >= 0).sum())
        points_of[frame_set.pulse], index_of[frame_set.pulse] = points, index
        freed[frame_set.pulse] = _freed(table, rig)
        tracker.predict(frame_set.time_ns * 1e-9)
        samples = tracker.update(points, frame_set.pulse, frame_set.time_ns, 0.0)
        rows += _rows(samples, points_of, index_of, begin_ns)
    tables = {frame_set.pulse: detections for frame_set, detections, _ in seen}
    xy = np.full((len(rows), cameras, 2), np.nan)
    sigma = np.full((len(rows), cameras), np.nan)
    for i, row in enumerate(rows):
        for k, camera in enumerate(rig.cameras):
            if row.rays[k] >= 0:
                one = tables[row.frame][camera.name]
                xy[i, k] = freed[row.frame][k][row.rays[k]]
                sigma[i, k] = np.sqrt(0.5 * np.trace(one.covariance_px2[row.rays[k]]))
    frame = np.array([row.frame for row in rows], np.int64)
    time_s = np.array([row.time_s for row in rows], float)
    track = np.array([row.track for row in rows], np.int64)
    xyz = np.array([row.xyz for row in rows], float).reshape(-1, 3)
    index = np.array([row.rays for row in rows], np.int64).reshape(-1, cameras)
    return PointImages(
        frame, time_s, track, xyz, _velocities(time_s, track, xyz), xy, sigma, index, used / np.maximum(found, 1),
        sigma_px,
    )  # fmt: skip


def _freed(table: RayTable, rig: Rig) -> list[Array]:
    """Return, for each camera, the images (n, 2) [px] of the directions that matching used for target centres."""
    return [
        lens_pixels(camera.lens, table.direction[begin:end] @ camera.world_from_camera.rotation)
        for camera, begin, end in zip(rig.cameras, table.start[:-1], table.start[1:], strict=True)
    ]


def _rows(samples: Samples, points_of: dict[int, Points], index_of: dict[int, Array], begin_ns: int) -> list[_Row]:
    """Return the measured samples with the detections of their points."""
    rows = []
    for i in np.flatnonzero(samples.status == 0):
        frame = int(samples.frame[i])
        if frame not in points_of or not len(points_of[frame]):
            continue
        away = np.linalg.norm(points_of[frame].xyz - samples.xyz[i], axis=1)
        at = int(np.argmin(away))
        if away[at] < 1e-6:
            time_s = 1e-9 * float(samples.time_ns[i] - begin_ns)
            rows.append(_Row(frame, time_s, int(samples.track[i]), samples.xyz[i], index_of[frame][at]))
    return rows


def _adopted(projected: Array, xy: Array, index: Array) -> Array:
    """Return each point's detection in a camera; points without one from matching get a free detection nearby."""
    index = index.copy()
    if not len(xy):
        return index
    tree = cKDTree(xy)
    free = np.ones(len(xy), bool)
    free[index[index >= 0]] = False
    for i in np.flatnonzero((index < 0) & np.isfinite(projected).all(axis=1)):
        away, at = tree.query(projected[i], k=2)
        if away[0] < min(ADOPT_PX, ADOPT_SHARE * away[1]) and free[at[0]]:
            index[i], free[at[0]] = at[0], False
    return index


def _velocities(time_s: Array, track: Array, xyz: Array) -> Array:
    """Return the velocity (n, 3) [m/s] of each sample by a parabola through its neighbours; NaN with too few."""
    speed = np.full((len(track), 3), np.nan)
    for name in np.unique(track):
        rows = np.flatnonzero(track == name)
        rows = rows[np.argsort(time_s[rows])]
        for j in range(SMOOTH, len(rows) - SMOOTH):
            near = rows[j - SMOOTH : j + SMOOTH + 1]
            t = time_s[near] - time_s[rows[j]]
            if np.ptp(t) <= 0 or np.ptp(t) > 3 * (2 * SMOOTH) * np.median(np.diff(t)):
                continue
            design = np.stack([np.ones_like(t), t, t**2], axis=1)
            speed[rows[j]] = np.linalg.lstsq(design, xyz[near], rcond=None)[0][1]
    return speed
