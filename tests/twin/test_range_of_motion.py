"""The calibration movement: what every joint goes through, standing feet, smoothness, room, what the seed draws."""

from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.truth import JointTruth
from twin.scenes.actions import Action
from twin.scenes.actor import BuiltInConfiguration, build_actor
from twin.scenes.gait import walker_skeleton
from twin.scenes.posture import Balance, Performer
from twin.scenes.range_of_motion import range_of_motion
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.scenes.soft_tissue import Skin
from twin.truth_log import joints_at

CENTER, SIZE = np.array([0.2, -0.1, 1.25]), np.array([2.5, 2.5, 2.5])
STEP_S = 0.04


def actor(seed: int = 3, **settings: Any) -> Scene:
    given: dict[str, Any] = {"duration_s": 20.0, "box_center_m": CENTER, "box_size_m": SIZE, **settings}
    return build_actor(**{**given, "action": "range_of_motion", "rng": np.random.default_rng(seed)})


def loop_of(scene: Scene) -> Action:
    assert isinstance(scene.configuration_at, BuiltInConfiguration)
    assert isinstance(scene.configuration_at.moved, Action)
    return scene.configuration_at.moved


class Sampled:
    """One loop, from its beginning."""

    def __init__(self, seed: int) -> None:
        self.scene = actor(seed)
        loop, model = loop_of(self.scene), self.scene.model
        self.times = np.arange(0.0, loop.length_s, STEP_S) - loop.start_s
        joints = joints_at(self.scene, self.times)
        assert joints is not None
        self.joints: JointTruth = joints
        sampler, floor = self.scene.sampler(), model.geom("floor").id
        limbs = [g for g in range(model.ngeom) if model.geom_group[g] != MARKER_GROUP and model.geom_bodyid[g] > 0]
        part = {g: model.geom(g).name.split("/")[0] for g in limbs}
        feet = [[g for g in limbs if part[g] in (f"{side}_foot", f"{side}_toes")] for side in "lr"]
        soles, balls, centre, self.inside, self.closest = [], [], [], True, np.inf
        apart = [(g, h) for g in limbs for h in limbs if _may_meet(part[g], part[h])]
        for k, t in enumerate(self.times):
            xyz = sampler.at(float(t)).marker_xyz
            data = sampler.data
            self.inside &= bool((np.abs(xyz - CENTER) < SIZE / 2).all())
            soles.append([min(mujoco.mj_geomDistance(model, data, floor, g, 2.0, None) for g in f) for f in feet])
            balls.append([data.body(f"{side}toes").xpos.copy() for side in "lr"])
            if k % 4 == 0:
                mujoco.mj_comPos(model, data)
                centre.append(data.subtree_com[1].copy())
                near = [mujoco.mj_geomDistance(model, data, g, h, 0.05, None) for g, h in apart]
                self.closest = min(self.closest, *near)
        self.soles, self.balls, self.centre = np.array(soles), np.array(balls), np.array(centre)

    def angles_deg(self, joint: str) -> Array:
        """Return flexion about z, then about x, then about y of a joint (t, 3)."""
        wxyz = self.joints.rotation[:, self.joints.names.index(joint)]
        return np.asarray(np.rad2deg(Rotation.from_quat(wxyz, scalar_first=True).as_euler("ZXY")))


def _may_meet(one: str, other: str) -> bool:
    """Whether two parts are to stay apart: a hand from trunk and legs, a leg from the other."""
    legs = ("thigh", "shank", "foot", "toes")
    if one[2:] in ("forearm", "hand"):
        return other in ("pelvis", "abdomen", "chest", "head") or other[2:] in legs
    return one[2:] in legs and other[2:] in legs and one[0] == "l" and other[0] == "r"


@pytest.fixture(scope="module", params=[3, 8])
def loop(request: pytest.FixtureRequest) -> Sampled:
    return Sampled(request.param)


