"""The actor: markers on the skin, limbs, walks in their box, recordings played as read."""

import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion, forward_kinematics
from mosca.errors import InputError
from twin.scenes.actor import build_actor
from twin.scenes.actor_markers import MARKER_SITES
from twin.scenes.gait import GAIT_PATHS, GaitPath
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.scenes.world import SEAT_M
from twin.truth_log import joints_at

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"
CENTER, SIZE = np.array([0.0, 0.0, 1.25]), np.array([2.5, 2.5, 2.5])
HALL = np.array([6.0, 6.0, 2.5])
ASF_UNIT_M = 0.0254 / 0.45

RECORDINGS: dict[str, dict[str, Any]] = {
    "walk": {"motion_file": "asfamc/02/02_01.amc", "skeleton_file": "asfamc/02/02.asf", "duration_s": 2.7},
    "dance": {
        "motion_file": "asfamc/usc520/131_04-dance.amc",
        "skeleton_file": "asfamc/usc520/131-dance.asf",
        "duration_s": 8.8,
    },
    "jump": {"motion_file": "bvh/13/13_11.bvh", "metres_per_unit": 0.0104, "duration_s": 3.2},
    "asf as bvh": {
        "motion_file": "bvh/16/16_01.bvh",
        "metres_per_unit": ASF_UNIT_M,
        "frame_rate_hz": 120.0,
        "duration_s": 2.4,
    },
}


def _walker(**settings: Any) -> Scene:
    given = {"duration_s": 4.0, "box_center_m": CENTER, "box_size_m": SIZE, "rng": np.random.default_rng(4)}
    return build_actor(**{**given, **settings})


def _recorded(name: str, **settings: Any) -> Scene:
    given = dict(RECORDINGS[name])
    for key in ("motion_file", "skeleton_file"):
        if key in given:
            given[key] = DATA / given[key]
            if not given[key].exists():
                pytest.skip(f"{given[key].name} is not in MOSCA_DATA")
    rng = np.random.default_rng(0)
    return build_actor(**{"box_center_m": CENTER, "box_size_m": HALL, "rng": rng, **given, **settings})


@pytest.fixture(scope="module", params=["gait", *RECORDINGS])
def full(request: pytest.FixtureRequest) -> Scene:
    """Return an actor with all 60 markers, from each kind of skeleton."""
    if request.param == "gait":
        return _walker(markers=60)
    return _recorded(request.param, markers=60)


def _at_rest(scene: Scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)  # qpos0: the neutral pose, arms out
    mujoco.mj_kinematics(scene.model, data)
    return data


@pytest.mark.data
def test_markers_sit_on_the_skin_and_in_no_other_limb(full: Scene) -> None:
    """Neutral pose: every ball is its base off its own part's skin, and outside all other parts.

    Where the part's shapes overlap (calf and shin) the nearer skin can be closer than the base, seen
    obliquely; 1.5 mm are left at least.
    """
    model, data = full.model, _at_rest(full)
    limbs = [g for g in range(model.ngeom) if model.geom_group[g] != MARKER_GROUP and model.geom_bodyid[g] > 0]
    for name, marker in zip(full.marker_names, full.marker_geoms, strict=True):
        gaps = {g: mujoco.mj_geomDistance(model, data, marker, g, 0.05, None) for g in limbs}
        own = min(gap for g, gap in gaps.items() if model.geom_bodyid[g] == model.geom_bodyid[marker])
        others = min(gap for g, gap in gaps.items() if model.geom_bodyid[g] != model.geom_bodyid[marker])
        assert 0.0015 < own < SEAT_M + 1e-4, f"{name}: {own} m off its part"
        assert others > 0.0005, f"{name} is {others} m from another part"


@pytest.mark.data
def test_no_two_markers_come_closer_than_6_cm_in_the_neutral_pose(full: Scene) -> None:
    xyz = _at_rest(full).geom_xpos[list(full.marker_geoms)]
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1) + 9 * np.eye(len(xyz))
    closest = np.unravel_index(distance.argmin(), distance.shape)
    assert distance.min() > 0.06, [full.marker_names[k] for k in closest]


