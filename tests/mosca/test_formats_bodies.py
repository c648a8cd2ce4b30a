"""Bodies to files and back: definitions (TOML), poses (CSV, TUM), skeletons (BVH)."""

import csv
import os
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion, Skeleton, angles_from_matrices, forward_kinematics
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv, write_bodies_csv
from mosca.formats.bodies.body_file import read_bodies, write_bodies
from mosca.formats.bodies.bvh_writer import write_bvh
from mosca.formats.bodies.tum import write_tum

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"
TRIANGLE = np.array([[0, 0, 0], [0.1, 0, 0], [0.02, 0.07, 0]])


def some_poses(n: int = 30, seed: int = 0) -> BodyPoses:
    rng = np.random.default_rng(seed)
    half = rng.normal(0, 1e-4, (n, 6, 6))
    covariance = half @ half.transpose(0, 2, 1)
    quaternion = Rotation.random(n, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    position = rng.normal(0, 2, (n, 3))
    residual = rng.uniform(0, 1e-3, n)
    withheld = np.arange(n) % 5 == 4
    for column in (quaternion, position, covariance, residual):
        column[withheld] = np.nan
    body = np.where(np.arange(n) % 2, "drone", 'arm, "left"')
    status = np.where(withheld, "withheld", "measured")
    times = 1_790_000_000_000_000_001 + 10_000_000 * np.arange(n)
    return BodyPoses(
        np.arange(n) // 2, times, body, quaternion, position,
        (covariance + covariance.transpose(0, 2, 1)) / 2, rng.integers(2, 9, n), residual, status,
    )  # fmt: skip


def test_csv_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "bodies.csv"
    for poses in (some_poses(), BodyPoses.none()):
        write_bodies_csv(poses, path)
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))

        def column(name: str) -> np.ndarray:
            return np.array([float(row[name] or "nan") for row in rows])  # noqa: B023

        assert [row["body"] for row in rows] == poses.body.tolist()
        assert [row["status"] for row in rows] == poses.status.tolist()
        for name in ("frame", "time_ns", "n_markers"):
            assert [int(row[name]) for row in rows] == getattr(poses, name).tolist()
        np.testing.assert_array_equal(column("residual_m"), poses.residual_m)
        for k, name in enumerate(("qw", "qx", "qy", "qz")):
            np.testing.assert_array_equal(column(name), poses.quaternion[:, k])
        for k, name in enumerate("xyz"):
            np.testing.assert_array_equal(column(name), poses.position[:, k])
        for i, j in zip(*np.triu_indices(6), strict=True):
            np.testing.assert_array_equal(column(f"c{'xyzuvw'[i]}{'xyzuvw'[j]}"), poses.covariance[:, i, j])
        again = read_bodies_csv(path)
        for name in BodyPoses.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(again, name), getattr(poses, name))
    assert [p.name for p in tmp_path.iterdir()] == ["bodies.csv"]


def test_csv_by_hand(tmp_path: Path) -> None:
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])[None]
    covariance[0, 0, 5] = covariance[0, 5, 0] = 0.5
    poses = BodyPoses([7], [8], ["b"], [[1.0, 0, 0, 0]], [[0.1, 0.2, 0.3]], covariance, [4], [0.001], ["measured"])
    write_bodies_csv(poses, tmp_path / "b.csv")
    head, line = (tmp_path / "b.csv").read_text().splitlines()
    cells = dict(zip(head.split(","), line.split(","), strict=True))
    assert head.startswith("frame,time_ns,body,qw,qx,qy,qz,x,y,z,cxx,cxy,cxz,cxu,cxv,cxw,cyy")
    assert (cells["cxw"], cells["cww"], cells["cuu"], cells["cyu"]) == ("0.5", "6.0", "4.0", "0.0")


def test_tum_by_hand(tmp_path: Path) -> None:
    one = BodyPoses(
        [0], [1_305_031_102_175_304_001], ["cup"], [[0.5, 0.5, -0.5, 0.5]], [[1.5, -2, 0.25]],
        np.full((1, 6, 6), np.nan), [4], [np.nan], ["measured"],
    )  # fmt: skip
    path = tmp_path / "cup.txt"
    write_tum(one, path)
    assert path.read_text().splitlines()[1] == "1305031102.175304001 1.5 -2.0 0.25 0.5 -0.5 0.5 0.5"


