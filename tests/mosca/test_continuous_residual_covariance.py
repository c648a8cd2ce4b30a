"""Covariances where curves alone would be too sure: jitter between exposures, image errors that last."""

from dataclasses import replace

import numpy as np
import pytest
from continuous_scenes import PLAIN, nees, ring, sines, staggered, take

import mosca.continuous.estimator.estimate as whole
from mosca.camera.projection import project
from mosca.continuous.estimator.estimate import estimate
from mosca.continuous.estimator.residual_covariance import covariance_of_shared
from mosca.data.rig import Rig
from mosca.triangulation.triangulate import triangulate

WITHIN = np.linspace(0.1, 1.9, 400)


def jittering(seed, markers, sigma_m):
    """Smooth points that are somewhere else by ``sigma_m`` an axis at each 120th of a second, lines between."""
    smooth, known = sines(seed, markers), np.arange(360) / 120
    quick = np.random.default_rng(seed).normal(0, sigma_m, (360, 3 * markers))

    def at(t):
        between = np.stack([np.interp(t, known, one) for one in quick.T], axis=1)
        return smooth(t) + between.reshape(-1, markers, 3)

    return at


def without(estimated):
    curves = estimated.curves
    return replace(estimated, curves=replace(curves, unheld=np.zeros_like(curves.unheld)))


def test_jitter_that_no_exposure_tells_is_stated():
    path = jittering(4, 6, 0.002)
    estimated = estimate(take(path, ring(), staggered(), 0.05, 4), ring(), PLAIN)
    # image noise is 0.2 mm: what is left of a smooth curve is the jitter, on lines two thirds of its variance
    stated = np.sqrt(estimated.curves.unheld[:, :, 0, 0].mean())
    assert stated == pytest.approx(0.002 * np.sqrt(2 / 3), rel=0.2)
    squares = nees(estimated, path, WITHIN)
    assert 0.8 < squares.mean() < 4.0
    assert (squares < 7.815).mean() > 0.9
    # the control: curves alone
    assert nees(without(estimated), path, WITHIN).mean() > 2 * squares.mean()


def test_image_errors_that_last_are_stated():
    path, rig = sines(5, 12), ring(4)
    observations = take(path, rig, staggered(rate=100.0, cameras=4), 0.1, 5)
    each = np.random.default_rng(5).normal(0, 0.1, (4, 12, 2))
    biased = replace(observations, xy_px=observations.xy_px + each[observations.camera, observations.point])
    estimated = estimate(biased, rig, PLAIN)
    squares = nees(estimated, path, WITHIN)
    # twelve points, each with one error of its own: the mean of 12 times chi2(3) / 12 scatters by 0.7
    assert 1.5 < squares.mean() < 5.0
    assert nees(without(estimated), path, WITHIN).mean() > 2 * squares.mean()


def test_nothing_is_added_where_images_say_all():
    estimated = estimate(take(sines(6, 8), ring(), staggered(), 0.1, 6), ring(), PLAIN)
    assert (estimated.curves.unheld == 0).all()


def test_what_the_rig_says_of_its_lenses_is_stated():
    """Images without such errors show none: what is stated is what as large an error of each image would do."""
    path, plain = sines(7, 12), ring(3)
    said = Rig(tuple(replace(camera, residual_px=0.1) for camera in plain.cameras))
    observations = take(path, plain, staggered(rate=100.0), 0.05, 7)
    both = np.tile((0.05**2 + 0.1**2) * np.eye(2), (len(observations), 1, 1))
    observations = replace(observations, covariance_px2=both)
    estimated, unsaid = (estimate(observations, rig, PLAIN) for rig in (said, plain))
    assert (unsaid.curves.unheld == 0).all()
    at = estimated.curves.knots.breaks_s
    places = path(at).reshape(-1, 3)
    images = np.stack([project(camera, places) for camera in plain.cameras], axis=1)
    wanted = np.trace(triangulate(plain, images, 0.1)[1], axis1=1, axis2=2)
    stated = np.trace(estimated.curves.unheld, axis1=2, axis2=3).ravel()
    # given for half a second at a time, in which points move by 0.1 m
    np.testing.assert_allclose(np.sqrt(stated), np.sqrt(wanted), rtol=0.15)


CLOCKS = ((0.0, 0.0), (0.003, 0.0), (-0.002, 0.0))


def labels_that_wander(observations, seed, sigma_px, lasting_s):
    """Image points off by an error of each point in each camera that lasts, as of a lens or of a label."""
    rng, xy = np.random.default_rng(seed), observations.xy_px.copy()
    for c in range(3):
        for p in range(10):
            own = np.flatnonzero((observations.camera == c) & (observations.point == p))
            apart = observations.time_s[own][:, None] - observations.time_s[own]
            alike = np.exp(-0.5 * (apart / lasting_s) ** 2) + 1e-6 * np.eye(len(own))
            xy[own] += sigma_px * np.linalg.cholesky(alike) @ rng.normal(size=(len(own), 2))
    spread = np.tile((0.05**2 + sigma_px**2) * np.eye(2), (len(xy), 1, 1))
    return replace(observations, xy_px=xy, covariance_px2=spread)


def offsets(wander_px, windows, monkeypatch):
    """Return of each window the errors (n, 2) of two offsets, and the standard deviations stated and those that
    independent errors would have.
    """
    given = {}

    def spied(image, solved, places):
        given["sigma"] = np.sqrt(np.diag(solved.covariance))
        return covariance_of_shared(image, solved, places)

    monkeypatch.setattr(whole, "covariance_of_shared", spied)
    rows = []
    for seed in range(windows):
        seen = take(sines(100 + seed, 10), ring(), staggered(), 0.05, seed, clocks=CLOCKS)
        seen = labels_that_wander(seen, 900 + seed, wander_px, 0.15) if wander_px else seen
        clocks = estimate(seen, ring(), replace(PLAIN, clocks="offset")).clocks[1:]
        error = [one.offset_s - true for one, (true, _drift) in zip(clocks, CLOCKS[1:], strict=True)]
        rows.append((error, [one.offset_sigma_s for one in clocks], given["sigma"]))
    return np.swapaxes(np.array(rows), 0, 1)


@pytest.mark.slow
def test_clocks_state_what_they_scatter_where_image_errors_last(monkeypatch):
    """The control: as if all errors were independent, offsets of windows scatter by twice what is stated."""
    error, stated, alone = offsets(0.2, 8, monkeypatch)
    scatter = np.sqrt((error**2).mean())
    assert scatter > 1.7 * np.sqrt((alone**2).mean())
    assert scatter < 1.5 * np.sqrt((stated**2).mean())


@pytest.mark.slow
def test_clocks_of_independent_errors_are_stated_as_before(monkeypatch):
    _error, stated, alone = offsets(0.0, 2, monkeypatch)
    np.testing.assert_allclose(stated, alone, rtol=1e-9)
