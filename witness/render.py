"""Reference image of a marker, computed without any code of the project.

A marker's outline is sampled at thousands of points: the tangent cone of a ball, the rim of a flat target. The points
are projected by OpenCV (pinhole and fisheye) or by fixed-point inversion of the paper's correction. The shoelace
formula gives area and centroid of the polygon. The pixel kernel (square times Gaussian) is symmetric, so that the
noise-free image sums to electrons times area, and its centroid is that of the polygon.

Camera frame: x right, y down, z forward [m]; pixel (0, 0) is the centre of the top-left pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

Array = NDArray[Any]
POINTS = 2000
"""Points of an outline: the area of an inscribed polygon of n corners is (2 pi / n)^2 / 6 too small, here 1.6e-6."""

Project = Callable[[Array], Array]
"""Directions (n, 3), camera frame -> pixel (n, 2)."""
Unproject = Callable[[Array], Array]
"""Pixel (n, 2) -> direction (n, 3), camera frame, of any length."""


@dataclass(frozen=True)
class WitnessLens:
    """A lens of the witness: ``project`` and its inverse ``unproject``."""

    project: Project
    unproject: Unproject


def opencv_lens(matrix: Array, distortion: Array) -> WitnessLens:
    """OpenCV's pinhole model, distortion in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6."""
    zero = np.zeros(3)

    def project(directions: Array) -> Array:
        return cv2.projectPoints(np.ascontiguousarray(directions, float), zero, zero, matrix, distortion)[0][:, 0]

    def unproject(xy: Array) -> Array:
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-13)
        given = np.asarray(xy, float).reshape(-1, 1, 2)
        ideal = cv2.undistortPoints(given, matrix, distortion, None, None, None, stop)
        return np.column_stack([ideal[:, 0], np.ones(len(ideal))])

    return WitnessLens(project, unproject)


def fisheye_lens(matrix: Array, distortion: Array) -> WitnessLens:
    """OpenCV's fisheye model, distortion k1 k2 k3 k4."""
    zero = np.zeros((3, 1))

    def project(directions: Array) -> Array:
        given = np.asarray(directions, float).reshape(-1, 1, 3)
        return cv2.fisheye.projectPoints(given, zero, zero, matrix, distortion)[0][:, 0]

    def unproject(xy: Array) -> Array:
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
        given = np.asarray(xy, float).reshape(-1, 1, 2)
        ideal = cv2.fisheye.undistortPoints(given, matrix, distortion, None, None, None, stop)
        return np.column_stack([ideal[:, 0], np.ones(len(ideal))])

    return WitnessLens(project, unproject)


def paper_lens(
    c: float, xp: float, yp: float, mx: float, my: float, a: float, k: tuple[float, ...], p: tuple[float, ...]
) -> WitnessLens:
    """The Mosca paper's model (section 2.2): ideal = measured + correction(measured), millimetres, y up."""

    def correction(x: Array, y: Array) -> tuple[Array, Array]:
        r2 = x**2 + y**2
        radial = k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
        dx = a * y + x * radial + (r2 + 2 * x**2) * p[0] + 2 * x * y * p[1]
        dy = a * x + y * radial + 2 * x * y * p[0] + (r2 + 2 * y**2) * p[1]
        return dx, dy

    def unproject(xy: Array) -> Array:
        x, y = mx * (xy[:, 0] - xp), -my * (xy[:, 1] - yp)
        dx, dy = correction(x, y)
        return np.column_stack([x + dx, -(y + dy), np.full(len(x), c)])

    def project(directions: Array) -> Array:
        v = np.asarray(directions, float)
        ideal_x, ideal_y = c * v[:, 0] / v[:, 2], -c * v[:, 1] / v[:, 2]
        x, y = ideal_x, ideal_y
        for _ in range(300):  # measured = ideal - correction(measured) contracts where the lens is usable
            dx, dy = correction(x, y)
            moved = np.hypot(ideal_x - dx - x, ideal_y - dy - y).max()
            x, y = ideal_x - dx, ideal_y - dy
            if moved < 1e-13:
                return np.column_stack([xp + x / mx, yp - y / my])
        raise ArithmeticError(f"inversion of the paper's correction still moves by {moved} mm")

    return WitnessLens(project, unproject)


