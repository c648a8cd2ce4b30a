"""Errors that a camera's images have in common: beside dense least squares, their learned share, controls."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.lens_field import MODES, add_field, field_as_noise
from mosca.correspondence.match import MatchSettings, match_counted
from mosca.correspondence.shared_turns import (
    Shared,
    add_equations,
    fill_equations,
    point_equations,
    remove_turns,
    share_likelihoods,
    without_turns,
)
from mosca.correspondence.shared_turns import solved as solution
from mosca.data.detections import Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.diagnostics.noise_model import FIELD_SHARES, OWN_SHARES
from mosca.numba_support.decorators import kernel

FOCAL, NOISE, SHAKE = 700.0, 0.01, 0.05
"""[px]: principal distance, error of each image, and shift of all images of a camera."""


@kernel
def turns_beside_field(normal, right, by_field, field_px2, variance):
    """Turns and their covariance."""
    field_as_noise(normal, right, by_field, field_px2, variance)
    return solution(normal, right, variance)


@kernel
def turn_sides(rays, views, members, xyz):
    """The right sides (2 c,) of the turns' equations, and their derivative by a field."""
    cameras = len(views)
    normal, right = np.zeros((2 * cameras, 2 * cameras)), np.zeros(2 * cameras)
    by_field, equations = np.zeros((cameras, 2, MODES, 2 * cameras)), point_equations(len(xyz), cameras, 2)
    for k in range(len(xyz)):
        fill_equations(k, xyz[k], members[k], np.ones(cameras), rays, views, np.zeros(cameras), equations)
        add_equations(k, equations, normal, right)
        add_field(k, members[k], equations, by_field)
    return right, by_field


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


def smooth(rng, field):
    """Amplitudes (c, 2, 5) of a lens's field that is a polynomial of the image's place, ``field`` px rms over it."""
    return rng.normal(0.0, field, (4, 2, 5))


def shifts(xy, amplitudes):
    """What such a field adds to images (n, 2); each polynomial has a mean square of 1/5 over the image."""
    u, v = xy[:, 0] / 327.5 - 1.0, xy[:, 1] / 245.0 - 1.0
    modes = [u * 3**0.5, v * 3**0.5, 3 * u * v, (u * u - 1 / 3) * 11.25**0.5, (v * v - 1 / 3) * 11.25**0.5]
    return np.column_stack(modes) @ amplitudes.T / 5**0.5


def seen(points, rng, own=NOISE, shake=SHAKE, steady=0.0, field=None):
    """The detections of a frame set, and the turns (c, 2) [rad] of its cameras."""
    turns, found = steady + rng.normal(0.0, shake / FOCAL, (4, 2)), {}
    for c, (camera, turn) in enumerate(zip(RIG.cameras, turns, strict=True)):
        xy = project(turned(camera, turn), points) + rng.normal(0.0, own, (len(points), 2))
        if field is not None:
            xy = xy + shifts(xy, field[c])
        n = len(xy)
        found[camera.name] = Detections(
            camera.name, xy, np.tile(NOISE**2 * np.eye(2), (n, 1, 1)), np.full(n, 4.0), np.full(n, 100.0), np.ones(n)
        )
    return found, turns


def shifted(detections, xy):
    return replace(detections, xy_px=xy)


def placed(rng, n):
    return rng.uniform(-0.5, 0.5, (n, 3))


def solved(found, shake=SHAKE, steady=None, field=0.0):
    """Rays of a frame set, its points in the order of camera a's images, and the turns removed from them."""
    table = make_ray_table(RIG, found, np.hypot(SHAKE, field))
    shared = Shared(np.full(4, shake), np.full(4, field), np.zeros((4, 2)) if steady is None else steady)
    matched = match_counted(table, Predicted.nothing(), MatchSettings(judge_sizes=False))
    return table, *without_turns(matched.points, matched.trusts, table, shared)


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
    matched = solved(found)[1]
    wanted, covariance = dense(found, matched.xyz, matched.rays)
    assert len(matched) == 12
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    np.testing.assert_allclose(matched.xyz, wanted, atol=0.01 * sigma.min())
    blocks = np.array([covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(12)])
    np.testing.assert_allclose(matched.covariance, blocks, rtol=0.01, atol=0.001 * blocks.max())


def errors(rng, sets, n, taken, own=NOISE, shake=SHAKE, field=0.0, stated=0.0):
    """Mean square error [m^2] and mean nees of the points of some frame sets; ``taken`` for shake [px]."""
    square, nees = [], []
    for _ in range(sets):
        points = placed(rng, n)
        found, _ = seen(points, rng, own, shake, field=smooth(rng, field) if field else None)
        matched = solved(found, taken, field=stated)[1]
        for xyz, covariance in zip(matched.xyz, matched.covariance, strict=True):
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
    alone, together = solved(found, 0.0)[1], solved(found, 0.9 * SHAKE)[1]
    sigma = np.sqrt(np.trace(alone.covariance[0]))
    assert np.linalg.norm(alone.xyz - together.xyz) < 0.05 * sigma
    np.testing.assert_allclose(together.covariance, alone.covariance, rtol=0.1, atol=0.02 * sigma**2)


