"""Run, boxing, dance and jump: speeds, joint limits, smoothness, gravity, feet, box, hiding, determinism.

Expected ranges: hand speeds of boxers (straight punches 6 to 8 m/s) and of recorded dancers (CMU subject 131:
3.6 and 5.3 m/s); joint ranges of the American Academy of Orthopaedic Surgeons; free fall.
"""

from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.data.arrays import Array
from mosca.data.motion.motion import matrices_from_quaternions
from mosca.errors import InputError
from scenarios.build.scene import build_scene
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.spec.scenes import ActorScene
from twin.scenes.actions import Action
from twin.scenes.actor import BuiltInConfiguration, build_actor
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.scenes.submovements import MovementSequence, minimum_jerk, there_and_back

ACTIONS = ("run", "boxing", "dance", "jump")
CENTER, SIZE = np.array([0.2, -0.1, 1.25]), np.array([2.5, 2.5, 2.5])
STEP_S = 0.005
GRAVITY = np.array([0.0, 0.0, -9.81])


def _actor(action: str, seed: int = 3, **settings: Any) -> Scene:
    given: dict[str, Any] = {"duration_s": 20.0, "box_center_m": CENTER, "box_size_m": SIZE, "markers": 50}
    return build_actor(**{**given, "action": action, "rng": np.random.default_rng(seed), **settings})


def _length(scene: Scene) -> float:
    assert isinstance(scene.configuration_at, BuiltInConfiguration)
    assert isinstance(scene.configuration_at.moved, Action)
    return scene.configuration_at.moved.length_s


def _start(scene: Scene) -> float:
    assert isinstance(scene.configuration_at, BuiltInConfiguration)
    assert isinstance(scene.configuration_at.moved, Action)
    return scene.configuration_at.moved.start_s


class Sampled:
    """A performance sampled over one loop."""

    def __init__(self, action: str) -> None:
        self.action, self.scene = action, _actor(action)
        sampler, model = self.scene.sampler(), self.scene.model
        floor = model.geom("floor").id
        feet = {
            side: [
                g for g in range(model.ngeom) if model.geom(g).name.split("/")[0] in (f"{side}_foot", f"{side}_toes")
            ]
            for side in "lr"
        }
        self.time_s = np.arange(0.0, _length(self.scene), STEP_S) - _start(self.scene)  # from the loop's beginning
        xyz, com, bodies, heights, left = [], [], [], [], []
        head = model.body("head").id
        for t in self.time_s:
            xyz.append(sampler.at(t).marker_xyz)
            mujoco.mj_comPos(model, sampler.data)
            com.append(sampler.data.subtree_com[1].copy())
            bodies.append(sampler.data.xpos.copy())
            left.append(sampler.data.xmat[head].reshape(3, 3)[:, 0].copy())
            heights.append(
                [min(mujoco.mj_geomDistance(model, sampler.data, floor, g, 2.0, None) for g in feet[s]) for s in "lr"]
            )
        self.xyz, self.com, self.bodies = np.array(xyz), np.array(com), np.array(bodies)
        self.soles, self.left_of_face = np.array(heights), np.array(left)
        self.speed = np.linalg.norm(np.diff(self.xyz, axis=0), axis=2) / STEP_S

    def speed_of(self, marker: str) -> Array:
        return self.speed[:, self.scene.marker_names.index(marker)]

    def body(self, name: str) -> Array:
        return self.bodies[:, self.scene.model.body(name).id]


@pytest.fixture(scope="module")
def performed() -> dict[str, Sampled]:
    return {action: Sampled(action) for action in ACTIONS}


@pytest.mark.parametrize(
    ("action", "slowest", "fastest", "marker"),
    [
        ("run", 1.5, 3.5, "WRA"),
        ("boxing", 6.0, 8.0, "WRA"),
        ("dance", 3.0, 5.0, "WRA"),
        ("dance", 3.0, 5.5, "FIN"),
        ("jump", 3.5, 6.5, "WRA"),
    ],
)
def test_hands_are_as_fast_as_those_of_people(
    performed: dict[str, Sampled], action: str, slowest: float, fastest: float, marker: str
) -> None:
    peaks = [performed[action].speed_of(side + marker).max() for side in "LR"]
    assert slowest < max(peaks) < fastest
    assert min(peaks) > 0.75 * max(peaks)
    assert performed[action].speed_of("C7").max() < 4.0  # the trunk: a jump's take-off and landing are the fastest


