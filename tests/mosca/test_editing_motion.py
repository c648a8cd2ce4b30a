"""Operations on motions: hand numbers, closed forms, and what holds of any body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.motion.motion import Motion, Skeleton, forward_kinematics
from mosca.editing.edit_file import MOTION_OPERATIONS, read_motion_edits
from mosca.editing.foot_lock import FootLock
from mosca.editing.motion_operations import FilterMotion, RotateJoint, TrimMotion
from mosca.editing.operation import EditError, RotationKeyframe
from mosca.editing.retarget import Retarget, retargeted
from mosca.errors import InputError

RATE = 100.0
NAMES = ("hip", "lThigh", "lShin", "lFoot", "lToe", "rThigh", "rShin", "rFoot", "rToe")
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)


def body(thigh=0.45, shin=0.4, toe=0.15, width=0.1):
    legs = [(s * width, 0, 0) if k == 0 else o for s in (1, -1) for k, o in enumerate(
        [None, (0, 0, -thigh), (0, 0, -shin), (0, -toe, -0.05)]
    )]  # fmt: skip
    return Skeleton(NAMES, np.array(PARENTS), np.array([(0, 0, 0), *legs], float))


def quaternions(x_rad):
    return np.stack([np.cos(x_rad / 2), np.sin(x_rad / 2), 0 * x_rad, 0 * x_rad], axis=-1)


def walk(t=200, skeleton=None):
    """A made-up walk along -y: legs swing about x, knees bend, the pelvis rises and falls."""
    s = np.arange(t) / RATE
    rotations = np.zeros((t, 9, 4))
    rotations[..., 0] = 1.0
    for thigh, shift in ((1, 0.0), (5, np.pi)):
        rotations[:, thigh] = quaternions(-0.2 - 0.4 * np.sin(2 * np.pi * s + shift))
        rotations[:, thigh + 1] = quaternions(0.8 + 0.3 * np.sin(2 * np.pi * s + shift + 1.0))
    root = np.stack([0.02 * np.sin(2 * np.pi * s), -0.5 * s, 0.85 + 0.02 * np.sin(4 * np.pi * s)], axis=1)
    return Motion(skeleton or body(), RATE, root, rotations)


def joint(motion, name):
    return forward_kinematics(motion)[0][:, motion.skeleton.index(name)]


def test_trim_and_filter():
    take = walk()
    part = TrimMotion((50, 99)).apply(take)
    np.testing.assert_array_equal(part.rotations, take.rotations[50:100])
    np.testing.assert_array_equal(part.root_xyz, take.root_xyz[50:100])
    shaken = take.rotations[:, 1] + np.random.default_rng(0).normal(0, 0.01, (200, 4))
    rotations = np.array(take.rotations)
    rotations[:, 1] = shaken / np.linalg.norm(shaken, axis=1, keepdims=True)
    done = FilterMotion(8.0, ("lThigh",)).apply(Motion(take.skeleton, RATE, take.root_xyz, rotations))
    np.testing.assert_allclose(np.linalg.norm(done.rotations, axis=2), 1, atol=1e-12)
    off = [np.abs(one - take.rotations[:, 1])[10:-10].std() for one in (rotations[:, 1], done.rotations[:, 1])]
    assert off[1] < 0.6 * off[0]
    np.testing.assert_array_equal(done.rotations[:, 2:], take.rotations[:, 2:])
    np.testing.assert_array_equal(done.root_xyz, take.root_xyz)
    assert np.any(FilterMotion(8.0).apply(take).root_xyz != take.root_xyz)


def test_a_joint_turns_about_its_own_axes_by_the_blend():
    take = walk()
    keys = (RotationKeyframe(50, (0, 0, 0)), RotationKeyframe(90, (0, 30, 0)), RotationKeyframe(130, (0, 0, 0)))
    done = RotateJoint("lShin", keys).apply(take)
    for frame, degrees in ((90, 30.0), (70, 15.0), (100, 30 * (1 - 3 / 16 + 2 / 64)), (20, 0.0)):
        a, b = (Rotation.from_quat(m.rotations[frame, 2][[1, 2, 3, 0]]) for m in (take, done))
        np.testing.assert_allclose(np.rad2deg((a.inv() * b).as_rotvec()), [0, degrees, 0], atol=1e-9)
    still = np.r_[0:51, 130:200]
    np.testing.assert_array_equal(done.rotations[still], take.rotations[still])
    np.testing.assert_array_equal(joint(done, "lShin"), joint(take, "lShin"))


def test_a_locked_foot_stands_and_only_its_leg_changes():
    take = walk()
    before, after = take, FootLock(("lThigh", "lShin", "lFoot"), contacts=((60, 90),), blend_s=0.1).apply(take)
    a, b = joint(before, "lFoot"), joint(after, "lFoot")
    speed = np.linalg.norm(np.gradient(a, axis=0), axis=1)
    place = a[60 + np.argmin(speed[60:91])]
    np.testing.assert_allclose(b[60:91], np.tile(place, (31, 1)), atol=1e-9)
    assert np.ptp(a[60:91], axis=0).max() > 0.02  # control: it slid
    untouched = np.r_[0:50, 101:200]
    np.testing.assert_array_equal(after.rotations[untouched], take.rotations[untouched])
    others = [k for k in range(9) if k not in (1, 2, 3)]
    np.testing.assert_array_equal(after.rotations[:, others], take.rotations[:, others])
    np.testing.assert_array_equal(after.root_xyz, take.root_xyz)
    # outside it the corrections at its two ends fade: half of them after half of the 11 steps, none is larger
    for end, step in ((60, -1), (90, 1)):
        fading = [np.linalg.norm((b - a)[end + step * k]) / np.linalg.norm((b - a)[end]) for k in range(12)]
        np.testing.assert_allclose(fading, [1 - 3 * (k / 11) ** 2 + 2 * (k / 11) ** 3 for k in range(12)], atol=1e-6)
    foot = [forward_kinematics(m)[1][:, 3] for m in (before, after)]
    np.testing.assert_allclose(foot[0], foot[1], atol=1e-9)  # its direction in the world
    np.testing.assert_allclose(np.linalg.norm(after.rotations, axis=2), 1, atol=1e-9)
    assert np.sum(after.rotations[1:] * after.rotations[:-1], axis=2).min() > 0.9


def test_the_knee_bends_in_its_own_plane():
    """Hip, knee and ankle move in the y z plane alone: after a lock whose place is in it, they still do."""
    take = walk()
    flat = Motion(take.skeleton, RATE, take.root_xyz * [0, 1, 1], take.rotations)
    locked = FootLock(("lThigh", "lShin", "lFoot"), contacts=((60, 90),)).apply(flat)
    for name in ("lThigh", "lShin", "lFoot"):
        np.testing.assert_allclose(joint(locked, name)[:, 0], 0.1, atol=1e-9)
    knee = [2 * np.arctan2(m.rotations[:, 2, 1], m.rotations[:, 2, 0]) for m in (flat, locked)]
    assert (knee[1][60:91] > 0).all()  # it never bends the other way
    assert np.abs(knee[1] - knee[0]).max() > 0.01


def test_contacts_are_found_where_the_foot_is_slow():
    take, leg = walk(), ("lThigh", "lShin", "lFoot")
    speed = np.linalg.norm(np.gradient(joint(take, "lFoot"), axis=0), axis=1) * RATE
    changed = [
        np.any(
            FootLock(leg, still_mps=still, shortest_s=0.04, blend_s=0.0).apply(take).rotations != take.rotations,
            (1, 2),
        )
        for still in (None, 0.8)
    ]
    assert changed[0].any()
    assert speed[changed[0]].max() < 0.25 * np.quantile(speed, 0.95)
    assert changed[1].sum() > changed[0].sum()
    assert speed[changed[1]].max() < 0.8


@pytest.mark.parametrize("scale", [1.0, 1.2, 0.7])
def test_a_scaled_body_walks_the_scaled_way(scale):
    take = walk()
    other = body(0.45 * scale, 0.4 * scale, 0.15 * scale, 0.1 * scale)
    other = Skeleton(NAMES, np.array(PARENTS), take.skeleton.offsets * scale)
    done = retargeted(take, other, ("lFoot", "rFoot"), {})
    floor = np.array([0, 0, min(joint(take, n)[:, 2].min() for n in ("lFoot", "rFoot", "lToe", "rToe"))])
    np.testing.assert_allclose(
        forward_kinematics(done)[0], floor + scale * (forward_kinematics(take)[0] - floor), atol=1e-12
    )


def test_feet_of_another_body_stand_on_the_floor_when_ours_do():
    take = walk()
    other = body(0.5, 0.3, 0.25, 0.2)
    renamed = Skeleton(tuple(f"x_{n}" for n in NAMES), other.parents, other.offsets)
    done = retargeted(take, renamed, ("lFoot", "rFoot"), {f"x_{n}": n for n in NAMES})
    low = [
        np.min([joint(m, p + n)[:, 2] for n in ("lFoot", "rFoot", "lToe", "rToe")], axis=0)
        for m, p in ((take, ""), (done, "x_"))
    ]
    np.testing.assert_allclose(low[1] - low[0].min(), (0.8 / 0.85) * (low[0] - low[0].min()), atol=1e-12)
    np.testing.assert_array_equal(done.rotations, take.rotations)


LEG = ("lThigh", "lShin", "lFoot")


@pytest.mark.parametrize(
    ("operation", "key", "told"),
    [
        (TrimMotion((0, 200)), "frames", "[0, 200] given; a first and a last frame from 0 to 199 are wanted"),
        (FilterMotion(8.0, ("lShinn",)), "joints", "'lShinn' given; there is no such joint; did you mean 'lShin'"),
        (FilterMotion(60.0), "cutoff_hz", "60 given; from 0.233 to below 50"),
        (RotateJoint("arm", (RotationKeyframe(0, (0, 0, 0)),)), "joint", "'arm' given; there is no such joint"),
        (RotateJoint("hip", (RotationKeyframe(900, (0, 0, 0)),)), "keyframes", "frame 900 given"),
        (FootLock(("lThigh", "lFoot", "lShin")), "leg", "hip, knee and ankle, each the parent of the next"),
        (FootLock(LEG, contacts=((60, 260),)), "contacts", "[60, 260] given; a first and a last frame from 0 to 199"),
        (FootLock(LEG, contacts=((60, 70), (70, 80))), "contacts", "[70, 80] given; it overlaps"),
        (FootLock(LEG, contacts=((0, 199),)), "contacts", "mm too short in it; a shorter contact is wanted"),
        (FootLock(LEG, still_mps=1e-6), "still_mps", "1e-06 taken; 'lFoot' is never slower"),
    ],
)
def test_what_cannot_be_done_names_key_and_value(operation, key, told):
    with pytest.raises(EditError) as error:
        operation.apply(walk())
    assert (error.value.key, told in str(error.value)) == (key, True), str(error.value)


def test_a_skeleton_without_a_counterpart_is_refused(tmp_path):
    other = Skeleton(tuple(f"x_{n}" for n in NAMES), body().parents, body().offsets)
    for joints, told in (({}, "'lFoot' has no counterpart"), ({"x_hip": "hipp"}, "did you mean 'hip'")):
        with pytest.raises(EditError, match=told):
            retargeted(walk(), other, ("lFoot",), joints)
    (tmp_path / "e.toml").write_text("[[edit]]\nretarget = { skeleton = 'none.bvh', feet = ['lFoot'] }\n")
    with pytest.raises(InputError, match=r"none\.bvh: no such file"):
        read_motion_edits(tmp_path / "e.toml").states(walk())


def test_every_operation_is_a_frozen_value():
    assert Retarget in MOTION_OPERATIONS.values()
    for operation in MOTION_OPERATIONS.values():
        assert operation.__dataclass_params__.frozen
