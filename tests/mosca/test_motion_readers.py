"""Motion readers against hand numbers, scipy's Euler angles, damaged files and CMU's recordings."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.joint_csv import read_points_csv
from mosca.data.motion.motion import Motion, forward_kinematics
from mosca.errors import InputError

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"

TWO_BONES = """HIERARCHY
ROOT hip
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT knee
  {
    OFFSET 0 1 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.01
0 0 0 0 0 0 0 0 0
10 20 30 90 0 0 90 0 0
"""

ASF = """:version 1.10
:units
  mass 1.0
  length 0.5
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name a
     direction 0 1 0
     length 2
     axis 0 0 90  XYZ
     dof rx
  end
  begin
     id 2
     name b
     direction 1 0 0
     length 1
     axis 10 20 30  XYZ
     dof rx ry rz
  end
:hierarchy
  begin
    root a
    a b
  end
"""

AMC = """#!comment
:FULLY-SPECIFIED
:DEGREES
1
root 0 0 0 0 0 0
a 90
b 0 0 0
2
root 1 2 3 10 20 30
a 0
b 40 50 60
"""


def _write(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_bvh_two_bones_by_hand(tmp_path: Path) -> None:
    motion = read_bvh(_write(tmp_path, "a.bvh", TWO_BONES), metres_per_unit=0.1)
    assert motion.skeleton.names == ("hip", "knee", "knee_end")
    assert motion.skeleton.orders == ("ZYX", "ZXY", "")
    assert motion.frame_rate_hz == pytest.approx(100.0)
    positions, _ = forward_kinematics(motion)
    # File: straight up y, which is the world's z.
    np.testing.assert_allclose(positions[0], [[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], atol=1e-15)
    # File: hip (10,20,30); 90 deg about z takes y to -x, twice 90 deg takes y to -y. World (x, -z, y).
    file = np.array([[10, 20, 30], [9, 20, 30], [9, 19, 30]])
    np.testing.assert_allclose(positions[1], 0.1 * np.stack([file[:, 0], -file[:, 2], file[:, 1]], 1), atol=1e-14)


def test_asf_amc_by_hand(tmp_path: Path) -> None:
    asf, amc = _write(tmp_path, "a.asf", ASF), _write(tmp_path, "a.amc", AMC)
    motion = read_asf_amc(asf, amc)
    unit = 0.0254 / 0.5
    assert motion.skeleton.names == ("root", "a", "b", "b_end")
    positions, _ = forward_kinematics(motion)
    # a's own x axis is the file's y (axis 0 0 90): 90 deg about y leaves a and takes b from x to -z.
    file = np.array([[0, 0, 0], [0, 0, 0], [0, 2, 0], [0, 2, -1]])
    np.testing.assert_allclose(positions[0], unit * np.stack([file[:, 0], -file[:, 2], file[:, 1]], 1), atol=1e-15)
    # Frame 2 by scipy's fixed-axis Euler angles (lower case): C M C^-1, first to last about fixed axes.
    root = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    axes = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    b = root * axes * Rotation.from_euler("xyz", [40, 50, 60], degrees=True) * axes.inv()
    start = np.array([1.0, 2.0, 3.0])
    file = np.array([start, start, start + root.apply([0, 2, 0])])
    file = np.vstack([file, file[2] + b.apply([1, 0, 0])])
    np.testing.assert_allclose(positions[1], unit * np.stack([file[:, 0], -file[:, 2], file[:, 1]], 1), atol=1e-14)


def test_quaternions_do_not_flip(tmp_path: Path) -> None:
    frames = "\n".join(f"0 0 0 {angle} 0 0 0 0 0" for angle in range(0, 720, 10))
    text = TWO_BONES[: TWO_BONES.index("Frames")] + f"Frames: 72\nFrame Time: 0.01\n{frames}\n"
    quaternions = read_bvh(_write(tmp_path, "a.bvh", text)).rotations
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=-1), 1.0, atol=1e-14)
    assert np.min(np.sum(quaternions[1:] * quaternions[:-1], axis=-1)) > 0.99


angles = st.floats(-720, 720).map(lambda a: round(a, 4))
order = st.permutations("XYZ").map("".join)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(first=order, second=order, values=st.lists(angles, min_size=6, max_size=6))
def test_bvh_agrees_with_scipy_for_every_channel_order(
    tmp_path: Path, first: str, second: str, values: list[float]
) -> None:
    text = TWO_BONES.replace("Zrotation Yrotation Xrotation", "HIP").replace(
        "Zrotation Xrotation Yrotation", " ".join(f"{a}rotation" for a in second)
    )
    text = text.replace("HIP", " ".join(f"{a}rotation" for a in first))
    text = text.replace("10 20 30 90 0 0 90 0 0", "10 20 30 " + " ".join(map(str, values)))
    positions, rotations = forward_kinematics(
        read_bvh(_write(tmp_path, "a.bvh", text), metres_per_unit=1.0, drop_frames=1)
    )
    hip = Rotation.from_euler(first, values[:3], degrees=True)  # capitals: intrinsic, left to right
    knee = hip * Rotation.from_euler(second, values[3:], degrees=True)
    up = Rotation.from_euler("x", 90, degrees=True)
    tip = np.array([10, 20, 30]) + hip.apply([0, 1, 0]) + knee.apply([0, 1, 0])
    np.testing.assert_allclose(positions[0, 2], up.apply(tip), atol=1e-12)
    np.testing.assert_allclose(rotations[0, 1], (up * knee * up.inv()).as_matrix(), atol=1e-12)


def _read(folder: Path, bvh: str | bytes = "", asf: str | bytes = ASF, amc: str | bytes = AMC) -> Motion:
    """Read a BVH, or an ASF with its AMC where there is none."""
    if bvh:
        return read_bvh(_write(folder, "a.bvh", bvh))
    return read_asf_amc(_write(folder, "a.asf", asf), _write(folder, "a.amc", amc))


@pytest.mark.parametrize(
    ("kind", "old", "new", "said"),
    [
        ("bvh", "Frames: 2", "Frames: 3", "cut short"),
        ("bvh", "Frames: 2", "Frames: 99999999999999", "a number within"),
        ("bvh", "Frame Time: 0.01", "Frame Time: 0", "seconds above zero"),
        ("bvh", "90 0 0 90", "90 0 nan 90", "a number within"),
        ("bvh", "90 0 0 90", "90 0 ups 90", "a number wanted"),
        ("bvh", "OFFSET 0 1 0\n    CH", "CH", "'knee' has no OFFSET"),
        ("bvh", "CHANNELS 3", "CHANNELS 4", "CHANNELS must be"),
        ("bvh", "JOINT knee", "JOINT hip", "used twice"),
        ("bvh", "JOINT knee\n  {", "JOINT knee", "line 7: 'OFFSET' outside"),
        ("bvh", "MOTION", "NOTION", "no 'MOTION'"),
        ("amc", "\n2\n", "\n3\n", "frame 3 follows 1"),
        ("amc", "b 40 50 60", "", "other bones than the first"),
        ("amc", "b 40 50 60", "b 40 50", "3 numbers wanted"),
        ("amc", "b 40 50 60", "c 40 50 60", "a bone of the ASF file wanted"),
        ("amc", "a 90", "a x", "a number wanted"),
    ],
)
def test_errors_say_what_is_wrong(tmp_path: Path, kind: str, old: str, new: str, said: str) -> None:
    good = {"bvh": TWO_BONES, "amc": AMC}[kind]
    assert old in good
    with pytest.raises(InputError, match=said) as error:
        _read(tmp_path, **{kind: good.replace(old, new, 1)})
    assert str(tmp_path / f"a.{kind}") in str(error.value)
    assert "\n" not in str(error.value)


def test_other_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_bvh(tmp_path / "none.bvh")
    with pytest.raises(InputError, match="is a folder"):
        read_asf_amc(tmp_path, tmp_path)
    with pytest.raises(InputError, match="0 to 1 can be dropped"):
        read_bvh(_write(tmp_path, "a.bvh", TWO_BONES), drop_frames=2)
    moving = TWO_BONES.replace("CHANNELS 3 Zrotation", "CHANNELS 4 Xposition Zrotation")
    moving = moving.replace("0 0 0 0 0 0 0 0 0", "0 0 0 0 0 0 0 0 0 0").replace("90 0 0 90", "90 0 0 5 90")
    with pytest.raises(InputError, match=r"'knee' moves 50\.0 mm against its parent"):
        read_bvh(_write(tmp_path, "b.bvh", moving))


def test_points_csv(tmp_path: Path) -> None:
    text = "Time,hip.x,hip.y,hip.z,toe.X,toe.Y,toe.Z\n0,1,2,3,4,5,6\n0.5,7,8,9,,,\n"
    points = read_points_csv(_write(tmp_path, "a.csv", text), metres_per_unit=0.01, y_up=True)
    assert points.names == ("hip", "toe")
    np.testing.assert_allclose(points.xyz[0], [[0.01, -0.03, 0.02], [0.04, -0.06, 0.05]])
    assert np.isnan(points.xyz[1, 1]).all()
    with pytest.raises(InputError, match="row 3: 6 cells given, 7 wanted"):
        read_points_csv(_write(tmp_path, "b.csv", text.replace(",,,", ",,")))
    with pytest.raises(InputError, match="must be filled and rise"):
        read_points_csv(_write(tmp_path, "b.csv", text.replace("0.5,", "0,")))


def _damaged(text: str) -> st.SearchStrategy[bytes]:
    """Return strategies for a file with a few bytes cut out, overwritten or put in."""
    good = text.encode()
    cut = st.tuples(st.integers(0, len(good)), st.integers(0, 12), st.binary(max_size=8))
    patch = st.sampled_from([b"", b"{", b"}", b"1e999", b"-1", b"nan", b"End", b"\x00", b"\n"])
    word = st.tuples(st.integers(0, len(good)), st.integers(0, 12), patch)
    return st.lists(st.one_of(cut, word), min_size=1, max_size=3).map(lambda edits: _edit(good, edits))


def _edit(good: bytes, edits: list[tuple[int, int, bytes]]) -> bytes:
    for start, length, put in edits:
        good = good[:start] + put + good[start + length :]
    return good


fuzz = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.mark.parametrize(("kind", "good"), [("bvh", TWO_BONES), ("asf", ASF), ("amc", AMC)])
@fuzz
@given(data=st.data())
def test_any_bytes_as_motion(tmp_path: Path, kind: str, good: str, data: st.DataObject) -> None:
    content = data.draw(st.one_of(st.binary(min_size=1, max_size=200), _damaged(good).filter(len)))
    try:
        motion = _read(tmp_path, **{kind: content})
    except InputError:
        return
    assert np.isfinite(forward_kinematics(motion)[0]).all()


@fuzz
@given(content=st.one_of(st.binary(max_size=200), _damaged("time,a.x,a.y,a.z\n0,1,2,3\n1,2,3,4\n")))
def test_any_bytes_as_points_csv(tmp_path: Path, content: bytes) -> None:
    try:
        points = read_points_csv(_write(tmp_path, "a.csv", content))
    except InputError:
        return
    assert points.xyz.shape == (len(points.time_s), len(points.names), 3)


def _need(*paths: Path) -> None:
    for path in paths:
        if not path.exists():
            pytest.skip(f"{path.name} is not in MOSCA_DATA")


@pytest.mark.data
def test_worldpos_tables_agree_with_bvh() -> None:
    bvh, table = DATA / "bvh/16/16_01.bvh", DATA / "bvh/16/16_01_worldpos.csv"
    _need(bvh, table)
    points = read_points_csv(table, y_up=True)
    motion = read_bvh(bvh, metres_per_unit=1.0)
    columns = [motion.skeleton.index(name) for name in points.names if name in motion.skeleton.names]
    kept = [k for k, name in enumerate(points.names) if name in motion.skeleton.names]
    np.testing.assert_allclose(points.xyz[:, kept], forward_kinematics(motion)[0][:, columns], atol=1e-4)


@pytest.mark.data
def test_converted_bvh_agrees_with_amc_below_the_chest() -> None:
    """SOURCE.md: root, legs and spine agree to 3e-5 units, which is the file's rounding."""
    bvh = DATA / "fairmotion/01_01.bvh"
    _need(bvh)
    amc = read_asf_amc(DATA / "asfamc/01/01.asf", DATA / "asfamc/01/01_01.amc", metres_per_unit=1.0)
    other = read_bvh(bvh, metres_per_unit=1.0, drop_frames=1)
    for name in ("lfemur", "ltibia", "lfoot", "rfemur", "rtibia", "rfoot", "upperback", "thorax"):
        ours = forward_kinematics(amc)[0][:, amc.skeleton.index(name)]
        theirs = forward_kinematics(other)[0][:, other.skeleton.index(name)]
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.data
def test_long_recording_stays_human() -> None:
    asf, amc = DATA / "asfamc/01/01.asf", DATA / "asfamc/01/01_01.amc"
    _need(asf, amc)
    motion = read_asf_amc(asf, amc)
    positions, rotations = forward_kinematics(motion)
    assert len(positions) == 2751
    assert motion.duration_s == pytest.approx(22.917, abs=1e-3)  # SOURCE.md: 22.9 s
    assert 1.5 < np.max(positions[..., 2]) < 2.0  # SOURCE.md: heights 1.5-1.9 m
    np.testing.assert_allclose(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3), 0, atol=1e-12)
    # Bones keep their length: rigid forward kinematics.
    bones = np.linalg.norm(positions[:, 1:] - positions[:, motion.skeleton.parents[1:]], axis=-1)
    assert np.ptp(bones, axis=0).max() < 1e-12