@pytest.mark.parametrize("action", ACTIONS)
def test_joints_stay_in_human_ranges(performed: dict[str, Sampled], action: str) -> None:
    scene = performed[action].scene
    qpos = np.array([scene.configuration_at(t) for t in performed[action].time_s[::4]])
    model = scene.model

    def local(name: str) -> Array:
        start = int(model.jnt_qposadr[model.body(name).jntadr[0]])
        return np.asarray(qpos[:, start : start + 4])

    def twist_deg(name: str, axis: int) -> Array:
        """Return the rotation about a rest axis of the joint."""
        wxyz = local(name)
        return (np.rad2deg(2 * np.arctan2(wxyz[:, 1 + axis], wxyz[:, 0])) + 180) % 360 - 180

    for side, sign in (("l", 1.0), ("r", -1.0)):
        knee, elbow = twist_deg(f"{side}tibia", 0), matrices_from_quaternions(local(f"{side}radius"))
        assert knee.min() > 0
        assert knee.max() < 135
        np.testing.assert_allclose(local(f"{side}tibia")[:, 2:], 0, atol=1e-6)  # a hinge
        # The forearm's axis in the upper arm's: it bends to the front only, and by 150 degrees at most.
        bend = np.rad2deg(np.arctan2(-sign * elbow[:, 1, 0], elbow[:, 0, 0]))
        assert bend.min() > 0
        assert bend.max() < 150
        np.testing.assert_allclose(elbow[:, 2, 0], 0, atol=1e-6)
        assert np.abs(twist_deg(f"{side}humerus", 0)).max() < 95  # rotation of the shoulder: 90 outward, 70 inward
        hip = matrices_from_quaternions(local(f"{side}femur"))
        flexion = np.rad2deg(np.arctan2(hip[:, 1, 2], hip[:, 2, 2]))  # of the thigh, to the front
        assert flexion.min() > -30
        assert flexion.max() < 125
        assert np.abs(np.rad2deg(np.arctan2(hip[:, 1, 0], hip[:, 0, 0]))).max() < 60
        ankle = twist_deg(f"{side}foot", 0)  # + is plantar
        assert ankle.min() > -38
        assert ankle.max() < 50
    for name in ("upperback", "thorax", "lowerneck", "head"):
        assert np.rad2deg(2 * np.arccos(np.abs(local(name)[:, 0]).min())) < 45


@pytest.mark.parametrize("action", ACTIONS)
def test_motion_is_smooth_to_the_second_derivative(action: str) -> None:
    """The step of the second difference over a shrinking stencil goes to zero with the stencil, everywhere."""
    scene = _actor(action)
    sampler = scene.sampler()
    rng = np.random.default_rng(0)
    knots = np.round(rng.uniform(0.0, _length(scene), 40) / STEP_S) * STEP_S
    start = _start(scene)
    times = [*(knots - start % STEP_S), _length(scene) - start]  # at knots, and where the loop closes

    def jump(t: float, h: float) -> float:
        x = [sampler.at(t + k * h).marker_xyz for k in range(-2, 3)]
        return float(np.abs((x[4] - 2 * x[3] + x[2]) - (x[2] - 2 * x[1] + x[0])).max() / h**2)

    wide, narrow = (np.array([jump(t, h) for t in times]) for h in (2e-3, 2e-4))
    # A kink in the velocity of 1 cm/s would show as 50 m/s^2 at the narrow stencil, and grow.
    assert narrow.max() < 12.0
    assert narrow.max() < 0.5 * max(wide.max(), 5.0)


def test_a_flying_body_falls_freely(performed: dict[str, Sampled]) -> None:
    """MuJoCo's centre of mass: g while both feet are off the floor, never less, for both jumps of the loop."""
    jump = performed["jump"]
    acceleration = np.diff(jump.com, 2, axis=0) / STEP_S**2
    flying = (jump.soles.min(axis=1) > 0.01)[1:-1]
    flights = np.split(np.nonzero(flying)[0], np.nonzero(np.diff(np.nonzero(flying)[0]) > 1)[0] + 1)
    assert len(flights) == 2
    for flight in flights:
        assert 0.35 < len(flight) * STEP_S < 0.60
        air = flight[3:-3]  # the spline through 200 Hz knots rings for 15 ms where the force sets in
        np.testing.assert_allclose(acceleration[air], np.tile(GRAVITY, (len(air), 1)), atol=0.05)
    assert acceleration[:, 2].min() > 1.04 * GRAVITY[2]  # the floor does not pull
    assert acceleration[:, 2].max() < 3 * 9.81
    assert np.ptp(jump.com[:, 2]) > 0.4


