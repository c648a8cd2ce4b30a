"""Worn cameras, their lamps, and the scoring of clocks, against values computed by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from track_tables import measured_tracks

from mosca.continuous.reconstruct import EstimatedClock
from mosca.data.lamp_codes import lamp_bits
from mosca.errors import InputError
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.build.worn_lamps import check_no_lamps, rider_pose, worn_lamps
from scenarios.build.worn_rig import known_lamps, worn_cameras, worn_rig
from scenarios.score.continuous import clock_scores
from scenarios.score.worn_cameras import path_scores, without_lamps
from scenarios.spec.catalog import find
from scenarios.spec.continuous import ContinuousSpec
from scenarios.spec.scenario import load_scenario


@pytest.fixture(scope="module")
def worn():
    path = find("continuous/worn")
    return load_scenario(path)


def rider(**given):
    places = {"name": "a", "place_m": (1.0, 2.0, 3.0), "forward": (1.0, 0.0, 0.0), "up": (0.0, 0.0, 1.0)}
    return SimpleNamespace(**(places | given))


def test_a_rider_looks_forward_with_its_rows_going_down():
    pose = rider_pose(rider())
    # x right, y down, z forward: what lies 1 m ahead, 2 m to its right and 3 m below
    np.testing.assert_allclose(pose.transform(np.array([[2.0, 3.0, 1.0]])), [[1 + 1.0, 2 - 2.0, 3 - 3.0]], atol=1e-12)


def test_forward_along_up_is_refused():
    with pytest.raises(InputError, match=r"camera 'a': forward = .* must not be parallel"):
        rider_pose(rider(up=(2.0, 0.0, 0.0)))


def test_each_worn_camera_has_its_lamp_beside_the_lens(worn):
    lamps = worn_lamps(worn)
    assert [lamp.name for lamp in lamps] == [f"lamp/{own.name}" for own in worn.camera]
    for lamp, own in zip(lamps, worn.camera, strict=True):
        away = np.linalg.norm(np.subtract(lamp.place_m, own.place_m))
        assert away == pytest.approx(np.linalg.norm(own.lamp_m), abs=1e-12)
        assert lamp.diameter_m == 0.02


def test_lamps_where_nobody_can_carry_them_are_refused(worn):
    with pytest.raises(InputError, match=r"camera 'front_left': lamp_m = .* only an actor's cameras"):
        check_no_lamps(worn)


def test_one_camera_on_the_body_is_too_few(worn):
    one = SimpleNamespace(mount=SimpleNamespace(body="root"))
    other = SimpleNamespace(mount=SimpleNamespace(body="head"))
    with pytest.raises(InputError, match="worn_on = 'root': 1 "):
        worn_cameras(worn, (one, other))


def test_a_track_at_a_lamps_place_is_left_out():
    n = 5
    xyz = np.concatenate([np.tile([0.3, 0.0, 0.0], (n, 1)), np.tile([0.35, 0.0, 0.0], (n, 1))])
    tracks = measured_tracks(np.tile(np.arange(n), 2), np.repeat([0, 1], n), xyz)
    kept = without_lamps(tracks, {"a": np.array([0.31, 0.0, 0.0])})
    assert set(kept.track.tolist()) == {1}


def test_clock_scores_are_the_worse_end_and_the_worst_camera():
    """Camera b runs 100 ppm slow and began 0.25 s late; its estimate is 1 ms and 50 ppm off."""
    stamps = np.arange(0, 2_000_000_001, 100_000_000)
    session = np.rint(0.25e9 + stamps * (1 + 1e-4)).astype(np.int64)
    frames = SimpleNamespace(
        camera=np.repeat([0, 1], len(stamps)),
        stamp_ns=np.concatenate([stamps, stamps + 7]),
        exposure_mid_ns=np.concatenate([stamps, session]),
    )
    truth = SimpleNamespace(frames=frames, cameras=("a", "b"))
    seen = [SimpleNamespace(frame_ns=stamps + late, period_s=0.1) for late in (0, 7)]
    clocks = (
        EstimatedClock("a"),
        EstimatedClock("b", 0.251, 1.5e-4, offset_sigma_s=1e-6, drift_sigma=1e-6, origin_ns=7),
    )
    found = SimpleNamespace(clocks=clocks, gathered=SimpleNamespace(seen=seen), rig=SimpleNamespace(names=("a", "b")))
    scores = clock_scores(found, truth)
    # at the end 1 ms + 2 s x 50 ppm = 1.1 ms of 100 ms
    assert scores["clock_frames"].value == pytest.approx(0.011, abs=1e-5)
    assert scores["clock_drift_ppm"].value == pytest.approx(50.0, abs=0.1)
    truth.frames = None
    assert clock_scores(found, truth) == {}


@pytest.fixture(scope="module")
def limbs():
    path = find("continuous/worn_limbs")
    spec = load_scenario(path)
    cameras = worn_cameras(spec, virtual_cameras(spec, true_rig(spec, path.parent)))
    return spec, cameras, worn_rig(spec, cameras).rig


def test_nobody_tells_where_cameras_on_limbs_sit(limbs):
    _spec, cameras, rig = limbs
    assert len({v.mount.body for v in cameras}) == 5
    for camera, virtual in zip(rig.cameras, cameras, strict=True):
        pose = camera.world_from_camera
        if virtual.mount.body == "root":
            np.testing.assert_array_equal(pose.rotation, virtual.camera.world_from_camera.rotation)
        else:
            np.testing.assert_array_equal(pose.rotation, np.eye(3))
            np.testing.assert_array_equal(pose.translation, np.zeros(3))


def test_lamps_blink_numbers_of_their_own_a_bit_for_a_frame(limbs):
    spec, _cameras, rig = limbs
    known, lamps = known_lamps(spec, rig)
    assert known == ("belt_left", "belt_right")
    assert lamps.bit_s == pytest.approx(1 / 60)
    assert len(set(lamps.numbers)) == 6
    for lamp, number in zip(worn_lamps(spec), lamps.numbers, strict=True):
        assert lamp.blink is not None
        assert lamp.blink.bits == lamp_bits(number)
        assert lamp.blink.bit_s == pytest.approx(1 / 60)


def test_a_camera_on_a_limb_without_a_number_is_told(limbs):
    spec, _cameras, rig = limbs
    bare = [c.model_copy(update={"lamp_number": None}) if c.name == "head" else c for c in spec.camera]
    with pytest.raises(InputError, match=r"camera 'head': continuous\.moving wants each worn camera's lamp_m"):
        known_lamps(spec.model_copy(update={"camera": tuple(bare)}), rig)


def test_paths_are_scored_where_nobody_knew_them():
    """The third camera is 3 mm and 0.01 rad off; the first two do not count."""
    turn = np.array([[np.cos(0.01), -np.sin(0.01), 0.0], [np.sin(0.01), np.cos(0.01), 0.0], [0.0, 0.0, 1.0]])
    t = np.array([0, 10**9])
    true = np.tile(np.eye(3), (2, 3, 1, 1)), np.zeros((2, 3, 3))
    rotations, centres = true[0].copy(), true[1].copy()
    rotations[:, 2], centres[:, 2] = turn, [0.003, 0.0, 0.0]
    centres[:, 0] = 9.0
    paths = SimpleNamespace(at=lambda time_s: (rotations, centres))
    worn = SimpleNamespace(
        reconstructed=SimpleNamespace(
            cameras=paths, clocks=[SimpleNamespace(origin_ns=0)], rig=SimpleNamespace(names=("a", "b", "c"))
        )
    )
    scores = path_scores(worn, ("a", "b"), true, t)
    assert scores["camera_position_rms"].value == pytest.approx(0.003)
    assert scores["camera_angle_rms"].value == pytest.approx(0.01, abs=1e-6)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"estimate": "known"}, "moving = true wants worn_on"),
        ({"estimate": "drift", "worn_on": "root"}, "taken to be of one clock"),
        ({"estimate": "known", "clocks": "own", "worn_on": "root"}, "taken to be of one clock"),
    ],
)
def test_cameras_that_move_want_a_body_and_one_clock(given, told):
    with pytest.raises(ValueError, match=told):
        ContinuousSpec(moving=True, **given)
