"""Poses of body-worn cameras at each instant from their images of each other's lamps (observed epipoles) alone.

Some cameras' poses are known; their frame is the world's. A camera whose lamp is seen by two placed cameras is at the
intersection of their rays; its rotation follows from its rays to the lamps of placed cameras (Wahba's problem). So
the cameras are placed one after the other. All cameras of an instant are then adjusted together to all sightings of
lamps (the second term of eq. 7 of the second paper, with the lamps' offsets from their lenses). Cameras that could
not be placed start from their pose at the nearest instant.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from mosca.camera.projection import cross_matrices, lens_directions
from mosca.continuous.association.blink_codes import DARKEST
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.association.tracklet_merging import parts_in_time
from mosca.data.arrays import Array
from mosca.data.rig import Rig

RAY_SIGMA = 2e-3
"""Error of a lamp's ray [rad]: a lamp is dark for up to a few frames, over which its image is interpolated."""
LOOSE = (0.5, 0.5)
"""Prior standard deviation [rad, m] of a pose about its initial value, for directions not determined by lamps."""
KNOWN = (0.04, 0.03)
"""Largest standard deviations [rad, m] of a pose that is used."""
SEED_PASSES = 5
STEPS = 8
FARTHEST_RAD = 0.03
"""Gate of a sighting about its lamp's predicted image."""


@dataclass(frozen=True, eq=False)
class LampRays:
    """``rays`` (t, c, c, 3): unit rays, viewer's frame, on which camera c at an instant sees the lamp of another
    (viewer, carrier); NaN where it does not. ``time_s`` (t,).
    """

    time_s: Array
    rays: Array


@dataclass(frozen=True, eq=False)
class MutualPoses:
    """world_from_camera at instants: ``rotations`` (t, c, 3, 3), ``centres`` (t, c, 3) [m], NaN where lamps do not
    determine them; ``residual_rad`` (t,) rms of the sightings.
    """

    time_s: Array
    rotations: Array
    centres: Array
    residual_rad: Array


def lamp_rays(
    seen: Sequence[CameraDetections],
    times_s: Sequence[Array],
    lamp: Sequence[Array],
    rig: Rig,
    instants_s: Array,
    bit_s: float,
) -> LampRays:
    """Return the rays to each other's lamps at ``instants_s`` (t,) of the common clock.

    For each camera's image points (n,): ``times_s`` and ``lamp``, the camera whose lamp it is or -1. Images are
    interpolated (cubic) while a lamp is dark, and not extrapolated.
    """
    c = len(rig.cameras)
    rays = np.full((len(instants_s), c, c, 3), np.nan)
    for v, camera in enumerate(rig.cameras):
        longest = (DARKEST + 1) * bit_s + 1.6 * seen[v].period_s
        for j in range(c):
            own = np.flatnonzero(lamp[v] == j)
            if len(own) < 2 or j == v:
                continue
            t, xy = times_s[v][own], seen[v].xy_px[own]
            for begin, end in parts_in_time(t, longest):
                part = (t >= begin) & (t <= end)
                at = np.flatnonzero((instants_s >= begin) & (instants_s <= end))
                if part.sum() < 4 or not len(at):
                    continue
                there = CubicSpline(t[part], xy[part])(instants_s[at])
                rays[at, v, j] = lens_directions(camera.lens, there)
    return LampRays(np.asarray(instants_s, dtype=float), rays)


def poses_from_lamps(sights: LampRays, rig: Rig, known: Array, lamp_m: Array) -> MutualPoses:
    """Return the cameras' poses at each instant.

    ``known`` (c,): which of the rig's poses are right and stay. ``lamp_m`` (c, 3): each camera's lamp in its own
    frame [m].
    """
    t, c = sights.rays.shape[:2]
    rotations, centres = np.full((t, c, 3, 3), np.nan), np.full((t, c, 3), np.nan)
    for k in np.flatnonzero(known):
        pose = rig.cameras[k].world_from_camera
        rotations[:, k], centres[:, k] = pose.rotation, pose.translation
    for i in range(t):
        _seeded(sights.rays[i], rotations[i], centres[i], known, lamp_m)
    begun = np.asarray(np.isfinite(centres).all(axis=2))
    residual = np.full(t, np.nan)
    result = MutualPoses(sights.time_s, np.full_like(rotations, np.nan), np.full_like(centres, np.nan), residual)
    for k in np.flatnonzero(begun.any(axis=0)):
        some = np.flatnonzero(begun[:, k])
        nearest = some[np.abs(some[None, :] - np.arange(t)[:, None]).argmin(axis=1)]
        rotations[:, k], centres[:, k] = rotations[nearest, k], centres[nearest, k]
    for i in range(t):
        one = _adjusted(sights.rays[i], rotations[i], centres[i], known, lamp_m)
        result.rotations[i], result.centres[i], residual[i] = one
    return result