def test_a_runner_flies_between_steps_and_treads_at_the_belts_speed(performed: dict[str, Sampled]) -> None:
    """Novacheck 1998: 160 to 170 steps a minute, contact 0.22 to 0.28 s, up and down by 6 to 10 cm; peak force 2 to
    2.8 times the weight (Cavanagh and Lafortune 1980).
    """
    runner = performed["run"]
    assert 155 < 2 * 60 / _length(runner.scene) < 175
    acceleration = np.diff(runner.com, 2, axis=0) / STEP_S**2
    up = acceleration[:, 2]
    flying = np.abs(up - GRAVITY[2]) < 0.1
    assert 0.20 < flying.mean() < 0.40
    assert up.min() > 1.01 * GRAVITY[2]  # the belt does not pull
    assert 1.0 < up.max() / 9.81 < 1.8
    assert 0.06 < np.ptp(runner.com[:, 2]) < 0.10
    assert np.abs(acceleration[:, :2]).max() < 1.5
    assert runner.soles.min() > 0
    for k, side in enumerate("lr"):
        ball = runner.body(f"{side}toes")
        velocity = np.diff(ball, axis=0) / STEP_S
        tread = (runner.soles[1:, k] < 0.004) & (runner.soles[:-1, k] < 0.004)
        assert 0.22 < tread.sum() * STEP_S < 0.28
        middle = velocity[tread][3:-3]
        assert np.ptp(np.linalg.norm(middle, axis=1)) < 0.06
        assert 2.6 < np.linalg.norm(middle, axis=1).mean() < 3.2
        heel = runner.body(f"{side}foot")[:, 2]
        assert 0.30 < heel.max() < 0.50  # as high as the knee


@pytest.mark.parametrize("action", ["boxing", "dance", "jump"])
def test_feet_stand_on_the_floor_and_do_not_slide(performed: dict[str, Sampled], action: str) -> None:
    one = performed[action]
    assert one.soles.min() > -1e-6
    if action != "jump":
        assert one.soles.min(axis=1).max() < 0.02  # one foot stands at any time
    for k, side in enumerate("lr"):
        ball = one.body(f"{side}toes")
        speed = np.linalg.norm(np.diff(ball[:, :2], axis=0), axis=1) / STEP_S
        standing = (one.soles[1:, k] < 0.007) & (one.soles[:-1, k] < 0.007)
        assert standing.mean() > 0.4
        assert np.percentile(speed[standing], 99) < 0.15


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("seed", range(2))
def test_everyone_stays_in_the_box_and_out_of_himself(action: str, seed: int) -> None:
    scene = _actor(action, seed)
    sampler, model = scene.sampler(), scene.model
    limbs = [g for g in range(model.ngeom) if model.geom_group[g] != MARKER_GROUP and model.geom_bodyid[g] > 0]
    arms = [g for g in limbs if model.geom(g).name.split("/")[0][2:] in ("forearm", "hand")]
    body = model.geom_bodyid
    for t in np.arange(0.0, _length(scene), 0.1):
        xyz = sampler.at(t).marker_xyz
        assert (np.abs(xyz - CENTER) < SIZE / 2).all()
        for g in arms:
            for h in limbs:
                joined = body[g] == body[h] or model.body_parentid[body[g]] == body[h]
                if (
                    joined
                    or model.body_parentid[body[h]] == body[g]
                    or model.geom(h).name[:5] == model.geom(g).name[:5]
                ):
                    continue
                if model.geom(g).name[0] == model.geom(h).name[0] and "arm" in model.geom(h).name:
                    continue  # a bent arm's own upper arm
                assert mujoco.mj_geomDistance(model, sampler.data, g, h, 0.01, None) > -0.01, (
                    model.geom(g).name, model.geom(h).name, t
                )  # fmt: skip


def test_arms_cross_and_guard(performed: dict[str, Sampled]) -> None:
    """As the face sees it the wrists change sides; a boxer's hands are up more often than not."""
    for action in ("boxing", "dance"):
        one = performed[action]
        gap = np.sum((one.body("lhand") - one.body("rhand")) * one.left_of_face, axis=1)
        assert gap.min() < -0.05
        assert gap.max() > 0.2
    boxer = performed["boxing"]
    lifted = np.maximum(boxer.body("lhand")[:, 2], boxer.body("rhand")[:, 2]) - boxer.body("lowerneck")[:, 2]
    assert (lifted > 0.0).mean() > 0.5


