"""True joints of the actor: the walk's formulas, the definitions read off its markers, axes of hinges, the file."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.joint_motion import JOINTS
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.motion import forward_kinematics
from mosca.data.truth import JointTruth, Truth, read_truth, write_truth
from mosca.errors import InputError
from twin.scenes.actor import build_actor
from twin.scenes.actor_joints import flexion_axis
from twin.scenes.scene import Scene
from twin.truth_log import PulseLog, joints_at, truth_of

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"
CENTER, SIZE = np.array([0.0, 0.0, 1.25]), np.array([2.5, 2.5, 2.5])
ANATOMICAL = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Columns: forward (-y), up, right (-x) of someone who faces -y."""


def actor(**settings: Any) -> Scene:
    wanted = {"duration_s": 2.0, "box_center_m": CENTER, "box_size_m": SIZE, "rng": np.random.default_rng(4)}
    return build_actor(**{**wanted, **settings})


def joints_of(scene: Scene, times: Array) -> JointTruth:
    joints = joints_at(scene, times)
    assert joints is not None
    return joints


def rotation(joints: JointTruth, name: str) -> Rotation:
    return Rotation.from_quat(joints.rotation[:, joints.names.index(name)], scalar_first=True)


def centre(joints: JointTruth, name: str) -> Array:
    return np.asarray(joints.centre[:, joints.names.index(name)])


def test_a_walkers_hips_and_knees_turn_as_its_formulas_say() -> None:
    """Formulas of ``gait.py`` by hand, at 1 m/s: 0.85 strides/s, legs of 0.491 of 1.75 m."""
    times = np.linspace(0.0, 2.0, 23)
    joints = joints_of(actor(gait="circle", speed_mps=1.0), times)
    phase = 2 * np.pi * 0.85 * times + np.random.default_rng(4).uniform(0, 2 * np.pi, 2)[0]
    swing = np.arcsin(1.0 / (4 * 0.85 * 0.491 * 1.75))
    for side, own, mirror in (("l", phase, 1.0), ("r", phase + np.pi, -1.0)):
        flexion = 0.12 + (0.45 + swing) * ((1 - np.sin(own)) / 2) ** 2
        turned = rotation(joints, f"{side}_knee").as_rotvec()
        np.testing.assert_allclose(turned, np.outer(-flexion, [0, 0, 1]), atol=1e-6)
        hip = swing * np.cos(own) + 0.06
        at_rest = Rotation.from_euler("XY", np.stack([-hip, np.full_like(hip, -0.02 * mirror)], axis=1)).as_matrix()
        expected = ANATOMICAL.T @ at_rest @ ANATOMICAL
        np.testing.assert_allclose(rotation(joints, f"{side}_hip").as_matrix(), expected, atol=1e-6)
        assert (rotation(joints, f"{side}_hip").as_rotvec()[:, 2] * hip > 0).all()  # flexion to the front is +z
        # at rest the palms look down: pronated by 90 degrees from the anatomical position
        bent = Rotation.from_euler("Z", (0.35 - 0.25 * np.cos(own))[:, None]) * Rotation.from_euler(
            "Y", -90 * mirror, True
        )
        np.testing.assert_allclose(rotation(joints, f"{side}_elbow").as_matrix(), bent.as_matrix(), atol=1e-6)


def axes(first: Array, second: Array, order: str) -> Array:
    """Return axes (t, 3, 3) with ``order[0]`` along ``first`` and ``order[1]`` nearest to ``second`` (t, 3)."""
    one = first / np.linalg.norm(first, axis=1, keepdims=True)
    two = second - np.sum(second * one, axis=1, keepdims=True) * one
    two = two / np.linalg.norm(two, axis=1, keepdims=True)
    columns = {order[0]: one, order[1]: two}
    third = next(c for c in "xyz" if c not in order)
    before, after = {"x": ("y", "z"), "y": ("z", "x"), "z": ("x", "y")}[third]
    columns[third] = np.cross(columns[before], columns[after])
    return np.asarray(np.stack([columns[c] for c in "xyz"], axis=-1))


