"""Points of which some images are merged with a neighbour's or look odd: which of them count, and for how much.

Images are projected by hand with known errors; the expected places and variances are those of a least-squares point
from the images that err by their noise alone, solved here with numerical derivatives of the projection.
"""

from dataclasses import replace

import numpy as np
import pytest
from rigs import PINHOLE, ring
from scipy.stats import chi2

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import EVERYWHERE, MatchSettings, match
from mosca.data.detections import Detections
from mosca.data.rays import Predicted

SIGMA, DIAMETER_M, TARGETS, LONG = 0.02, 0.014, 60, 1.5
RIG = ring(4, PINHOLE, height_m=[0.6, 1.3, 0.6, 1.3])


def images(rng, merged, shift_px, long):
    """Detections of targets in order; of the cameras ``merged`` each target's image is shifted by ``shift_px``.

    ``long`` (c,): whether a camera's images are long. A merged pair of one image's size shows nothing else.
    """
    points, found = rng.uniform(-0.4, 0.4, (TARGETS, 3)), {}
    for c, camera in enumerate(RIG.cameras):
        angle = rng.uniform(0, 2 * np.pi, TARGETS)
        off = shift_px * np.column_stack([np.cos(angle), np.sin(angle)]) if c in merged else 0.0
        xy = project(camera, points) + rng.normal(0, SIGMA, (TARGETS, 2)) + off
        away = np.linalg.norm(points - camera.world_from_camera.translation, axis=1)
        found[camera.name] = Detections(
            camera.name, xy, np.tile(SIGMA**2 * np.eye(2), (TARGETS, 1, 1)), 800.0 * DIAMETER_M / away,
            np.full(TARGETS, 100.0), np.where(long[c], LONG, 1.0) * np.ones(TARGETS),
        )  # fmt: skip
    return points, found


def bound(point, cameras):
    """Covariance of a point from images with ``SIGMA`` of some cameras."""
    information = np.zeros((3, 3))
    for camera in (RIG.cameras[c] for c in cameras):
        steps = 1e-5 * np.eye(3)
        slope = (project(camera, point + steps) - project(camera, point - steps)).T / 2e-5
        information += slope.T @ slope / SIGMA**2
    return np.linalg.inv(information)


def placed(found, predicted=None):
    """Points, as if round images elsewhere made the long ones rare."""
    table = replace(make_ray_table(RIG, found, 0.0), odd=0)
    settings = MatchSettings(camera_sigma_px=0.0)
    return match(table, predicted or Predicted.nothing(), settings, EVERYWHERE, DIAMETER_M)


def errors(points, truth3d):
    """Errors (n, 3), covariances and targets of the points whose images are all of one target."""
    same = (points.rays == points.rays.max(axis=1, keepdims=True)) | (points.rays < 0)
    whole = np.flatnonzero(same.all(axis=1))
    target = points.rays[whole].max(axis=1)
    return points.xyz[whole] - truth3d[target], points.covariance[whole], target


def test_long_images_that_agree_count_in_full_and_a_merged_one_among_them_does_not():
    ratio, nees = [], []
    for seed in range(4):
        truth3d, found = images(np.random.default_rng(seed), {3}, 0.6, [True] * 4)
        off, covariance, target = errors(placed(found), truth3d)
        assert len(target) >= 0.9 * TARGETS
        ratio += [e @ e / np.trace(bound(truth3d[t], (0, 1, 2))) for e, t in zip(off, target, strict=True)]
        nees += [e @ np.linalg.solve(v, e) for e, v in zip(off, covariance, strict=True)]
    # rms within a tenth of what the three other images can tell, as stated
    assert np.sqrt(np.mean(ratio)) < 1.1
    assert 2.4 < np.mean(nees) < 3.6
    assert 0.93 < np.mean(np.array(nees) < chi2.ppf(0.95, 3)) < 0.975


@pytest.mark.parametrize("long", [[False] * 4, [False, False, True, True], [True] * 4])
def test_images_that_err_by_their_noise_alone_count_in_full_whatever_their_shape(long):
    truth3d, found = images(np.random.default_rng(5), set(), 0.0, long)
    points = placed(found)
    _, covariance, target = errors(points, truth3d)
    assert len(target) == TARGETS
    assert (points.trusted > 3.99).mean() > 0.95
    for v, t in zip(covariance[:5], target[:5], strict=True):
        np.testing.assert_allclose(v, bound(truth3d[t], range(4)), rtol=0.02, atol=1e-12)


def test_two_images_show_no_disagreement():
    # control: along the epipolar line a pair agrees whatever its errors, so that odd shapes still count for less
    truth3d, found = images(np.random.default_rng(6), set(), 0.0, [True] * 4)
    tracks = Predicted(truth3d, np.tile(1e-6 * np.eye(3), (TARGETS, 1, 1)))
    points = placed({name: one for name, one in found.items() if name in ("c0", "c1")}, tracks)
    assert len(points) > 0
    assert points.trusted.max() < 1.9