def test_a_dancer_turns_and_squats_with_arms_overhead(performed: dict[str, Sampled]) -> None:
    dancer = performed["dance"]
    across = dancer.body("lfemur") - dancer.body("rfemur")
    turned = np.unwrap(np.arctan2(across[:, 1], across[:, 0]))
    assert np.ptp(turned) > 1.9 * np.pi
    assert abs(turned[-1] - turned[0]) < 0.1  # as much to the left as to the right
    pelvis = dancer.body("root")[:, 2]
    assert pelvis.max() - pelvis.min() > 0.27
    assert (np.minimum(dancer.body("lhand"), dancer.body("rhand"))[:, 2] - dancer.body("head")[:, 2]).max() > 0.1


@pytest.mark.parametrize("action", ACTIONS)
def test_one_seed_is_one_performance_and_loops(action: str) -> None:
    one, again, other = _actor(action, 5), _actor(action, 5), _actor(action, 0)
    length = _length(one)
    for t in (0.0, 1.234, 7.7):
        np.testing.assert_array_equal(one.configuration_at(t), again.configuration_at(t))
        assert np.abs(one.configuration_at(t) - other.configuration_at(t)).max() > 0.05
        np.testing.assert_allclose(one.configuration_at(t + 40 * length), one.configuration_at(t), atol=1e-9)


@pytest.mark.parametrize("action", ACTIONS)
def test_people_of_other_statures(action: str) -> None:
    stature = {"run": 1.9, "boxing": 1.9, "dance": 1.55, "jump": 1.65}[action]
    scene = _actor(
        action, stature_m=stature, box_size_m=np.array([3.0, 3.0, 3.0]), box_center_m=np.array([0, 0, 1.5])
    )
    highest = max(scene.sampler().at(t).marker_xyz[:, 2].max() for t in np.arange(0.0, 4.0, 0.1))
    assert stature - 0.25 < highest < stature + 0.6


def test_errors() -> None:
    with pytest.raises(InputError, match=r"action = 'dance': the person moves through .* the box is 1\.5 x 1\.5"):
        _actor("dance", box_size_m=np.array([1.5, 1.5, 2.5]))
    with pytest.raises(InputError, match="allowed: walk, run, boxing, dance, jump, range_of_motion"):
        _actor("swim")
    for more, said in (
        ({"gait": "circle"}, "gait is of action = 'walk'"),
        ({"gait_detail": "full"}, "gait_detail is of action = 'walk'"),
        ({"speed_mps": 1.0}, "speed_mps is of action = 'walk'"),
        ({"motion": "take.bvh"}, "leave one of them out"),
    ):
        with pytest.raises(ValueError, match=said):
            ActorScene.model_validate({"kind": "actor", "action": "boxing", **more})
    assert ActorScene(kind="actor", gait="in_place").action == "walk"


@given(st.lists(st.tuples(st.floats(0, 5), st.floats(0.1, 2), st.floats(-1, 1)), min_size=1, max_size=6))
def test_movements_add_up_to_the_last_target(moves: list[tuple[float, float, float]]) -> None:
    score = MovementSequence()
    score.begin(arm=0.25)
    for start, length, target in moves:
        score.move("arm", start, start + length, target)
    ends = score.at(np.array([-1.0, 8.0]))["arm"][:, 0]
    np.testing.assert_allclose(ends, [0.25, moves[-1][2]], atol=1e-12)


def test_curves_have_the_slopes_of_their_closed_forms() -> None:
    """Flash and Hogan: the peak speed is 15/8 of the mean, in the middle; a hill peaks at 1."""
    u = np.linspace(-0.2, 1.2, 2801)
    way, hill = minimum_jerk(u), there_and_back(u)
    assert np.gradient(way, u).max() == pytest.approx(15 / 8, abs=1e-4)
    assert way[0] == 0
    assert way[-1] == 1
    assert hill.max() == pytest.approx(1.0)
    for curve in (way, hill):
        assert np.abs(np.diff(curve, 3)).max() / (u[1] - u[0]) ** 3 < 400  # bounded third differences: C2


@pytest.mark.parametrize("words", ["action='boxing'", "gait='in_place'", "gait='back_and_forth'"])
def test_a_scenario_file_is_obeyed(words: str) -> None:
    path = find("actor")
    chosen = load_scenario(path, (f"scene.{words}", "scene.skin='off'", "capture.duration_s=1"))
    moved = build_scene(chosen, path.parent).configuration_at
    assert isinstance(moved, BuiltInConfiguration)
    assert isinstance(moved.moved, Action) if "boxing" in words else getattr(moved.moved, "path", "") in words