def test_rotations_are_those_of_frames_laid_through_markers_and_joints() -> None:
    """Bones are rigid and the skin is still: the definitions can be read off the scene at every instant."""
    scene = actor(action="boxing", duration_s=3.0)
    times = np.linspace(0.0, 3.0, 31)
    joints, sampler = joints_of(scene, times), scene.sampler()
    marker, body = [], []
    for t in times:
        marker.append(sampler.at(t).marker_xyz)
        body.append(sampler.data.xmat.reshape(-1, 3, 3).copy())
    xyz = dict(zip(scene.marker_names, np.moveaxis(np.array(marker), 1, 0), strict=True))
    world = {scene.model.body(b).name: np.array(body)[:, b] for b in range(scene.model.nbody)}

    def mid(*names: str) -> Array:
        return np.asarray(np.mean([xyz[name] for name in names], axis=0))

    found: dict[str, Array] = {
        "pelvis": axes(xyz["RASI"] - xyz["LASI"], mid("LASI", "RASI") - mid("LPSI", "RPSI"), "zx")
    }
    low, high = mid("STRN", "T10"), mid("CLAV", "C7")
    found["thorax"] = axes(high - low, np.cross(xyz["CLAV"] - low, xyz["C7"] - low), "yz")
    found["head"] = axes(mid("LFHD", "RFHD") - mid("LBHD", "RBHD"), mid("RFHD", "RBHD") - mid("LFHD", "LBHD"), "xz")
    pairs = {"lumbar": ("pelvis", "thorax"), "neck": ("thorax", "head")}
    for side, right in (("l", -1.0), ("r", 1.0)):
        at = {
            name: centre(joints, f"{side}_{name}") for name in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
        }
        m = {name: xyz[side.upper() + name] for name in ("HEE", "TOE", "MT5", "WRA", "WRB", "FIN", "PNK")}
        found[f"{side}thigh"] = axes(at["hip"] - at["knee"], world[f"{side}femur"][..., 0] * -1.0, "yz")
        found[f"{side}shank"] = axes(at["knee"] - at["ankle"], world[f"{side}tibia"][..., 0] * -1.0, "yz")
        foot = m["TOE"] - m["HEE"]
        found[f"{side}foot"] = axes(foot, right * (m["MT5"] - m["TOE"]), "xz")
        found[f"{side}arm"] = axes(at["shoulder"] - at["elbow"], right * world[f"{side}humerus"][..., 2], "yz")
        found[f"{side}forearm"] = axes(at["elbow"] - at["wrist"], right * (m["WRA"] - m["WRB"]), "yz")
        found[f"{side}hand"] = axes(at["wrist"] - (m["FIN"] + m["PNK"]) / 2, right * (m["FIN"] - m["PNK"]), "yz")
        pairs |= {
            f"{side}_hip": ("pelvis", f"{side}thigh"),
            f"{side}_knee": (f"{side}thigh", f"{side}shank"),
            f"{side}_ankle": (f"{side}shank", f"{side}foot"),
            f"{side}_shoulder": ("thorax", f"{side}arm"),
            f"{side}_elbow": (f"{side}arm", f"{side}forearm"),
            f"{side}_wrist": (f"{side}forearm", f"{side}hand"),
        }
    assert joints.names == JOINTS
    np.testing.assert_allclose(rotation(joints, "pelvis").as_matrix(), found["pelvis"], atol=1e-9)
    for name, (near, far) in pairs.items():
        expected = np.swapaxes(found[near], -1, -2) @ found[far]
        np.testing.assert_allclose(rotation(joints, name).as_matrix(), expected, atol=1e-9, err_msg=name)
    hips = (centre(joints, "l_hip") + centre(joints, "r_hip")) / 2
    np.testing.assert_allclose(centre(joints, "pelvis"), hips, atol=1e-12)
    assert np.isnan(centre(joints, "lumbar")).all()
    assert np.isnan(centre(joints, "neck")).all()
    assert (joints.rotation[..., 0] >= 0).all()
    for side in "lr":  # elbows flex about +z, knees about -z
        assert (rotation(joints, f"{side}_knee").as_rotvec()[:, 2] < 0).all()
        assert (rotation(joints, f"{side}_elbow").as_euler("ZXY")[:, 0] > 0).all()


def test_what_landmarks_do_not_tell_is_not_a_number() -> None:
    joints = joints_of(actor(markers=30), np.array([0.0]))
    unknown = {name for name, wxyz in zip(joints.names, joints.rotation[0], strict=True) if np.isnan(wxyz).any()}
    assert unknown == {
        f"{side}_{joint}" for side in "lr" for joint in ("elbow", "wrist", "ankle")
    }  # no WRB, PNK, MT5
    assert np.isfinite(centre(joints, "l_elbow")).all()


@given(st.integers(0, 10**6), st.floats(0.35, 1.5), st.booleans())
def test_the_axis_of_a_hinge_is_found_from_its_rotations(seed: int, bend: float, flexed: bool) -> None:
    """200 angles from 0 to 2 ``bend``, with noise of 0.5 degrees about all axes."""
    rng = np.random.default_rng(seed)
    near = rng.normal(size=3)
    near /= np.linalg.norm(near)
    sign = 1.0 if flexed else -1.0
    turns = Rotation.from_rotvec(np.outer(sign * rng.uniform(0.0, 2 * bend, 200), near))
    noisy = turns * Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(0.5), (200, 3)))
    for axis in flexion_axis(noisy.as_matrix(), flexed=flexed):
        assert np.rad2deg(np.arccos(np.minimum(axis @ near, 1.0))) < 1.5


