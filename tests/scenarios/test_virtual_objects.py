"""Objects of a second scene: moved by bodies, pushing others, scored at the display's instant; bad input told."""

import json
import time
from contextlib import ExitStack

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Rig
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.formats.bodies.body_file import write_bodies
from mosca.pipeline import PipelineSettings
from mosca.rigid_bodies.prediction import PredictionSettings
from reports.virtual_evidence import VirtualEvidence
from reports.virtual_plots import objects_picture
from scenarios.cli.main import cli
from scenarios.commands.live_sources import LiveOptions, LiveSource, PacedFrames
from scenarios.commands.live_virtual import LiveVirtual, check_virtual, live_virtual
from scenarios.score.virtual_objects import object_errors, object_scores, shown_words
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.virtual.objects import BoundObjects, ShownPoses, bindings
from scenarios.virtual.scene import VirtualScene
from twin.scenes.scene import MARKER_GROUP, Scene

PUSHER = """<mujoco><option timestep="0.002"/><worldbody>
<geom type="plane" size="5 5 .1"/>
<body name="hand" mocap="true" pos="-1 0 .1"><geom type="box" size=".1 .1 .1"/></body>
<body name="crate" pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1" density="100"/></body>
<body name="post"><geom type="sphere" size=".05" pos="3 3 1"/></body>
</worldbody></mujoco>"""
PLACES = np.array([[0.1, 0.0, 0.0], [-0.1, 0.05, 0.0], [0.0, -0.1, 0.02], [0.0, 0.08, 0.06]])
BODY = RigidBody("drone", ("a", "b", "c", "d"), PLACES - PLACES.mean(axis=0))
SPEED = np.array([0.5, 0.0, 0.0])
START = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def pusher(tmp_path):
    path = tmp_path / "pusher.xml"
    path.write_text(PUSHER)
    return path