@pytest.mark.data
def test_bvh_and_amc_of_the_same_walk_have_the_same_timing() -> None:
    """SOURCE.md: BVH = AMC + 1 frame; the skeletons differ by 7-12 cm, but a knee's rise and fall agrees."""
    bvh = DATA / "bvh/02/02_01.bvh"
    _need(bvh)
    walk = read_asf_amc(DATA / "asfamc/02/02.asf", DATA / "asfamc/02/02_01.amc")
    other = read_bvh(bvh, metres_per_unit=0.0104, drop_frames=1)
    ours, theirs = forward_kinematics(walk)[0], forward_kinematics(other)[0]
    assert len(ours) == len(theirs)
    for mine, yours in (("ltibia", "lShin"), ("rtibia", "rShin"), ("lhand", "lHand")):
        a = ours[:, walk.skeleton.index(mine)] - ours[:, 0]
        b = theirs[:, other.skeleton.index(yours)] - theirs[:, 0]
        assert np.corrcoef(a[:, 1], b[:, 1])[0, 1] > 0.97
    # Root paths: both walk 3.4 m along the same horizontal axis within the unit's stated 2 %.
    np.testing.assert_allclose(np.ptp(ours[:, 0, 1]), np.ptp(theirs[:, 0, 1]), rtol=0.02)