def with_gap(lens: WitnessLens, gap_px: float, width: int, height: int, order: int = 9) -> WitnessLens:
    """The lens followed by a radial displacement gap_px * T(s), s = distance from the centre / half diagonal.

    T(s) = cos(order arccos s) is the Chebyshev polynomial by its trigonometric definition; s <= 1 inside the image.
    The order is the first that the lens's own radial powers do not reach: 9, and 11 for a fisheye.
    """
    if gap_px == 0.0:
        return lens
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    half_diagonal = np.hypot(width, height) / 2

    def displaced(xy: Array) -> Array:
        away = xy - centre
        distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-12)
        size = gap_px * np.cos(order * np.arccos(np.clip(distance / half_diagonal, 0, 1)))
        result: Array = xy + away * (size / distance)[:, None]
        return result

    def unproject(xy: Array) -> Array:
        before = xy
        for _ in range(60):
            before = before + (xy - displaced(before))
        return lens.unproject(before)

    return WitnessLens(lambda directions: displaced(lens.project(directions)), unproject)


def across(v: Array) -> tuple[Array, Array]:
    """Two unit vectors that span the plane at right angles to v (3,), by singular value decomposition."""
    _u, _s, turned = np.linalg.svd(np.asarray(v, float).reshape(1, 3))
    return turned[1], turned[2]


def ball_outline(centre: Array, radius: float, points: int = POINTS) -> Array:
    """Directions (n, 3) of the cone that touches a ball: half angle asin(r / distance) about its centre."""
    distance = np.linalg.norm(centre)
    half = np.arcsin(radius / distance)
    e1, e2 = across(centre)
    t = 2 * np.pi * np.arange(points)[:, None] / points
    result: Array = np.cos(half) * centre / distance + np.sin(half) * (np.cos(t) * e1 + np.sin(t) * e2)
    return result


def disc_outline(centre: Array, normal: Array, radius: float, points: int = POINTS) -> Array:
    """Points (n, 3) on the rim of a flat round target [m]."""
    e1, e2 = across(normal)
    t = 2 * np.pi * np.arange(points)[:, None] / points
    result: Array = centre + radius * (np.cos(t) * e1 + np.sin(t) * e2)
    return result


def area_and_centroid(polygon: Array) -> tuple[float, Array]:
    """Area [px^2] and centroid (2,) [px] of a closed polygon (n, 2): shoelace, about its mean for precision."""
    origin = polygon.mean(axis=0)
    x, y = (polygon - origin).T
    x1, y1 = np.roll(x, -1), np.roll(y, -1)
    cross = x * y1 - x1 * y
    area = cross.sum() / 2
    centroid = np.array([((x + x1) * cross).sum(), ((y + y1) * cross).sum()]) / (6 * area)
    return abs(area), origin + centroid


def pixels_by_brute_force(polygon: Array, sigma_px: float, width: int, height: int, fine: int = 32) -> Array:
    """Return the share of each pixel (H, W) that a convex polygon of light covers behind a Gaussian blur.

    A pixel has ``fine`` x ``fine`` cells, each cut into 16 lines along x that are covered exactly between the
    polygon's left and right side (fewer lines miss the tips: 6e-4 of a pixel at one line a cell). scipy blurs the
    cells, and each pixel gets the mean of its cells. A margin of 6 px includes the light from outside.
    """
    margin, lines = 6, 16
    rows, columns = height + 2 * margin, width + 2 * margin
    cover = np.zeros((rows * fine, columns * fine))
    left = -margin - 0.5 + np.arange(columns * fine) / fine
    turned = np.roll(polygon, -int(polygon[:, 1].argmin()), axis=0)  # from the top down one side, up the other
    bottom = int(turned[:, 1].argmax())
    one, other = turned[: bottom + 1], np.vstack([turned[bottom:], turned[:1]])[::-1]
    for row in range(len(cover)):
        y = -margin - 0.5 + (row + (np.arange(lines) + 0.5) / lines) / fine
        y = y[(y > turned[0, 1]) & (y < turned[bottom, 1])]
        if len(y):
            ends = np.sort([np.interp(y, *side.T[::-1]) for side in (one, other)], axis=0)[:, :, None]
            lit = np.clip((np.minimum(ends[1], left + 1 / fine) - np.maximum(ends[0], left)) * fine, 0, 1)
            cover[row] = lit.sum(axis=0) / lines
    blurred = gaussian_filter1d(cover, sigma_px * fine, axis=0, mode="constant", truncate=7.0)
    binned = blurred.reshape(rows, fine, -1).mean(axis=1)
    blurred = gaussian_filter1d(binned, sigma_px * fine, axis=1, mode="constant", truncate=7.0)
    binned = blurred.reshape(rows, columns, fine).mean(axis=2)
    return np.asarray(binned[margin:-margin, margin:-margin])


def image_centroid(light: Array) -> Array:
    """Centre of light (2,) [px] of an image (H, W), in double precision."""
    pixels = np.asarray(light, float)
    total = pixels.sum()
    x = (pixels.sum(axis=0) * np.arange(pixels.shape[1])).sum() / total
    y = (pixels.sum(axis=1) * np.arange(pixels.shape[0])).sum() / total
    return np.array([x, y])