def flying_scene(duration_s=2.0):
    """A body of four balls that moves at SPEED without turning."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="drone")
    body.add_freejoint()
    for name, place in zip(BODY.markers, BODY.positions, strict=True):
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=place, group=MARKER_GROUP)
    model = spec.compile()
    geoms = tuple(model.geom(name).id for name in BODY.markers)
    still = [1.0, 0.0, 0.0, 0.0]
    return Scene(
        model, BODY.markers, geoms, lambda t: np.array([*(START + SPEED * t), *still]), duration_s,
        {"drone": BODY.markers},
    )  # fmt: skip


def poses_at(times_ns):
    """Exact poses of the flying body."""
    n = len(times_ns)
    xyz = START + SPEED * np.asarray(times_ns)[:, None] * 1e-9
    return BodyPoses(
        np.arange(n), np.asarray(times_ns), np.full(n, "drone"), np.tile([1.0, 0, 0, 0], (n, 1)), xyz,
        np.tile(1e-12 * np.eye(6), (n, 1, 1)), np.full(n, 4), np.zeros(n), np.full(n, "measured"),
    )  # fmt: skip


def samples_at(frame, time_ns):
    n = len(PLACES)
    xyz = BODY.positions + START + SPEED * time_ns * 1e-9
    one, zero = np.full(n, frame), np.zeros(n)
    spread = np.tile(1e-10 * np.eye(3), (n, 1, 1))
    return Samples(one, np.full(n, time_ns), np.arange(n), xyz, spread, np.full(n, 4), zero, zero.astype(np.int8))


def turned(x):
    return np.eye(3), np.array([x, 0.0, 0.1])


def test_a_moved_body_pushes_what_lies_before_it(pusher):
    """A crate of 0.1 m half width stays before the front of a hand of the same width, but for what contacts give.

    A mocap body has no velocity: a critically damped contact of 20 ms, MuJoCo's default, is pressed in by
    2 x 20 ms x 0.8 m/s.
    """
    scene = VirtualScene(pusher, ("hand",))
    for k in range(121):
        scene.show(k / 60, {"hand": turned(-1.0 + 0.5 * k / 60 * 1.6)})
    placed = scene.placements()
    np.testing.assert_allclose(placed["hand"][1], [0.6, 0.0, 0.1], atol=1e-12)
    assert placed["crate"][1][0] > 0.6 + 0.2 - 2 * 0.02 * 0.8
    assert scene.left_out_s == 0


def test_without_a_push_the_rest_stays(pusher):
    scene = VirtualScene(pusher, ("hand",))
    for k in range(30):
        scene.show(k / 60, {"hand": turned(-1.0)})
    np.testing.assert_allclose(scene.placements()["crate"][1], [0, 0, 0.1], atol=1e-3)


def test_a_pause_is_left_out_and_told(pusher):
    scene = VirtualScene(pusher, ("hand",))
    scene.show(0.0, {"hand": turned(-1.0)})
    scene.show(10.0, {"hand": turned(-0.9)})
    assert scene.left_out_s == pytest.approx(9.75)


def test_shapes_are_closed_and_of_their_size(pusher):
    meshes = {body: vertices for body, vertices, _, _ in VirtualScene(pusher, ()).meshes()}
    np.testing.assert_allclose(np.ptp(meshes["crate"], axis=0), 0.2)
    np.testing.assert_allclose(np.ptp(meshes["post"], axis=0), 0.1, rtol=0.02)
    np.testing.assert_allclose(meshes["post"].mean(axis=0), [3, 3, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("moved", "told"),
    [
        (("cup",), "no body 'cup' to move; its mocap bodies are hand"),
        (("crate",), "body 'crate' is no mocap body and cannot be moved; its mocap bodies are hand"),
    ],
)
def test_what_cannot_be_moved_is_one_line(pusher, moved, told):
    with pytest.raises(InputError) as raised:
        VirtualScene(pusher, moved)
    assert str(raised.value) == f"{pusher}: {told}"


def test_a_scene_that_is_none_is_one_line(tmp_path):
    (tmp_path / "torn.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(InputError, match=r"torn\.xml: MuJoCo cannot load it: XML") as raised:
        VirtualScene(tmp_path / "torn.xml", ())
    assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match="no such file"):
        VirtualScene(tmp_path / "none.xml", ())


@pytest.mark.parametrize(
    ("texts", "told"),
    [
        (("dron=cup",), "--bind dron=cup: rig.toml has no body 'dron'; there are drone, wand"),
        (("drone",), "--bind drone: BODY=OBJECT is wanted, as drone=cup"),
        (("drone=cup", "wand=cup"), "--bind wand=cup: object 'cup' follows body 'drone' already; leave one of them"),
    ],
)
def test_bindings_that_cannot_be_are_one_line(texts, told):
    with pytest.raises(InputError) as raised:
        bindings(texts, ("drone", "wand"), "rig.toml")
    assert str(raised.value).startswith(told)


def test_one_body_may_move_two_objects():
    assert bindings(("drone=cup", "drone=lid"), ("drone",), "x") == {"cup": "drone", "lid": "drone"}


def shown_with(latency_ns, predicted=True, displays=40):
    """Displays at 60 Hz of exact poses at 100 Hz that are known so long after their exposure."""
    objects = BoundObjects({"cup": "drone"}, PredictionSettings())
    times = np.arange(100) * 10_000_000
    rows, taken = [], 0
    for k in range(10, 10 + displays):
        now = round(k * 1e9 / 60)
        known = int((times + latency_ns <= now).sum())
        objects.update(poses_at(times).select(np.arange(taken, known)))
        taken = known
        rows += objects.at(now)
    if not predicted:
        rows = [one._replace(pose=one.measured) for one in rows]
    return ShownPoses.of(rows)


@pytest.mark.parametrize("latency_ns", [0, 15_000_000, 35_000_000])
def test_uniform_flight_is_shown_where_it_is_and_unpredicted_trails_by_speed_times_age(latency_ns):
    shown = shown_with(latency_ns)
    errors = object_errors(shown, (BODY,), flying_scene())
    assert np.abs(errors.position_m).max() < 1e-5
    np.testing.assert_allclose(errors.unpredicted_m[:, 0], -0.5 * shown.age_s, atol=1e-9)
    scores = object_scores(shown, errors, None)
    assert scores["object_position_rms"].value < 1e-5
    assert scores["objects_current"].value == 1
    assert latency_ns * 1e-9 <= scores["object_age_p99"].value <= latency_ns * 1e-9 + 0.01
    late = shown_with(latency_ns, predicted=False)
    trailing = object_scores(late, object_errors(late, (BODY,), flying_scene()), None)["object_position_rms"].value
    assert trailing == pytest.approx(0.5 * np.sqrt((late.age_s**2).mean()), rel=1e-6)
    assert "0 stale" in shown_words(shown, errors)


def test_a_display_that_is_delayed_interpolates():
    objects = BoundObjects({"cup": "drone"})
    objects.update(poses_at(np.arange(40) * 10_000_000))
    (one,) = objects.at(400_000_000, 45_000_000)
    assert one.pose.status == "interpolated"
    np.testing.assert_allclose(one.pose.position, START + SPEED * 0.355, atol=1e-6)


def test_an_object_whose_body_is_lost_is_held_and_stale():
    objects = BoundObjects({"cup": "drone"}, PredictionSettings(horizon_s=0.05))
    assert objects.at(0) == []
    objects.update(poses_at(np.arange(40) * 10_000_000))
    late, later = (objects.at(t)[0].pose for t in (600_000_000, 900_000_000))
    assert late.status == later.status == "stale"
    np.testing.assert_array_equal(late.position, later.position)
    # found again after a gap: what was before the first new pose is not known, and held as well
    objects.update(poses_at([1_000_000_000]))
    (one,) = objects.at(1_000_000_000, 30_000_000)
    assert one.pose.status == "stale"
    shown = ShownPoses.of([one])
    assert object_scores(shown, object_errors(shown, (BODY,), flying_scene()), None)["objects_current"].value == 0


def test_frames_that_are_played_know_their_clock():
    """At twice the pace 1 s of this computer is 2 s of the take; the first frame is due at its exposure's middle."""
    info = CameraInfo("a", 4, 3, 8, 20.0)
    paced = PacedFrames((info,), [Frame("a", 0, 5_000_000_000, 1_000_000, np.zeros((3, 4), np.uint8))], speed=2.0)
    assert paced.session_ns(0) is None
    before = time.monotonic_ns()
    assert len(list(paced)) == 1
    after = time.monotonic_ns()
    later_ns = 1_000_000_000
    # float seconds of the host's clock are read to well below 1 ms
    assert paced.session_ns(before) - 1_000_000 <= 5_000_500_000 <= paced.session_ns(after) + 1_000_000
    assert paced.session_ns(after + later_ns) - paced.session_ns(after) == pytest.approx(2 * later_ns, abs=1000)


