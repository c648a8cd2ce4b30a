"""Lenses in the models of both twin and witness, and markers before them."""

from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens, Lens, MoscaLens, OpenCVLens
from scenarios.fidelity.twin_adapter import Target, ball, disc
from witness.render import WitnessLens, disc_outline, fisheye_lens, opencv_lens, paper_lens
from witness.views import pinhole, place, tangent_circle, tilted_normal

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
    "rational": (OpenCVLens(690.0, 694.0, 333.0, 238.0, *RATIONAL), opencv_lens(MATRIX, np.array(RATIONAL))),
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
            np.array([[270.0, 0, 322.0], [0, 271.0, 240.0], [0, 0, 1]]), np.array([-0.03, 0.004, -0.001, 0.0002])
        ),
    ),
}
TILT_MATRICES = {
    "paper": np.array([[6.5 / 0.00943, 0, 301.4], [0, 6.5 / 0.00944, 255.5], [0, 0, 1]]),
    "fisheye": np.array([[6 * 270.0, 0, 322.0], [0, 6 * 271.0, 240.0], [0, 0, 1]]),
}
"""Centre of rotation of a tilted sensor, where it is not that of MATRIX: principal point and, instead of the
principal distance, the distance of the exit pupil, which for a fisheye is six times as far."""
PLACES = {"centre": (327.3, 245.8), "edge": (618.4, 251.7), "corner": (39.6, 450.2)}


def small_camera(
    size: tuple[int, int], f_px: float = 300.0, bent: tuple[float, ...] = ()
) -> tuple[OpenCVLens, WitnessLens]:
    """Return a camera of a small image, principal point in its middle, OpenCV distortion ``bent``."""
    return OpenCVLens(f_px, f_px, (size[0] - 1) / 2, (size[1] - 1) / 2, *bent), pinhole(size, f_px, bent)


def marker(
    witness: WitnessLens, xy: tuple[float, float], diameter: float, tilt_deg: float | None, distance: float = 2.0
) -> tuple[Target, Array]:
    """Return a still marker for the twin and its outline (n, 3) for the witness [m].

    ``tilt_deg``: None for a ball, else the angle between a disc's normal and the line of sight.
    """
    centre, radius, sight, one, other = place(witness, xy, diameter, distance)
    if tilt_deg is None:
        return ball(centre, radius), tangent_circle(centre, radius)
    normal = tilted_normal(tilt_deg, sight, one, other)
    return disc(centre, normal, radius), disc_outline(centre, normal, radius)


def shifted(lens: Lens, right_px: float, down_px: float) -> OpenCVLens:
    """Return an OpenCV lens with its principal point moved: a fault for controls."""
    assert isinstance(lens, OpenCVLens)
    return replace(lens, cx_px=lens.cx_px + right_px, cy_px=lens.cy_px + down_px)
