"""Poses of markers before a camera, and lenses composed of others, shared by several checks."""

import numpy as np

from witness.image import Array
from witness.render import WitnessLens, ball_outline, opencv_lens


def real_lens(plain: WitnessLens, matrix: Array, tilt_deg: tuple[float, float], shift_m: float) -> WitnessLens:
    """Return a lens whose entrance pupil shifts along the axis with the field and whose sensor is tilted.

    A chief ray of field angle theta crosses the axis at ``shift_m`` * 2 sin^2 theta, found by iteration. The tilt is
    OpenCV's, for a camera with only the principal distances and point of ``matrix``.
    """
    tilted = opencv_lens(matrix, np.array([0.0] * 12 + list(np.deg2rad(tilt_deg))))
    inverse = np.linalg.inv(matrix)

    def project(places: Array) -> Array:
        places = np.asarray(places, float)
        crossing = np.zeros(len(places))
        for _ in range(50):
            sine2 = (places[:, 0] ** 2 + places[:, 1] ** 2) / (
                places[:, 0] ** 2 + places[:, 1] ** 2 + (places[:, 2] - crossing) ** 2
            )
            crossing = shift_m * 2 * sine2
        xy = plain.project(places - np.column_stack([np.zeros((len(places), 2)), crossing]))
        return tilted.project(np.column_stack([xy, np.ones(len(xy))]) @ inverse.T)

    return WitnessLens(project, plain.unproject)


def pinhole(size: tuple[int, int], f_px: float = 300.0, bent: tuple[float, ...] = ()) -> WitnessLens:
    """Return the lens of a small image, principal point in its middle, with OpenCV's distortion ``bent``."""
    matrix = np.array([[f_px, 0, (size[0] - 1) / 2], [0, f_px, (size[1] - 1) / 2], [0, 0, 1]])
    return opencv_lens(matrix, np.array([*bent, *[0.0] * (8 - len(bent))]))


def place(
    lens: WitnessLens, xy: tuple[float, float], diameter: float, distance: float = 2.0
) -> tuple[Array, float, Array, Array, Array]:
    """Return the pose of a marker whose image is near ``xy`` and about ``diameter`` px large.

    Returns its centre (3,), radius, and three unit vectors: the line of sight and two across it.
    """
    sight = lens.unproject(np.array([xy]))[0]
    sight = sight / np.linalg.norm(sight)
    one = np.cross(sight, [0.31, 0.9, 0.2])
    one /= np.linalg.norm(one)
    other = np.cross(sight, one)
    step = 1e-5
    around = lens.project(
        distance * np.array([sight + step * one, sight - step * one, sight + step * other, sight - step * other])
    )
    slopes = np.array([around[0] - around[1], around[2] - around[3]]) / (2 * step)
    scale = np.sqrt(abs(np.linalg.det(slopes)))  # px/rad
    return distance * sight, distance * diameter / 2 / scale, sight, one, other


def tilted_normal(tilt_deg: float, sight: Array, one: Array, other: Array) -> Array:
    """Return the normal (3,) of a disc that faces the camera except for ``tilt_deg``; vectors as from ``place``."""
    tilt = np.deg2rad(tilt_deg)
    return np.asarray(-np.cos(tilt) * sight + np.sin(tilt) * (0.6 * one + 0.8 * other))


def tangent_circle(centre: Array, radius: float) -> Array:
    """Return the points (n, 3) [m] where a ball's tangent cone touches it."""
    directions = ball_outline(centre, radius)
    return np.asarray(directions * np.sqrt(centre @ centre - radius**2))
