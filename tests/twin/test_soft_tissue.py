"""Markers that slide on the bones: sizes, directions, what they share, the damped spring, and what stays as it is."""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.errors import InputError
from scenarios.build.scene import build_scene
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.spec.scenes import ActorScene
from twin.scenes.actor import build_actor
from twin.scenes.actor_markers import MARKER_SITES, seats
from twin.scenes.anatomy import limb_shapes, read_anatomy
from twin.scenes.gait import walker_skeleton
from twin.scenes.paths import quaternion_addresses
from twin.scenes.scene import Scene
from twin.scenes.soft_tissue import SoftTissue, along_skin, drawn_skin, response, soft_tissue, terms
from twin.truth_log import joints_at

CENTER, SIZE = np.array([0.0, 0.0, 1.5]), np.array([3.0, 3.0, 3.0])
KINDS = {site.name: site.part.removeprefix("l_").removeprefix("r_") for site in MARKER_SITES}
TIMES = np.linspace(-0.1, 2.1, 45)


def actor(seed: int = 4, **settings: Any) -> Scene:
    wanted = {"duration_s": 2.0, "box_center_m": CENTER, "box_size_m": SIZE, "rng": np.random.default_rng(seed)}
    return build_actor(**{**wanted, **settings})


def softened(scene: Scene) -> SoftTissue:
    assert isinstance(scene.configuration_at, SoftTissue)
    return scene.configuration_at


def positions(scene: Scene, times: Array = TIMES) -> Array:
    sampler = scene.sampler()
    return np.array([sampler.at(float(t)).marker_xyz for t in times])


def test_bones_move_as_ever_and_only_markers_slide() -> None:
    """The same seed: bones, joints' truth and shapes are those of a still skin; markers are off by millimetres."""
    still, soft = actor(markers=60), actor(markers=60, skin="strong")
    a, b = still.sampler(), soft.sampler()
    for t in TIMES:
        a.at(float(t)), b.at(float(t))
        for k in range(1, still.model.nbody):
            name = still.model.body(k).name
            np.testing.assert_allclose(b.data.body(name).xpos, a.data.body(name).xpos, atol=1e-9)
    one, other = joints_at(still, TIMES[:5]), joints_at(soft, TIMES[:5])
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(other.centre, one.centre, atol=1e-9)
    np.testing.assert_allclose(other.rotation, one.rotation, atol=1e-9)
    off = np.linalg.norm(positions(soft) - positions(still), axis=2)
    assert 0.002 < np.sqrt(np.mean(off**2)) < 0.02
    assert off.min(axis=0).max() > 0.0
    assert off.max() < 0.06


@pytest.fixture(scope="module")
def persons() -> tuple[list[str], Array, Array]:
    """Return marker names (m), normals (m, 3), and displacements (n, m, 3) of n persons at 1 rad in all joints."""
    anatomy = read_anatomy(walker_skeleton(1.75), "walker")
    seated = seats(anatomy, limb_shapes(anatomy), 50, "default")
    turned = np.array([[np.sqrt(0.75), 0.3, 0.0, 0.4]])  # 2 sin(angle / 2) = 1
    found = []
    for seed in range(200):
        skin = drawn_skin(anatomy, seated, "strong", np.random.default_rng(seed))
        found.append(skin.posture @ np.tile(terms(turned)[0], len(skin.joints)))
    slid = np.array(found).reshape(200, -1, 3) / anatomy.scale
    return [seat.name for seat in seated], np.array([seat.normal for seat in seated]), slid


def test_displacements_lie_along_the_skin_and_have_the_sizes_stated(persons: tuple[list[str], Array, Array]) -> None:
    """Rms of the docs' table, and a fifth of the variance along the normal; 200 persons."""
    names, normal, slid = persons
    kinds = np.array([KINDS[name] for name in names])
    stated = {
        "thigh": 15.0,
        "shank": 10.0,
        "pelvis": 8.0,
        "upper_arm": 8.0,
        "forearm": 4.0,
        "chest": 4.0,
        "foot": 2.5,
    }
    square = np.sum(slid**2, axis=2)
    for kind, expected in stated.items():
        assert 1e3 * np.sqrt(square[:, kinds == kind].mean()) == pytest.approx(expected, rel=0.1), kind
    across = np.einsum("nma,ma->nm", slid, normal) ** 2
    assert (across / square.mean(axis=0)).mean() == pytest.approx(0.2, abs=0.02)


