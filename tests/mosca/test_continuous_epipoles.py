"""Fundamental and essential matrices with observed epipoles, against closed forms and OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.continuous.comparison_methods.epipoles import (
    TooFewPointsError,
    distances_along,
    essential,
    fundamental,
    poses_of_essential,
    relative_pose,
)
from mosca.data.rig import Pose

WHICH = ["none", "first", "second", "both"]


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def noisy(rng, sigma, *rays):
    return [unit(one + rng.normal(0, sigma, one.shape)) for one in rays]


def scene(seed):
    """Two cameras in any attitude amid points on all sides: epipoles and rays beyond 90 degrees are the rule."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    base = unit(rng.normal(size=3))
    xyz = rng.normal(0, 2, (20, 3))
    other = xyz @ turn.T + base
    return Pose(turn, base), unit(xyz), unit(other), -turn.T @ base, base


def given_epipoles(which, epipole, other):
    return {
        "epipole": epipole if which in ("first", "both") else None,
        "other": other if which in ("second", "both") else None,
    }


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(WHICH))
def test_exact_rays_give_the_pose(seed, which):
    pose, a, b, e, e2 = scene(seed)
    found = relative_pose(a, b, **given_epipoles(which, e, e2))
    # points near the base make the linear solution ill-conditioned, not wrong
    assert np.abs(found.rotation - pose.rotation).max() < 1e-6
    assert np.abs(found.translation - pose.translation).max() < 1e-6


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(WHICH))
def test_observed_epipoles_hold_exactly_under_noise(seed, which):
    _, a, b, e, e2 = scene(seed)
    rng = np.random.default_rng(seed + 1)
    a, b = noisy(rng, 0.01, a, b)
    chosen = given_epipoles(which, e, e2)
    for matrix in (fundamental(a, b, **chosen), essential(a, b, **chosen)):
        if chosen["epipole"] is not None:
            assert np.abs(matrix @ e).max() < 1e-12  # eq. 5
        if chosen["other"] is not None:
            assert np.abs(matrix.T @ e2).max() < 1e-12  # eq. 6
        assert abs(np.linalg.det(matrix)) < 1e-12
    sizes = np.linalg.svd(essential(a, b, **chosen))[1]
    assert sizes == pytest.approx([1, 1, 0], abs=1e-12)


def pinhole_pair(seed):
    rng = np.random.default_rng(seed)
    k = np.array([[400.0, 0, 320], [0, 420, 240], [0, 0, 1]])
    turn = Rotation.from_rotvec([0.1, -0.4, 0.05]).as_matrix()
    move = np.array([1.0, 0.1, 0.2])
    xyz = rng.uniform([-2, -2, 4], [2, 2, 9], (30, 3))
    images = []
    for v in (xyz, xyz @ turn.T + move):
        p = v @ k.T
        images.append(p[:, :2] / p[:, 2:])
    return k, Pose(turn, move / np.linalg.norm(move)), images


def homogeneous(xy):
    return np.column_stack([xy, np.ones(len(xy))])


def test_fundamental_agrees_with_opencv():
    k, _, (a, b) = pinhole_pair(1)
    theirs = cv2.findFundamentalMat(a, b, cv2.FM_8POINT)[0]
    inverse = np.linalg.inv(k)
    # bearings of pixels are as good as any: F = K^-T E K^-1
    rays = [homogeneous(one) @ inverse.T for one in (a, b)]
    ours = inverse.T @ fundamental(*rays) @ inverse
    ours /= ours[2, 2]
    assert ours == pytest.approx(theirs / theirs[2, 2], rel=1e-4, abs=1e-9)


def test_pose_agrees_with_opencv():
    k, pose, (a, b) = pinhole_pair(2)
    matrix = cv2.findEssentialMat(a, b, k, method=cv2.LMEDS)[0]
    _, turn, move, _ = cv2.recoverPose(matrix, a, b, k)
    inverse = np.linalg.inv(k)
    found = relative_pose(*(unit(homogeneous(one) @ inverse.T) for one in (a, b)))
    assert found.rotation == pytest.approx(turn, abs=1e-5)
    assert found.translation == pytest.approx(move.ravel(), abs=1e-5)
    assert found.rotation == pytest.approx(pose.rotation, abs=1e-8)


