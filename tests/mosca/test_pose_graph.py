"""Chaining of views: poses joined over common views, and separate groups where there are none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.calibration.initial.pose_graph import chain
from mosca.data.rig import Pose
from mosca.errors import CalibrationError


def some_poses(rng, n) -> list[Pose]:
    return [Pose(Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.uniform(-3, 3, 3)) for _ in range(n)]


def same(one: Pose, other: Pose) -> bool:
    return np.allclose(one.rotation, other.rotation, atol=1e-9) and np.allclose(
        one.translation, other.translation, atol=1e-9
    )


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), cameras=st.integers(1, 6), more=st.integers(0, 8))
def test_exact_views_give_all_poses_back(seed, cameras, more):
    """Stand k joins cameras k and k + 1; any views beside these change nothing."""
    rng = np.random.default_rng(seed)
    world_from_camera, world_from_target = some_poses(rng, cameras), some_poses(rng, cameras)
    pairs = {(k, k) for k in range(cameras)} | {(k + 1, k) for k in range(cameras - 1)}
    pairs |= {(int(rng.integers(cameras)), int(rng.integers(cameras))) for _ in range(more)}
    views = {(c, s): world_from_camera[c].inverse() @ world_from_target[s] for c, s in pairs}
    doubt = {view: float(rng.random()) for view in views}
    reference = int(rng.integers(cameras))
    placed, stands = chain(views, doubt, reference, [f"c{k}" for k in range(cameras)])
    for c, pose in placed.items():
        assert same(pose, world_from_target[reference].inverse() @ world_from_camera[c])
    for s, pose in stands.items():
        assert same(pose, world_from_target[reference].inverse() @ world_from_target[s])
    assert len(placed) == len(stands) == cameras


def test_doubtful_views_are_gone_around():
    rng = np.random.default_rng(1)
    cameras, targets = some_poses(rng, 2), some_poses(rng, 2)
    views = {(c, s): cameras[c].inverse() @ targets[s] for c in (0, 1) for s in (0, 1)}
    wrong = views[1, 0] @ Pose(Rotation.from_rotvec([0, 1.0, 0]).as_matrix(), [0, 0, 0])
    views[1, 0] = wrong
    placed, _ = chain(views, {(0, 0): 0.1, (1, 0): 1.0, (0, 1): 0.1, (1, 1): 0.1}, 0, ["a", "b"])
    assert same(placed[1], targets[0].inverse() @ cameras[1])
    # with the doubt the other way round the wrong one is believed
    placed, _ = chain(views, {(0, 0): 0.1, (1, 0): 0.1, (0, 1): 1.0, (1, 1): 1.0}, 0, ["a", "b"])
    assert not same(placed[1], targets[0].inverse() @ cameras[1])


def test_no_link_names_both_groups():
    pose = Pose(np.eye(3), [0, 0, 1.0])
    views = {(0, 0): pose, (1, 0): pose, (2, 1): pose, (3, 1): pose}
    with pytest.raises(CalibrationError, match="cameras left, top and right, back never saw") as told:
        chain(views, dict.fromkeys(views, 0.1), 0, ["left", "top", "right", "back"])
    assert "\n" not in str(told.value)
    assert told.value.code == "no-link"


def test_a_blind_camera_is_named():
    pose = Pose(np.eye(3), [0, 0, 1.0])
    with pytest.raises(CalibrationError, match="camera 'top': the target was not seen") as told:
        chain({(0, 0): pose}, {(0, 0): 0.1}, 0, ["left", "top"])
    assert "left" not in str(told.value)


def test_stands_that_no_placed_camera_saw_are_left_out():
    pose = Pose(np.eye(3), [0, 0, 1.0])
    placed, stands = chain({(0, 0): pose, (0, 3): pose}, {(0, 0): 0.1, (0, 3): 0.2}, 0, ["a"])
    assert set(placed) == {0}
    assert set(stands) == {0, 3}
