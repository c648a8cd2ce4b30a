"""Order and knots of the motion's prior, and cameras' own errors, as the image points have them."""

from dataclasses import replace

import numpy as np
import pytest
from continuous_scenes import PLAIN, ring, rms, take

from mosca.camera.projection import project_with_jacobians
from mosca.continuous.estimator import single_point
from mosca.continuous.estimator.estimate import estimate
from mosca.continuous.estimator.motion_prior import CORNERED
from mosca.continuous.resample import tracks_on_grid
from tests.studies.free_running_bound import least_variance, spectrum

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


def test_axes_of_either_sign_give_the_same_curves(monkeypatch):
    """The signs of eigenvectors are the linear algebra's choice, which differs between processors."""
    observations = take(swinging(5, 3), ring(), STAMPS, 0.03, 5)
    settings, eigh = replace(PLAIN, clocks="offset"), np.linalg.eigh
    plain = estimate(observations, ring(), settings)
    monkeypatch.setattr(np.linalg, "eigh", lambda matrix: (eigh(matrix)[0], -eigh(matrix)[1]))
    turned = estimate(observations, ring(), settings)
    np.testing.assert_allclose(turned.curves.at(INSIDE), plain.curves.at(INSIDE), atol=1e-9)


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


LATE = [np.arange(begin, 1.4, 1 / 30) for begin in (0.002, 0.1157, 0.3522)]


def least_rms(observations, rig, path, time_s):
    """The Bayesian Cramer-Rao bound [m] of who knows the motion's spectrum."""
    of_motion, total = spectrum(lambda t: path(np.array([t]))[0], 0.0, 4.0), 0.0
    by = np.empty((len(observations), 2, 3))
    xyz = np.array([path(np.array([t]))[0, p] for t, p in zip(observations.time_s, observations.point, strict=True)])
    for c, camera in enumerate(rig.cameras):
        own = observations.camera == c
        by[own] = project_with_jacobians(camera, xyz[own]).by_point
    for p in range(len(observations.points)):
        own = observations.point == p
        least = least_variance(time_s, observations.time_s[own], by[own], observations.covariance_px2[own], of_motion)
        total += least.mean() / len(observations.points)
    return np.sqrt(total)


@pytest.mark.parametrize("cornered", [CORNERED, 99])
def test_what_two_cameras_see_is_near_what_the_motions_spectrum_lets_be_known(cornered, monkeypatch):
    """The control: without a corner, high orders leave polynomials free, which two cameras hardly hold."""
    monkeypatch.setattr(single_point, "CORNERED", cornered)
    path, two = swinging(2, 4), np.arange(0.13, 0.34, 0.01)
    observations = take(path, ring(), LATE, 0.03, 2)
    done = estimate(observations, ring(), replace(PLAIN, clocks="offset"))
    times = rms(done, path, two) / least_rms(observations, ring(), path, two)
    assert bool(times < 2.0) is (cornered == CORNERED)
    # until the second camera runs, depth is extrapolated
    at = np.array([0.05, 0.1, 0.12, 0.2])
    tracks = tracks_on_grid(done.curves, observations, ring(), at, np.rint(at * 1e9).astype(np.int64), [1 / 30] * 3)
    status = np.array(tracks.status)[np.lexsort((tracks.track, tracks.frame))].reshape(4, -1)
    assert (status == [["filled"], ["filled"], ["measured"], ["measured"]]).all()
