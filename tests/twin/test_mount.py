"""The mount: spectra by Welch's method, positions by hand, images by similar triangles."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.rig import OpenCVLens, Pose
from mosca.errors import InputError
from twin.cameras.exposure.mount import CameraSupport, Mount, pixels_per_radian
from twin.cameras.optics.lens import TwinLens
from twin.streams import rng

FOCAL_PX, SEED = 800.0, 3
STEADY = Mount(body_px=0.0)
POSE = Pose(Rotation.from_euler("zyx", [20.0, -40.0, 10.0], degrees=True).as_matrix(), np.array([1.0, -2.0, 0.5]))


def stand(mount: Mount, seed: int = SEED, duration_s: float = 100.0, name: str = "eye") -> CameraSupport:
    return CameraSupport.of(mount, name, POSE, FOCAL_PX, seed, duration_s)


def image_of(stand_: CameraSupport, times_s: Array, place: Array, frame: int = 0) -> Array:
    """Image (k, 2) of a point in the world by a pinhole: similar triangles, from the middle of the view [px]."""
    rotation, position = stand_.pose_at(times_s, frame)
    here = np.einsum("kji,kj->ki", rotation, place - position)
    return FOCAL_PX * here[:, :2] / here[:, 2:]


def far_along(x: float = 0.0, y: float = 0.0) -> Array:
    """A distant point that the steady camera sees ``x``, ``y`` px from the middle of its view."""
    return POSE.rotation @ np.array([x / FOCAL_PX, y / FOCAL_PX, 1.0]) * 1e6 + POSE.translation


def test_a_steady_camera_stands_where_the_rig_says() -> None:
    rotation, position = stand(STEADY).pose_at(np.array([0.0, 1.0]), 5)
    np.testing.assert_allclose(rotation, np.tile(POSE.rotation, (2, 1, 1)), atol=1e-15)
    np.testing.assert_array_equal(position, np.tile(POSE.translation, (2, 1)))


def test_pixels_per_radian_are_the_principal_distance() -> None:
    lens = TwinLens.of(OpenCVLens(FOCAL_PX, FOCAL_PX, 300.0, 200.0), 640, 480).vector
    assert pixels_per_radian(lens) == pytest.approx(FOCAL_PX, rel=1e-12)


# shake


def test_the_shake_of_a_frame_is_a_turn_about_x_and_y() -> None:
    shaken = stand(Mount(body_px=0.5))
    rotation, _position = shaken.pose_at(np.array([0.0, 0.1]), 7)
    turn = rng(SEED, "camera/eye/body", 7).normal(0.0, 0.5, 2) / FOCAL_PX
    expected = POSE.rotation @ Rotation.from_rotvec([turn[0], turn[1], 0.0]).as_matrix()
    np.testing.assert_allclose(rotation, np.tile(expected, (2, 1, 1)), atol=1e-15)
    assert not np.allclose(shaken.pose_at(np.zeros(1), 8)[0], expected, atol=1e-6)


# vibration


def vibration(**words: Any) -> tuple[Array, float]:
    """Image motion (n, 2) of 200 s of vibration, sampled at 500 Hz."""
    rate = 500.0
    return stand(replace(STEADY, **words)).image_shift_px(np.arange(0.0, 200.0, 1 / rate)), rate


def test_vibration_has_its_rms_in_its_band() -> None:
    shift, rate = vibration(vibration_px=0.4, vibration_hz=(10.0, 50.0))
    np.testing.assert_allclose(shift.std(axis=0), 0.4, rtol=0.01)
    assert abs(np.corrcoef(shift.T)[0, 1]) < 0.15
    frequency, power = welch(shift, rate, nperseg=2048, axis=0)
    inside = (frequency > 9.5) & (frequency < 50.5)
    step = frequency[1]
    np.testing.assert_allclose(power[inside].sum(axis=0) * step, 0.16, rtol=0.02)
    # flat: each quarter of the band holds a quarter of the power (a tone of 64 falls beside an edge here and there)
    for low in (10.0, 20.0, 30.0, 40.0):
        part = (frequency >= low) & (frequency < low + 10.0)
        np.testing.assert_allclose(power[part].sum(axis=0) * step, 0.04, rtol=0.15)


def test_vibration_has_its_slope() -> None:
    shift, rate = vibration(vibration_px=0.4, vibration_hz=(5.0, 80.0), vibration_slope=-2.0)
    np.testing.assert_allclose(shift.std(axis=0), 0.4, rtol=0.01)
    frequency, power = welch(shift, rate, nperseg=1024, axis=0)
    # averaged over bands wide enough to hold several tones: a line of slope -2 in the logarithms
    edges = np.array([8.0, 14.0, 24.0, 42.0, 74.0])
    bands = [power[(frequency >= a) & (frequency < b)].mean(axis=0) for a, b in pairwise(edges)]
    middle = np.sqrt(edges[:-1] * edges[1:])
    for axis in range(2):
        slope = np.polyfit(np.log(middle), np.log([band[axis] for band in bands]), 1)[0]
        assert slope == pytest.approx(-2.0, abs=0.15)


def test_vibration_moves_within_an_exposure() -> None:
    # a band about 50 Hz of 1 px rms: its speed is 2 pi 50 px/s rms, so within 1 ms it moves by 0.31 px rms
    quick = stand(replace(STEADY, vibration_px=1.0, vibration_hz=(49.0, 51.0)))
    times = np.arange(0.0, 200.0, 0.0137)
    moved = quick.image_shift_px(times + 0.001) - quick.image_shift_px(times)
    np.testing.assert_allclose(moved.std(axis=0), 2.0 * np.sin(np.pi * 50.0 * 0.001), rtol=0.1)


def test_the_image_moves_as_the_shift_says() -> None:
    moving = replace(STEADY, vibration_px=0.5, drift_px_per_s=(0.3, -0.2), wander_px=0.2)
    times = np.linspace(0.0, 10.0, 50)
    shift = stand(moving).image_shift_px(times)
    # small rotations: 3 px of 800 differ from the tangent by 1e-5 of themselves
    np.testing.assert_allclose(image_of(stand(moving), times, far_along()), shift, atol=2e-4)


# drift


def test_drift_is_steady() -> None:
    shift = stand(replace(STEADY, drift_px_per_s=(0.02, -0.01))).image_shift_px(np.array([0.0, 10.0, 25.0]))
    np.testing.assert_allclose(shift, [[0.0, 0.0], [0.2, -0.1], [0.5, -0.25]], atol=1e-15)


def test_wandering_stays_within_its_bounds() -> None:
    walk = stand(replace(STEADY, wander_px=0.3, wander_bound_px=0.7), duration_s=5000.0)
    shift = walk.image_shift_px(np.arange(0.0, 5000.0, 0.25))
    assert np.abs(shift).max() <= 0.7
    assert np.abs(shift).max() > 0.6
    np.testing.assert_array_equal(shift[0], 0.0)
    # a walk between walls comes everywhere equally often: the rms of an even law over +-0.7
    np.testing.assert_allclose(shift.std(axis=0), 0.7 / np.sqrt(3.0), rtol=0.1)
    # the middle of the walk of single steps is far from the walls: their rms there is the stated one
    steps = np.diff(walk.image_shift_px(np.arange(0.0, 5000.0)), axis=0)
    inner = np.abs(shift[:-4:4]) < 0.1
    assert steps[inner].std() == pytest.approx(0.3, rel=0.1)


def test_a_longer_session_begins_alike() -> None:
    mount = replace(STEADY, wander_px=0.3)
    times = np.linspace(0.0, 20.0, 77)
    np.testing.assert_array_equal(
        stand(mount, duration_s=20.0).image_shift_px(times), stand(mount, duration_s=2000.0).image_shift_px(times)
    )


# bump


def test_a_bump_stays() -> None:
    bumped = stand(replace(STEADY, bump_s=2.0, bump_px=(3.0, -1.5), bump_m=(0.01, 0.0, -0.02), bump_rise_s=0.02))
    times = np.array([0.0, 2.0, 2.01, 2.02, 50.0])
    expected = np.outer([0.0, 0.0, 0.5, 1.0, 1.0], [3.0, -1.5])
    np.testing.assert_allclose(image_of(bumped, times, far_along()), expected, atol=1e-4)
    _rotation, position = bumped.pose_at(times, 0)
    shifted = POSE.translation + POSE.rotation @ np.array([0.01, 0.0, -0.02])
    np.testing.assert_allclose(position[0], POSE.translation, atol=1e-15)
    np.testing.assert_allclose(position[-1], shifted, atol=1e-15)


def test_a_bump_is_fast_only_while_it_lasts() -> None:
    mount = replace(STEADY, bump_s=2.0, bump_rise_s=0.02)
    assert [mount.fastest_hz(t, t + 0.001) for t in (1.0, 1.9995, 2.01, 2.03)] == [0.0, 50.0, 50.0, 0.0]


# riding


def test_a_camera_rides_on_a_body() -> None:
    riding = stand(replace(STEADY, body="arm"))
    turns = Rotation.from_euler("xyz", [[0.0, 0.0, 0.0], [30.0, -20.0, 60.0]], degrees=True).as_matrix()
    places = np.array([[0.0, 0.0, 0.0], [3.0, 2.0, 1.0]])
    rotation, position = riding.pose_at(np.array([0.0, 1.0]), 0, (turns, places))
    for k in range(2):
        world_from_body, body_from_camera = np.eye(4), np.eye(4)
        world_from_body[:3, :3], world_from_body[:3, 3] = turns[k], places[k]
        body_from_camera[:3, :3], body_from_camera[:3, 3] = POSE.rotation, POSE.translation
        expected = world_from_body @ body_from_camera
        np.testing.assert_allclose(rotation[k], expected[:3, :3], atol=1e-15)
        np.testing.assert_allclose(position[k], expected[:3, 3], atol=1e-15)


def test_poses_are_pure_functions_of_time() -> None:
    mount = Mount(vibration_px=0.3, wander_px=0.1, bump_s=1.0, bump_px=(1.0, 0.0))
    times = np.linspace(0.0, 3.0, 31)
    whole, _ = stand(mount).pose_at(times, 4)
    for k in (0, 10, 30):
        np.testing.assert_allclose(stand(mount).pose_at(times[k : k + 1], 4)[0][0], whole[k], atol=1e-15)
    assert not np.allclose(stand(mount, seed=SEED + 1).pose_at(times, 4)[0], whole, atol=1e-6)
    assert not np.allclose(stand(mount, name="other").pose_at(times, 4)[0], whole, atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [{"vibration_hz": (50.0, 5.0)}, {"vibration_hz": (0.0, 5.0)}, {"wander_bound_px": 0.0}, {"bump_rise_s": 0.0}],
)
def test_what_cannot_be_is_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"mount: {next(iter(wrong))} = "):
        Mount(**wrong)
