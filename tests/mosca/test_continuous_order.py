"""Order and knots of the motion's prior, and cameras' own errors, as the image points have them."""

from dataclasses import replace

import numpy as np
import pytest
from continuous_scenes import PLAIN, ring, rms, take

from mosca.continuous.estimator import single_point
from mosca.continuous.estimator.estimate import estimate

STAMPS = [np.arange(0.002 + late, 1.2, 1 / 30) for late in (0.0, 0.0137, 0.0022)]
INSIDE = np.arange(0.2, 1.0, 0.004)


def swinging(seed, markers=6):
    """Points on three sines of 3 to 10 Hz an axis; a function (t,) -> (t, markers, 3)."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(3.0, 10.0, (markers, 3, 3)), rng.uniform(0, 2 * np.pi, (markers, 3, 3))
    base = rng.uniform(-0.4, 0.4, (markers, 3))
    return lambda t: base + 0.015 * np.sin(2 * np.pi * f * np.asarray(t)[:, None, None, None] + phase).sum(3)


@pytest.mark.parametrize("orders", [(2, 3, 5, 7), (2, 3)])
def test_swinging_points_take_a_prior_whose_spectrum_ends(orders, monkeypatch):
    """The control: priors of low orders take swings for jerks, and know little between exposures."""
    monkeypatch.setattr(single_point, "ORDERS", orders)
    path = swinging(2)
    done = estimate(take(path, ring(), STAMPS, 0.03, 2), ring(), PLAIN)
    # 0.03 px at 2.5 m and 600 px are 0.13 mm across a ray
    assert (rms(done, path, INSIDE) < 0.3e-3) is (7 in orders)


def test_each_cameras_errors_are_told_by_its_residuals():
    """As where what interpolation does between exposures was taken for noise of all cameras."""
    observations = take(swinging(3), ring(), STAMPS, 0.03, 3)
    noisy = observations.camera == 1
    xy = observations.xy_px + np.random.default_rng(4).normal(0, 0.085, (len(noisy), 2)) * noisy[:, None]
    stated = replace(observations, xy_px=xy, covariance_px2=9.0 * observations.covariance_px2)
    found = estimate(stated, ring(), PLAIN).of_camera
    # 0.09 px are stated: hypot(0.085, 0.03) of one camera, three times what the others have
    assert found[1] == pytest.approx(1.0, abs=0.25)
    # what the prior leaves of the motion comes on top
    assert found[[0, 2]].max() < 0.75
