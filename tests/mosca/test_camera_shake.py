"""What the shake of cameras does to points that are near each other, against triangulated draws."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import ring

from mosca.camera.projection import project
from mosca.data.rig import MoscaLens, Rig
from mosca.skeleton.marker_frames import common_shift, turned_alike
from mosca.triangulation.camera_shake import LEAST_OWN, shake_covariance, without

LENS = MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01, -0.006, 1e-3, -1.5e-5, 0, 1e-4, 5e-5)
SHAKE_PX = (0.05, 0.08, 0.03, 0.06)


def shaking(shake_px=SHAKE_PX, residual_px=0.0):
    cameras = ring(4, LENS).cameras
    return Rig(tuple(replace(c, shake_px=s, residual_px=residual_px) for c, s in zip(cameras, shake_px, strict=True)))


def by_point(camera, place, step_m=1e-5):
    """Derivatives (2, 3) [px/m] of an image by the point, by central differences of the projection."""
    offsets = step_m * np.eye(3)
    return (project(camera, place + offsets) - project(camera, place - offsets)).T / (2 * step_m)


def test_the_covariance_is_that_of_points_in_images_that_are_shifted():
    rig, rng, place = shaking(residual_px=0.02), np.random.default_rng(1), np.array([[0.1, -0.2, 0.15]])
    (stated,), (images,) = shake_covariance(rig, place)
    assert images == 4
    weights = np.repeat(1 / np.hypot(SHAKE_PX, 0.02), 2)
    slopes = np.concatenate([by_point(camera, place) for camera in rig.cameras])
    draws = 20_000
    shifts = rng.normal(0, 1, (draws, 8)) * np.repeat(SHAKE_PX, 2)
    # shifts of 0.1 px at 3 m are small: least squares is linear in them
    moved = np.linalg.lstsq(weights[:, None] * slopes, (weights * shifts).T, rcond=None)[0].T
    found = np.einsum("ni,nj->ij", moved, moved) / draws
    root = np.linalg.inv(np.linalg.cholesky(stated))
    np.testing.assert_allclose(root @ found @ root.T, np.eye(3), atol=4 * np.sqrt(2 / draws))


def test_without_shake_there_is_none():
    covariance, _ = shake_covariance(shaking((0.0,) * 4), np.zeros((2, 3)))
    assert not covariance.any()
    assert not shake_covariance(Rig(()), np.zeros((2, 3)))[0].any()


def test_a_point_that_one_camera_sees_has_none():
    rig = shaking()
    covariance, images = shake_covariance(Rig(rig.cameras[:1]), np.zeros((1, 3)))
    assert images.tolist() == [1]
    assert not covariance.any()


def test_cameras_in_one_place_tell_no_distance():
    camera = shaking().cameras[0]
    covariance, images = shake_covariance(Rig((camera, replace(camera, name="other"))), np.zeros((1, 3)))
    assert images.tolist() == [2]
    assert not covariance.any()


def test_what_is_taken_off_leaves_a_covariance():
    own = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_allclose(without(own[None], 0.25 * own[None])[0], 0.75 * own, rtol=1e-12)
    # more than there is, along one axis
    left = without(own[None], np.diag([5.0, 0.5, 0.0])[None])[0]
    np.testing.assert_allclose(left, np.diag([LEAST_OWN, 1.5, 3.0]), rtol=1e-12)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 4.0])
def test_a_body_shifts_by_no_more_than_its_markers_errors(share):
    """Neither on the whole nor in any direction; a covariance that is large enough leaves it as it is."""
    rig, middle = shaking(), np.zeros((1, 3))
    (whole,), _ = shake_covariance(rig, middle)
    root, each = np.linalg.cholesky(whole), share * np.array([0.5, 1.0, 1.5])
    stated = root @ np.diag(each) @ root.T
    (shared,), (alike,) = common_shift(rig, middle, np.array([4.0]), stated[None])
    left = min(np.trace(stated) / np.trace(whole), 1.0)
    np.testing.assert_allclose(shared, root @ np.diag(np.minimum(left, each)) @ root.T, rtol=1e-6, atol=1e-20)
    np.testing.assert_allclose(alike, shared)  # all cameras see all markers


@pytest.mark.parametrize(("seen_by", "expected"), [(1.0, 1.0), (0.5, (np.pi / 4 - 1 / np.pi) * 4 / np.pi)])
def test_the_share_that_turns_nothing_where_it_is_known_in_closed_form(seen_by, expected):
    assert turned_alike(np.array([seen_by]))[0] == pytest.approx(expected, abs=1e-4)


def test_the_share_that_turns_nothing_is_that_of_drawn_cameras():
    """Errors along one axis of markers around a body, each the mean of the shakes of the cameras on its side."""
    rng, n, seen_by = np.random.default_rng(2), 72, 2 / 3
    angle = np.arange(n) * 2 * np.pi / n
    apart = np.abs((angle[:, None] - angle + np.pi) % (2 * np.pi) - np.pi)
    sees = apart < np.pi * seen_by
    mean = sees / sees.sum(axis=1, keepdims=True)
    error = rng.normal(size=(4000, n)) @ mean.T
    common, own = np.var(error.mean(axis=1)), np.var(error, axis=0).mean()
    # a turn weights pairs by their squared distance: their differences have 2 (own - share x common)
    weight = np.sin(apart / 2) ** 2
    difference = np.mean((error[:, :, None] - error[:, None, :]) ** 2, axis=0)
    share = (own - 0.5 * (weight * difference).sum() / weight.sum()) / common
    assert turned_alike(np.array([seen_by]))[0] == pytest.approx(share, abs=0.05)