def live_of(path, session_ns, scene, **more):
    source = LiveSource(None, Rig(()), PipelineSettings(), lambda: None, session_ns, (), scene)
    return LiveVirtual(LiveOptions("flying", virtual=path, bind=("drone=hand",), **more), source, ())


@pytest.mark.parametrize("offset_ns", [0, 3_600_000_000_000])
def test_a_live_run_states_the_latency_by_the_clocks(pusher, tmp_path, offset_ns):
    """A clock that stands 20 ms after the newest exposure: that is the latency, whatever the clock's origin."""
    write_bodies([BODY], tmp_path / "bodies.toml")
    times = [offset_ns + k * 10_000_000 for k in range(30)]
    live = live_of(pusher, lambda _: times[-1] + 20_000_000, None, bodies=tmp_path / "bodies.toml", display_hz=200.0)
    for k, time_ns in enumerate(times):
        live.step(k, time_ns, samples_at(k, time_ns))
    live.start()
    while not live._done.displays:
        live._over.wait(0.01)
    lines, counts = live.finish()
    assert "from exposure to display 20.0 ms, p99 20.0 ms, at most 20.0 ms" in lines[0]
    assert lines[2].startswith("drone -> hand: ")
    assert lines[2].endswith(" extrapolated")
    assert counts["virtual"]["latency_s"]["p99"] == pytest.approx(0.02)
    json.dumps(counts)


def test_a_live_run_of_a_scene_states_the_error(pusher):
    live = live_of(pusher, lambda _: 310_000_000, flying_scene())
    for k in range(30):
        live.step(k, k * 10_000_000, samples_at(k, k * 10_000_000))
    live.start()
    while not live._done.displays:
        live._over.wait(0.01)
    lines, counts = live.finish()
    found = counts["virtual"]["errors"]["extrapolated"]
    assert found["position_rms_m"] < 1e-4
    # this clock stands: what is handed over is handed over at the instant that was predicted
    assert found["at_instant_position_rms_m"] == pytest.approx(found["position_rms_m"], abs=1e-12)
    assert found["unpredicted_position_rms_m"] == pytest.approx(0.5 * 0.02, rel=1e-3)
    assert lines[-1].startswith("extrapolated: objects off by ")


