"""Balls of a tape that ends at an angle, and images through a lens that hardly blurs, against integrals."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr

from scenarios.fidelity.twin_adapter import ball, seen_by_twin
from scenarios.fidelity.views import LENSES, PLACES, H, W, marker, small_camera
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.pixel_kernel import ROWS, fill_taps, gaussian_kernel
from twin.cameras.render.occluders import BOX, Occluders
from witness.image import contour_image
from witness.render import image_centroid

FADE = (np.deg2rad(50.0), np.deg2rad(87.0))
SIZE, SIGMA = (100, 100), 0.3
BALL = np.array([0.0, 0.0, 100.0])
"""So far away that its image is as wide as the ball: 20 px at 1,000 px of focal length."""


def _law(angle: float) -> float:
    s = np.clip((FADE[1] - angle) / (FADE[1] - FADE[0]), 0.0, 1.0)
    return float(s * s * (3 - 2 * s))


def _seen(fade: tuple[float, float], **hidden: object) -> np.ndarray:
    lens, _ = small_camera(SIZE, 1000.0)
    optics = Optics(SIGMA, gap_px=0.0)
    return seen_by_twin(lens, SIZE, [ball(BALL, 1.0, fade_rad=fade)], optics, **hidden)[0]


def _variance(image: np.ndarray) -> float:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    return float(
        sum((image * (q - c) ** 2).sum() / image.sum() for q, c in zip((x, y), image_centroid(image), strict=True))
    )


def test_light_and_width_of_a_ball_whose_tape_ends() -> None:
    """A ball far away shows the angle a at the share sin(a) of its radius."""
    even, faded = _seen((4.0, 5.0)), _seen(FADE)
    light = quad(lambda a: 2 * np.sin(a) * np.cos(a) * _law(a), 0, np.pi / 2, points=FADE)[0]
    assert even.sum() == pytest.approx(np.pi * 10.0**2, rel=1e-3)
    assert faded.sum() / even.sum() == pytest.approx(light, rel=1e-3)
    assert np.abs(image_centroid(faded) - (SIZE[0] - 1) / 2).max() < 1e-3
    spread = quad(lambda a: 2 * np.sin(a) ** 3 * np.cos(a) * _law(a), 0, np.pi / 2, points=FADE)[0] / light
    # both axes together: the radius' second moment, twice the blur's and the pixel's
    assert _variance(faded) == pytest.approx(100 * spread + 2 * (SIGMA**2 + 1 / 12), rel=2e-3)


def test_half_of_such_a_ball_is_half_of_its_light() -> None:
    none = np.zeros(0, dtype=np.int64)
    box = Occluders(
        np.zeros(1, np.int64), np.array([BOX]), np.array([[20.0, 20.0, 0.1]]), np.array([-1]), none, np.zeros(0)
    )
    half = _seen(FADE, occluders=box, geoms_at=lambda t: (np.array([[-20.0, 0.0, 90.0]]), np.eye(3)[None]))
    assert half.sum() / _seen(FADE).sum() == pytest.approx(0.5, abs=2e-3)


def test_the_sharpest_lens() -> None:
    kernel = gaussian_kernel(0.1)
    for at in np.linspace(0.0, 1.0, 407):
        s = np.arange(2 * kernel.reach) - kernel.reach + at  # of the pixels from the table's first one on
        exact = ndtr((s + 0.5) / 0.1) - ndtr((s - 0.5) / 0.1)
        fill_taps(kernel.taps, ROWS, at, found := np.empty(2 * kernel.reach + 1))
        assert np.abs(found[:-1] - exact).max() < 1e-4
        assert found[-1] == 0.0
    lens, witness = LENSES["rational"]
    for diameter in (2.0, 8.0):
        target, outline = marker(witness, PLACES["edge"], diameter, None)
        image, _ = seen_by_twin(lens, (W, H), [target], Optics(0.1, gap_px=0.0))
        assert np.abs(image - contour_image(witness.project(outline), 0.1, W, H)).max() < 2e-3
    with pytest.raises(ValueError, match="at least"):
        gaussian_kernel(0.09)
