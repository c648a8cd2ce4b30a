"""The bundle adjustment's stated errors are true: scatter, blunders, robust losses, inner
datum."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import cv2_pixels, moved, ring, views, wand_points, wand_problem
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mosca.calibration.bundle.solver import (
    BundleSettings,
    CameraUnknowns,
    Distances,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.camera.projection import project_with_jacobians
from mosca.data.rig import Camera, Pose

NOISE = 0.2


def waved(frames, noise, **how):
    cameras = ring(k1=-0.1)
    points = wand_points(frames)
    camera, point, xy = views(cameras, points, 0, 0.9)
    kept = np.bincount(point, minlength=len(points))[point] >= 2
    camera, point, xy = camera[kept], point[kept], xy[kept]
    see = Observations(camera, point, xy + noise(xy.shape), sigma_px=NOISE)
    return cameras, points, wand_problem(cameras, see, points, rod_sigma_m=2e-4, **how)


def noisy(frames, seed):
    """Return the problem of a wand in so many frames, with normal noise."""
    rng = np.random.default_rng(seed)
    return waved(frames, lambda shape: rng.normal(0, NOISE, shape))[2]


def unknowns_of(cameras, held_first=True) -> np.ndarray:
    """Return positions, f_px and k1 in their order in ``parameters`` (without rotations)."""
    out = []
    for k, c in enumerate(cameras):
        out += ([] if k == 0 and held_first else [*c.world_from_camera.translation]) + [c.lens.fx_px, c.lens.k1]
    return np.array(out)


def test_the_stated_covariance_is_the_scatter():
    rng = np.random.default_rng(0)
    runs, nees, points_nees, sigma0s, redundancy = 60, [], [], [], 0
    for _ in range(runs):
        noise = rng.normal(0, NOISE, (5000, 2))
        cameras, points, problem = waved(12, lambda shape, n=noise: n[: shape[0]])
        rods = problem.distances
        lengths = rods.length_m + rng.normal(0, rods.sigma_m)
        problem = replace(problem, distances=Distances(rods.first, rods.second, lengths, rods.sigma_m))
        done = solve(problem, BundleSettings(tolerance=1e-3))
        own = [k for k, name in enumerate(done.parameters) if "turn" not in name]
        error = unknowns_of(done.cameras) - unknowns_of(cameras)
        # in units of the stated standard deviation of unit weight, which is 1 here
        covariance = done.precision.covariance[np.ix_(own, own)] / done.sigma0**2
        nees.append(error @ np.linalg.solve(covariance, error))
        seen = np.flatnonzero(np.isfinite(done.points).all(axis=1) & (done.precision.points[:, 0, 0] > 0))
        away = (done.points - points)[seen[0]]
        points_nees.append(away @ np.linalg.solve(done.precision.points[seen[0]] / done.sigma0**2, away))
        sigma0s.append(done.sigma0**2)
        redundancy = done.redundancy
    low, high = chi2.ppf([0.0005, 0.9995], runs * len(own))
    assert low < np.sum(nees) < high
    low, high = chi2.ppf([0.0005, 0.9995], runs * 3)
    assert low < np.sum(points_nees) < high
    low, high = chi2.ppf([0.0005, 0.9995], runs * redundancy)
    assert low < np.sum(sigma0s) * redundancy < high


def test_the_inner_datum_is_the_pseudo_inverse():
    """A free network's cofactors are the pseudo-inverse of its normal matrix, with the datum over all its
    points."""
    rng = np.random.default_rng(2)
    cameras, points, problem = waved(8, lambda shape: rng.normal(0, NOISE, shape), hold_first=False)
    for rods, motions in ((problem.distances, 6), (Distances([], [], [], []), 7)):
        network = replace(problem, distances=rods, datum="points")
        done = solve(network, BundleSettings(tolerance=1e-8))
        see, n = problem.observations, len(points)
        u = 8 * len(cameras)
        design = np.zeros((2 * len(see) + len(rods), u + 3 * n))
        for k, camera in enumerate(done.cameras):
            mine = np.flatnonzero(see.camera == k)
            seen = project_with_jacobians(camera, done.points[see.point[mine]])
            ratio = camera.lens.fy_px / camera.lens.fx_px
            lens = np.stack([seen.by_lens[:, :, 0] + ratio * seen.by_lens[:, :, 1], seen.by_lens[:, :, 4]], axis=2)
            for j, m in enumerate(mine):
                rows, at = slice(2 * m, 2 * m + 2), u + 3 * see.point[m]
                design[rows, 8 * k : 8 * k + 8] = np.hstack([seen.by_pose[j], lens[j]])
                design[rows, at : at + 3] = seen.by_point[j]
        design[: 2 * len(see)] /= NOISE
        for j in range(len(rods)):
            away = done.points[rods.first[j]] - done.points[rods.second[j]]
            by = away / np.linalg.norm(away) / rods.sigma_m[j]
            design[2 * len(see) + j, u + 3 * rods.first[j] :][:3] = by
            design[2 * len(see) + j, u + 3 * rods.second[j] :][:3] = -by
        # inner constraints over the points: border the normal matrix with the motions of the points
        motion = np.zeros((u + 3 * n, motions))
        for j, (x, y, z) in enumerate(done.points):
            motion[u + 3 * j : u + 3 * j + 3, :3] = np.eye(3)
            motion[u + 3 * j : u + 3 * j + 3, 3:6] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
            if motions == 7:
                motion[u + 3 * j : u + 3 * j + 3, 6] = x, y, z
        normal = design.T @ design
        size = np.sqrt(np.diag(normal))
        bordered = np.block(
            [
                [normal / np.outer(size, size), motion / size[:, None]],
                [(motion / size[:, None]).T, np.zeros((motions, motions))],
            ]
        )
        cofactors = np.linalg.inv(bordered)[: u + 3 * n, : u + 3 * n] / np.outer(size, size)
        covariance = done.sigma0**2 * cofactors
        sigma = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(
            done.precision.covariance / np.outer(sigma[:u], sigma[:u]),
            covariance[:u, :u] / np.outer(sigma[:u], sigma[:u]),
            atol=1e-4,
        )
        for j in range(n):
            at = slice(u + 3 * j, u + 3 * j + 3)
            np.testing.assert_allclose(
                done.precision.points[j], covariance[at, at], rtol=1e-3, atol=1e-3 * covariance[at, at].max()
            )
        assert done.redundancy == 2 * len(see) + len(rods) - u - 3 * n + motions
        assert np.nansum(done.precision.redundancy_numbers) <= done.redundancy + 1e-6


def test_redundancy_numbers_add_up():
    problem = noisy(15, 3)
    problem = replace(problem, distances=Distances([0], [1], [0.5], [1e-7]))
    done = solve(problem)
    # one length, hardly redundant at all, and image points: together they have the redundancy
    assert np.nansum(done.precision.redundancy_numbers) == pytest.approx(done.redundancy, abs=1e-3)


def test_blunders_are_found_and_named():
    rng = np.random.default_rng(4)
    _, _, problem = waved(60, lambda shape: rng.normal(0, NOISE, shape))
    clean = solve(problem, BundleSettings(blunder_significance=0.01))
    assert len(clean.rejected) == 0
    see = problem.observations
    rays = np.bincount(see.point)[see.point]
    wrong = rng.choice(np.flatnonzero(rays >= 4), 25, replace=False)
    # one per point at most, so that each can be separated
    wrong = wrong[np.unique(see.point[wrong], return_index=True)[1]]
    xy = see.xy_px.copy()
    xy[wrong] += rng.uniform(6, 40, (len(wrong), 1)) * np.array([[0.6, 0.8]])
    spoiled = replace(problem, observations=Observations(see.camera, see.point, xy, sigma_px=NOISE))
    bad = solve(spoiled)
    done = solve(spoiled, BundleSettings(blunder_significance=0.01))
    np.testing.assert_array_equal(done.rejected, np.sort(wrong))
    assert bad.sigma0 > 3 * done.sigma0
    assert 0.85 < done.sigma0 < 1.15
    assert not done.used[done.rejected].any()
    # the statistic of what was left out is that of the prediction by the others: as improbable as it is
    assert (done.precision.statistic[wrong] > 100).all()
    sigma = done.standard_deviations["c1.f_px"]
    assert done.cameras[1].lens.fx_px == pytest.approx(clean.cameras[1].lens.fx_px, abs=3 * sigma)


def test_good_points_are_rejected_no_more_often_than_stated():
    # four known cameras, two points: of 16 coordinates 10 are redundant, and the variance of so few is hardly known
    cameras = ring(k1=-0.1)[:4]
    points = np.array([[0.05, 0.02, 1.1], [-0.1, 0.08, 0.95]])
    camera, point, xy = views(cameras, points, 0, 2.0)
    assert len(xy) == 8
    rng, rejected = np.random.default_rng(11), 0
    held = tuple(CameraUnknowns(one, free=(), held=True) for one in cameras)
    for _ in range(300):
        see = Observations(camera, point, xy + rng.normal(0, NOISE, xy.shape), sigma_px=NOISE)
        problem = Problem(held, see, ObjectPoints.free(2))
        rejected += len(solve(problem, BundleSettings(blunder_significance=0.2, precision=False)).rejected) > 0
    # Bonferroni: at most 20 % of networks lose a point, and nearly so many where tests hardly depend on each other
    assert 0.1 < rejected / 300 < 0.25


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_losses_hold_against_blunders(loss):
    rng = np.random.default_rng(5)
    _, _, problem = waved(80, lambda shape: rng.normal(0, NOISE, shape))
    see = problem.observations
    xy = see.xy_px.copy()
    wrong = rng.choice(len(xy), 40, replace=False)
    xy[wrong] += rng.normal(0, 15, (40, 2))
    spoiled = replace(problem, observations=Observations(see.camera, see.point, xy, sigma_px=NOISE))
    plain, robust = solve(spoiled), solve(spoiled, BundleSettings(loss=loss))
    good = solve(problem)
    off = [np.abs(unknowns_of(one.cameras) - unknowns_of(good.cameras))[3::5].max() for one in (plain, robust)]
    assert robust.converged
    assert off[1] < 0.2 * off[0]


def test_a_robust_optimum_is_a_stationary_point():
    rng = np.random.default_rng(6)
    _, _, problem = waved(10, lambda shape: rng.standard_t(2, shape) * NOISE)
    done = solve(problem, BundleSettings(loss="cauchy", tolerance=1e-8, hold_weak=False))
    again = solve(problem, BundleSettings(loss="cauchy", tolerance=1e-10, hold_weak=False), done)
    assert again.cost == pytest.approx(done.cost, rel=1e-12)
    u = np.sum((done.residuals_px / NOISE) ** 2, axis=1)
    lengths = np.linalg.norm(done.points[0::2] - done.points[1::2], axis=1)
    k2 = 2.5**2
    expected = np.sum(k2 * np.log1p(u / k2)) + np.sum(((lengths - 0.5) / 2e-4) ** 2)
    assert done.cost == pytest.approx(expected, rel=1e-9)


def body_problem(rng, frames=30, held=False, sigma=1e-4):
    """Return shape, cameras and problem of a five-ball body of nearly known shape carried before four
    cameras."""
    cameras = ring(k1=-0.1)
    shape = rng.uniform(-0.2, 0.2, (5, 3))
    poses = [
        Pose(Rotation.random(random_state=k).as_matrix(), rng.uniform(-0.5, 0.5, 3) + [0, 0, 1])
        for k in range(frames)
    ]
    rows = [(c, p, f) for c in range(4) for p in range(5) for f in range(frames)]
    camera, point, placement = np.array(rows).T
    place = np.array([poses[f].transform(shape[p][None])[0] for p, f in zip(point, placement, strict=True)])
    xy = np.empty((len(rows), 2))
    for c in range(4):
        xy[camera == c] = cv2_pixels(cameras[c], place[camera == c])
    xy += rng.normal(0, NOISE, xy.shape)
    unknowns = tuple(
        CameraUnknowns(moved(c, rng, 0.02 if k else 0, 0.03 if k else 0), ("f_px", "k1"), held=k == 0)
        for k, c in enumerate(cameras)
    )
    begin = [moved(Camera("", 0, 0, cameras[0].lens, p), rng, 0.05, 0.03).world_from_camera for p in poses]
    measured = shape if held else shape + rng.normal(0, sigma, shape.shape)
    points = ObjectPoints.fixed(measured) if held else ObjectPoints.weighted(measured, sigma)
    see = Observations(camera, point, xy, placement, NOISE)
    return shape, cameras, Problem(unknowns, see, points, Placements.of(begin))


def test_a_body_of_known_shape_calibrates_and_its_shape_is_improved():
    rng = np.random.default_rng(9)
    shape, cameras, problem = body_problem(rng, sigma=1e-3)
    done = solve(problem)
    assert done.converged
    assert 0.9 < done.sigma0 < 1.1
    error = unknowns_of(done.cameras) - unknowns_of(cameras)
    own = [k for k, name in enumerate(done.parameters) if "turn" not in name and "point" not in name]
    statistic = error @ np.linalg.solve(done.precision.covariance[np.ix_(own, own)], error)
    assert chi2.ppf(0.001, len(own)) < statistic < chi2.ppf(0.999, len(own))
    # distances within the body, from 600 image points, are better than 1 mm
    i, j = np.triu_indices(5, 1)
    before, after = (
        np.linalg.norm(x[i] - x[j], axis=1) - np.linalg.norm(shape[i] - shape[j], axis=1)
        for x in (problem.points.xyz, done.points)
    )
    size = 1 + np.mean(before / np.linalg.norm(shape[i] - shape[j], axis=1))
    assert np.std(after / np.linalg.norm(shape[i] - shape[j], axis=1)) < 0.5 * np.std(before)
    assert 0.9 < size < 1.1
    assert done.precision.placements.shape == (30, 6, 6)
    assert np.isfinite(done.precision.placements).all()
    assert sum("point" in name for name in done.parameters) == 15


def test_time_and_blocks_do_not_depend_on_the_order_of_the_observations():
    rng = np.random.default_rng(10)
    _, _, problem = body_problem(rng)
    see = problem.observations
    order = rng.permutation(len(see))
    mixed = Observations(see.camera[order], see.point[order], see.xy_px[order], see.placement[order], NOISE)
    one, two = solve(problem), solve(replace(problem, observations=mixed))
    assert one.cost == pytest.approx(two.cost, rel=1e-10)
    np.testing.assert_allclose(one.residuals_px[order], two.residuals_px, atol=1e-6)
    np.testing.assert_allclose(one.precision.statistic[order], two.precision.statistic, rtol=1e-5)


def test_points_that_no_two_rays_meet_are_left_out_not_invented():
    problem = noisy(20, 11)
    see = problem.observations
    once = np.append(True, see.point[1:] != see.point[:-1]) & (see.point == 7)
    keep = (see.point != 7) | (np.cumsum(see.point == 7) == 1)
    assert once.any()
    alone = Observations(see.camera[keep], see.point[keep], see.xy_px[keep], sigma_px=NOISE)
    done = solve(replace(problem, observations=alone))
    assert not done.used[np.asarray(alone.point) == 7].any()
    assert np.isnan(done.precision.points[7]).all()
    assert np.isfinite(done.precision.points[6]).all()


def test_precision_is_not_there_unless_asked_for():
    problem = noisy(10, 12)
    done = solve(problem, BundleSettings(precision=False))
    assert done.precision is None
    with pytest.raises(ValueError, match=r"settings\.precision"):
        _ = done.standard_deviations