def test_left_and_right_are_where_they_are_called() -> None:
    scene = _walker(markers=60)
    xyz = dict(zip(scene.marker_names, _at_rest(scene).geom_xpos[list(scene.marker_geoms)], strict=True))
    pairs = [name[1:] for name in xyz if "R" + name[1:] in xyz and "L" + name[1:] in xyz and name[0] == "L"]
    assert len(pairs) == 27  # 60 less C7, T10, CLAV, STRN, L3 and ARIEL
    for name in pairs:  # neutral pose: facing -y, left at +x
        assert xyz["L" + name][0] > 0 > xyz["R" + name][0]
    assert xyz["CLAV"][1] < xyz["C7"][1]
    assert xyz["LTOE"][1] < xyz["LHEE"][1]
    assert xyz["ARIEL"][2] == max(p[2] for p in xyz.values())


@pytest.mark.parametrize("markers", [30, 41, 50, 60])
def test_the_marker_set_can_be_smaller_or_larger(markers: int) -> None:
    scene = _walker(markers=markers, marker_diameter_m=0.02)
    assert scene.marker_names == tuple(site.name for site in MARKER_SITES[:markers])
    np.testing.assert_allclose(scene.model.geom_size[list(scene.marker_geoms), 0], 0.01)
    assert all(len(names) >= 3 for names in scene.bodies.values())


def test_default_is_50_markers_of_16_mm() -> None:
    scene = _walker()
    assert len(scene.marker_names) == 50
    np.testing.assert_allclose(scene.model.geom_size[list(scene.marker_geoms), 0], 0.008)
    assert 60 < scene.model.body_mass.sum() < 95  # limbs of water weigh what a person of 1.75 m weighs


@pytest.mark.parametrize("path", GAIT_PATHS)
@pytest.mark.parametrize(("speed", "size"), [(0.6, 2.5), (1.0, 2.5), (1.5, 4.0)])
def test_a_walker_stays_in_its_box_and_on_the_floor(path: GaitPath, speed: float, size: float) -> None:
    center, box = np.array([0.3, -0.2, 1.25]), np.array([size, size + 0.5, 2.5])
    scene = _walker(gait=path, speed_mps=speed, box_center_m=center, box_size_m=box, duration_s=12.0)
    sampler, model = scene.sampler(), scene.model
    floor = model.geom("floor").id
    solid = [g for g in range(model.ngeom) if model.geom_group[g] != MARKER_GROUP and g != floor]
    lowest = []
    for t in np.linspace(-0.1, 12.1, 120):
        xyz = sampler.at(t).marker_xyz
        assert (np.abs(xyz - center) < box / 2).all()
        gaps = [mujoco.mj_geomDistance(model, sampler.data, floor, g, 1.0, None) for g in solid]
        lowest.append(min(gaps))
    # The lower foot stays within 2 cm of the floor (1.3 cm measured at 1 m/s) and never goes through it.
    assert min(lowest) > -1e-6
    assert max(lowest) < 0.03


def _angles_deg(scene: Scene, joint: str, times: Array) -> Array:
    joints = joints_at(scene, times)
    assert joints is not None
    wxyz = joints.rotation[:, joints.names.index(joint)]
    return np.asarray(np.rad2deg(Rotation.from_quat(wxyz, scalar_first=True).as_euler("ZXY")))


def test_a_walker_in_full_detail_moves_hips_and_pelvis_as_people_do() -> None:
    """Kadaba et al. 1990 in degrees: adduction in stance 3 to 8, abduction in swing 3 to 8, rotation ranges over 8 to
    18, obliquity 6 to 12; knees bend twice a stride. The planar walker's hips stay within 2.
    """
    times = np.arange(0.0, 1 / 0.85, 0.005)  # a stride at 1 m/s
    full = _walker(gait="in_place", gait_detail="full")
    for side, mirror in (("l", 1.0), ("r", -1.0)):
        hip, knee = _angles_deg(full, f"{side}_hip", times), _angles_deg(full, f"{side}_knee", times)
        adduction = -mirror * hip[:, 1]
        assert 3.0 < adduction.max() < 8.0
        assert 3.0 < -adduction.min() < 8.0
        behind = np.diff(hip[:, 0], append=hip[0, 0]) < 0  # the thigh goes back: stance
        assert adduction[behind].mean() > 1.5
        assert adduction[~behind].mean() < -2.0
        assert 8.0 < np.ptp(hip[:, 2]) < 18.0
        bend = -knee[:, 0]
        peaks = (bend > np.roll(bend, 1)) & (bend >= np.roll(bend, -1))
        assert peaks.sum() == 2
        assert 10.0 < bend[peaks].min() < 25.0
        assert np.abs(_angles_deg(_walker(gait="in_place"), f"{side}_hip", times)[:, 1]).max() < 2.0
    sampler, across = full.sampler(), []
    for t in times:
        sampler.at(float(t))
        hips = sampler.data.body("lfemur").xpos - sampler.data.body("rfemur").xpos
        across.append(np.rad2deg(np.arcsin(hips[2] / np.linalg.norm(hips))))
    assert 6.0 < np.ptp(across) < 12.0


