"""mosca skeleton fit and track: a person with known bones fitted and followed; wrong inputs in one line."""

import os
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from command_line import mosca, refusal
from skeleton_takes import RATE_HZ, legs_model, poses, take, write_legs

from mosca.data.files.rig_file import write_rig
from mosca.data.motion.bvh import read_bvh
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.tracks import Tracks
from mosca.formats.bodies.subject_file import read_subject
from mosca.formats.joints.angles_csv import read_angles_csv
from mosca.formats.joints.joints_csv import read_joints_csv
from mosca.formats.tracks.tracks_file import write_tracks

PEOPLE = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "people"
MODEL = legs_model()


def written(path, tracks):
    write_tracks(tracks, path, RATE_HZ)
    return path


def relabelled(tracks, change):
    columns = {name: getattr(tracks, name) for name in Tracks.__dataclass_fields__}
    return Tracks(**columns | {"label": np.array([change(label) for label in tracks.label.tolist()], dtype=np.str_)})


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A folder with the take, fitted once through the command line, and what was printed."""
    folder = tmp_path_factory.mktemp("skeleton")
    write_legs(folder / "legs.xml")
    tracks, centres = take(MODEL, prefix="Anna:")
    written(folder / "anna.npz", tracks)
    written(folder / "plain.npz", relabelled(tracks, lambda label: label.removeprefix("Anna:")))
    words = ["skeleton", "fit", "anna.npz", "--out", "s.npz", "--model", "legs.xml", "--mjcf", "fitted.xml"]
    words += ["--osim-scale", "scale.xml"]
    done = mosca(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout, centres


def test_what_a_fit_says(fitted):
    folder, told, centres = fitted
    lines = told.splitlines()
    assert lines[0].startswith(f"{len(MODEL.labels)} markers used: LASI, RASI, ")
    assert float(re.search(r"^size: (\S+) of the model", told, re.M)[1]) == pytest.approx(1.0, abs=0.05)
    # three coordinates of 0.3 mm noise, less what poses and parameters take up
    assert 0.3 < float(re.search(r"^residuals: (\S+) mm rms of 60 frames", told, re.M)[1]) < 0.3 * 3**0.5
    found = re.findall(r"^length (\S+) to (\S+): (\d+\.\d) \+- (\d+\.\d) mm \(95 %\)$", told, re.M)
    names = ["pelvis", *MODEL.joints]
    subject = read_subject(folder / "s.npz")
    drawn = np.random.default_rng(4).multivariate_normal(subject.parameters, subject.covariance, 2000)
    assert {pair[:2] for pair in found} == {
        ("l_hip", "l_knee"), ("l_knee", "l_ankle"), ("r_hip", "r_knee"), ("r_knee", "r_ankle"), ("l_hip", "r_hip"),
    }  # fmt: skip
    for a, b, length, wide in found:
        true = 1e3 * np.linalg.norm(centres[0, names.index(a)] - centres[0, names.index(b)])
        # 1.5 times the half width of 95 % is three standard deviations; 0.1 mm is printed
        assert abs(float(length) - true) < 1.5 * float(wide) + 0.1, (a, b)
        # lengths of bones drawn as the subject's covariance says
        bones = [
            drawn[:, MODEL.joint_rows(joint)] for joint in (a, b) if (a == "l_hip" and b == "r_hip") or joint == b
        ]
        spread = np.linalg.norm(bones[0] - bones[1] if len(bones) == 2 else bones[0], axis=1).std()
        assert float(wide) == pytest.approx(1960 * spread, rel=0.1, abs=0.06), (a, b)
    assert "not told by this take: l_hip" not in told
    assert (folder / "fitted.xml").is_file()
    scales = {
        one.findtext("segment"): float(one.findtext("scales").split()[1])
        for one in ElementTree.parse(folder / "scale.xml").iter("Scale")
    }
    # gait2354 has 0.43 m from knee to ankle; the lengths that were printed
    printed = {pair[:2]: float(pair[2]) for pair in found}
    for side in "lr":
        length = 1e-3 * printed[f"{side}_knee", f"{side}_ankle"]
        assert scales[f"tibia_{side}"] == pytest.approx(length / 0.43, abs=2e-4)
    assert f"tibia_l {scales['tibia_l']:.3f}" in told


def test_a_take_that_moves_nothing_says_so(tmp_path):
    write_legs(tmp_path / "legs.xml")
    written(tmp_path / "still.npz", take(MODEL, 3, still=True)[0])
    done = mosca(*["skeleton", "fit", "still.npz", "--out", "s.npz", "--model", "legs.xml"], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^not told by this take: l_hip, known to \d+ mm; missing: swing the leg", done.stdout, re.M)
    assert re.search(r"^not told by this take: r_hip", done.stdout, re.M)


def test_all_files_of_a_take(fitted, tmp_path):
    folder, _, centres = fitted
    files = {
        "out": "j.csv",
        "angles": "a.csv",
        "bvh": "t.bvh",
        "mot": "t.mot",
        "c3d": "t.c3d",
        "plot": "a.svg",
        "rrd": "t.rrd",
    }
    options = [word for name, file in files.items() for word in (f"--{name}", tmp_path / file)]
    done = mosca("skeleton", "track", "anna.npz", "--subject", "s.npz", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    told = done.stdout
    assert "60 of 60 frames solved" in told
    assert re.search(r"^  l_hip: centre \S+ mm, rotation \S+ deg$", told, re.M)
    joints = read_joints_csv(tmp_path / "j.csv")
    names = ["pelvis", *MODEL.joints]
    for joint in MODEL.joints:
        k = joints.joints.index(joint)
        off = joints.centre[:, k] - centres[:, names.index(joint)]
        assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.01, joint
        square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(joints.centre_covariance[:, k]), off)
        assert square.mean() < 16.3, (
            joint
        )  # 99.9 % of chi squared with 3: errors of the parameters are the same in all
    # knees turn about z by what the poses say
    q = poses(MODEL, 60)
    angles = read_angles_csv(tmp_path / "a.csv")
    for side in "lr":
        start = 7 + 4 * MODEL.joints.index(f"{side}_knee")
        true = -2 * np.arctan2(q[:, start + 3], q[:, start])
        given = angles.angles[:, angles.names.index(f"{side}_knee_flexion")]
        assert np.std(given - true) < np.deg2rad(2.0)
        assert np.ptp(true) > 1.0
    motion = read_bvh(tmp_path / "t.bvh", metres_per_unit=0.01)
    assert len(motion.root_xyz) == 60
    assert motion.frame_rate_hz == pytest.approx(RATE_HZ)
    np.testing.assert_allclose(motion.root_xyz, centres[:, 0], atol=0.02)
    rows = np.loadtxt(tmp_path / "t.mot", skiprows=8)
    assert rows.shape[0] == 60
    assert "13 coordinates in" in told  # three of the pelvis, ten of the legs
    labels = ezc3d.c3d(str(tmp_path / "t.c3d"))["parameters"]["POINT"]["LABELS"]["value"]
    assert {"Anna:LKNE", "l_hip", "LHipAngles"} <= set(labels)
    assert (tmp_path / "t.rrd").read_bytes()[:4] == b"RRF2"  # what is in it: tests/reports/test_viewer.py
    picture = ElementTree.parse(tmp_path / "a.svg").getroot()
    assert picture.tag == "{http://www.w3.org/2000/svg}svg"
    assert not [value for one in picture.iter() for value in one.attrib.values() if "var(" in value]


def test_a_rig_says_what_shakes_all_joints(fitted, tmp_path):
    """Cameras around the person that shake by 0.05 px: centres are known the worse for it, rotations better."""
    folder, _, _ = fitted
    lens = OpenCVLens(1000.0, 1000.0, 500.0, 500.0)
    turns = [
        np.array([[-np.sin(a), 0, -np.cos(a)], [np.cos(a), 0, -np.sin(a)], [0, -1, 0]]) for a in (0, 1.5, 3, 4.5)
    ]
    poses_of = [Pose(turn, np.array([0.0, 0.0, 1.0]) - 4.0 * turn[:, 2]) for turn in turns]
    for shake_px in (0.05, 0.0, 0.5):
        cameras = [Camera(f"c{k}", 1000, 1000, lens, p, shake_px=shake_px) for k, p in enumerate(poses_of)]
        write_rig(Rig(tuple(cameras)), tmp_path / f"rig{shake_px}.toml")
    words = ["skeleton", "track", "anna.npz", "--subject", "s.npz", "--out"]
    for file, more in (
        ("a.csv", []),
        ("b.csv", ["--rig", tmp_path / "rig0.05.toml"]),
        ("c.csv", ["--rig", tmp_path / "rig0.5.toml"]),
    ):
        done = mosca(*words, tmp_path / file, *more, cwd=folder)
        assert done.returncode == 0, done.stderr
    alone, shaken, most = (read_joints_csv(tmp_path / file) for file in ("a.csv", "b.csv", "c.csv"))
    more, capped = (
        np.sqrt(np.nanmedian(np.trace(one.centre_covariance - alone.centre_covariance, axis1=2, axis2=3)) / 3)
        for one in (shaken, most)
    )
    # 0.05 px of 1,000 at 4 m are 0.2 mm in each of four images: 0.1 to 0.2 mm an axis
    assert 1e-4 < more < 2e-4
    # ten times as much is more than the markers' covariances state: 0.3 mm an axis
    assert 2e-4 < capped < 3.1e-4
    of_rotations = [np.trace(one.rotation_covariance, axis1=2, axis2=3) for one in (alone, shaken)]
    assert np.nanmedian(of_rotations[1] / of_rotations[0]) < 1.0
    told = refusal(*words, tmp_path / "d.csv", "--rig", tmp_path / "rig0.0.toml", cwd=folder)
    assert "rig0.0.toml: no camera has shake_px" in told
    behind = [
        replace(camera, world_from_camera=Pose(turns[0], 9.0 * turns[0][:, 2]), shake_px=0.5) for camera in cameras
    ]
    write_rig(Rig(tuple(behind)), tmp_path / "elsewhere.toml")
    told = refusal(*words, tmp_path / "e.csv", "--rig", tmp_path / "elsewhere.toml", cwd=folder)
    assert "elsewhere.toml: no two of its cameras see the markers" in told
    assert not any((tmp_path / file).exists() for file in ("d.csv", "e.csv"))


def test_a_walk_is_drawn_over_its_gait_cycles(fitted, tmp_path):
    folder, _, _ = fitted
    written(tmp_path / "walk.npz", take(MODEL, 200)[0])
    walk = ["skeleton", "track", tmp_path / "walk.npz", "--subject", "s.npz", "--plot", tmp_path / "a.svg"]
    done = mosca(*walk, cwd=folder)
    assert "joint angles over the gait cycle in" in done.stdout
    assert "gait cycle [%]" in (tmp_path / "a.svg").read_text()
    done = mosca(*walk, "--frames", "0:20", cwd=folder)
    assert "joint angles over time in" in done.stdout


def test_labels_with_and_without_a_person_are_the_same(fitted, tmp_path):
    folder, _, _ = fitted
    for name in ("anna", "plain"):
        done = mosca(
            "skeleton", "track", f"{name}.npz", "--subject", "s.npz", "--out", tmp_path / f"{name}.csv",
            "--frames", "10:20", cwd=folder,
        )  # fmt: skip
        assert "11 of 11 frames solved" in done.stdout
    assert (tmp_path / "anna.csv").read_bytes() == (tmp_path / "plain.csv").read_bytes()


def test_one_person_of_two(fitted, tmp_path):
    """Two sets at once are refused; --person takes one of them."""
    folder, _, _ = fitted
    anna, _ = take(MODEL, 20, prefix="Anna:")
    ben, _ = take(MODEL, 20, prefix="Ben:", seed=2)
    columns = {name: [getattr(one, name) for one in (anna, ben)] for name in Tracks.__dataclass_fields__}
    columns["track"][1] = columns["track"][1] + 100
    columns["xyz"][1] = columns["xyz"][1] + [2.0, 0, 0]
    both = {name: np.concatenate(parts) for name, parts in columns.items()}
    both = Tracks(**both).select(np.lexsort((both["track"], both["frame"])))
    written(tmp_path / "two.npz", both)
    words = ["skeleton", "track", tmp_path / "two.npz", "--subject", "s.npz", "--out", tmp_path / "j.csv"]
    line = refusal(*words, cwd=folder)
    assert "Anna:LASI and Ben:LASI stand at once in frame 0 (tracks 0 and 100)" in line
    assert "--person Anna takes one person" in line
    done = mosca(*words, "--person", "Ben", cwd=folder)
    assert "20 of 20 frames solved" in done.stdout
    joints = read_joints_csv(tmp_path / "j.csv")
    hip = joints.centre[0, joints.joints.index("l_hip"), 0]
    assert hip == pytest.approx(2.0, abs=0.2)
    assert "--person Eve: " in refusal(*words, "--person", "Eve", cwd=folder)


TRACK = "skeleton track plain.npz --subject s.npz "
FIT = "skeleton fit {} --out new.npz"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (TRACK, "nothing to write; give --out, --angles,"),
        (TRACK + "--out new.txt", "new.txt: suffix '.txt' given; .csv is wanted here"),
        (TRACK + "--plot new.png", "new.png: suffix '.png' given; .svg is wanted here"),
        (TRACK + "--out new.csv --angles new.csv", "a file stands twice"),
        (TRACK + "--out nowhere/new.csv", "nowhere"),
        (TRACK + "--out new.csv --frames 900:999", "plain.npz: no samples in frames 900:999"),
        (TRACK + "--out new.csv --heading nan", "nan is no finite number"),
        ("skeleton track plain.npz --subject plain.npz --out new.csv", "plain.npz: holds no skeleton subject: mod"),
        ("skeleton track plain.npz --subject none.npz --out new.csv", "none.npz: no such file"),
        ("skeleton track arms.npz --subject s.npz --out new.csv", "arms.npz: 0 of its labels are markers of s.npz"),
        (FIT.format("none.npz"), "none.npz: no such file"),
        (FIT.format("bare.npz"), "bare.npz: no track has a label; 'mosca labels auto' names"),
        (FIT.format("odd.npz"), "odd.npz: 0 of its labels are markers of"),
        (FIT.format("odd.npz"), "l.ankle (LANK?)"),
        (FIT.format("mm.npz"), "mm.npz: the subject would be 99"),
        (FIT.format("mm.npz"), "Are the coordinates in metres?"),
        ("skeleton track mm.npz --subject s.npz --out new.csv", "Are the coordinates in metres?"),
        (FIT.format("plain.npz") + " --model s.npz", "s.npz: cannot be read: no utf-8 text"),
        (FIT.format("plain.npz") + " --model none.xml", "none.xml: no such file"),
        (FIT.format("plain.npz") + " --mjcf new.txt", "new.txt: suffix '.txt' given; a model is an .xml file"),
        ("skeleton fit plain.npz --out new.toml", "new.toml: suffix '.toml' given; a subject is a .npz file"),
    ],
)
def test_wrong_inputs_leave_nothing(fitted, words, told):
    folder, _, _ = fitted
    tracks, _ = take(MODEL, 3)
    if not (folder / "bare.npz").exists():
        written(folder / "bare.npz", relabelled(tracks, lambda label: ""))
        names = {label: f"x{label}x{label}" for label in MODEL.labels} | {"LANK": "l.ankle"}
        written(folder / "odd.npz", relabelled(tracks, names.__getitem__))
        written(folder / "arms.npz", relabelled(tracks, lambda label: f"arm-{label}"))
        columns = {name: getattr(tracks, name) for name in Tracks.__dataclass_fields__}
        written(folder / "mm.npz", Tracks(**columns | {"xyz": 1e3 * tracks.xyz}))
    before = sorted(folder.iterdir())
    assert told in refusal(*words.split(), cwd=folder)
    assert sorted(folder.iterdir()) == before


@pytest.mark.data
@pytest.mark.slow
def test_a_real_walk(tmp_path):
    """CMU subject 2 walks, 343 frames, 41 markers: an adult's size, and markers as near to the model as skin."""
    path = PEOPLE / "cmu_02_01.c3d"
    if not path.is_file():
        pytest.skip(f"needs {path} of MOSCA_DATA")
    done = mosca("skeleton", "fit", path, "--out", "s.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert float(re.search(r"^residuals: (\S+) mm", done.stdout, re.M)[1]) < 10
    subject = read_subject(tmp_path / "s.npz")
    assert 0.9 < subject.size < 1.1
    done = mosca("skeleton", "track", path, "--subject", "s.npz", "--out", "j.csv", "--bvh", "w.bvh", cwd=tmp_path)
    assert "343 of 343 frames solved" in done.stdout
