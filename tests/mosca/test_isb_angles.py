"""Joint angles: directions by hand, scipy composes the rotations again, deviations against drawn rotations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_scenes import motion_of
from scipy.spatial.transform import Rotation

from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JOINTS
from mosca.skeleton.isb_angles import CONVENTIONS, UNKNOWN_RAD, isb_angles

FORWARD, UP, RIGHT = np.eye(3)
LEFT, DOWN, BACK = -RIGHT, -UP, -FORWARD
Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The world (Z up) from axes with y up."""


def outward(joint: str) -> np.ndarray:
    return LEFT if joint.startswith("l_") else RIGHT


def of(angles: JointAngles, name: str) -> np.ndarray:
    return angles.angles[:, angles.names.index(name)]


# a quarter of what takes the vector "from" to "to" is positive in the angle; in words of anatomy, no axis named
QUARTERS = [
    ("lumbar_flexion", UP, FORWARD), ("lumbar_bending", UP, RIGHT), ("lumbar_rotation", FORWARD, LEFT),
    ("neck_flexion", UP, FORWARD), ("neck_bending", UP, RIGHT), ("neck_rotation", FORWARD, LEFT),
    ("hip_flexion", DOWN, FORWARD), ("hip_adduction", DOWN, "in"), ("hip_internal_rotation", FORWARD, "in"),
    ("knee_flexion", DOWN, BACK), ("knee_adduction", DOWN, "in"), ("knee_internal_rotation", FORWARD, "in"),
    ("ankle_dorsiflexion", FORWARD, UP), ("ankle_inversion", DOWN, "in"), ("ankle_internal_rotation", FORWARD, "in"),
    ("elbow_flexion", DOWN, FORWARD), ("elbow_adduction", DOWN, "in"), ("elbow_pronation", FORWARD, "in"),
    ("wrist_flexion", DOWN, FORWARD), ("wrist_adduction", DOWN, "in"), ("wrist_pronation", FORWARD, "in"),
    ("shoulder_elevation", DOWN, "out"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "start", "end"), QUARTERS)
def test_senses_by_hand(name: str, start: np.ndarray, end: np.ndarray | str) -> None:
    kind, angle = name.split("_", 1)
    for joint in (one for one in JOINTS if one in (kind, f"l_{kind}", f"r_{kind}")):
        to = {"in": -outward(joint), "out": outward(joint)}[end] if isinstance(end, str) else end
        turn = Rotation.from_rotvec(0.4 * np.cross(start, to)[None])
        angles = isb_angles(motion_of({joint: turn}))
        np.testing.assert_allclose(of(angles, f"{joint}_{angle}"), 0.4, atol=1e-12)
        others = [a for a in angles.names if a != f"{joint}_{angle}"]
        np.testing.assert_allclose([of(angles, a)[0] for a in others], 0, atol=1e-12)


def test_shoulder_by_hand() -> None:
    for joint in ("l_shoulder", "r_shoulder"):
        out = outward(joint)
        abducted = Rotation.from_rotvec(1.2 * np.cross(DOWN, out)[None])
        forward = Rotation.from_rotvec(np.pi / 2 * np.cross(DOWN, FORWARD)[None])
        # turned about its long axis, the front to the middle, then lifted
        turned = abducted * Rotation.from_rotvec(0.3 * np.cross(FORWARD, -out)[None])
        for turn, wanted in (
            (abducted, (0, 1.2, 0)),
            (turned, (0, 1.2, 0.3)),
            (forward, (np.pi / 2, np.pi / 2, None)),
        ):
            angles = isb_angles(motion_of({joint: turn})).angles[0]
            for given_, value in zip(angles, wanted, strict=True):
                assert value is None or given_ == pytest.approx(value, abs=1e-12)


def test_pelvis_by_hand() -> None:
    # who walks towards the world's y: forward is +y, right +x
    heading = np.pi / 2
    stands = Rotation.from_matrix(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]))
    for vector, name in (((-1, 0, 0), "tilt"), ((0, 1, 0), "obliquity"), ((0, 0, 1), "rotation")):
        # about left: the front goes down; about forward: the right side goes down; about up: to the left
        turn = Rotation.from_rotvec(0.2 * np.array([vector]))
        angles = isb_angles(motion_of({"pelvis": turn * stands}), heading_rad=heading)
        wanted = [0.2 if one == f"pelvis_{name}" else 0.0 for one in angles.names]
        np.testing.assert_allclose(angles.angles[0], wanted, atol=1e-12)


def composed(angles: JointAngles, joint: str) -> Rotation:
    """Return the rotation that the angles of a joint describe, by scipy."""
    side, kind = (joint[0], joint[2:]) if joint[1] == "_" else ("", joint)
    rows = sorted((row for row in CONVENTIONS if row.joint == kind), key=lambda row: row.position)
    turns = [of(angles, f"{joint}_{r.name}") * (r.left_sign if side == "l" else r.sign) for r in rows]
    turn = Rotation.from_euler("YXY" if kind == "shoulder" else "ZXY", np.stack(turns, axis=1))
    return Rotation.from_matrix(Y_UP @ turn.as_matrix()) if joint == "pelvis" else turn