@pytest.mark.parametrize("path", GAIT_PATHS)
def test_a_walker_in_full_detail_stays_in_its_box_and_on_the_floor(path: GaitPath) -> None:
    scene = _walker(gait=path, gait_detail="full", duration_s=6.0)
    sampler, model = scene.sampler(), scene.model
    floor, lowest = model.geom("floor").id, []
    solid = [g for g in range(model.ngeom) if model.geom_group[g] != MARKER_GROUP and g != floor]
    for t in np.linspace(-0.1, 6.1, 90):
        assert (np.abs(sampler.at(t).marker_xyz - CENTER) < SIZE / 2).all()
        lowest.append(min(mujoco.mj_geomDistance(model, sampler.data, floor, g, 1.0, None) for g in solid))
    assert min(lowest) > -1e-6
    assert max(lowest) < 0.03
    with pytest.raises(InputError, match="gait_detail = 'fine' given; allowed: planar, full"):
        _walker(gait_detail="fine")


def test_a_walker_walks_at_the_speed_asked_for() -> None:
    scene = _walker(gait="circle", speed_mps=0.8, duration_s=5.0)
    root = np.array([scene.configuration_at(t)[:2] for t in np.arange(0, 5, 0.01)])
    way = np.linalg.norm(np.diff(root, axis=0), axis=1).sum()
    assert way == pytest.approx(0.8 * 4.99, rel=1e-3)
    # It faces its direction of motion: the nose side (-y of the root) points along the path.
    qpos = scene.configuration_at(1.0)
    ahead = np.zeros(3)
    mujoco.mju_rotVecQuat(ahead, np.array([0.0, -1.0, 0.0]), qpos[3:7])
    going = root[101] - root[99]
    assert ahead[:2] @ going / np.linalg.norm(going) > 0.99


def test_a_walkers_markers_stay_out_of_its_other_limbs() -> None:
    scene = _walker(gait="circle", speed_mps=1.2, box_size_m=HALL, markers=60)
    model, sampler = scene.model, scene.sampler()
    limbs = [g for g in range(model.ngeom) if model.geom_group[g] != MARKER_GROUP and model.geom_bodyid[g] > 0]
    for t in np.linspace(0, 1.5, 16):
        sampler.at(t)
        for marker in scene.marker_geoms:
            for g in limbs:
                if model.geom_bodyid[g] != model.geom_bodyid[marker]:
                    assert mujoco.mj_geomDistance(model, sampler.data, marker, g, 0.01, None) > -1e-3


def _read(name: str) -> Motion:
    given = RECORDINGS[name]
    if "skeleton_file" in given:
        return read_asf_amc(DATA / given["skeleton_file"], DATA / given["motion_file"])
    return read_bvh(
        DATA / given["motion_file"],
        metres_per_unit=given["metres_per_unit"],
        frame_rate_hz=given.get("frame_rate_hz"),
        drop_frames=1,
    )


@pytest.mark.data
@pytest.mark.parametrize("name", RECORDINGS)
def test_bodies_stand_where_the_recording_says_at_each_frame(name: str) -> None:
    """MuJoCo's kinematics against the reader's own, two codes: every joint at every 10th frame."""
    scene = _recorded(name, placement="file", keep_in_box=False, start_s=0.1)
    motion, sampler = _read(name), scene.sampler()
    positions, _ = forward_kinematics(motion)
    bodies = [(scene.model.body(b).name, b) for b in range(1, scene.model.nbody)]
    joints = [motion.skeleton.index(body) for body, _ in bodies]
    for k in range(12, len(positions) - 12, 10):
        sampler.at(k / motion.frame_rate_hz - 0.1)
        np.testing.assert_allclose(sampler.data.xpos[[b for _, b in bodies]], positions[k, joints], atol=1e-6)


