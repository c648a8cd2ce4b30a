"""Errors that a camera's images have in common: beside dense least squares, their learned share, controls."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import MatchSettings, Shared, match_counted
from mosca.correspondence.shared_turns import share_likelihoods
from mosca.data.detections import Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.diagnostics.noise_model import OWN_SHARES

FOCAL, NOISE, SHAKE = 700.0, 0.01, 0.05
"""[px]: principal distance, error of each image, and shift of all images of a camera."""


def looking(name, place):
    axis = -np.asarray(place) / np.linalg.norm(place)
    right = np.cross(axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(axis, right), axis])
    return Camera(name, 656, 491, OpenCVLens(FOCAL, FOCAL, 327.5, 245.0), Pose(rotation, np.asarray(place, float)))


RIG = Rig(
    (looking("a", (3, 0, 1)), looking("b", (0, 3, 0.5)), looking("c", (-2.5, -1, 1.5)), looking("d", (0, -3, 0)))
)


def turned(camera, turn):
    pose = camera.world_from_camera
    rotation = pose.rotation @ Rotation.from_rotvec([*turn, 0.0]).as_matrix()
    return Camera(camera.name, camera.width, camera.height, camera.lens, Pose(rotation, pose.translation))


def seen(points, rng, own=NOISE, shake=SHAKE, steady=0.0):
    """The detections of a frame set, and the turns (c, 2) [rad] of its cameras."""
    turns, found = steady + rng.normal(0.0, shake / FOCAL, (4, 2)), {}
    for camera, turn in zip(RIG.cameras, turns, strict=True):
        xy = project(turned(camera, turn), points) + rng.normal(0.0, own, (len(points), 2))
        n = len(xy)
        found[camera.name] = Detections(
            camera.name, xy, np.tile(NOISE**2 * np.eye(2), (n, 1, 1)), np.full(n, 4.0), np.full(n, 100.0), np.ones(n)
        )
    return found, turns


def placed(rng, n):
    return rng.uniform(-0.5, 0.5, (n, 3))


def solved(found, shake=SHAKE, steady=None, own=0.0):
    """Points of a frame set in the order of camera a's images, with the turns found."""
    table = make_ray_table(RIG, found, SHAKE)
    shared = Shared(np.full(4, shake), np.full(4, own), np.zeros((4, 2)) if steady is None else steady)
    return table, match_counted(table, Predicted.nothing(), MatchSettings(judge_sizes=False), shared=shared)


def dense(found, points, rows):
    """Generalised least squares with the whole covariance of all images (no points eliminated); by differences."""
    m, slopes, by_turn, rest = len(points), [], [], []
    for c, camera in enumerate(RIG.cameras):
        xy, at = found[camera.name].xy_px[rows[:, c]], project(camera, points)
        rest.append((xy - at).reshape(-1))
        block = np.zeros((2 * m, 3 * m))
        for p in range(3):
            moved = project(camera, points + 1e-6 * np.eye(3)[p])
            for k in range(m):
                block[2 * k : 2 * k + 2, 3 * k + p] = (moved[k] - at[k]) / 1e-6
        slopes.append(block)
        turn = np.zeros((2 * m, 8))
        for i in range(2):
            away = project(turned(camera, 1e-6 * np.eye(2)[i]), points)
            turn[:, 2 * c + i] = (away - at).reshape(-1) / 1e-6
        # a turn shifts the images by SHAKE on average
        by_turn.append(turn * SHAKE / np.sqrt(0.5 * (turn[:, 2 * c : 2 * c + 2] ** 2).sum() / m))
    a, b, r = np.vstack(slopes), np.vstack(by_turn), np.concatenate(rest)
    weight = np.linalg.inv(NOISE**2 * np.eye(len(a)) + b @ b.T)
    covariance = np.linalg.inv(a.T @ weight @ a)
    return points + (covariance @ a.T @ weight @ r).reshape(-1, 3), covariance


def test_points_and_covariances_are_those_of_dense_least_squares():
    rng = np.random.default_rng(1)
    points = placed(rng, 12)
    found, _ = seen(points, rng)
    _, matched = solved(found)
    wanted, covariance = dense(found, matched.points.xyz, matched.points.rays)
    assert len(matched.points) == 12
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    np.testing.assert_allclose(matched.points.xyz, wanted, atol=0.01 * sigma.min())
    blocks = np.array([covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(12)])
    np.testing.assert_allclose(matched.points.covariance, blocks, rtol=0.01, atol=0.001 * blocks.max())


