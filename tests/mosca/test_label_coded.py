"""Coded targets as points with numbers: positions, covariance by chi-square, misread numbers left out."""

from dataclasses import replace

import numpy as np
from rigid_scenes import some_rig
from scipy import stats

from mosca.camera.projection import project
from mosca.data.found_targets import CodedDetections
from mosca.labelling.coded_targets import coded_label, coded_points, coded_samples

SIGMA_PX = 0.05
PLACES = np.random.default_rng(0).uniform(-0.8, 0.8, (12, 3))
NUMBERS = np.array([3, 7, 11, 19, 23, 42, 77, 100, 101, 200, 300, 506])


def seen_by(rig, rng, keep=1.0):
    found = {}
    for camera in rig.cameras:
        xy = project(camera, PLACES) + rng.normal(0, SIGMA_PX, (12, 2))
        rows = np.flatnonzero(np.isfinite(xy).all(axis=1) & (rng.random(12) < keep))
        n = len(rows)
        found[camera.name] = CodedDetections(
            camera.name, NUMBERS[rows], xy[rows], np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1)),
            np.full((n, 2), 5.0), np.zeros(n), np.zeros(n), np.ones(n), [],
        )  # fmt: skip
    return found


def test_numbers_and_places() -> None:
    rng = np.random.default_rng(1)
    rig = some_rig(rng)
    d2 = []
    for _ in range(60):
        points, number = coded_points(rig, seen_by(rig, rng, keep=0.9), 0.0)
        truth = PLACES[np.searchsorted(NUMBERS, number)]
        assert (points.n_cameras >= 2).all()
        error = points.xyz - truth
        d2 += np.einsum("ni,nij,nj->n", error, np.linalg.inv(points.covariance), error).tolist()
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(d2)) / len(d2)
    assert low < np.mean(d2) < high
    # rms over both axes of all rays, less the point's own three unknowns
    assert 0.5 * SIGMA_PX < np.sqrt(np.mean(points.residual_px**2)) < SIGMA_PX
    samples = coded_samples(points, number, 5, 50)
    np.testing.assert_array_equal(samples.track, number)
    assert coded_label(7) == "code/007"


def test_a_misread_number_is_left_out() -> None:
    rng = np.random.default_rng(2)
    rig = some_rig(rng)
    found = seen_by(rig, rng)
    name = rig.cameras[1].name
    one = found[name]
    xy = one.xy_px.copy()
    xy[4] += [3.0, -2.0]
    found[name] = replace(one, xy_px=xy)
    points, number = coded_points(rig, found)
    row = int(np.flatnonzero(number == one.number[4])[0])
    assert points.rays[row, 1] == -1
    assert points.n_cameras[row] == 3
    assert (np.delete(points.n_cameras, row) == 4).all()
    assert np.abs(points.xyz - PLACES).max() < 2e-3


def test_nothing_seen_and_one_camera() -> None:
    rng = np.random.default_rng(3)
    rig = some_rig(rng)
    points, number = coded_points(rig, {})
    assert len(points) == len(number) == 0
    found = seen_by(rig, rng)
    points, number = coded_points(rig, {rig.cameras[0].name: found[rig.cameras[0].name]})
    assert len(points) == len(number) == 0