def test_tum_holds_one_body_to_the_nanosecond(tmp_path: Path) -> None:
    path, poses = tmp_path / "drone.txt", some_poses()
    write_tum(poses, path, "drone")
    mine, rows = poses.of("drone"), [line.split() for line in path.read_text().splitlines()[1:]]
    assert [int(Decimal(row[0]) * 10**9) for row in rows] == mine.time_ns.tolist()
    values = np.array(rows, dtype=float)
    np.testing.assert_array_equal(values[:, 1:4], mine.position)
    np.testing.assert_array_equal(values[:, [7, 4, 5, 6]], mine.quaternion)
    with pytest.raises(InputError, match="no body given"):
        write_tum(poses, path)
    with pytest.raises(InputError, match="body 'cup' given"):
        write_tum(poses, path, "cup")
    early = BodyPoses(
        [0], [-1_500_000_001], ["b"], [[1.0, 0, 0, 0]], np.zeros((1, 3)), np.zeros((1, 6, 6)), [3], [0], ["measured"]
    )  # fmt: skip
    write_tum(early, path)
    assert path.read_text().splitlines()[1].startswith("-1.500000001 ")


BODIES = """kind = "bodies"
[[body]]
name = "cup"
sigma_m = 0.0003
[[body.marker]]
position_m = [0.0, 0.0, 0.0]
[[body.marker]]
name = "handle"
position_m = [0.1, 0.0, 0.0]
[[body.marker]]
position_m = [0.02, 0.07, 0.0]
"""


def test_definitions(tmp_path: Path) -> None:
    path = tmp_path / "bodies.toml"
    path.write_text(BODIES)
    (cup,) = read_bodies(path)
    assert cup.markers == ("cup/1", "handle", "cup/3")
    np.testing.assert_array_equal(cup.positions, TRIANGLE)
    write_bodies([cup], path)
    (again,) = read_bodies(path)
    assert (again.name, again.markers, again.sigma_m) == ("cup", cup.markers, 0.0003)
    np.testing.assert_array_equal(again.positions, cup.positions)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"bodies"', '"body"', "key 'kind'"),
        ("position_m = [0.1", "position = [0.1", "unknown key 'body\\[0\\].marker\\[1\\].position'; did you mean"),
        ("[0.02, 0.07, 0.0]", "[0.2, 0.0, 0.0]", "body 'cup': the markers lie in a line"),
        ("[0.02, 0.07, 0.0]", "[0.05, 0.07, 0.0]", "body 'cup' looks like itself turned: markers .* move marker"),
        ("[0.02, 0.07, 0.0]", "[0.1, 0.009, 0.0]", "'handle' and 'cup/3' are 9.0 mm apart"),
        ('"handle"', '"cup/1"', "marker 'cup/1' stands twice"),
        ("0.0003", "-1", "key 'body\\[0\\].sigma_m'"),
        ("[[body.marker]]\nposition_m = [0.0, 0.0, 0.0]", "", "key 'body\\[0\\].marker'"),
    ],
)  # fmt: skip
def test_faults_of_a_definition(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "bodies.toml"
    assert old in BODIES
    path.write_text(BODIES.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as error:
        read_bodies(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_definition_that_cannot_be_read_back_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="name"):
        write_bodies([RigidBody("two words", ("a", "b", "c"), TRIANGLE)], tmp_path / "b.toml")
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=100, deadline=None)
@given(place=st.floats(0, 1), length=st.integers(0, 20), data=st.binary(max_size=10))
def test_any_edit_is_read_and_written_again_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, place: float, length: int, data: bytes
) -> None:
    at = int(place * len(BODIES))
    path = tmp_path_factory.mktemp("edit") / "a.toml"
    path.write_bytes(BODIES.encode()[:at] + data + BODIES.encode()[at + length :])
    try:
        result = read_bodies(path)
    except InputError:
        return
    # what was read is written and read again as it is
    write_bodies(result, path.with_name("again.toml"))
    again = read_bodies(path.with_name("again.toml"))
    for one, other in zip(again, result, strict=True):
        assert (one.name, one.markers, one.sigma_m) == (other.name, other.markers, other.sigma_m)
        np.testing.assert_array_equal(one.positions, other.positions)


@settings(max_examples=60, deadline=None)
@given(
    order=st.permutations("XYZ").map("".join),
    angles=st.lists(st.sampled_from([-np.pi / 2, 0.0, np.pi / 2, 1e-9, 1.0, -2.5, 3.1]), min_size=3, max_size=3),
)  # fmt: skip
def test_angles_give_the_rotation_back(order: str, angles: list[float]) -> None:
    matrix = Rotation.from_euler(order, angles).as_matrix()
    again = Rotation.from_euler(order, angles_from_matrices(matrix, order)).as_matrix()
    np.testing.assert_allclose(again, matrix, atol=1e-15)


