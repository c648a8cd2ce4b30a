"""Lenses that twin and witness both know, and markers placed before them."""

from dataclasses import replace

import numpy as np
from witness_door import Target, ball, disc
from witness_image import Array
from witness_render import WitnessLens, ball_outline, disc_outline, fisheye_lens, opencv_lens, paper_lens

from mosca.data.rig import FisheyeLens, Lens, MoscaLens, OpenCVLens

W, H = 656, 491
MATRIX = np.array([[690.0, 0, 333.0], [0, 694.0, 238.0], [0, 0, 1]])
RATIONAL = [-0.23, 0.07, 7e-4, -5e-4, -0.01, 0.02, 0.01, 0.002]
PRISM = [4e-3, -2e-3, -3e-3, 1e-3]
TAU = [0.015, -0.02]
LENSES: dict[str, tuple[Lens, WitnessLens]] = {
    "paper": (
        MoscaLens(6.5, 301.4, 255.5, 0.00943, 0.00944, -0.0067, 8.7e-4, -1.8e-5, 3e-7, 2.8e-4, 4.5e-5),
        paper_lens(6.5, 301.4, 255.5, 0.00943, 0.00944, -0.0067, (8.7e-4, -1.8e-5, 3e-7), (2.8e-4, 4.5e-5)),
    ),
    "rational": (
        OpenCVLens(690.0, 694.0, 333.0, 238.0, *RATIONAL),
        opencv_lens(MATRIX, np.array(RATIONAL)),
    ),
    "thin prism": (
        OpenCVLens(690.0, 694.0, 333.0, 238.0, *RATIONAL, *PRISM),
        opencv_lens(MATRIX, np.array(RATIONAL + PRISM)),
    ),
    "tilted": (
        OpenCVLens(690.0, 694.0, 333.0, 238.0, *RATIONAL, *PRISM, *TAU),
        opencv_lens(MATRIX, np.array(RATIONAL + PRISM + TAU)),
    ),
    "fisheye": (
        FisheyeLens(270.0, 271.0, 322.0, 240.0, -0.03, 0.004, -0.001, 0.0002),
        fisheye_lens(
            np.array([[270.0, 0, 322.0], [0, 271.0, 240.0], [0, 0, 1]]),
            np.array([-0.03, 0.004, -0.001, 0.0002]),
        ),
    ),
}
PLACES = {"centre": (327.3, 245.8), "edge": (618.4, 251.7), "corner": (39.6, 450.2)}


def real_lens(
    plain: WitnessLens, matrix: Array, tilt_deg: tuple[float, float], shift_m: float
) -> WitnessLens:
    """Return a lens whose entrance pupil wanders along the axis and whose sensor is tilted.

    A chief ray of field angle theta crosses the axis at ``shift_m`` * 2 sin^2 theta: found step by step. The tilt
    is OpenCV's, of a camera that has the principal distances and point of ``matrix`` and nothing else.
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


def small_camera(
    size: tuple[int, int], f_px: float = 300.0, bent: tuple[float, ...] = ()
) -> tuple[OpenCVLens, WitnessLens]:
    """Return a pinhole camera of a small image, principal point in its middle, OpenCV distortion ``bent``."""
    cx, cy = (size[0] - 1) / 2, (size[1] - 1) / 2
    matrix = np.array([[f_px, 0, cx], [0, f_px, cy], [0, 0, 1]])
    return OpenCVLens(f_px, f_px, cx, cy, *bent), opencv_lens(
        matrix, np.array([*bent, *[0.0] * (8 - len(bent))])
    )


def shifted(lens: Lens, right_px: float, down_px: float) -> Lens:
    """Return a pinhole lens with its principal point moved: a fault for controls."""
    assert isinstance(lens, OpenCVLens)
    return replace(lens, cx_px=lens.cx_px + right_px, cy_px=lens.cy_px + down_px)


def place(
    witness: WitnessLens, xy: tuple[float, float], diameter: float, distance: float = 2.0
) -> tuple[Array, float, Array, Array, Array]:
    """Return where a marker must stand for its image to lie about ``xy`` and to be about ``diameter`` px large.

    Returns its centre (3,), radius, and three unit vectors: the line of sight and two across it.
    """
    sight = witness.unproject(np.array([xy]))[0]
    sight = sight / np.linalg.norm(sight)
    one = np.cross(sight, [0.31, 0.9, 0.2])
    one /= np.linalg.norm(one)
    other = np.cross(sight, one)
    step = 1e-5
    around = witness.project(
        distance
        * np.array([sight + step * one, sight - step * one, sight + step * other, sight - step * other])
    )
    slopes = np.array([around[0] - around[1], around[2] - around[3]]) / (2 * step)
    scale = np.sqrt(abs(np.linalg.det(slopes)))  # px/rad
    return distance * sight, distance * diameter / 2 / scale, sight, one, other


def marker(
    witness: WitnessLens,
    xy: tuple[float, float],
    diameter: float,
    tilt_deg: float | None,
    distance: float = 2.0,
) -> tuple[Target, Array]:
    """Return a still marker for the twin and its outline (n, 3) for the witness [m].

    ``tilt_deg``: None for a ball, else the angle between a disc's normal and the line of sight.
    """
    centre, radius, sight, one, other = place(witness, xy, diameter, distance)
    if tilt_deg is None:
        return ball(centre, radius), tangent_circle(centre, radius)
    tilt = np.deg2rad(tilt_deg)
    normal = -np.cos(tilt) * sight + np.sin(tilt) * (0.6 * one + 0.8 * other)
    return disc(centre, normal, radius), disc_outline(centre, normal, radius)


def tangent_circle(centre: Array, radius: float) -> Array:
    """Return the places (n, 3) [m] where a ball's tangent cone touches it."""
    directions = ball_outline(centre, radius)
    return np.asarray(directions * np.sqrt(centre @ centre - radius**2))


def image_slopes(project: object, at: Array, step: float = 1e-6) -> Array:
    """Return d pixel / d place (2, 3) by central differences."""
    steps = step * np.eye(3)
    return np.column_stack([(project(at + s)[0] - project(at - s)[0]) / (2 * step) for s in steps])  # type: ignore[operator]
