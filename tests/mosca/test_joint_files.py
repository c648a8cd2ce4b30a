"""Joints and angles in files: CSV to the last bit, OpenSim's files by hand and by OpenSim."""

import contextlib
import csv
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_scenes import motion_of, some_motion
from scipy.spatial.transform import Rotation

from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.errors import InputError
from mosca.formats.joints.angles_csv import read_angles_csv, write_angles_csv
from mosca.formats.joints.centre_tracks import centres_as_tracks
from mosca.formats.joints.joints_csv import read_joints_csv, write_joints_csv
from mosca.formats.joints.opensim import COORDINATES, KNEE_SIGNS, write_mot, write_scale_set
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from mosca.skeleton.isb_angles import CONVENTIONS, isb_angles

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "people" / "gait2354"
MODEL = DATA / "subject01_simbody.osim"


def equal(one: object, other: object) -> None:
    for name in one.__dataclass_fields__:  # type: ignore[attr-defined]
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_joints_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    for motion in (some_motion(), some_motion().select(np.arange(0))):
        write_joints_csv(motion, path)
        again = read_joints_csv(path)
        if len(motion):
            equal(again, motion)
        else:
            assert len(again) == 0


def test_joints_by_hand(tmp_path: Path) -> None:
    spread = np.array([[1.0, 0.4, 0.5], [0.4, 2.0, 0.6], [0.5, 0.6, 3.0]])
    one = JointMotion(
        [7], [8], ("pelvis",), [[[0.1, 0.2, np.nan]]], [[spread]], [[[0.5, 0.5, -0.5, 0.5]]], [[10 * spread]]
    )  # fmt: skip
    write_joints_csv(one, tmp_path / "j.csv")
    with open(tmp_path / "j.csv", newline="", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert (row["frame"], row["time_ns"], row["joint"], row["x_m"], row["z_m"]) == ("7", "8", "pelvis", "0.1", "")
    assert [row[f"s{k}_m2"] for k in ("xx", "yy", "zz", "xy", "xz", "yz")] == [
        "1.0",
        "2.0",
        "3.0",
        "0.4",
        "0.5",
        "0.6",
    ]
    assert [row[f"r{k}_rad2"] for k in ("xx", "yz")] == ["10.0", "6.0"]
    assert [row[k] for k in ("qw", "qx", "qy", "qz")] == ["0.5", "0.5", "-0.5", "0.5"]


@pytest.mark.parametrize(
    ("row", "old", "new", "message"),
    [
        (0, "x_m", "x", r"its first line is not that of a joints\.csv"),
        (1, "pelvis", "neck", "frame 5 names a joint twice"),
        # 15 joints a frame: line 21 is l_knee of frame 6
        (20, "l_knee", "head", "row 21: frame 6 with joint 'head'; wanted is 'l_knee' of frame 6"),
        (20, "6,", "7,", "row 21: frame 7 with joint 'l_knee'; wanted is 'l_knee' of frame 6"),
        (20, ",1790000000010", ",1790000000011", "row 21: frame 6"),
        (16, "pelvis,", "pelvis,inf", "row 17: x_m = 'inf"),
        (16, "pelvis,", "pelvis,inf,", "row 17: 23 values given, 22 wanted"),
    ],
)
def test_faults_of_joints(tmp_path: Path, row: int, old: str, new: str, message: str) -> None:
    path = tmp_path / "joints.csv"
    write_joints_csv(some_motion(), path)
    lines = path.read_text().splitlines()
    assert old in lines[row]
    lines[row] = lines[row].replace(old, new, 1)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=message) as error:
        read_joints_csv(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_frames_rise_and_numbers_are_finite(tmp_path: Path) -> None:
    path, motion = tmp_path / "joints.csv", some_motion()
    write_joints_csv(motion.select(np.array([0, 1, 1])), path)
    with pytest.raises(InputError, match="row 32: frame 6 after 6; frames must rise"):
        read_joints_csv(path)
    centre = motion.centre.copy()
    centre[1, 2, 2] = np.inf
    write_joints_csv(JointMotion(**{**vars(motion), "centre": centre}), path)
    with pytest.raises(InputError, match="row 19: z_m is not finite"):
        read_joints_csv(path)


def test_a_quaternion_has_norm_one_and_files_end_with_a_whole_frame(tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    motion = some_motion()
    write_joints_csv(motion, path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(InputError, match="its last frame has 14 of 15 joints"):
        read_joints_csv(path)
    rotation = motion.rotation.copy()
    rotation[0, 0] *= 1.001
    write_joints_csv(JointMotion(**{**vars(motion), "rotation": rotation}), path)
    with pytest.raises(InputError, match="row 2: qw, qx, qy, qz are no unit quaternion"):
        read_joints_csv(path)


def test_angles_in_degrees_and_back(tmp_path: Path) -> None:
    path = tmp_path / "angles.csv"
    angles = isb_angles(some_motion())
    assert len(angles.names) == 45
    write_angles_csv(angles, path)
    again = read_angles_csv(path)
    assert again.names == angles.names
    np.testing.assert_array_equal(again.frame, angles.frame)
    np.testing.assert_allclose(again.angles, angles.angles, rtol=1e-15)
    np.testing.assert_allclose(again.sigma, angles.sigma, rtol=1e-15)
    one = JointAngles([3], [4], ("l_knee_flexion",), [[np.pi / 3]], [[np.pi / 180]])
    write_angles_csv(one, path)
    head, row = path.read_text().splitlines()
    assert head == "frame,time_ns,l_knee_flexion_deg,l_knee_flexion_sigma_deg"
    np.testing.assert_allclose([float(cell) for cell in row.split(",")], [3, 4, 60, 1], rtol=1e-15)
    path.write_text(f"{head}\n3,4,x,1\n")
    with pytest.raises(InputError, match=r"row 2: l_knee_flexion_deg = 'x'"):
        read_angles_csv(path)
    path.write_text("frame,time_ns,a_deg,b_sigma_deg\n")
    with pytest.raises(InputError, match="its first line is not that of a table of joint angles"):
        read_angles_csv(path)


@settings(max_examples=60, deadline=None)
@given(place=st.floats(0, 1), length=st.integers(0, 20), data=st.binary(max_size=10), kind=st.sampled_from("ja"))
def test_any_edit_is_read_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, place: float, length: int, data: bytes, kind: str
) -> None:
    path = tmp_path_factory.mktemp("edit") / "a.csv"
    motion = some_motion(4)
    write_joints_csv(motion, path) if kind == "j" else write_angles_csv(isb_angles(motion), path)
    whole = path.read_bytes()
    at = int(place * len(whole))
    path.write_bytes(whole[:at] + data + whole[at + length :])
    with contextlib.suppress(InputError):
        read_joints_csv(path) if kind == "j" else read_angles_csv(path)


def test_centres_are_tracks(tmp_path: Path) -> None:
    motion = some_motion()
    tracks = centres_as_tracks(motion)
    assert len(tracks) == motion.centre.shape[0] * motion.centre.shape[1] - 1
    for suffix in ("csv", "npz", "trc", "c3d"):
        write_tracks(tracks, tmp_path / f"a.{suffix}", 100.0)
        again = read_tracks(tmp_path / f"a.{suffix}")
        for k, joint in enumerate(motion.joints):
            of = again.label == joint
            known = np.isfinite(motion.centre[:, k, 0])
            np.testing.assert_array_equal(again.frame[of], motion.frame[known])
            np.testing.assert_allclose(again.xyz[of], motion.centre[known, k], atol=1e-6)
    assert len(centres_as_tracks(motion.select(np.arange(0)))) == 0


def read_mot(path: Path) -> tuple[list[str], np.ndarray]:
    head, body = path.read_text().split("endheader\n")
    names, *rows = [line.split("\t") for line in body.splitlines()]
    stated = dict(line.split("=") for line in head.splitlines() if "=" in line)
    assert stated == {"version": "1", "nRows": str(len(rows)), "nColumns": str(len(names)), "inDegrees": "yes"}
    return names, np.array(rows, dtype=float)


def test_mot_by_hand(tmp_path: Path) -> None:
    # bent forward by 10 degrees, right knee flexed by 60, walking towards the world's x at a height of 1 m
    upright = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    bent = upright * Rotation.from_euler("Z", [[-10.0]] * 2, True)
    knee = Rotation.from_euler("Z", [[-60.0]] * 2, True)
    motion = motion_of({"pelvis": bent, "r_knee": knee}, centre=np.tile([[1.5, 0.25, 1.0]], (2, 2, 1)))
    angles = isb_angles(motion)
    for model, sign in (("gait2354", -1), ("Rajagopal", 1)):
        write_mot(angles, tmp_path / "a.mot", model=model, pelvis=motion)
        names, rows = read_mot(tmp_path / "a.mot")
        columns = "time pelvis_tilt pelvis_list pelvis_rotation knee_angle_r pelvis_tx pelvis_ty pelvis_tz"
        assert names == columns.split()
        wanted = [[t, -10, 0, 0, sign * 60, 1.5, 1.0, -0.25] for t in (0, 0.01)]
        np.testing.assert_allclose(rows, wanted, atol=1e-12)


# coordinates and axes of the joints in subject01_simbody.osim (gait2354), in their order
X, Y, Z = np.eye(3)
MODEL_JOINTS = {
    "pelvis": (("pelvis_tilt", Z), ("pelvis_list", X), ("pelvis_rotation", Y)),
    "lumbar": (("lumbar_extension", Z), ("lumbar_bending", X), ("lumbar_rotation", Y)),
    "r_hip": (("hip_flexion_r", Z), ("hip_adduction_r", X), ("hip_rotation_r", Y)),
    "l_hip": (("hip_flexion_l", Z), ("hip_adduction_l", -X), ("hip_rotation_l", -Y)),
    "r_knee": (("knee_angle_r", Z),),
    "l_knee": (("knee_angle_l", Z),),
}


def test_coordinates_turn_the_axes_of_the_model(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    turns = {}
    for joint, axes in MODEL_JOINTS.items():
        free = rng.uniform(-0.9, 0.9, (5, 3)) * [1, len(axes) > 1, len(axes) > 1]
        turns[joint] = Rotation.from_euler("ZXY", free)
    upright = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    motion = motion_of({**turns, "pelvis": upright * turns["pelvis"]})
    write_mot(isb_angles(motion), tmp_path / "a.mot", model="gait2354")
    names, rows = read_mot(tmp_path / "a.mot")
    for joint, axes in MODEL_JOINTS.items():
        again = Rotation.identity(5)
        for name, axis in axes:
            again = again * Rotation.from_rotvec(np.deg2rad(rows[:, [names.index(name)]]) * axis)
        np.testing.assert_allclose((again.inv() * turns[joint]).magnitude(), 0, atol=1e-12, err_msg=joint)


def test_what_a_mot_cannot_hold(tmp_path: Path) -> None:
    path, motion = tmp_path / "a.mot", some_motion()
    angles = isb_angles(motion)
    with pytest.raises(InputError, match="is unknown in frame 8; fill the gaps"):
        write_mot(angles, path)
    with pytest.raises(InputError, match="model 'gait' given; gait2354, gait2392, Rajagopal are known"):
        write_mot(angles, path, model="gait")
    with pytest.raises(InputError, match="no angle to write; wanted are some of pelvis_tilt"):
        write_mot(JointAngles([0], [0], ("finger",), [[0]], [[0]]), path)
    with pytest.raises(InputError, match="no pelvis in each frame"):
        write_mot(angles, path, pelvis=motion.select(np.arange(3)))
    with pytest.raises(InputError, match="body 'femur_r' with factors"):
        write_scale_set({"femur_r": (1.0, 0.0, 1.0)}, path)
    with pytest.raises(InputError, match="no body to scale"):
        write_scale_set({}, path)
    assert list(tmp_path.iterdir()) == []


def test_coordinates_name_our_angles() -> None:
    ours = {f"{side}{row.joint}_{row.name}" for row in CONVENTIONS for side in ("", "l_", "r_")}
    assert {name for name, _ in COORDINATES.values()} <= ours
    assert set(KNEE_SIGNS.values()) == {-1, 1}


@pytest.mark.data
def test_opensim_sees_the_same_pose_and_opens_its_files(tmp_path: Path) -> None:
    """OpenSim sets its model's coordinates; from its bodies' rotations alone we find them again."""
    opensim = pytest.importorskip("opensim", reason="opensim is not installed: pip install -e '.[bench]'")
    if not MODEL.is_file():
        pytest.skip(f"needs {MODEL} of MOSCA_DATA")
    opensim.Logger.setLevelString("Off")
    model = opensim.Model(str(MODEL))
    state = model.initSystem()
    exact = [name for name in COORDINATES if not name.startswith("ankle")]
    rng = np.random.default_rng(4)
    bodies = {"lumbar": ("pelvis", "torso")}
    for s in "lr":
        bodies |= {f"{s}_{joint}": (f"{a}_{s}".replace("pelvis_" + s, "pelvis"), f"{b}_{s}") for joint, a, b in (
            ("hip", "pelvis", "femur"), ("knee", "femur", "tibia"), ("ankle", "tibia", "talus"))}  # fmt: skip
    set_to, rotations, places = [], {name: [] for name in ("pelvis", *bodies)}, []
    hip_in_pelvis = np.mean([
        model.getJointSet().get(f"hip_{s}").getParentFrame().findTransformInBaseFrame().p().to_numpy() for s in "lr"
    ], axis=0)  # fmt: skip

    def turn(body: str) -> np.ndarray:
        r = model.getBodySet().get(body).getTransformInGround(state).R()
        return np.array([[r.get(i, j) for j in range(3)] for i in range(3)])

    for _ in range(4):
        row = {}
        for name in (*exact, "ankle_angle_r", "ankle_angle_l", "pelvis_tx", "pelvis_ty", "pelvis_tz"):
            value = rng.uniform(-0.6, 0.6) - (0.7 if name.startswith("knee") else 0)
            model.getCoordinateSet().get(name).setValue(state, value, False)
            row[name] = value if name[-3:-1] == "_t" else np.rad2deg(value)
        model.realizePosition(state)
        set_to.append(row)
        pelvis = model.getBodySet().get("pelvis")
        places.append(pelvis.findStationLocationInGround(state, opensim.Vec3(*hip_in_pelvis)).to_numpy())
        rotations["pelvis"].append(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ turn("pelvis"))
        for joint, (proximal, distal) in bodies.items():
            rotations[joint].append(turn(proximal).T @ turn(distal))
    centre = np.zeros((4, len(rotations), 3))
    centre[:, 0] = np.array(places)[:, [0, 2, 1]] * [1, -1, 1]
    motion = motion_of({name: Rotation.from_matrix(np.array(r)) for name, r in rotations.items()}, centre=centre)
    path = tmp_path / "a.mot"
    write_mot(isb_angles(motion), path, model="gait2354", pelvis=motion, hips_in_pelvis_m=tuple(hip_in_pelvis))
    table = opensim.TimeSeriesTable(str(path))
    assert table.getTableMetaDataAsString("inDegrees") == "yes"
    np.testing.assert_allclose(table.getIndependentColumn(), [0, 0.01, 0.02, 0.03], atol=1e-12)
    for name in set_to[0]:
        values = table.getDependentColumn(name).to_numpy()
        true = np.array([row[name] for row in set_to])
        # the axis of the model's ankle is oblique: 2 % and what is of second order
        np.testing.assert_allclose(values, true, atol=1.5 if name.startswith("ankle") else 1e-6, err_msg=name)
    scales = {"femur_r": (1.0, 1.07, 1.0), "pelvis": (0.9, 1.1, 0.95)}
    write_scale_set(scales, tmp_path / "a.xml")
    read = opensim.ScaleSet(str(tmp_path / "a.xml"))
    assert read.getSize() == 2
    for k, (body, factors) in enumerate(scales.items()):
        assert read.get(k).getSegmentName() == body
        assert read.get(k).getApply()
        np.testing.assert_allclose([read.get(k).getScaleFactors().get(i) for i in range(3)], factors)