@pytest.mark.data
@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_has_no_corners_at_its_frames(name: str) -> None:
    """Straight segments between 120 Hz frames would jump by acceleration / 120 Hz: 0.1 m/s and more."""
    scene = _recorded(name)
    sampler, e = scene.sampler(), 1e-7
    for k in range(12, int(scene.duration_s * 120), 7):
        t = k / 120 - 0.1  # start_s is 0.1 s: these are the recording's own frames
        before, here, after = (sampler.at(u).marker_xyz for u in (t - e, t, t + e))
        assert np.abs((after - here) / e - (here - before) / e).max() < 2e-3


@pytest.mark.data
@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_is_put_over_the_middle_of_the_box_and_on_the_floor(name: str) -> None:
    center = np.array([1.0, 2.0, 1.3])
    scene = _recorded(name, box_center_m=center, heading_deg=30.0)
    sampler, model = scene.sampler(), scene.model
    floor, lowest = model.geom("floor").id, []
    feet = [g for g in range(model.ngeom) if "foot" in model.geom(g).name]
    xyz = []
    for t in np.linspace(0, scene.duration_s, 200):
        xyz.append(sampler.at(t).marker_xyz)
        lowest.append(min(mujoco.mj_geomDistance(model, sampler.data, floor, g, 3.0, None) for g in feet))
    middle = (np.min(xyz, axis=(0, 1)) + np.max(xyz, axis=(0, 1))) / 2
    np.testing.assert_allclose(middle[:2], center[:2], atol=0.1)
    assert -1e-3 < min(lowest) < 5e-3
    assert (np.abs(np.array(xyz)[..., :2] - center[:2]) < HALL[:2] / 2).all()


@pytest.mark.data
def test_errors_say_what_the_recording_has() -> None:
    with pytest.raises(InputError, match=r"lasts 2\.850 s \(343 frames at 120 Hz\)"):
        _recorded("walk", duration_s=5.0)
    with pytest.raises(InputError, match=r"moves through 0\.\d\d x 4\.\d\d m up to 1\.\d\d m; the box is 2\.5"):
        _recorded("walk", box_size_m=SIZE)
    assert _recorded("walk", box_size_m=SIZE, keep_in_box=False).duration_s == 2.7
    with pytest.raises(InputError, match="set metres_per_unit"):
        _recorded("asf as bvh", metres_per_unit=0.01)
    with pytest.raises(InputError, match=r"an \.amc with its \.asf"):
        _recorded("walk", skeleton_file=None)


def test_other_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="30 to 60"):
        _walker(markers=61)
    with pytest.raises(InputError, match="allowed: in_place, circle, back_and_forth"):
        _walker(gait="moonwalk")
    with pytest.raises(InputError, match="use gait = 'in_place'"):
        _walker(box_size_m=np.array([1.2, 1.2, 2.5]))
    with pytest.raises(InputError, match=r"the box ends at 1\.50 m"):
        _walker(box_size_m=np.array([2.5, 2.5, 0.5]))
    with pytest.raises(InputError, match="speed_mps = -1"):
        _walker(speed_mps=-1.0)
    bvh = tmp_path / "arm.bvh"
    bvh.write_text(
        "HIERARCHY\nROOT hip\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\nEnd Site\n{\nOFFSET 0 1 0\n"
        "}\n}\nMOTION\nFrames: 2\nFrame Time: 0.1\n0 0 0\n0 0 0\n"
    )
    with pytest.raises(InputError, match=r"no joint for abdomen \(upperback or .*the file has hip, hip_end"):
        _walker(motion_file=bvh)


def test_markers_sit_where_other_hands_put_them():
    """Off by the stated sigma along the skin, by half across it; alike in all actions of a seed."""

    def made(action, sigma_m):
        box = {"box_center_m": [0, 0, 1.3], "box_size_m": [4, 4, 2.8]}
        return build_actor(
            duration_s=0.2, **box, rng=np.random.default_rng(3), action=action, seat_sigma_m=sigma_m
        )  # fmt: skip

    nominal, again, other = made("walk", 0.0), made("walk", 0.005), made("dance", 0.005)
    geoms = list(nominal.marker_geoms)
    moved = again.model.geom_pos[geoms] - nominal.model.geom_pos[geoms]
    np.testing.assert_array_equal(again.model.geom_pos[geoms], other.model.geom_pos[geoms])
    # 50 markers: two coordinates of 5 mm and one of 2.5, so 7.5 mm in the root mean square, to a tenth by chance
    assert 0.0060 < np.sqrt(np.mean(np.sum(moved**2, axis=1))) < 0.0090
    with pytest.raises(InputError, match="seat_sigma_m = 1 given"):
        made("walk", 1)