def some_motion() -> Motion:
    names = ("hip", "spine", "leg", "head", "leg_end", "head_end", "hand")
    skeleton = Skeleton(
        names, [-1, 0, 0, 1, 2, 3, 1],
        [[0, 0, 0], [0, 0.01, 0.5], [0.1, 0, -0.4], [0, 0, 0.3], [0, 0, -0.4], [0, 0, 0.2], [0.3, 0, 0]],
        ("ZYX", "X", "ZXY", "", "", "", "YZ"),
    )  # fmt: skip
    rng = np.random.default_rng(3)
    turns = Rotation.random(20 * 7, random_state=3).as_quat()[:, [3, 0, 1, 2]].reshape(20, 7, 4)
    turns[:, [4, 5]] = [1, 0, 0, 0]  # ends do not rotate
    return Motion(skeleton, 120.0, rng.normal(0, 1, (20, 3)), turns)


def test_bvh_by_hand(tmp_path: Path) -> None:
    skeleton = Skeleton(("hip", "hip_end"), [-1, 0], [[0, 0, 0], [0, 0, 0.5]], ("ZXY", ""))
    # a quarter turn about the world's z, which is the file's y
    turn = np.array([[[np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)], [1, 0, 0, 0]]])
    write_bvh(Motion(skeleton, 50.0, [[0.1, 0.2, 0.3]], turn), tmp_path / "a.bvh")
    text = (tmp_path / "a.bvh").read_text()
    assert "OFFSET 0.000000000 50.000000000 0.000000000" in text.replace("-0.0", "0.0")
    assert "Frame Time: 0.02" in text
    values = [float(cell) for cell in text.splitlines()[-1].split()]
    np.testing.assert_allclose(values, [10, 30, -20, 0, 0, 90], atol=1e-9)


def test_bvh_round_trip(tmp_path: Path) -> None:
    motion = some_motion()
    write_bvh(motion, tmp_path / "a.bvh", metres_per_unit=0.0254)
    again = read_bvh(tmp_path / "a.bvh", metres_per_unit=0.0254)
    assert again.frame_rate_hz == pytest.approx(120.0, rel=1e-15)
    assert set(again.skeleton.names) == {*motion.skeleton.names, "hand_end"}
    one, two = forward_kinematics(motion)[0], forward_kinematics(again)[0]
    for k, name in enumerate(motion.skeleton.names):
        np.testing.assert_allclose(two[:, again.skeleton.index(name)], one[:, k], atol=1e-9)


def test_what_a_bvh_cannot_hold(tmp_path: Path) -> None:
    motion, path = some_motion(), tmp_path / "a.bvh"
    for bad, message in (
        (Motion(motion.skeleton, 100.0, np.empty((0, 3)), np.empty((0, 7, 4))), "no frame to write"),
        (Motion(motion.skeleton, 100.0, np.full((20, 3), np.nan), motion.rotations), "no finite number"),
        (Motion(Skeleton(("a b", "a\tb"), [-1, 0], np.zeros((2, 3))), 100.0, np.zeros((1, 3)),
                np.tile([1.0, 0, 0, 0], (1, 2, 1))), "differ in more than blanks"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            write_bvh(bad, path)
    with pytest.raises(InputError, match="metres_per_unit"):
        write_bvh(motion, path, metres_per_unit=0.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.data
def test_real_walks_as_bvh_and_back(tmp_path: Path) -> None:
    bvh, asf = DATA / "bvh/02/02_01.bvh", DATA / "asfamc/02/02.asf"
    if not bvh.is_file() or not asf.is_file():
        pytest.skip(f"needs {bvh} and {asf} of MOSCA_DATA")
    for motion in (read_bvh(bvh), read_asf_amc(asf, DATA / "asfamc/02/02_01.amc")):
        write_bvh(motion, tmp_path / "a.bvh")
        again = read_bvh(tmp_path / "a.bvh")
        assert len(again.root_xyz) == len(motion.root_xyz)
        assert again.frame_rate_hz == pytest.approx(motion.frame_rate_hz, rel=1e-12)
        one, two = forward_kinematics(motion)[0], forward_kinematics(again)[0]
        for k, name in enumerate(motion.skeleton.names):
            np.testing.assert_allclose(two[:, again.skeleton.index(name)], one[:, k], atol=1e-9)
