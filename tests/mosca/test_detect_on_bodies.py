"""Targets on what is lit itself, a head or a hand before a dark room: not part of it, and found at their places."""

import numpy as np
import pytest
from pixel_parts import averaged

from mosca.detection.detect import DetectionSettings, detect, target_regions
from mosca.detection.search import is_compact

SIZE, FINE = 96, 6


def disc(x: float, y: float, diameter: float, blur: float) -> np.ndarray:
    """Return a blurred disc of brightness 1 (SIZE, SIZE), drawn on a grid of 1/6 px."""
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    sharp = ((at - x) ** 2 + (at - y)[:, None] ** 2 < (diameter / 2) ** 2).astype(np.float32)
    return averaged(sharp, FINE, blur)


def photographed(light: np.ndarray, seed: int = 3) -> np.ndarray:
    """Return a sensor's image of so many grey values over black, 20 electrons each, half a grey value of noise."""
    rng = np.random.default_rng(seed)
    image = rng.poisson(20.0 * np.maximum(light, 0.0)) / 20.0 + rng.normal(6.0, 0.5, light.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("body_dn", [20.0, 40.0, 60.0])
@pytest.mark.parametrize("body_px", [22.0, 45.0])
@pytest.mark.parametrize("diameter", [1.5, 3.0, 6.0])
def test_a_target_on_a_lit_body_is_found_at_its_place(diameter: float, body_px: float, body_dn: float) -> None:
    x, y = 49.3 + body_px / 8, 45.6 - body_px / 10
    body, target = disc(48.0, 47.0, body_px, 0.5), disc(x, y, diameter, 0.5)
    found = detect(photographed(body_dn * body + (200.0 - body_dn) * target), "cam")
    assert np.hypot(*(found.xy_px - (x, y)).T).min() < 0.5


@pytest.mark.parametrize("body_dn", [15.0, 40.0])
def test_the_edge_of_a_body_does_not_draw_the_targets_beside_it(body_dn: float) -> None:
    """Fitted before an even background they were 0.033 and 0.055 px off."""
    off, squares = [], []
    for k, angle in enumerate(np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, 24)):
        x, y = 48.0 + np.array([np.cos(angle), np.sin(angle)]) * 18.5
        body, target = disc(48.0, 48.0, 44.0, 0.6), disc(x, y, 3.4, 0.6)
        found = detect(photographed(body_dn * (1.0 - target) * body + 150.0 * target, seed=k), "cam")
        nearest = np.hypot(*(found.xy_px - (x, y)).T).argmin()
        off.append(found.xy_px[nearest] - (x, y))
        squares.append(off[-1] @ np.linalg.solve(found.covariance_px2[nearest], off[-1]) / 2.0)
    assert np.sqrt(np.mean(np.square(off))) < 0.03
    assert np.median(squares) < 2.0


def test_the_rule_of_the_paper_takes_the_body_with_its_target() -> None:
    light = 40.0 * disc(48.0, 47.0, 45.0, 0.5) + 160.0 * disc(55.0, 41.0, 3.0, 0.5)
    paper = DetectionSettings(thresholds="paper", centroid="paper")
    labels = target_regions(photographed(light), paper)
    assert np.bincount(labels[labels > 0]).max() > 0.9 * np.pi * 22.5**2


@pytest.mark.parametrize("blur", [0.35, 0.6, 1.0, 3.0, 8.0])
@pytest.mark.parametrize("diameter", [0.5, 2.0, 7.0, 30.0])
def test_images_of_discs_are_compact(blur: float, diameter: float) -> None:
    """However they lie among the pixels: none is softer than a point spread function."""
    for x, y in 47.0 + np.random.default_rng(3).uniform(-0.5, 0.5, (4, 2)):
        image = disc(x, y, diameter, blur)
        image /= image.max()
        assert is_compact.py_func(np.count_nonzero(image > 1 / 16), np.count_nonzero(image > 0.5))


def test_a_target_with_a_body_around_it_is_not_compact() -> None:
    image = 0.2 * disc(48.0, 47.0, 22.0, 0.5) + 0.8 * disc(50.0, 45.0, 3.0, 0.5)
    assert not is_compact.py_func(np.count_nonzero(image > 1 / 16), np.count_nonzero(image > 0.5))
