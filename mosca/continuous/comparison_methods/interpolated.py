"""The second paper's linear and cubic methods (section 5): image tracks are interpolated to common instants.

Each camera's track of each point is interpolated in the image, by straight lines or a cubic spline, to instants at
which the other cameras have it too. The cameras are then treated as synchronous: points are intersected (known
cameras) or adjusted with the cameras (unknown ones), with epipoles (eq. 7) or without them (eq. 4). Interpolated
image points are treated as observations, which is the main error of these methods in fast motion.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from mosca.continuous.comparison_methods.initial_poses import first_scene
from mosca.continuous.comparison_methods.synchronous import Cameras, PosesAndPoints, Views, adjust, intersected
from mosca.continuous.model.camera_paths import PosedCameras, StillCameras
from mosca.continuous.model.observations import CameraPaths, TimedObservations
from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.errors import InputError

Kind = Literal["linear", "cubic"]
LONGEST_GAP = 2.5
"""Longest gap in a track that is interpolated, in spacings of its camera's exposures."""


@dataclass(frozen=True, eq=False)
class ImageTracks:
    """Image tracks as functions of time: ``at`` returns Views at any instants."""

    observations: TimedObservations
    rig: Rig
    kind: Kind

    def at(self, time_s: Array) -> Views:
        """Return image points (t, c, m, 2) at ``time_s`` (t,); NaN outside a track and in its longer gaps."""
        see, time_s = self.observations, np.asarray(time_s, dtype=float)
        xy = np.full((len(time_s), len(see.cameras), len(see.points), 2), np.nan)
        for k in range(len(see.cameras)):
            mine = np.flatnonzero(see.camera == k)
            mine = mine[np.lexsort((see.time_s[mine], see.point[mine]))]
            exposures = np.unique(see.time_s[mine])
            if len(exposures) < 2:
                continue
            longest = LONGEST_GAP * float(np.median(np.diff(exposures)))
            breaks = np.flatnonzero((np.diff(see.point[mine]) != 0) | (np.diff(see.time_s[mine]) > longest))
            for piece in np.split(mine, breaks + 1):
                t = see.time_s[piece]
                if len(piece) >= 2:
                    inside, found = _on_line(self.kind, t, see.xy_px[piece], time_s)
                    xy[inside, k, see.point[piece[0]]] = found
        order = tuple(self.rig.camera(name) for name in see.cameras)
        return Views(order, xy, see.carried_by, see.carried_at)


@dataclass(frozen=True, eq=False)
class Interpolated:
    """A method's curves and cameras.

    ``points``: names of the free points; ``rms_px``: image errors at the instants of the adjustment; ``scene`` and
    ``instants_s`` (t,): result and instants of that adjustment.
    """

    points: tuple[str, ...]
    tracks: ImageTracks
    paths: CameraPaths
    moving: bool
    instants_s: Array
    scene: PosesAndPoints
    rms_px: float

    def at(self, time_s: Array) -> Array:
        """Return the positions (t, points, 3) [m]; NaN where fewer than two cameras have a point.

        With stationary cameras, image points are interpolated to ``time_s`` and intersected. With moving ones,
        positions at the instants of the adjustment are interpolated like image tracks.
        """
        if self.moving:
            return _between(self.instants_s, self.scene.xyz, np.asarray(time_s, dtype=float), self.tracks.kind)
        views = self.tracks.at(time_s)
        rotations, centres = self.paths.at(time_s)
        start = PosesAndPoints(rotations, centres, intersected(views, rotations, centres))
        return adjust(views, start, "known").scene.xyz


def interpolated(
    observations: TimedObservations,
    rig: Rig,
    kind: Kind = "cubic",
    cameras: Cameras = "known",
    *,
    epipoles: bool = True,
    instants_s: Array | None = None,
) -> Interpolated:
    """Return the result of the paper's linear or cubic method.

    ``cameras``: "known" as in ``rig``; "fixed" or "moving": only their lenses are taken from it (and, as the datum,
    the first camera's pose and its distance to the second). ``epipoles``: whether they are used where observed; with
    known cameras they are never used. ``instants_s`` (t,): common instants; by default all exposures between the
    latest of the cameras' first and the earliest of their last ones. InputError where the cameras share no time or
    too few points.
    """
    tracks = ImageTracks(observations, rig, kind)
    instants = common_instants(observations) if instants_s is None else np.asarray(instants_s, dtype=float)
    views = tracks.at(instants)
    start = first_scene(views, cameras, epipoles=epipoles)
    done = adjust(views, start, cameras, epipoles=epipoles)
    free = tuple(observations.points[m] for m in views.free)
    scene = done.scene
    paths: CameraPaths
    if cameras == "moving":
        paths = PosedCameras(observations.cameras, instants, scene.rotations, scene.centres, kind)
    else:
        paths = StillCameras(observations.cameras, scene.rotations[0], scene.centres[0])
    rms = float(np.sqrt(np.mean(done.rms_px**2)))
    return Interpolated(free, tracks, paths, cameras == "moving", instants, scene, rms)


def common_instants(observations: TimedObservations) -> Array:
    """Return the instants of all exposures (t,) within the time that all cameras share [s]."""
    times = [np.unique(observations.time_s[observations.camera == k]) for k in range(len(observations.cameras))]
    for name, t in zip(observations.cameras, times, strict=True):
        if len(t) < 2:
            raise InputError(f"camera '{name}': {len(t)} exposures with image points, at least 2 are needed")
    first, last = max(t[0] for t in times), min(t[-1] for t in times)
    if first >= last:
        late = observations.cameras[int(np.argmax([t[0] for t in times]))]
        raise InputError(
            f"camera '{late}': begins at {first:.3f} s, when another has ended at {last:.3f} s; let the cameras "
            "share time"
        )
    every = np.unique(np.concatenate(times))
    return np.asarray(every[(every >= first) & (every <= last)])


def _between(instants: Array, xyz: Array, time_s: Array, kind: Kind) -> Array:
    """Interpolate positions (t, n, 3) in time, separately in pieces without NaN; NaN elsewhere."""
    found = np.full((len(time_s), *xyz.shape[1:]), np.nan)
    for n in range(xyz.shape[1]):
        known = np.isfinite(xyz[:, n]).all(axis=1).astype(int)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], known, [0]])))
        for start, end in edges.reshape(-1, 2):
            if end - start < 2:
                continue
            inside, values = _on_line(kind, instants[start:end], xyz[start:end, n], time_s)
            found[inside, n] = values
    return found


def _on_line(kind: Kind, t: Array, values: Array, time_s: Array) -> tuple[Array, Array]:
    """Return which of ``time_s`` lie within ``t`` (n,), and ``values`` (n, k) interpolated there."""
    inside = (time_s >= t[0] - 1e-9) & (time_s <= t[-1] + 1e-9)
    line = make_interp_spline(t, values, k=1) if kind == "linear" else CubicSpline(t, values)
    return inside, line(time_s[inside])