def test_four_poses_are_opencvs():
    matrix = essential(*scene(3)[1:3])
    one, two, move = cv2.decomposeEssentialMat(matrix)
    ours = poses_of_essential(matrix)
    for turn in (one, two):
        for sign in (1, -1):
            assert any(
                np.allclose(p.rotation, turn, atol=1e-9)
                and np.allclose(p.translation, sign * move.ravel(), atol=1e-9)
                for p in ours
            )


def test_epipoles_help_under_noise():
    """A body of 1 m between two cameras 3 m from it, median of 40: both epipoles halve the pose's error."""
    errors = {which: [] for which in WHICH}
    for seed in range(40):
        rng = np.random.default_rng(seed + 500)
        turn = Rotation.from_rotvec([0.0, -2.0, 0.1]).as_matrix()
        base = np.array([0.0, 0.0, 3.0]) - turn @ [0.0, 0.0, 3.0]
        xyz = rng.uniform(-0.5, 0.5, (25, 3)) + [0, 0, 3]
        a, b = unit(xyz), unit(xyz @ turn.T + base)
        base = unit(base)
        pose, e, e2 = Pose(turn, base), -turn.T @ base, base
        a, b, e, e2 = noisy(rng, 0.005, a, b, e, e2)
        for which in WHICH:
            found = relative_pose(a, b, **given_epipoles(which, e, e2))
            turned, moved = found.rotation - pose.rotation, found.translation - pose.translation
            errors[which].append(np.linalg.norm(turned) + np.linalg.norm(moved))
    median = {which: np.median(values) for which, values in errors.items()}
    assert median["both"] < 0.5 * median["none"]
    assert median["both"] < median["first"] < median["none"]


def test_swapped_epipoles_do_not_fit():
    """Control: each view given the other's epipole, the rays no longer meet."""
    misfits, fits = [], []
    for seed in range(20):
        _, a, b, e, e2 = scene(seed)
        wrong, right = essential(a, b, e2, e), essential(a, b, e, e2)
        for matrix, errors in ((wrong, misfits), (right, fits)):
            errors.append(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", b, matrix, a) ** 2)))
    assert np.median(misfits) > 0.05
    assert max(fits) < 1e-9


@pytest.mark.parametrize(("which", "enough"), [("none", 8), ("first", 5), ("second", 5), ("both", 3)])
def test_fewest_points(which, enough):
    _, a, b, e, e2 = scene(7)
    chosen = given_epipoles(which, e, e2)
    matrix = fundamental(a[:enough], b[:enough], **chosen)
    assert np.abs(np.einsum("ni,ij,nj->n", b, matrix, a)).max() < 1e-8
    with pytest.raises(TooFewPointsError, match=f"{enough - 1} corresponding points"):
        fundamental(a[: enough - 1], b[: enough - 1], **chosen)


def test_two_points_and_both_epipoles_are_a_pose():
    pose, a, b, e, e2 = scene(11)
    assert relative_pose(a[:2], b[:2], e, e2).rotation == pytest.approx(pose.rotation, abs=1e-9)
    with pytest.raises(TooFewPointsError):
        essential(a[:1], b[:1], e, e2)


def test_distances_along_rays():
    turn = Rotation.from_rotvec([0, 0.3, 0]).as_matrix()
    pose = Pose(turn, np.array([1.0, 0, 0]))
    xyz = np.array([[0.5, 0.2, 3.0], [-1.0, 0.4, -2.0]])
    other = pose.transform(xyz)
    s, r = distances_along(pose, unit(xyz), unit(other))
    assert s == pytest.approx(np.linalg.norm(xyz, axis=1))
    assert r == pytest.approx(np.linalg.norm(other, axis=1))
