"""Scenes for the tests of continuous time: smooth random motion, not drawn from any spline, seen by cameras."""

import numpy as np
import rigs
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.continuous.model.estimated import ContinuousSettings
from mosca.continuous.model.observations import TimedObservations, no_carriers
from mosca.data.rig import OpenCVLens

PLAIN = ContinuousSettings(limbs=False)


def staggered(seconds=2.0, rate=50.0, cameras=3):
    return [np.arange(0.004 * c, seconds, 1 / rate) for c in range(cameras)]


def ring(n=3, away=2.5):
    """n cameras of 656 x 491 around the origin, 68 degrees apart."""
    lens, heights = OpenCVLens(600.0, 600.0, 327.5, 245.0), 0.8 + 0.1 * np.arange(n)
    return rigs.ring(n, lens, radius_m=away, height_m=heights, first_rad=0.3, step_rad=1.2)


def sines(seed, markers):
    """Points that move by sums of five sines an axis; a function (t,) -> (t, markers, 3)."""
    rng = np.random.default_rng(seed)
    f = rng.uniform(0.2, 3.0, (markers, 3, 5))
    phase, size = rng.uniform(0, 2 * np.pi, f.shape), rng.uniform(0, 0.12, f.shape) / (1 + f)
    base = rng.uniform(-0.5, 0.5, (markers, 3))
    return lambda t: base + (size * np.sin(2 * np.pi * f * np.asarray(t)[:, None, None, None] + phase)).sum(3)


def limbs(seed, bodies=2):
    """Rigid triangles that rotate and swing, and one loose point; a function (t,) -> (t, 3 bodies + 1, 3)."""
    rng = np.random.default_rng(seed)
    shapes = rng.uniform(-0.2, 0.2, (bodies, 3, 3))
    centres, turns, loose = sines(seed + 1, bodies), sines(seed + 2, bodies), sines(seed + 3, 1)

    def at(t):
        w = 4 * turns(t)
        rotation = Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(len(w), bodies, 3, 3)
        points = centres(t)[:, :, None] + np.einsum("tbij,bpj->tbpi", rotation, shapes)
        return np.concatenate([points.reshape(len(w), -1, 3), loose(t)], axis=1)

    return at


def take(path, rig, stamps, sigma_px, seed=0, clocks=None, row_s=0.0):
    """Image points with noise. ``stamps``: of each camera; true time is offset + (1 + drift) stamp + row y."""
    rng = np.random.default_rng(seed)
    parts = []
    for c, camera in enumerate(rig.cameras):
        offset, drift = (0.0, 0.0) if clocks is None else clocks[c]
        when = offset + (1 + drift) * stamps[c]
        points = path(when)
        n = points.shape[1]
        xy = project(camera, points.reshape(-1, 3)).reshape(-1, n, 2)
        for _ in range(5 if row_s else 0):
            later = when[:, None] + row_s * xy[:, :, 1]
            points = np.stack([path(later[:, p])[:, p] for p in range(n)], axis=1)
            xy = project(camera, points.reshape(-1, 3)).reshape(-1, n, 2)
        xy = xy + sigma_px * rng.normal(size=xy.shape)
        exposure, point = np.meshgrid(np.arange(len(when)), np.arange(n), indexing="ij")
        flat = exposure.ravel()
        columns = [np.full(flat.size, c), point.ravel(), flat, stamps[c][flat]]
        parts.append(np.column_stack([*columns, xy.reshape(-1, 2)]))
    a = np.concatenate(parts)
    names = tuple(f"m{k}" for k in range(n))
    spread = np.tile(sigma_px**2 * np.eye(2), (len(a), 1, 1))
    return TimedObservations(
        rig.names, names, a[:, 0], a[:, 1], a[:, 2], a[:, 3], a[:, 4:6], spread, **no_carriers(names)
    )


def rms(estimated, path, time_s):
    """Root mean square distance from the truth [m]."""
    return float(np.sqrt(((estimated.curves.at(time_s) - path(time_s)) ** 2).sum(axis=2).mean()))


def nees(estimated, path, time_s):
    """Squared errors in units of the stated covariance (t, points)."""
    away = estimated.curves.at(time_s) - path(time_s)
    covariance = estimated.curves.covariance_at(time_s)
    return np.einsum("tpi,tpi->tp", away, np.linalg.solve(covariance, away[..., None])[..., 0])
