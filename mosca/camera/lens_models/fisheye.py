"""Equidistant fisheye with a polynomial in the angle (Kannala-Brandt).

With theta the angle from the optical axis and rho(theta) = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 +
k4 theta^8): u = cx + fx rho cos(phi), v = cy + fy rho sin(phi). Images beyond 90 degrees from the axis too, where
z is negative: up to the image circle, where rho stops rising or theta reaches 180 degrees.
Source: Kannala and Brandt 2006; the parameters are those of OpenCV's ``fisheye`` with zero skew.
"""

from functools import lru_cache

import numpy as np

from mosca.camera.lens_models.monotonic_range import first_positive_root
from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens

STEPS = 60
CONVERGED_RAD = 1e-14
NEAR_AXIS = 1e-9


def directions(lens: FisheyeLens, xy_px: Array) -> Array:
    """Pixel (n, 2) -> unit direction (n, 3), camera frame; NaN outside the image circle."""
    xy = np.asarray(xy_px, dtype=float)
    image = (xy - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px)
    rho = np.hypot(image[:, 0], image[:, 1])
    theta = _theta(lens, rho)
    # sin(theta)/rho -> 1 on the axis
    scale = np.where(rho > NEAR_AXIS, np.sin(theta) / np.where(rho > NEAR_AXIS, rho, 1.0), 1.0)
    v = np.column_stack([image * scale[:, None], np.cos(theta)])
    v[np.isnan(theta)] = np.nan
    return v


def pixels(lens: FisheyeLens, directions: Array) -> tuple[Array, Array, Array]:
    """Direction (n, 3), camera frame -> pixel (n, 2), d pixel/d direction (n, 2, 3), d pixel/d lens (n, 2, 8).

    NaN beyond the angle where rho stops rising, and straight behind.
    """
    v = np.asarray(directions, dtype=float)
    s = np.hypot(v[:, 0], v[:, 1])
    near = s <= NEAR_AXIS * np.abs(v[:, 2])
    s_safe = np.where(near, 1.0, s)
    z_safe = np.where(v[:, 2] == 0, 1.0, v[:, 2])
    theta = np.arctan2(s, v[:, 2])
    rho, slope = _rho(lens, theta), _rho_slope(lens, theta)
    norm2 = s * s + v[:, 2] ** 2
    norm2_safe = np.where(norm2 > 0, norm2, 1.0)
    # unit vector across the axis, and rho / s: on the axis rho/s -> 1/z
    across = np.where(near[:, None], 0.0, v[:, :2] / s_safe[:, None])
    rho_over_s = np.where(near, 1.0 / z_safe, rho / s_safe)
    image = np.where(near[:, None], v[:, :2] * rho_over_s[:, None], across * rho[:, None])
    theta_by = np.column_stack([across * v[:, 2:], -s]) / norm2_safe[:, None]  # d theta / d direction (n, 3)
    by = across[:, :, None] * (slope[:, None] * theta_by)[:, None, :]
    # turning about the axis moves the image across it by rho / s
    turn = np.eye(2) - across[:, :, None] * across[:, None, :]
    by[:, :, :2] += np.where(near[:, None, None], np.eye(2), turn) * rho_over_s[:, None, None]
    # along the axis a point near it moves as in a pinhole
    by[near, :, 2] = (-image / z_safe[:, None])[near]
    focal = np.array([lens.fx_px, lens.fy_px])
    xy = np.array([lens.cx_px, lens.cy_px]) + focal * image
    by_direction = focal[:, None] * by
    by_lens = np.zeros((len(v), 2, 8))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = image[:, 0], image[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    for k in range(4):
        by_lens[:, :, 4 + k] = focal * across * (theta ** (3 + 2 * k))[:, None]
    seen = (slope > 0) & (theta**2 < fold_rad2(lens)) & (norm2 > 0) & ~(near & (v[:, 2] < 0))
    xy[~seen], by_direction[~seen], by_lens[~seen] = np.nan, np.nan, np.nan
    return xy, by_direction, by_lens


@lru_cache(maxsize=256)
def fold_rad2(lens: FisheyeLens) -> float:
    """Return the squared angle [rad^2] at which rho stops rising, or infinity."""
    return first_positive_root((1.0, 3 * lens.k1, 5 * lens.k2, 7 * lens.k3, 9 * lens.k4))


def _theta(lens: FisheyeLens, rho: Array) -> Array:
    """Return the angles (n,) of image radii (n,), NaN outside the image circle.

    Newton's method between bounds: rho rises up to the circle, so that bisection takes over where a step leaves
    them (just inside the fold the slope is nearly zero).
    """
    last = min(np.pi, np.sqrt(fold_rad2(lens)))
    low, high = np.zeros(len(rho)), np.full(len(rho), last)
    theta = np.minimum(rho, last)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            short = _rho(lens, theta) < rho
            low, high = np.where(short, theta, low), np.where(short, high, theta)
            tried = theta + (rho - _rho(lens, theta)) / _rho_slope(lens, theta)
            moved = np.where((tried >= low) & (tried <= high), tried, (low + high) / 2)
            step, theta = np.abs(moved - theta), moved
            if not np.any(step > CONVERGED_RAD):
                break
        inside = (np.abs(rho - _rho(lens, theta)) < 1e-10) & (theta < last)
    return np.where(inside, theta, np.nan)


def _rho(lens: FisheyeLens, theta: Array) -> Array:
    t2 = theta * theta
    return theta * (1 + t2 * (lens.k1 + t2 * (lens.k2 + t2 * (lens.k3 + t2 * lens.k4))))


def _rho_slope(lens: FisheyeLens, theta: Array) -> Array:
    t2 = theta * theta
    return 1 + t2 * (3 * lens.k1 + t2 * (5 * lens.k2 + t2 * (7 * lens.k3 + t2 * 9 * lens.k4)))