def test_markers_of_a_thigh_share_half_of_their_variance(persons: tuple[list[str], Array, Array]) -> None:
    """Correlation of two markers' displacements along the thigh, which both have along the skin: one half."""
    names, _, slid = persons
    a, b = (slid[:, names.index(name), 2] for name in ("LTHI", "LTHF"))
    assert np.mean(a * b) / np.sqrt(np.mean(a * a) * np.mean(b * b)) == pytest.approx(0.5, abs=0.15)
    other = slid[:, names.index("RTHI"), 2]
    assert abs(np.mean(a * other) / np.mean(a * a)) < 0.2


def test_moderate_is_two_fifths_of_strong() -> None:
    strong, moderate = softened(actor(skin="strong")), softened(actor(skin="moderate"))
    np.testing.assert_allclose(moderate.posture, 0.4 * strong.posture, rtol=1e-12)
    np.testing.assert_allclose(moderate.wobble, 0.4 * strong.wobble, rtol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_a_fifth_of_an_isotropic_variance_stays_along_the_normal(vector: list[float]) -> None:
    """E d d^T = M M^T for unit variance in each axis: trace 3 as before, and normal part 0.2 of it."""
    normal = np.array(vector) / np.linalg.norm(vector)
    m = along_skin(normal)
    assert np.trace(m @ m.T) == pytest.approx(3.0)
    assert normal @ m @ m.T @ normal == pytest.approx(0.6)


@given(st.floats(0.01, 3.1), st.integers(0, 999))
def test_terms_are_bounded_and_of_unit_length_at_one_radian(angle: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    wxyz = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_quat(scalar_first=True)
    found = terms(wxyz[None])[0]
    u = 2 * np.sin(angle / 2)
    g = np.sqrt(2) * u / np.sqrt(1 + u**2)
    assert np.linalg.norm(found[:3]) == pytest.approx(g)
    assert np.linalg.norm(found[3:]) == pytest.approx(g**2)
    assert g < 1.27


@pytest.mark.parametrize(("natural_hz", "damping"), [(10.0, 0.3), (15.0, 0.3), (12.0, 0.6)])
def test_tissue_rings_as_a_damped_spring(natural_hz: float, damping: float) -> None:
    """A step of the acceleration: x = -a / w^2 (1 - e^(-zwt) (cos + z / sqrt(1 - z^2) sin)); a strike: by scipy."""
    w, root = 2 * np.pi * natural_hz, np.sqrt(1 - damping**2)
    time = np.arange(200) / 200.0

    def step(t: Array) -> Array:
        fading = np.exp(-damping * w * t) * (np.cos(w * root * t) + damping / root * np.sin(w * root * t))
        return np.asarray(-9.0 / w**2 * (1 - fading))

    # linear between instants: a step is a ramp of one interval, the mean of the steps that come during it
    nodes, weights = np.polynomial.legendre.leggauss(6)
    ramp = np.sum([v / 2 * step(time + (1 + u) / 400.0) for u, v in zip(nodes, weights, strict=True)], axis=0)
    found = response(np.concatenate([np.zeros((1, 1)), np.full((200, 1), 9.0)]), natural_hz, damping)[1:, 0]
    np.testing.assert_allclose(found, ramp, atol=1e-10)

    def strike(t: float) -> float:
        return 30.0 * float(np.exp(-(((t - 0.2) / 0.03) ** 2)))

    def law(t: float, y: Array) -> list[float]:
        return [y[1], -strike(t) - 2 * damping * w * y[1] - w * w * y[0]]

    expected = solve_ivp(law, (0, time[-1]), [0, 0], t_eval=time, rtol=1e-9, atol=1e-12, max_step=0.005).y[0]
    found = response(np.array([[strike(t)] for t in time]), natural_hz, damping)[:, 0]
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())


@pytest.fixture(scope="module")
def jumper() -> Scene:
    return actor(action="jump", skin="strong", duration_s=6.0)


def test_a_jump_sets_thighs_ringing(jumper: Scene) -> None:
    """What is left without posture: more for a jumper than for someone walking, and millimetres."""
    sizes = {}
    for action, scene in (("walk", actor(skin="strong", duration_s=6.0)), ("jump", jumper)):
        soft = softened(scene)
        rang = np.array([soft.wobble @ soft.tissue(t) for t in np.arange(0.0, 6.0, 0.01)]).reshape(600, -1, 3)
        sizes[action] = np.linalg.norm(rang - rang.mean(axis=0), axis=2).max()
    assert 0.0002 < sizes["walk"] < sizes["jump"] < 0.02


def test_slow_wobble_is_the_bones_acceleration_over_the_square_of_the_frequency(jumper: Scene) -> None:
    """Below its resonance tissue lags behind the bone by a / w^2: along -a, by 1.1 to 2.6 mm at 10 m/s^2.

    It stiffens: x / sqrt(1 + x^2 / s^2) is 0.85 of x at 0.6 s.
    """
    scene = jumper
    soft, sampler = softened(scene), scene.sampler()
    chest = sorted({s.part for s in MARKER_SITES if s.name in scene.marker_names}).index("chest")
    times, h = np.arange(0.0, 6.0, 0.01), 0.01
    body = scene.model.body("thorax").id
    xyz, lag = [], []
    for t in (times[0] - h, *times, times[-1] + h):
        sampler.at(float(t))
        xyz.append(sampler.data.xpos[body].copy())
        lag.append(sampler.data.xmat[body].reshape(3, 3) @ soft.tissue(t)[3 * chest : 3 * chest + 3])
    acceleration, moved = np.diff(np.array(xyz), 2, axis=0) / h**2, np.array(lag)[1:-1]
    share = -np.sum(acceleration * moved) / np.sum(acceleration**2)
    assert 0.85 * (2 * np.pi * 15.0) ** -2 < share < (2 * np.pi * 9.0) ** -2
    assert np.corrcoef(-acceleration.ravel(), moved.ravel())[0, 1] > 0.75


def test_skin_is_at_rest_when_arms_hang_and_the_sign_of_quaternions_says_nothing() -> None:
    """Left arm turned about y by 90 degrees, right one by -90: hands below shoulders, no displacement."""
    scene = actor(skin="strong")
    soft, model = softened(scene), scene.model
    qpos, data = model.qpos0.copy(), mujoco.MjData(model)
    for name, sign in (("lhumerus", 1.0), ("rhumerus", -1.0)):
        start = int(model.jnt_qposadr[model.body(name).jntadr[0]])
        qpos[start : start + 4] = np.sqrt(0.5) * np.array([1.0, 0.0, sign, 0.0])
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    for side in "lr":
        below = data.body(f"{side}humerus").xpos - data.body(f"{side}hand").xpos
        assert below[2] == pytest.approx(np.linalg.norm(below))
    still = replace(soft, bones=lambda _t: qpos.copy())
    rang = (soft.wobble @ soft.tissue(0.5)).reshape(-1, 3)
    np.testing.assert_allclose(still(0.5)[soft.slides], rang, atol=1e-12)

    given: dict[str, Any] = {
        "anatomy": read_anatomy(walker_skeleton(1.75), "walker"),
        "skin": "strong",
        "duration_s": 0.2,
    }
    seated = seats(given["anatomy"], limb_shapes(given["anatomy"]), 50, "default")
    starts = quaternion_addresses(model)[0][:, None] + np.arange(4)

    def turned_over(t: float) -> Array:
        over = soft.bones(t)
        over[starts] *= -1
        return over

    one, other = (
        soft_tissue(bones, model, seated=seated, rng=np.random.default_rng(1), **given)(0.1)[soft.slides]
        for bones in (soft.bones, turned_over)
    )
    np.testing.assert_allclose(other, one, atol=1e-12)


def test_a_soft_skin_is_a_pure_smooth_function_of_time(jumper: Scene) -> None:
    scene, again = actor(skin="strong"), actor(skin="strong")
    for t in (-0.1, 0.0, 0.7331, 2.1):
        np.testing.assert_array_equal(scene.configuration_at(t), scene.configuration_at(t))
        np.testing.assert_allclose(scene.configuration_at(t), again.configuration_at(t), atol=1e-12)
    other = actor(5, skin="strong")
    assert np.abs(softened(other).posture - softened(scene).posture).max() > 1e-3
    soft = softened(jumper)

    def jump(t: float, h: float) -> float:
        x = [soft(t + k * h)[soft.slides] for k in range(-2, 3)]
        return float(np.abs((x[4] - 2 * x[3] + x[2]) - (x[2] - 2 * x[1] + x[0])).max() / h**2)

    times = np.concatenate([np.arange(0.0, 2.0, 0.05), np.arange(0.0025, 2.0, 0.1003)])
    assert max(jump(t, 2e-4) for t in times) < 20.0  # a kink of 1 cm/s would show as 50 m/s^2


@pytest.mark.data
def test_recordings_have_a_skin_too() -> None:
    from tests.twin.test_scenes_actor import _recorded

    still, soft = _recorded("walk"), _recorded("walk", skin="strong")
    times = np.linspace(0, 2.7, 28)
    off = np.linalg.norm(positions(soft, times) - positions(still, times), axis=2)
    assert 0.002 < np.sqrt(np.mean(off**2)) < 0.02


def test_the_anatomical_set_has_both_ends_of_knees_ankles_and_elbows() -> None:
    """A rest pose seen from the front: each pair lies on both sides of its joint, nearly level with it."""
    scene = actor(marker_set="anatomical")
    assert len(scene.marker_names) == 53
    left_out = {"LWT", "RWT", "RBAK"}
    medial = {side + name for side in "LR" for name in ("KNM", "ANM", "ELM")}
    assert set(scene.marker_names) == {s.name for s in MARKER_SITES[:50]} - left_out | medial
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    xyz = dict(zip(scene.marker_names, data.geom_xpos[list(scene.marker_geoms)], strict=True))
    for side in "lr":
        for outer, inner, bone, along in (
            ("KNE", "KNM", "tibia", 0), ("ANK", "ANM", "foot", 0), ("ELB", "ELM", "radius", 2)
        ):  # fmt: skip
            a, b, joint = xyz[side.upper() + outer], xyz[side.upper() + inner], data.body(f"{side}{bone}").xpos
            assert np.linalg.norm((a + b) / 2 - joint) < 0.025
            assert (a - joint)[along] * (b - joint)[along] < 0
    for action in ("walk", "dance"):  # feet together the balls inside the knees would touch: nobody moves like that
        moved = positions(actor(marker_set="anatomical", action=action, duration_s=6.0), np.arange(0.0, 6.0, 0.05))
        knees = [moved[:, scene.marker_names.index(name)] for name in ("LKNM", "RKNM")]
        assert np.linalg.norm(knees[0] - knees[1], axis=1).min() > 0.0165


def test_words_that_are_not_known_and_a_scenario_file_that_is_obeyed() -> None:
    with pytest.raises(InputError, match="skin = 'loose' given; allowed: off, moderate, strong"):
        actor(skin="loose")
    with pytest.raises(InputError, match="marker_set = 'hands' given; allowed: default, anatomical"):
        actor(marker_set="hands")
    with pytest.raises(ValueError, match="markers is of the default set; 'anatomical' has its own"):
        ActorScene.model_validate({"kind": "actor", "marker_set": "anatomical", "markers": 50})
    path = find("actor")
    words = ("scene.skin='moderate'", "scene.marker_set='anatomical'", "capture.duration_s=1")
    spec = load_scenario(path, words)
    if "markers" not in spec.scene.model_fields_set:
        made = build_scene(spec, path.parent)
        assert isinstance(made.configuration_at, SoftTissue)
        assert len(made.marker_names) == 53