@given(seed=st.integers(0, 10**6), joint=st.sampled_from(JOINTS))
def test_angles_give_the_rotation_back(seed: int, joint: str) -> None:
    rotations = Rotation.random(20, random_state=seed)
    angles = isb_angles(motion_of({joint: rotations}))
    assert np.isfinite(angles.angles).all()
    np.testing.assert_allclose((rotations.inv() * composed(angles, joint)).magnitude(), 0, atol=1e-9)


@given(seed=st.integers(0, 10**6), kind=st.sampled_from([one[2:] for one in JOINTS if one[1] == "_"]))
def test_mirrored_motions_have_equal_angles(seed: int, kind: str) -> None:
    right = Rotation.random(10, random_state=seed)
    mirror = np.diag([1.0, 1.0, -1.0])
    left = Rotation.from_matrix(mirror @ right.as_matrix() @ mirror)
    one, other = isb_angles(motion_of({f"r_{kind}": right})), isb_angles(motion_of({f"l_{kind}": left}))
    apart = np.angle(np.exp(1j * (one.angles - other.angles)))
    np.testing.assert_allclose(apart, 0, atol=1e-7)
    assert [n[2:] for n in one.names] == [n[2:] for n in other.names]


@pytest.mark.parametrize(
    ("joint", "middle"),
    [("r_hip", 0.3), ("l_knee", 1.3), ("pelvis", -0.4), ("r_shoulder", -0.35), ("l_shoulder", 2.0)],
)
def test_sigma_against_drawn_rotations(joint: str, middle: float) -> None:
    rng = np.random.default_rng(7)
    sequence = "YXY" if "shoulder" in joint else "ZXY"
    true = Rotation.from_euler(sequence, [[0.5, middle, -0.8]])
    half = np.array([[0.01, 0, 0], [0.004, 0.008, 0], [-0.006, 0.002, 0.012]])
    covariance = half @ half.T
    drawn = true * Rotation.from_rotvec(rng.normal(size=(20_000, 3)) @ half.T)
    if joint == "pelvis":
        turned = [Rotation.from_matrix(Y_UP @ one.as_matrix()) for one in (true, drawn)]
        true, drawn = turned
    sigma = isb_angles(motion_of({joint: true}, covariance)).sigma[0]
    spread = isb_angles(motion_of({joint: drawn})).angles.std(axis=0)
    # 20,000 draws know a deviation to 0.5 %; the second order adds (sigma / distance from singularity)^2 / 2 = 0.4 %
    np.testing.assert_allclose(sigma, spread, rtol=0.03)


def test_singular_positions_are_unknown() -> None:
    covariance = 1e-4 * np.eye(3)
    for elevation in (0.0, 1e-8, 0.004, np.pi - 0.004, np.pi):
        hanging = Rotation.from_euler("YXY", [[0.3, -elevation, 0.2]])
        angles = isb_angles(motion_of({"r_shoulder": hanging}, covariance))
        assert np.isnan(angles.angles[0, [0, 2]]).all()
        assert np.isnan(angles.sigma[0, [0, 2]]).all()
        assert angles.angles[0, 1] == pytest.approx(elevation, abs=1e-7)
        assert angles.sigma[0, 1] == pytest.approx(0.01, rel=1e-6)
    # 1 / sin(elevation): 0.01 rad become 0.1 rad at 0.1 rad, and stay known
    angles = isb_angles(motion_of({"r_shoulder": Rotation.from_euler("YXY", [[0.3, -0.1, 0.2]])}, covariance))
    np.testing.assert_allclose(angles.sigma[0], [0.1, 0.01, 0.1], rtol=0.01)
    np.testing.assert_allclose(angles.angles[0], [0.3, 0.1, 0.2], atol=1e-12)
    beside = Rotation.from_euler("ZXY", [[0.3, np.pi / 2, 0.2], [0.3, 1.4, 0.2]])
    hip = isb_angles(motion_of({"r_hip": beside}, covariance))
    assert np.isnan(hip.angles).tolist() == [[True, False, True], [False, False, False]]
    assert (hip.sigma[1] < UNKNOWN_RAD).all()
    assert hip.angles[0, 1] == pytest.approx(np.pi / 2, abs=1e-7)


def test_angles_run_on() -> None:
    # a pelvis that turns twice round, one frame unknown; 3 degrees a frame
    turns = np.deg2rad(3 * np.arange(240))
    pelvis = Rotation.from_matrix(Y_UP @ Rotation.from_euler("Y", turns[:, None]).as_matrix())
    motion = motion_of({"pelvis": pelvis})
    rotation = motion.rotation.copy()
    rotation[100] = np.nan
    angles = isb_angles(motion_of({"pelvis": pelvis}, rotation=rotation))
    known = np.arange(240) != 100
    np.testing.assert_allclose(of(angles, "pelvis_rotation")[known], turns[known], atol=1e-9)
    assert np.isnan(angles.angles[100]).all()


def test_unknown_covariances_leave_angles_known() -> None:
    angles = isb_angles(motion_of({"r_knee": Rotation.from_euler("Z", [[-0.7]]), "finger": Rotation.identity(1)}))
    assert angles.names == ("r_knee_flexion", "r_knee_adduction", "r_knee_internal_rotation")
    np.testing.assert_allclose(angles.angles, [[0.7, 0, 0]], atol=1e-15)
    assert np.isnan(angles.sigma).all()
    with pytest.raises(ValueError, match="1 names for 2 angles"):
        JointAngles([0], [0], ("a", "a"), np.zeros((1, 2)), np.zeros((1, 2)))
