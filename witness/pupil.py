"""Effects of defocus and coma on an image by geometrical optics: light through each pupil point is displaced.

A thin lens of focal length f and f-number N, focused at d0, images a point at distance d as a blur circle of
diameter ``f^2 / N * |d - d0| / (d (d0 - f))`` (similar triangles behind the lens). Light through the pupil point
rho (unit disc) lands at half the signed diameter times rho. Classical (Seidel) third-order coma of length L
displaces it by ``L / 3 * |rho|^2 (2 + cos 2t, sin 2t)``, t and the first axis counted from the direction away from
the image's centre: the comatic patch reaches from 0 to L with a 60 degree opening (Born and Wolf, section 5.3).
The mean displacement is subtracted: the mean position of a marker's light belongs to the lens model.
"""

from collections.abc import Callable

import numpy as np
from scipy.integrate import quad

from witness.image import Array


def blur_circle_px(d_m: float, focus_m: float, f_mm: float, f_number: float, pitch_mm: float) -> float:
    """Return the signed diameter of the blur circle [px], positive for points beyond the focus."""
    f = f_mm / 1e3
    return f * f / f_number * (d_m - focus_m) / (d_m * (focus_m - f)) / (pitch_mm / 1e3)


def pupil(radial: int = 16, around: int = 40) -> tuple[Array, Array]:
    """Return points (n, 2) of the unit disc and weights (n,) that sum to 1: Gauss-Legendre in rho^2 by angle."""
    nodes, weights = np.polynomial.legendre.leggauss(radial)
    rho = np.sqrt((1 + nodes) / 2)
    # neighbouring rings are rotated against each other, so that no direction is preferred
    t = 2 * np.pi * (np.arange(around)[None, :] + 0.381966 * np.arange(radial)[:, None]) / around
    points = rho[:, None, None] * np.stack([np.cos(t), np.sin(t)], axis=-1)
    return points.reshape(-1, 2), np.repeat(weights / 2 / around, around)


def displacements(points: Array, circle_px: float, coma_px: float, outwards: Array) -> Array:
    """Return the displacements (n, 2) from their mean of light through pupil ``points`` (n, 2) [px].

    ``circle_px``: signed blur circle; ``coma_px``: signed length of the coma; ``outwards`` (2,): unit vector
    away from the image's centre. Pupil points and displacements: x along columns, y along rows.
    """
    sideways = np.array([-outwards[1], outwards[0]])
    a, b = points @ outwards, points @ sideways
    # rho^2 cos 2t = a^2 - b^2, rho^2 sin 2t = 2 a b
    along = coma_px / 3 * (2 * (a * a + b * b) + a * a - b * b)
    across = coma_px / 3 * 2 * a * b
    comatic = along[:, None] * outwards + across[:, None] * sideways
    # by hand: the mean over the disc of rho^2 is 1/2, those of rho^2 cos 2t and rho^2 sin 2t are 0
    result: Array = circle_px / 2 * points + comatic - coma_px / 3 * outwards
    return result


def pupil_mean(image_at: Callable[[Array], Array], places: Array, weights: Array) -> Array:
    """Return the mean of images displaced by ``places`` (n, 2) [px]; ``image_at``: displacement (2,) -> (H, W)."""
    total = weights[0] * image_at(places[0])
    for place, weight in zip(places[1:], weights[1:], strict=True):
        total = total + weight * image_at(place)
    result: Array = total
    return result


def disc_variance(circle_px: float) -> float:
    """Return the variance along one axis of a uniform blur circle [px^2], integrated numerically."""
    radius = circle_px / 2
    second = quad(lambda x: x * x * 2 * np.sqrt(radius**2 - x * x), -radius, radius)[0]
    return float(second / (np.pi * radius**2))