def test_a_steady_turn_is_kept():
    rng, steady = np.random.default_rng(4), np.zeros((4, 2))
    steady[2] = 0.2 / FOCAL, -0.1 / FOCAL
    points = placed(rng, 40)
    found, turns = seen(points, rng, steady=steady)
    _, matched, removed = solved(found, 0.999 * SHAKE)
    assert np.abs(removed - turns).max() < 0.5 * SHAKE / FOCAL
    kept, never = solved(found, 0.999 * SHAKE, removed)[1], solved(found, 0.0)[1]
    # all of it kept: the points are those of independent images but for their weights
    away = np.linalg.norm(kept.xyz - never.xyz, axis=1)
    assert np.median(away) < 0.2 * np.median(np.linalg.norm(matched.xyz - never.xyz, axis=1))


def likely_shares(own, shake, field=0.0):
    """The mean shares of the images' own errors and of the lens's field, of ten sets of 15 points."""
    rng, total = np.random.default_rng(5), np.zeros((len(OWN_SHARES), len(FIELD_SHARES)))
    amplitudes = smooth(rng, field)
    for _ in range(10):
        table, found, _ = solved(seen(placed(rng, 15), rng, own, shake, field=amplitudes)[0], 0.0)
        total += share_likelihoods(
            table.rays, table.views, table.start, found.rays, found.xyz, found.n_cameras >= 2,
            table.extra_px2, (OWN_SHARES, FIELD_SHARES), np.arange(4), (0, 1),
        )  # fmt: skip
    likely = np.exp(total - total.max())
    likely /= likely.sum()
    return likely.sum(axis=1) @ OWN_SHARES, likely.sum(axis=0) @ FIELD_SHARES


@pytest.mark.parametrize(
    ("own", "shake", "least", "most"),
    [(NOISE, SHAKE, 0.0, 0.02), (np.hypot(NOISE, 0.5 * SHAKE), SHAKE * 0.75**0.5, 0.2, 0.3), (SHAKE, 0.0, 0.5, 1.0)],
)
def test_the_share_of_what_images_have_in_common_is_learned(own, shake, least, most):
    """The last case is the control: errors that are each image's own are not taken for shake, nor for a field."""
    single, smooth_share = likely_shares(own, shake)
    assert least <= single <= most
    assert smooth_share < 0.03


@pytest.mark.parametrize("field", [0.25 * SHAKE, 0.5 * SHAKE])
def test_a_smooth_field_is_told_from_single_errors(field):
    single, share = likely_shares(NOISE, SHAKE, field)
    assert single < 0.02
    # one draw of 40 amplitudes: their mean square scatters by a quarter; grid of quarters
    assert 0.25 * (field / SHAKE) ** 2 < share < 4.0 * (field / SHAKE) ** 2


def test_errors_of_a_smooth_field_are_stated():
    """A field that is taken for single images' errors (the control) turns cameras by more than is stated."""
    field = 0.8 * SHAKE
    worse, wrong = errors(np.random.default_rng(7), 30, 60, 0.999 * SHAKE, field=field)
    square, nees = errors(np.random.default_rng(7), 30, 60, 0.999 * SHAKE, field=field, stated=field)
    assert 2.0 < nees < 4.0 < 8.0 < wrong
    assert square < 0.9 * worse


def test_covariances_are_those_of_the_points_answers_to_errors():
    """Every error is made one at a time: of each image, of each camera's turns, of each amplitude of a field."""
    points, field, step = placed(np.random.default_rng(11), 8), 0.5 * SHAKE, 1e-3
    exact, none = seen(points, np.random.default_rng(0), 1e-9, 0.0)[0], np.zeros((4, 2, 5))
    matched = solved(exact, 0.999 * SHAKE, field=field)[1]
    order, wanted = matched.rays[:, 0], np.zeros((8, 3, 3))

    def add(found, sigma):
        moved = solved(found, 0.999 * SHAKE, field=field)[1]
        answer = (moved.xyz[np.argsort(moved.rays[:, 0])] - matched.xyz[np.argsort(order)])[order] / step
        np.add(wanted, sigma**2 * answer[:, :, None] * answer[:, None, :], out=wanted)

    for c, camera in enumerate(RIG.cameras):
        for i in range(2):
            turn = step / FOCAL * np.eye(2)[i]
            xy = project(turned(camera, turn), points)
            add({**exact, camera.name: shifted(exact[camera.name], xy)}, SHAKE)
            for m in range(5):
                one = none.copy()
                one[c, i, m] = step
                xy = exact[camera.name].xy_px + shifts(exact[camera.name].xy_px, one[c])
                add({**exact, camera.name: shifted(exact[camera.name], xy)}, field)
            for k in range(8):
                xy = exact[camera.name].xy_px + step * np.outer(np.arange(8) == k, np.eye(2)[i])
                add({**exact, camera.name: shifted(exact[camera.name], xy)}, NOISE)
    # pixels are not quite the stereographic plane
    np.testing.assert_allclose(matched.covariance, wanted, rtol=0.05, atol=0.01 * wanted.max())


