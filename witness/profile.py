"""Light of targets that are not evenly bright or not convex: limb darkening, shading, printed figures.

Targets are given by their definitions (brightness as a function of the position on the target), never by the contours
that the twin draws. The twin's contours are checked against these definitions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from witness.image import Array, contour_image, lines_image, lines_moments, scan
from witness.render import WitnessLens, across, area_and_centroid


@dataclass(frozen=True, eq=False)
class Spots:
    """Points of light that represent a disc."""

    xy: Array
    """(n, 2) [px]"""
    area: Array
    """(n,) [px^2]"""
    q: Array
    """(n,) distance from the middle, as a share of the radius."""
    offset: Array
    """(n, 3) offset from the middle over the radius, camera frame."""


def spots(
    lens: WitnessLens, centre: Array, radius: float, normal: Array | None, radial: int = 64, around: int = 160
) -> Spots:
    """Return the image of a ball's (``normal`` None) or a disc's face in Gauss-Legendre rings.

    The rings lie at q = sin t, since sqrt(1 - q^2) is smooth in t. On a ball, q = sin i for the ray that meets the
    sphere at an angle of incidence i; the sine of its angle to the centre is ``q radius / distance``.
    """
    nodes, weights = np.polynomial.legendre.leggauss(radial)
    t = (nodes + 1) * np.pi / 4
    q = np.repeat(np.sin(t), around)
    ring = np.repeat(weights * np.pi / 4 * np.cos(t), around) * 2 * np.pi / around
    angle = np.tile(2 * np.pi * (np.arange(around) + 0.5) / around, radial)
    one, other = across(centre if normal is None else normal)

    def beside(q: Array, angle: Array) -> Array:
        result: Array = (q * np.cos(angle))[:, None] * one + (q * np.sin(angle))[:, None] * other
        return result

    def project(q: Array, angle: Array) -> Array:
        if normal is not None:
            return lens.project(centre + radius * beside(q, angle))
        distance = np.linalg.norm(centre)
        sine = radius / distance
        cosine = np.sqrt(1 - (q * sine) ** 2)
        return lens.project(cosine[:, None] * centre / distance + sine * beside(q, angle))

    step = 1e-5
    by_q = (project(q * (1 + step), angle) - project(q * (1 - step), angle)) / (2 * step * q[:, None])
    by_angle = (project(q, angle + step) - project(q, angle - step)) / (2 * step)
    area = ring * np.abs(by_q[:, 0] * by_angle[:, 1] - by_q[:, 1] * by_angle[:, 0])
    return Spots(project(q, angle), area, q, beside(q, angle))


def brightness(face: Spots, limb: float, shade: tuple[float, float, float]) -> Array:
    """Return B = 1 - limb (1 - sqrt(1 - q^2)) + shade . offset of each spot (n,)."""
    result: Array = 1 - limb * (1 - np.sqrt(np.maximum(1 - face.q**2, 0))) + face.offset @ np.array(shade)
    return result


Pattern = Callable[[Array, Array], Array]
"""Positions x, y on a plate [m] -> whether they are lit (n,)."""


def on_plate(lens: WitnessLens, centre: Array, turn: Array, xy: Array) -> tuple[Array, Array]:
    """Return where the rays of pixels (n, 2) meet a plate through ``centre``: x and y along its axes [m]."""
    rays = lens.unproject(xy)
    reach = (centre @ turn[:, 2]) / (rays @ turn[:, 2])
    beside = rays * reach[:, None] - centre
    return beside @ turn[:, 0], beside @ turn[:, 1]


def pattern_image(
    lens: WitnessLens,
    centre: Array,
    turn: Array,
    patterns: list[tuple[Pattern, float]],
    radius: float,
    sigma_px: float,
    size: tuple[int, int],
    lines_per_px: int = 60,
) -> tuple[Array, float, Array]:
    """Return image (H, W), light [px^2] and centroid (2,) [px] of patterns on a plate, each with its brightness.

    Scan lines evaluate the patterns' definitions: this is supersampling with exact ends of lines.
    """
    t = 2 * np.pi * np.arange(100)[:, None] / 100
    rim = lens.project(centre + 1.02 * radius * (np.cos(t) * turn[:, 0] + np.sin(t) * turn[:, 1]))
    low, high = rim.min(axis=0) - 0.3, rim.max(axis=0) + 0.3
    image, light, moment = np.zeros((size[1], size[0])), 0.0, np.zeros(2)
    for pattern, gain in patterns:

        def lit(xy: Array, pattern: Pattern = pattern) -> Array:
            return pattern(*on_plate(lens, centre, turn, xy))

        lines, step = scan(lit, low, high, lines_per_px, 8, 14)
        image += gain * lines_image(lines, step, sigma_px, *size)
        area, centroid = lines_moments(lines, step)
        light += gain * area
        moment += gain * area * centroid
    return image, light, moment / light


def outline_image(
    lens: WitnessLens,
    centre: Array,
    turn: Array,
    outlines: list[tuple[Array, float]],
    sigma_px: float,
    size: tuple[int, int],
) -> tuple[Array, float, Array]:
    """Return image, light and centroid of outlines, each with its gain, by Green's theorem and the shoelace formula.

    Outlines (n, 2) are closed, dense and on the plate [m].
    """
    image, light, moment = np.zeros((size[1], size[0])), 0.0, np.zeros(2)
    for outline, gain in outlines:
        polygon = lens.project(centre + outline @ turn[:, :2].T)
        image += gain * contour_image(polygon, sigma_px, *size)
        area, centroid = area_and_centroid(polygon)
        light += gain * area
        moment += gain * area * centroid
    return image, light, moment / light


def dense(corners: Array, per_side: int = 150) -> Array:
    """Return a polygon (n, 2) with many points on each side."""
    share = np.arange(per_side)[:, None] / per_side
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.vstack([a + (b - a) * share for a, b in sides])


def arc(radius: float, start: float, end: float, points: int = 600) -> Array:
    """Return points (n, 2) on an arc about the origin, both ends included."""
    angle = np.linspace(start, end, points)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])
