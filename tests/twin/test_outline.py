"""The box of a target's image, beside its outline looked at in 720 points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.rig import FisheyeLens, MoscaLens, OpenCVLens
from mosca.numba_support.decorators import kernel
from twin.cameras.optics.lens import GapTerms, TwinLens
from twin.cameras.render.inputs import TargetPose
from twin.cameras.render.outline import BALL, FLAT, image_box

W, H = 656, 491
LENSES = {
    "mosca": MoscaLens(6.5, 291.45, 255.46, 0.00943, 0.00944, -0.0067, 8.7e-4, -1.8e-5, 3e-7, 2.8e-4, 4.5e-5),
    "opencv": OpenCVLens(350.0, 352.0, 330.0, 240.0, -0.21, 0.08, 6e-4, -4e-4, -0.01, 0.02, 0.01, 0.003),
    "fisheye": FisheyeLens(140.0, 141.0, 320.0, 241.0, -0.02, 0.003, -0.001, 0.0001),
}
WIDE = {"mosca": 1.0, "opencv": 1.5, "fisheye": 1.7}
"""Angles from the axis up to which targets are drawn [rad]: beyond what the lenses image."""


@kernel
def box_of(lens, shape, rotation, place, radius):
    whole, box = image_box(lens, TargetPose(shape, rotation, place[0], place[1], place[2], radius))
    return whole, box.left, box.right, box.top, box.bottom


def outline(shape, rotation, place, radius):
    """The rim of a flat target, or the circle where the cone of sight touches a ball (720, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 720)
    if shape == FLAT:
        return place + radius * (np.outer(np.cos(angle), rotation[:, 0]) + np.outer(np.sin(angle), rotation[:, 1]))
    off = np.linalg.norm(place)
    axis = place / off
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    reach = radius * np.sqrt(1.0 - (radius / off) ** 2)
    circle = np.outer(np.cos(angle), across) + np.outer(np.sin(angle), np.cross(axis, across))
    return place * (1.0 - (radius / off) ** 2) + reach * circle


def drawn_places(rng, wide):
    """Directions up to ``wide`` [rad] from the axis, 1 to 3 m away (400, 3)."""
    theta, phi = wide * np.sqrt(rng.uniform(0.0, 1.0, 400)), rng.uniform(-np.pi, np.pi, 400)
    away = rng.uniform(1.0, 3.0, 400)
    return away[:, None] * np.column_stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    )  # fmt: skip


@pytest.mark.parametrize("shape", [BALL, FLAT], ids=["ball", "flat"])
@pytest.mark.parametrize("name", LENSES)
def test_a_box_holds_the_image_and_little_more(name, shape):
    """Up to the border of what the lens images: what is beyond it is told there, and only there."""
    rng, radius, border, inside = np.random.default_rng(3), 0.05, 0, 0
    lens = TwinLens.of(LENSES[name], W, H, GapTerms(0.25, (0.6, -0.4), 0.003))
    for place in drawn_places(rng, WIDE[name]):
        rotation = Rotation.random(rng=rng).as_matrix()
        whole, *box = box_of(lens.vector, shape, rotation, place, radius)
        low, high = np.array(box[::2]), np.array(box[1::2])
        seen = lens.pixels(outline(shape, rotation, place, radius))
        wider = lens.pixels(outline(shape, rotation, place, 1.05 * radius))
        if not np.isfinite(seen).all():
            border += np.isfinite(seen).any()
            assert not whole
        elif np.isfinite(wider).all():
            inside += 1
            assert whole
            assert (wider.min(axis=0) <= low).all()
            assert (low <= seen.min(axis=0)).all()
            assert (seen.max(axis=0) <= high).all()
            assert (high <= wider.max(axis=0)).all()
    assert inside > 100
    assert border > 5