@pytest.mark.data
def test_long_jump_travels_what_the_index_says() -> None:
    """SOURCE.md: 13_11 has 415 frames and the feet travel 118 units, about 1.2 m."""
    path = DATA / "bvh/13/13_11.bvh"
    _need(path)
    motion = read_bvh(path, metres_per_unit=1.0, drop_frames=1)
    foot = forward_kinematics(motion)[0][:, motion.skeleton.index("lFoot")]
    assert len(foot) == 415
    assert np.linalg.norm((foot[-1] - foot[0])[:2]) == pytest.approx(118, abs=6)


@pytest.mark.data
def test_subject_16_is_as_tall_as_people_are() -> None:
    """SOURCE.md: bvh/16 is in ASF units and its header's 30 Hz is wrong: 120 Hz."""
    path = DATA / "bvh/16/16_01.bvh"
    _need(path)
    motion = read_bvh(path, metres_per_unit=0.0254 / 0.45, frame_rate_hz=120.0, drop_frames=1)
    positions, _ = forward_kinematics(motion)
    assert len(positions) == 321
    assert 1.6 < np.max(positions[..., 2]) < 2.2


def test_a_brace_behind_a_joints_name_is_no_part_of_it(tmp_path):
    path = tmp_path / "a.bvh"
    text = "HIERARCHY\nROOT Hips{0}OFFSET 0 0 0\nCHANNELS 1 Xposition\nEnd Site{0}OFFSET 0 1 0\n}}\n}}\n"
    for brace in ("\n{\n", " {\n"):
        path.write_text(text.format(brace) + "MOTION\nFrames: 1\nFrame Time: 0.01\n1.0\n")
        assert read_bvh(path).skeleton.names == ("Hips", "Hips_end")
