"""Bones on springs against equilibria worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.skeleton.spring_fit import SpringBones

NO_JOINTS = {"parent": [], "child": [], "offset": np.zeros((0, 3)), "joint_stiffness": 1.0}


def test_opposing_springs_hold_a_bone_in_the_middle() -> None:
    """Two markers on one bone, both pushed outward along their line by the same: equal and opposite forces."""
    bones = SpringBones([0, 0], np.array([[-0.1, 0, 0], [0.1, 0, 0]]), **NO_JOINTS)
    assert bones.settle(np.array([[-0.13, 0.0, 0.0], [0.13, 0.0, 0.0]]))
    np.testing.assert_allclose(bones.origin, 0.0, atol=1e-9)
    np.testing.assert_allclose(bones.rotation[0], np.eye(3), atol=1e-9)


def test_one_displaced_marker_of_two_moves_the_bone_halfway() -> None:
    """Marker b is pulled away along the line by 4 cm: the bone follows by 2 cm and keeps its direction."""
    bones = SpringBones([0, 0], np.array([[-0.1, 0, 0], [0.1, 0, 0]]), **NO_JOINTS)
    assert bones.settle(np.array([[-0.1, 0.0, 0.0], [0.14, 0.0, 0.0]]))
    np.testing.assert_allclose(bones.origin[0], [0.02, 0, 0], atol=1e-9)


@pytest.mark.parametrize("angle", [0.3, 2.5])
def test_a_bone_turns_with_its_markers(angle: float) -> None:
    """Four markers turned about z and moved: the torques vanish at that turn, however far it is."""
    rest = 0.2 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0.5], [0, -1, 0]])
    turn = Rotation.from_rotvec([0, 0, angle])
    bones = SpringBones([0] * 4, rest, **NO_JOINTS)
    assert bones.settle(turn.apply(rest) + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(bones.rotation[0], turn.as_matrix(), atol=1e-8)
    np.testing.assert_allclose(bones.origin[0], [1.0, 2.0, 3.0], atol=1e-8)


@pytest.mark.parametrize("joint_stiffness", [0.5, 1.0, 4.0])
def test_three_springs_in_a_row_share_the_stretch(joint_stiffness: float) -> None:
    """Marker, bone, joint, bone, marker along a line, 3 cm too long: springs 1, k, 1 in series.

    The force is 0.03 / (2 + 1/k). The joint opens by force / k. Forces along the line have no lever: nothing turns.
    """
    bones = SpringBones([0, 1], np.zeros((2, 3)), [0], [1], np.array([[0.4, 0, 0]]), joint_stiffness)
    bones.origin[1] = [0.4, 0, 0]
    assert bones.settle(np.array([[0.0, 0.0, 0.0], [0.43, 0.0, 0.0]]))
    force = 0.03 / (2 + 1 / joint_stiffness)
    on_parent, on_child = bones.joint_ends()
    np.testing.assert_allclose(on_child - on_parent, [[force / joint_stiffness, 0, 0]], atol=1e-8)
    np.testing.assert_allclose(bones.origin[:, 0], [force, 0.43 - force], atol=1e-8)


def test_a_bone_without_markers_turns_with_its_parent() -> None:
    rest = 0.2 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0.5], [0, -1, 0]])
    turn = Rotation.from_rotvec([0.4, 0.2, -0.5])
    bones = SpringBones([0] * 4, rest, [0], [1], np.array([[0.0, 0.0, 0.5]]), 1.0)
    bones.origin[1] = [0, 0, 0.5]
    assert bones.settle(turn.apply(rest))
    np.testing.assert_allclose(bones.rotation[1], turn.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(bones.origin[1], turn.apply([0, 0, 0.5]), atol=1e-7)


def test_a_marker_not_seen_pulls_nowhere() -> None:
    rest = 0.2 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0.5], [0, -1, 0]])
    bones = SpringBones([0] * 4, rest, **NO_JOINTS)
    xyz = rest + [0.0, 0.0, 0.1]
    xyz[3] = np.nan
    assert bones.settle(xyz)
    np.testing.assert_allclose(bones.origin[0], [0, 0, 0.1], atol=1e-8)