def test_a_late_hand_over_is_told_from_a_wrong_prediction(pusher):
    """Each look at the clock comes 10 ms after the one before: of three a display, predicted is for the second."""
    ticks = iter(range(310_000_000, 10_000_000_000, 10_000_000))
    live = live_of(pusher, lambda _: next(ticks), flying_scene(), display_hz=1000.0, horizon=20.0)
    for k in range(30):
        live.step(k, k * 10_000_000, samples_at(k, k * 10_000_000))
    live.start()
    while not live._done.displays:
        live._over.wait(0.01)
    found = live.finish()[1]["virtual"]["errors"]["extrapolated"]
    assert found["at_instant_position_rms_m"] < 1e-3
    # 10 ms at 0.5 m/s
    assert found["position_rms_m"] == pytest.approx(0.005, rel=0.2)


def test_what_ends_the_display_ends_the_run(pusher):
    def broken(_):
        raise InputError("the clock is gone")

    live = live_of(pusher, broken, flying_scene())
    live.start()
    live._thread.join()
    with pytest.raises(InputError, match="the clock is gone"):
        live.step(0, 0, samples_at(0, 0))
    assert live.finish()[0] == ["virtual objects: no body was found; are its markers seen?"]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"bind": ("drone=cup",)}, "--bind drone=cup: of which scene is the object? give --virtual SCENE.xml"),
        ({"display_hz": 30.0}, "--display-hz 30.0: is of virtual objects; give --virtual SCENE.xml"),
        ({"virtual": "desk.xml"}, "--virtual desk.xml: nothing moves it; give --bind BODY=OBJECT, as drone=cup"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(more, told):
    with pytest.raises(InputError) as raised:
        check_virtual(LiveOptions("x", **more))
    assert str(raised.value) == told


def test_devices_and_recordings_need_a_definition_of_their_bodies(pusher):
    source = LiveSource(None, Rig(()), PipelineSettings(), lambda: None, lambda _: None)
    options = LiveOptions("recording:take", virtual=pusher, bind=("drone=hand",))
    with ExitStack() as stack, pytest.raises(InputError, match=r"--bodies BODIES\.toml is wanted"):
        live_virtual(options, source, (), stack)


def test_the_verb_tells_bad_input_in_a_line():
    with pytest.raises(InputError, match="--bind drone=cup: of which scene is the object"):
        CliRunner().invoke(cli, ["live", "drone", "--bind", "drone=cup"], catch_exceptions=False)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("pipeline.bodies=false", "needs tracked bodies"),
        ("virtual.bind=[]", "virtual.bind"),
        ("virtual.display_hz=0", "virtual.display_hz"),
    ],
)
def test_scenarios_that_cannot_be_are_told(change, told):
    with pytest.raises(InputError, match=told):
        load_scenario(find("machines/virtual_objects"), (change,))


def test_limits_and_fault_need_the_section(tmp_path):
    text = find("controls/late_display").read_text()
    path = tmp_path / "s.toml"
    path.write_text(text.replace('[virtual]\nbind = ["drone=tray"]\n', ""))
    with pytest.raises(InputError, match=r"needs virtual objects; add \[virtual\]"):
        load_scenario(path)


def test_the_picture_states_both_errors():
    shown = shown_with(15_000_000)
    errors = object_errors(shown, (BODY,), flying_scene())
    away = np.linalg.norm(errors.position_m, axis=1), np.linalg.norm(errors.unpredicted_m, axis=1)
    stated = np.sqrt(np.trace(shown.covariance[:, :3, :3], axis1=1, axis2=2))
    picture = objects_picture(
        VirtualEvidence(1e-9 * shown.time_ns, shown.age_s, *away, stated, np.zeros(len(shown), bool))
    )
    assert f"{1e3 * np.sqrt((away[1] ** 2).mean()):.3g} mm unpredicted" in picture.alt
