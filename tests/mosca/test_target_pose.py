"""Poses of a known target: solid, plane with its mirrored twin, noise, blunders."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.calibration.initial.target_pose import homography, plane_of, poses_of
from mosca.data.rig import Pose


def directions(pose: Pose, points) -> np.ndarray:
    away = pose.transform(points)
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def solid(rng, n=20) -> np.ndarray:
    return rng.uniform(-0.5, 0.5, (n, 3))


def plane(columns=5, rows=4, step=0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.column_stack([step * x.ravel(), step * y.ravel(), np.zeros(columns * rows)])


def off(fit, pose: Pose) -> tuple[float, float]:
    found = fit.camera_from_target
    turn = Rotation.from_matrix(found.rotation.T @ pose.rotation).magnitude()
    return turn, float(np.linalg.norm(found.translation - pose.translation))


def some_pose(seed: int, distance: float) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(Rotation.random(random_state=seed).as_matrix(), [*rng.uniform(-0.3, 0.3, 2), distance])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), distance=st.floats(1.5, 20))
def test_a_solid_target_has_its_pose_back(seed, distance):
    pose, points = some_pose(seed, distance), solid(np.random.default_rng(seed))
    fits = poses_of(directions(pose, points), points)
    turn, shift = off(fits[0], pose)
    assert turn < 1e-6
    assert shift < 1e-6 * distance
    assert fits[0].used.all()
    # relief turned inside out does not fit a solid target's rays
    assert len(fits) == 1 or fits[1].rms_rad > 1e-4


@settings(max_examples=40, deadline=None)
@given(tilt=st.floats(0.15, 1.2), way=st.floats(0, 2 * np.pi), spin=st.floats(0, 2 * np.pi), far=st.floats(1, 4))
def test_a_tilted_plane_has_its_pose_first_and_never_more_than_two(tilt, way, spin, far):
    turn = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0])) * Rotation.from_euler("z", spin)
    pose, points = Pose(turn.as_matrix(), [0.1, -0.05, far]), plane()
    fits = poses_of(directions(pose, points), points)
    assert 1 <= len(fits) <= 2
    assert off(fits[0], pose)[0] < 1e-5
    assert fits[0].rms_rad < 1e-8


def test_a_far_plane_has_a_mirrored_pose_that_fits_nearly_as_well():
    tilt = 0.6
    points = plane() - plane().mean(axis=0)
    pose = Pose(Rotation.from_rotvec([0, tilt, 0]).as_matrix(), [0, 0, 20.0])
    one, two = poses_of(directions(pose, points), points)
    assert off(one, pose)[0] < 1e-5
    # by reflection at the plane across the line of sight: the tilt changes its sign
    mirrored = Pose(Rotation.from_rotvec([0, -tilt, 0]).as_matrix(), [0, 0, 20.0])
    assert off(two, mirrored)[0] < 0.02
    # the two differ by second-order perspective alone: offset^2 / distance^2 = (0.2 / 20)^2
    assert 0 < two.rms_rad < 3 * (0.2 / 20) ** 2


def test_noise_goes_into_the_pose_as_the_geometry_says():
    """A facing square of half edge h, n points, at z: depth is off by about z / h sigma / sqrt(n) z."""
    rng = np.random.default_rng(1)
    points = solid(rng, 200)
    pose = Pose(np.eye(3), [0, 0, 4.0])
    sigma, errors = 1e-4, []
    for _ in range(60):
        rays = directions(pose, points) + rng.normal(0, sigma, (200, 3))
        fit = poses_of(rays / np.linalg.norm(rays, axis=1, keepdims=True), points)[0]
        errors.append(fit.camera_from_target.translation - pose.translation)
        assert fit.rms_rad == pytest.approx(np.sqrt(2) * sigma, rel=0.3)
    sideways, depth = np.std(errors, axis=0)[:2].mean(), np.std(errors, axis=0)[2]
    assert sideways == pytest.approx(sigma * 4 / np.sqrt(200), rel=0.35)
    spread = np.sqrt((points[:, :2] ** 2).sum(axis=1).mean())
    assert depth == pytest.approx(sigma * 4 * 4 / spread / np.sqrt(200), rel=0.35)


@pytest.mark.parametrize("share", [0.05, 0.15])
def test_blunders_are_left_out(share):
    rng = np.random.default_rng(2)
    points = solid(rng, 60)
    pose = some_pose(3, 3.0)
    rays = directions(pose, points) + rng.normal(0, 3e-5, (60, 3))
    wrong = rng.choice(60, int(60 * share), replace=False)
    rays[wrong] += rng.normal(0, 0.05, (len(wrong), 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    fit = poses_of(rays, points)[0]
    assert off(fit, pose)[0] < 3e-4
    assert not fit.used[wrong].any()
    good = np.setdiff1d(np.arange(60), wrong)
    assert fit.used[good].mean() > 0.95
    # without it the pose follows them
    plain = poses_of(rays, points, robust=False)[0]
    assert off(plain, pose)[0] > 5 * off(fit, pose)[0]


def test_rays_that_are_not_there_count_as_unused():
    points = plane()
    pose = Pose(Rotation.from_rotvec([0.4, 0.1, 0]).as_matrix(), [0, 0, 1.5])
    rays = directions(pose, points)
    rays[[2, 7]] = np.nan
    fit = poses_of(rays, points)[0]
    assert not fit.used[[2, 7]].any()
    assert off(fit, pose)[0] < 1e-6
    assert poses_of(rays[:4], points[:4]) == ()


def test_homography_of_a_perspective_map():
    """x' = (2x + 1) / (0.5y + 1), y' = (y - 1) / (0.5y + 1), written down."""
    h = np.array([[2, 0, 1], [0, 1, -1], [0, 0.5, 1.0]])
    at = plane()[:, :2]
    image = np.column_stack([2 * at[:, 0] + 1, at[:, 1] - 1]) / (0.5 * at[:, 1:] + 1)
    found = homography(at, image)
    np.testing.assert_allclose(found / found[2, 2], h, atol=1e-9)


def test_plane_of_a_plane():
    turn = Rotation.from_rotvec([0.3, -0.8, 0.2]).as_matrix()
    middle, axes, relief = plane_of(plane() @ turn.T + [1, 2, 3])
    np.testing.assert_allclose(abs(axes[:, 2] @ turn[:, 2]), 1, atol=1e-12)
    np.testing.assert_allclose(middle, turn @ [0.2, 0.15, 0] + [1, 2, 3], atol=1e-12)
    assert relief < 1e-12
    assert np.linalg.det(axes) == pytest.approx(1)
