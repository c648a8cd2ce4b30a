"""OpenCV's camera model, from its published definition (documentation of calib3d), in float64 with numpy.

x' = X/Z, y' = Y/Z, r^2 = x'^2 + y'^2, q = 1 + k1 r^2 + k2 r^4 + k3 r^6:
x'' = x' q + 2 p1 x' y' + p2 (r^2 + 2 x'^2),
y'' = y' q + p1 (r^2 + 2 y'^2) + 2 p2 x' y'; u = fx x'' + cx, v = fy y'' + cy.
"""

import numpy as np

from witness.mitsuba.scene import Array, LensCamera

NEWTON_STEPS = 12


def distorted(xy: Array, distortion: tuple[float, ...]) -> Array:
    """Return distorted plane coordinates (..., 2) of the ideal ones ``xy``."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    q = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def distortion_slopes(xy: Array, distortion: tuple[float, ...]) -> Array:
    """Return the derivatives (..., 2, 2) of distorted plane coordinates by the ideal ones ``xy``."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    q = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    cross = x * y * slope + 2 * p1 * x + 2 * p2 * y
    rows = [
        np.stack([q + x * x * slope + 2 * p1 * y + 6 * p2 * x, cross], -1),
        np.stack([cross, q + y * y * slope + 6 * p1 * y + 2 * p2 * x], -1),
    ]
    return np.stack(rows, -2)


def _ideal(camera: LensCamera, points: Array) -> tuple[Array, Array]:
    """Return plane coordinates (..., 2) before distortion and depths (...); NaN behind the camera."""
    p = (np.asarray(points, float) - camera.position_m) @ camera.rotation
    with np.errstate(all="ignore"):
        z = np.where(p[..., 2] > 1e-6, p[..., 2], np.nan)
        return p[..., :2] / z[..., None], z


def project(camera: LensCamera, points: Array) -> Array:
    """Return pixels (..., 2) of the points (..., 3) in the world; NaN behind the camera."""
    return distorted(_ideal(camera, points)[0], camera.distortion) * camera.focal_px + camera.principal_px


def project_slopes(camera: LensCamera, points: Array) -> Array:
    """Return the derivatives (..., 2, 3) of the pixels by the points (..., 3)."""
    ideal, z = _ideal(camera, points)
    zero = np.zeros_like(z)
    rows = [np.stack([1 / z, zero, -ideal[..., 0] / z], -1), np.stack([zero, 1 / z, -ideal[..., 1] / z], -1)]
    by_ideal = np.array(camera.focal_px)[:, None] * distortion_slopes(ideal, camera.distortion)
    return np.asarray(by_ideal @ np.stack(rows, -2) @ camera.rotation.T)


def directions(camera: LensCamera, pixels: Array) -> Array:
    """Return rays' directions (..., 3) in the world, of length 1 along the camera's axis."""
    wanted = (np.asarray(pixels, float) - camera.principal_px) / camera.focal_px
    xy = wanted.copy()
    for _ in range(NEWTON_STEPS):
        off = distorted(xy, camera.distortion) - wanted
        xy = xy - np.linalg.solve(distortion_slopes(xy, camera.distortion), off[..., None])[..., 0]
    result: Array = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1) @ camera.rotation.T
    return result


def in_image(camera: LensCamera, pixels: Array, margin: float = 0.0) -> Array:
    """Return whether pixels (..., 2) lie inside the image, ``margin`` away from its edge."""
    w, h = camera.size
    with np.errstate(invalid="ignore"):
        result: Array = (
            (pixels[..., 0] >= margin - 0.5)
            & (pixels[..., 0] <= w - 0.5 - margin)
            & (pixels[..., 1] >= margin - 0.5)
            & (pixels[..., 1] <= h - 0.5 - margin)
        )
    return result


def ball_outline_area(camera: LensCamera, centre: Array, diameter_m: float, around: int = 720) -> tuple[float, Array]:
    """Return area [px^2] and area centroid [px] of a ball's outline through the distorted lens (polygon of its rim).

    The rim is the circle in which the cone from the lens's centre touches the sphere.
    """
    towards = np.asarray(centre, float) - camera.position_m
    distance = float(np.linalg.norm(towards))
    axis = towards / distance
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    sine = diameter_m / 2 / distance
    foot = camera.position_m + axis * distance * (1 - sine**2)
    radius = diameter_m / 2 * np.sqrt(1 - sine**2)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rim = foot + radius * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up)
    return polygon_centroid(project(camera, rim))


def polygon_centroid(corners: Array) -> tuple[float, Array]:
    """Return area and centroid of a polygon (n, 2)."""
    origin = corners.mean(0)
    a = corners - origin
    b = np.roll(a, -1, 0)
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    area = cross.sum() / 2
    return abs(float(area)), origin + ((a + b) * cross[:, None]).sum(0) / (6 * area)