def test_every_joint_goes_through_what_a_laboratory_asks_for(loop: Sampled) -> None:
    """At least (asked for) and at most (ranges of the American Academy of Orthopaedic Surgeons) in degrees."""
    for side, mirror in (("l", -1.0), ("r", 1.0)):
        hip, knee, ankle = (loop.angles_deg(f"{side}_{name}") for name in ("hip", "knee", "ankle"))
        assert 30 < hip[:, 0].max() < 120
        assert -30 < hip[:, 0].min() < -20
        assert 23 < (-mirror * hip[:, 1]).max() < 45  # abduction
        assert np.ptp(hip[:, 2]) > 20
        assert 60 < -knee[:, 0].min() < 135
        np.testing.assert_allclose(knee[:, 1:], 0, atol=1e-3)
        assert np.ptp(ankle[:, 0]) > 35
        assert np.ptp(ankle[:, 1]) > 25
        shoulder, elbow, wrist = (loop.angles_deg(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist"))
        assert 75 < shoulder[:, 0].max() < 180
        assert 70 < (-mirror * shoulder[:, 1]).max() < 180
        assert np.ptp(shoulder[:, 2]) > 30
        assert 90 < elbow[:, 0].max() < 150
        assert elbow[:, 0].min() > 0
        assert np.ptp(elbow[:, 2]) > 50  # the forearm turned
        assert np.ptp(wrist[:, 0]) > 20
        assert np.ptp(wrist[:, 1]) > 20
    for joint, least in (("lumbar", (22, 35, 35)), ("neck", (40, 40, 70))):
        assert (np.ptp(loop.angles_deg(joint), axis=0) > least).all(), joint


def test_hips_are_swung_in_two_dimensions(loop: Sampled) -> None:
    """Star and circle: the thigh's directions spread over both axes, else no hip centre can be found from them."""
    for side in "lr":
        wxyz = loop.joints.rotation[:, loop.joints.names.index(f"{side}_hip")]
        along = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()[:, :, 1]
        spread_deg = np.rad2deg(np.sqrt(np.linalg.eigvalsh(np.cov(along.T))))
        assert spread_deg[1] > 4.0  # the lesser of the two across the thigh


@pytest.mark.parametrize(("skin", "least_mm", "most_mm"), [("off", 0.0, 0.01), ("strong", 1.0, 40.0)])
def test_hip_centres_are_found_from_markers_where_the_truth_has_them(
    skin: Skin, least_mm: float, most_mm: float
) -> None:
    """SCoRE (Ehrig et al. 2006) on poses by Kabsch's fit: two poses of markers say where they meet in one point."""
    scene = actor(skin=skin, duration_s=24.0)
    times = np.arange(0.0, 24.0, 0.25)
    sampler = scene.sampler()
    xyz = np.array([sampler.at(float(t)).marker_xyz for t in times])
    joints = joints_at(scene, times)
    assert joints is not None
    index = scene.marker_names.index
    pelvis = [index(name) for name in ("LASI", "RASI", "LPSI", "RPSI", "LWT", "RWT")]
    for side in "LR":
        poses = [fitted(xyz[:, m]) for m in (pelvis, [index(side + name) for name in ("THI", "THF", "KNE")])]
        (r1, t1), (r2, t2) = poses
        rows = np.concatenate([r1, -r2], axis=2).reshape(-1, 6)
        found = np.linalg.lstsq(rows, (t2 - t1).reshape(-1), rcond=None)[0]
        at = r1 @ found[:3] + t1
        hip = joints.centre[:, joints.names.index(f"{side.lower()}_hip")]
        off_mm = 1e3 * np.sqrt(np.mean(np.sum((at - hip) ** 2, axis=1)))
        assert least_mm <= off_mm < most_mm


def fitted(xyz: Array) -> tuple[Array, Array]:
    """Return rotations (t, 3, 3) and translations (t, 3) that take the first of t clouds (t, m, 3) to each."""
    middle = xyz.mean(axis=1)
    centred = xyz - middle[:, None]
    rotations = np.array([Rotation.align_vectors(cloud, centred[0])[0].as_matrix() for cloud in centred])
    return rotations, middle - rotations @ middle[0]


def test_one_foot_stands_at_any_time_and_does_not_slide(loop: Sampled) -> None:
    assert loop.soles.min() > -1e-6
    assert loop.soles.min(axis=1).max() < 0.003
    for k in range(2):
        standing = (loop.soles[1:, k] < 0.004) & (loop.soles[:-1, k] < 0.004)
        speed = np.linalg.norm(np.diff(loop.balls[:, k], axis=0), axis=1) / STEP_S
        assert 0.6 < standing.mean() < 0.85
        assert speed[standing].max() < 0.05
        assert loop.soles[:, k].max() > 0.1


def test_the_body_is_carried_by_the_foot_that_stands(loop: Sampled) -> None:
    """While a foot is in the air, the centre of mass is above the other, within 6 cm to its side."""
    across = loop.balls[0, 0] - loop.balls[0, 1]
    across = across[:2] / np.linalg.norm(across[:2])
    for air, stands in ((0, 1), (1, 0)):
        lifted = loop.soles[::4, air] > 0.03
        aside = np.abs((loop.centre - loop.balls[::4, stands])[:, :2] @ across)
        assert lifted.mean() > 0.15
        assert aside[lifted].max() < 0.06


def test_nothing_leaves_the_box_or_meets_itself(loop: Sampled) -> None:
    assert loop.inside
    assert loop.closest > 0.0


def test_it_is_smooth_also_where_the_loop_closes() -> None:
    scene = actor()
    sampler, length, start = scene.sampler(), loop_of(scene).length_s, loop_of(scene).start_s
    times = [*(np.random.default_rng(0).uniform(0.0, length, 40) - start), length - start]

    def jump(t: float, h: float) -> float:
        x = [sampler.at(t + k * h).marker_xyz for k in range(-2, 3)]
        return float(np.abs((x[4] - 2 * x[3] + x[2]) - (x[2] - 2 * x[1] + x[0])).max() / h**2)

    wide, narrow = (max(jump(t, h) for t in times) for h in (2e-3, 2e-4))
    assert narrow < 5.0  # a kink in the velocity of 1 cm/s would show as 50 m/s^2
    assert narrow < 0.5 * max(wide, 5.0)


def test_one_seed_is_one_loop_and_others_differ() -> None:
    one, again = actor(5), actor(5)
    length = loop_of(one).length_s
    np.testing.assert_array_equal(one.configuration_at(1.234), again.configuration_at(1.234))
    np.testing.assert_allclose(one.configuration_at(1.0 + 3 * length), one.configuration_at(1.0), atol=1e-9)
    other = actor(6)
    assert np.abs(other.configuration_at(1.234) - one.configuration_at(1.234)).max() > 0.05
    for scene in (one, other):
        assert 0.95 * 24.0 <= loop_of(scene).length_s <= 1.05 * 24.0


@pytest.mark.parametrize("stature", [1.5, 1.95])
def test_people_of_other_statures_stand_as_well(stature: float) -> None:
    scene = actor(stature_m=stature, box_size_m=np.array([3.0, 3.0, 3.0]), box_center_m=np.array([0, 0, 1.5]))
    model, sampler = scene.model, scene.sampler()
    feet = [g for g in range(model.ngeom) if model.geom(g).name.split("/")[0][2:] in ("foot", "toes")]
    for t in np.arange(0.0, 24.0, 0.2):
        sampler.at(t)
        gaps = [mujoco.mj_geomDistance(model, sampler.data, model.geom("floor").id, g, 2.0, None) for g in feet]
        assert -1e-6 < min(gaps) < 0.003


def test_a_loop_can_be_slower_or_faster() -> None:
    skeleton = walker_skeleton(1.75)
    performer = Performer(skeleton, 1.0, 0.036, Balance(np.ones(24), np.zeros((24, 3))))
    usual, slow = (range_of_motion(performer, np.random.default_rng(1), s) for s in (24.0, 48.0))
    assert slow.duration_s == pytest.approx(2 * usual.duration_s, rel=1e-3)
    np.testing.assert_allclose(slow.rotations[::2][: len(usual.rotations)], usual.rotations, atol=1e-2)