def test_a_joint_that_is_held_tells_no_axis() -> None:
    """Spread of 9.8 and 10.2 degrees rms about the axis, evenly, so that 1 - cos holds to its square."""
    for spread_deg, known in ((9.5, False), (10.5, True)):
        angles = np.deg2rad(spread_deg) * np.array([-1.0, 1.0]) + 0.5
        axis, _ = flexion_axis(Rotation.from_rotvec(np.outer(angles, [0, 0, 1.0])).as_matrix(), flexed=True)
        np.testing.assert_allclose(axis, [0, 0, 1] if known else [np.nan] * 3, atol=1e-9)


@pytest.mark.data
def test_a_recordings_knees_are_hinges_and_its_joints_where_the_reader_has_them() -> None:
    """CMU's skeletons give knee and elbow one axis each, in the file; it is found again without being told."""
    files = DATA / "asfamc/02/02_01.amc", DATA / "asfamc/02/02.asf"
    if not files[0].exists():
        pytest.skip("02_01.amc is not in MOSCA_DATA")
    scene = actor(
        motion_file=files[0], skeleton_file=files[1], placement="file", keep_in_box=False, box_size_m=2 * SIZE,
        start_s=0.0, duration_s=2.7,
    )  # fmt: skip
    motion = read_asf_amc(files[1], files[0])
    frames = np.arange(0, 320, 8)
    joints = joints_of(scene, frames / motion.frame_rate_hz)
    positions, _ = forward_kinematics(motion)
    for name, bone in (
        ("hip", "femur"),
        ("knee", "tibia"),
        ("ankle", "foot"),
        ("elbow", "radius"),
        ("wrist", "hand"),
    ):
        where = positions[frames, motion.skeleton.index(f"l{bone}")]
        np.testing.assert_allclose(centre(joints, f"l_{name}"), where, atol=1e-6)
    sampler = scene.sampler()
    marker = np.array([sampler.at(float(k / motion.frame_rate_hz)).marker_xyz for k in frames])
    xyz = dict(zip(scene.marker_names, np.moveaxis(marker, 1, 0), strict=True))
    for side, right in (("l", -1.0), ("r", 1.0)):
        m = {name: xyz[side.upper() + name] for name in ("WRA", "WRB", "FIN", "PNK")}
        elbow, wrist = centre(joints, f"{side}_elbow"), centre(joints, f"{side}_wrist")
        forearm = axes(elbow - wrist, right * (m["WRA"] - m["WRB"]), "yz")
        hand = axes(wrist - (m["FIN"] + m["PNK"]) / 2, right * (m["FIN"] - m["PNK"]), "yz")
        expected = np.swapaxes(forearm, -1, -2) @ hand
        np.testing.assert_allclose(rotation(joints, f"{side}_wrist").as_matrix(), expected, atol=1e-9)
        turned = rotation(joints, f"{side}_knee").as_rotvec()
        assert np.abs(turned[:, :2] - turned[0, :2]).max() < np.deg2rad(2.0)
        assert np.ptp(turned[:, 2]) > np.deg2rad(40.0)


# the file


def _truth() -> Truth:
    scene = actor()
    times = (0.0, 0.01, 0.02)
    return truth_of([PulseLog(t, scene.sampler().at(t).marker_xyz, ()) for t in times], (), scene)


def test_the_twins_truth_has_joints_at_the_pulses_and_its_file_keeps_them(tmp_path: Path) -> None:
    truth = _truth()
    write_truth(truth, tmp_path / "truth.npz")
    again = read_truth(tmp_path / "truth.npz").joints
    expected = joints_of(actor(), np.array([0.0, 0.01, 0.02]))
    assert again is not None
    assert again.names == expected.names == JOINTS
    np.testing.assert_array_equal(again.centre, expected.centre)
    np.testing.assert_array_equal(again.rotation, expected.rotation)
    write_truth(replace(truth, joints=None), tmp_path / "none.npz")
    assert read_truth(tmp_path / "none.npz").joints is None


def test_joints_that_do_not_fit_their_truth_are_refused(tmp_path: Path) -> None:
    truth = _truth()
    assert truth.joints is not None
    short = JointTruth(truth.joints.names, truth.joints.centre[:2], truth.joints.rotation[:2])
    with pytest.raises(ValueError, match="joints: 2 instants given for 3 pulses"):
        replace(truth, joints=short)
    with pytest.raises(ValueError, match="joints: 14 names for 15 joints"):
        JointTruth((*JOINTS[:-1], JOINTS[0]), truth.joints.centre, truth.joints.rotation)
    write_truth(truth, tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz") as file:
        arrays = {name: file[name] for name in file.files if name not in ("sha256", "joints.rotation")}
    np.savez_compressed(tmp_path / "part.npz", **arrays)
    with pytest.raises(InputError, match=r"joints\.rotation"):
        read_truth(tmp_path / "part.npz")