def _seeded(rays: Array, rotations: Array, centres: Array, known: Array, lamp_m: Array) -> None:
    """Compute the camera poses of one instant one after the other, into the given arrays."""
    placed = np.array(known, dtype=bool)
    waiting = True
    while waiting:
        waiting = False
        for k in np.flatnonzero(~placed):
            lamps = centres + np.einsum("cij,cj->ci", rotations, lamp_m)
            by = np.flatnonzero(placed & np.isfinite(rays[:, k, 0]))
            to = np.flatnonzero(placed & np.isfinite(rays[k, :, 0]))
            if len(by) < 2 or len(to) < 2:
                continue
            own = _meeting(centres[by], np.einsum("cij,cj->ci", rotations[by], rays[by, k]))
            rotation = np.eye(3)
            for _pass in range(SEED_PASSES):
                centre = own - rotation @ lamp_m[k]
                away = lamps[to] - centre
                away /= np.linalg.norm(away, axis=1)[:, None]
                rotation = Rotation.align_vectors(away, rays[k, to])[0].as_matrix()
            rotations[k], centres[k] = rotation, own - rotation @ lamp_m[k]
            placed[k] = waiting = True


def _meeting(origins: Array, rays: Array) -> Array:
    """Return the point nearest to rays (n, 3) from ``origins`` (n, 3)."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.asarray(np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, origins)))


def _adjusted(
    rays: Array, rotations: Array, centres: Array, known: Array, lamp_m: Array
) -> tuple[Array, Array, float]:
    """Return the poses of one instant that fit all sightings of lamps best, NaN where they are not determined, and
    the rms residual [rad].
    """
    begun = np.asarray(np.isfinite(centres).all(axis=1))
    free = np.flatnonzero(begun & ~known)
    slot = np.full(len(known), -1)
    slot[free] = np.arange(len(free))
    viewer, carrier = np.nonzero(np.isfinite(rays[..., 0]) & begun[:, None] & begun[None, :])
    rotation, centre = rotations.copy(), centres.copy()
    first_rotation, first_centre = rotations[free], centres[free]
    weight = np.ones(len(viewer))
    for _step in range(STEPS):
        rest, rows = _linearised(rays, rotation, centre, lamp_m, viewer, carrier, slot, 6 * len(free))
        # Cauchy weight: a sighting of something else does not distort the poses
        weight = 1.0 / (1.0 + (np.linalg.norm(rest, axis=1) / FARTHEST_RAD) ** 2)
        near = np.array(
            [
                np.append((Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)).as_rotvec(), q - p)
                for a, b, p, q in zip(rotation[free], first_rotation, centre[free], first_centre, strict=True)
            ]
        ).reshape(-1, 6)
        loose = np.tile(np.repeat(np.array(LOOSE) ** -2.0, 3), len(free))
        scaled = weight[:, None, None] * rows / RAY_SIGMA**2
        matrix = np.einsum("nki,nkj->ij", rows, scaled) + np.diag(loose)
        change = np.linalg.solve(matrix, np.einsum("nki,nk->i", scaled, rest) + loose * near.ravel())
        for n, k in enumerate(free):
            rotation[k] = rotation[k] @ Rotation.from_rotvec(change[6 * n : 6 * n + 3]).as_matrix()
            centre[k] += change[6 * n + 3 : 6 * n + 6]
        if np.abs(change).max(initial=0.0) < 1e-6:
            break
    if len(free):
        sigma = np.sqrt(np.diag(np.linalg.inv(matrix))).reshape(-1, 2, 3).max(axis=2)
        for n, k in enumerate(free):
            if sigma[n, 0] > KNOWN[0] or sigma[n, 1] > KNOWN[1]:
                rotation[k], centre[k] = np.nan, np.nan
    rotation[~begun], centre[~begun] = np.nan, np.nan
    rms = float(np.sqrt((weight[:, None] * rest**2).sum() / max(2.0 * weight.sum(), 1.0)))
    return rotation, centre, rms


def _linearised(
    rays: Array, rotation: Array, centre: Array, lamp_m: Array, viewer: Array, carrier: Array, slot: Array, count: int
) -> tuple[Array, Array]:
    """Return observed minus predicted directions (n, 3) and their derivatives (n, 3, count) by each free camera's
    rotation about its own axes and its position.
    """
    back = np.swapaxes(rotation[viewer], 1, 2)
    lamp = centre[carrier] + np.einsum("nij,nj->ni", rotation[carrier], lamp_m[carrier])
    way = np.einsum("nij,nj->ni", back, lamp - centre[viewer])
    length = np.linalg.norm(way, axis=1)
    ahead = way / length[:, None]
    by_way = (np.eye(3) - ahead[:, :, None] * ahead[:, None, :]) / length[:, None, None]
    crossed = cross_matrices(way)
    rows = np.zeros((len(viewer), 3, count))
    by_carrier_rotation = -back @ rotation[carrier] @ cross_matrices(lamp_m[carrier])
    for n in range(len(viewer)):
        v, j = 6 * slot[viewer[n]], 6 * slot[carrier[n]]
        if v >= 0:
            rows[n, :, v : v + 3] += by_way[n] @ crossed[n]
            rows[n, :, v + 3 : v + 6] -= by_way[n] @ back[n]
        if j >= 0:
            rows[n, :, j : j + 3] += by_way[n] @ by_carrier_rotation[n]
            rows[n, :, j + 3 : j + 6] += by_way[n] @ back[n]
    return rays[viewer, carrier] - ahead, rows