def test_turns_are_the_best_linear_prediction_beside_a_field():
    rng, n = np.random.default_rng(8), 8
    root, by_field = rng.normal(size=(n, n)), rng.normal(size=(4, 2, MODES, n))
    field, variance, right = rng.uniform(0.1, 2.0, 4), rng.uniform(0.5, 2.0, 4), rng.normal(size=n)
    data, prior = root @ root.T + np.eye(n), np.diag(np.repeat(variance, 2))
    noise = data + np.einsum("ckmi,ckmj,c->ij", by_field, by_field, field)
    # joint normal distribution of turns and right side
    gain = prior @ data @ np.linalg.inv(data @ prior @ data + noise)
    turns, covariance = turns_beside_field(np.tril(data), right.copy(), by_field, field, variance)
    np.testing.assert_allclose(turns, -gain @ right, rtol=1e-4)
    np.testing.assert_allclose(covariance, prior - gain @ data @ prior, rtol=1e-4, atol=1e-6)


def test_derivatives_by_the_field_are_those_of_shifted_images():
    """G b is what a field b adds to the turns' right sides, by images that the field has shifted."""
    rng = np.random.default_rng(9)
    points, field = placed(rng, 12), smooth(rng, 1e-3)
    sides, found = [], None
    for amplitudes in (None, field):
        table, matched, _ = solved(seen(points, np.random.default_rng(10), 1e-6, 0.0, field=amplitudes)[0], 0.0)
        found = found or matched
        members = np.where(found.rays >= 0, table.start[:4] + found.rays, -1)
        right, by_field = turn_sides(table.rays, table.views, members, found.xyz)
        sides.append(right)
    # residuals are predicted minus observed; the stereographic plane is not quite the image
    wanted = -np.einsum("ckmj,ckm->j", by_field, field)
    np.testing.assert_allclose(sides[1] - sides[0], wanted, atol=0.05 * np.abs(wanted).max())


def test_errors_of_single_images_get_worse_where_they_are_taken_for_shake():
    """Control of the gain: with independent errors it is not there, and stated covariances are too small."""
    alone, nees = errors(np.random.default_rng(6), 30, 40, 0.0, SHAKE, 0.0)
    together, wrong = errors(np.random.default_rng(6), 30, 40, 0.999 * SHAKE, SHAKE, 0.0)
    assert together > 0.98 * alone
    assert nees < 3.6 < 6.0 < wrong


def test_points_with_doubtful_images_are_no_better_known_than_their_images_tell():
    """Turns and field are in the weights of such images, and are taken off: no more than they are in them."""
    rng, field, noise, n = np.random.default_rng(12), 0.05 * SHAKE, 0.2 * NOISE, 40
    points = 1.6 * placed(rng, n)
    found = {
        name: replace(one, covariance_px2=0.04 * one.covariance_px2) for name, one in seen(points, rng)[0].items()
    }
    table = make_ray_table(RIG, found, np.hypot(SHAKE, field))
    members, trusts = np.tile(np.arange(n)[:, None], 4), np.ones((n, 4))
    trusts[::4, 0] = 0.1  # hardly count in camera a
    slopes = np.stack(
        [
            np.stack([project(c, points + 1e-6 * axis) - project(c, points - 1e-6 * axis) for axis in np.eye(3)], -1)
            for c in RIG.cameras
        ],
        axis=1,
    ) / 2e-6  # fmt: skip
    shared = SHAKE**2 + field**2

    def covariances(whole_px2):
        return np.linalg.inv(np.einsum("ncki,nckj,nc->nij", slopes, slopes, 1.0 / whole_px2))

    images_px2 = (noise**2 + shared) / trusts**2
    xyz, known = points.copy(), covariances(images_px2)
    variances = np.full(4, SHAKE**2), np.full(4, field**2), np.zeros(8)
    remove_turns(xyz, known, members, trusts, table.rays, table.views, table.start, variances)
    # without turns and field nothing is known better (Cramer and Rao)
    spare = np.linalg.eigvalsh(known - covariances(images_px2 - shared))
    assert (spare > -1e-3 * np.linalg.eigvalsh(known)[:, :1]).all()
    # and the images' common error is mostly removed
    before, after = np.trace(covariances(images_px2), axis1=1, axis2=2), np.trace(known, axis1=1, axis2=2)
    assert np.median(after[::4] / before[::4]) < 0.5