def errors(rng, sets, n, taken, own=NOISE, shake=SHAKE):
    """Mean square error [m^2] and mean nees of the points of some frame sets; ``taken`` for shake [px]."""
    square, nees = [], []
    for _ in range(sets):
        points = placed(rng, n)
        _, matched = solved(seen(points, rng, own, shake)[0], taken)
        for xyz, covariance in zip(matched.points.xyz, matched.points.covariance, strict=True):
            off = xyz - points[np.linalg.norm(points - xyz, axis=1).argmin()]
            square.append(off @ off)
            nees.append(off @ np.linalg.solve(covariance, off))
    return np.mean(square), np.mean(nees)


def test_many_points_show_the_shake_of_their_cameras():
    alone, _ = errors(np.random.default_rng(2), 30, 40, 0.0)
    together, nees = errors(np.random.default_rng(2), 30, 40, SHAKE * 0.999)
    # dense equations of the same numbers of cameras and points have half of the rms
    assert together < 0.55**2 * alone
    assert 2.4 < nees < 3.6


def test_a_single_point_stays_where_it_is():
    rng = np.random.default_rng(3)
    found, _ = seen(placed(rng, 1), rng)
    alone, together = solved(found, 0.0)[1].points, solved(found, 0.9 * SHAKE)[1].points
    sigma = np.sqrt(np.trace(alone.covariance[0]))
    assert np.linalg.norm(alone.xyz - together.xyz) < 0.05 * sigma
    np.testing.assert_allclose(together.covariance, alone.covariance, rtol=0.1, atol=0.02 * sigma**2)


def test_a_steady_turn_is_kept():
    rng, steady = np.random.default_rng(4), np.zeros((4, 2))
    steady[2] = 0.2 / FOCAL, -0.1 / FOCAL
    points = placed(rng, 40)
    found, turns = seen(points, rng, steady=steady)
    _, matched = solved(found, 0.999 * SHAKE)
    removed = matched.turns
    assert np.abs(removed - turns).max() < 0.5 * SHAKE / FOCAL
    _, kept = solved(found, 0.999 * SHAKE, removed)
    _, never = solved(found, 0.0)
    # all of it kept: the points are those of independent images but for their weights
    away = np.linalg.norm(kept.points.xyz - never.points.xyz, axis=1)
    assert np.median(away) < 0.2 * np.median(np.linalg.norm(matched.points.xyz - never.points.xyz, axis=1))


@pytest.mark.parametrize(
    ("own", "shake", "least", "most"),
    [(NOISE, SHAKE, 0.0, 0.02), (np.hypot(NOISE, 0.5 * SHAKE), SHAKE * 0.75**0.5, 0.2, 0.3), (SHAKE, 0.0, 0.5, 1.0)],
)
def test_the_share_of_what_images_have_in_common_is_learned(own, shake, least, most):
    """The last case is the control: errors that are each image's own are not taken for shake."""
    rng, total = np.random.default_rng(5), np.zeros(len(OWN_SHARES))
    for _ in range(10):
        table, matched = solved(seen(placed(rng, 15), rng, own, shake)[0], 0.0)
        found = matched.points
        total += share_likelihoods(
            table.rays, table.views, table.start, found.rays, found.xyz, found.n_cameras >= 2, np.zeros(4),
            table.extra_px2, OWN_SHARES, (0, 1),
        )  # fmt: skip
    likely = np.exp(total - total.max())
    assert least <= OWN_SHARES @ likely / likely.sum() <= most


def test_errors_of_single_images_get_worse_where_they_are_taken_for_shake():
    """Control of the gain: with independent errors it is not there, and stated covariances are too small."""
    alone, nees = errors(np.random.default_rng(6), 30, 40, 0.0, SHAKE, 0.0)
    together, wrong = errors(np.random.default_rng(6), 30, 40, 0.999 * SHAKE, SHAKE, 0.0)
    assert together > 0.98 * alone
    assert nees < 3.6 < 6.0 < wrong
