"""The drone: the paper's size and mass, forces that obey mechanics, a path that is followed."""

from typing import Any

import mujoco
import numpy as np
import pytest

from mosca.errors import InputError
from twin.scenes.drone import EDGE_M, Flight, build_drone
from twin.scenes.flight import FLIGHT_PATHS, FlightPath
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.scenes.world import SEAT_M

CENTER, SIZE = np.array([0.2, 0.1, 1.25]), np.array([2.5, 2.5, 2.5])


def _flight(**settings: Any) -> Flight:
    given = {"duration_s": 3.0, "box_center_m": CENTER, "box_size_m": SIZE, "rng": np.random.default_rng(2)}
    return build_drone(**{**given, **settings})


def test_size_and_mass_are_the_papers() -> None:
    scene = _flight(duration_s=0.1).scene
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_forward(model, data)
    assert model.body_mass.sum() == pytest.approx(0.366, abs=1e-12)
    np.testing.assert_allclose(data.subtree_com[1], [0, 0, data.subtree_com[1][2]], atol=1e-12)
    # The hull's outermost points: rim capsules, whose ends are on a polygon inside the true circle.
    reach = []
    for g in range(1, model.ngeom):
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE and model.geom_group[g] != MARKER_GROUP:
            axis = data.geom_xmat[g].reshape(3, 3)[:, 2] * model.geom_size[g, 1]
            reach.append(np.abs(data.geom_xpos[g]) + np.abs(axis) + model.geom_size[g, 0])
    np.testing.assert_allclose(2 * np.max(reach, axis=0)[:2], EDGE_M, atol=1e-9)


def test_markers_are_seated_on_the_airframe_and_tell_front_from_back() -> None:
    scene = _flight(duration_s=0.1).scene
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    frame = [g for g in range(1, model.ngeom) if model.geom_group[g] != MARKER_GROUP]
    for marker in scene.marker_geoms:
        gap = min(mujoco.mj_geomDistance(model, data, marker, g, 0.1, None) for g in frame)
        assert SEAT_M - 5e-4 < gap < SEAT_M + 1e-4
    assert scene.bodies == {"drone": tuple(f"D{k}" for k in range(1, 9))}
    xyz = data.geom_xpos[list(scene.marker_geoms)]
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1)
    assert (distance + np.eye(8)).min() > 0.06
    # No relabelling of the set onto itself comes within a millimetre: sorted distances differ by marker.
    profiles = np.sort(distance, axis=1)
    apart = np.abs(profiles[:, None] - profiles[None]).max(axis=-1) + np.eye(8)
    assert apart.min() > 0.01


@pytest.mark.parametrize("path", [path for path in FLIGHT_PATHS if path not in ("hover", "steps")])
def test_the_path_is_followed_within_15_mm_at_half_a_metre_a_second(path: FlightPath) -> None:
    """Largest error measured over three seeds and paths: 9.3 mm, rms 5.1 mm, with gusts of 0.02 N rms."""
    flight = _flight(path=path)
    times = np.linspace(-0.1, 3.1, 640)
    flown = np.array([flight.scene.configuration_at(t)[:3] for t in times])
    wanted = flight.reference.at(times)[0]
    assert np.linalg.norm(flown - wanted, axis=1).max() < 0.015
    speeds = np.linalg.norm(np.diff(flown, axis=0), axis=1) / (times[1] - times[0])
    np.testing.assert_allclose(speeds, 0.5, atol=0.05)


def test_hovering_stays_and_steps_jump_by_a_tenth_of_a_metre() -> None:
    times = np.linspace(-0.1, 3.1, 640)
    still = _flight(path="hover")
    flown = np.array([still.scene.configuration_at(t)[:3] for t in times])
    assert np.linalg.norm(flown - still.reference.at(0.0)[0], axis=1).max() < 0.015
    wanted = _flight(path="steps").reference.at(np.array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5]))[0]
    np.testing.assert_allclose(np.abs(np.diff(wanted, axis=0)).max(axis=1), [0.1, 0.05, 0.1, 0.05, 0.1, 0.05])


def _centre_of_mass(scene: Scene, time_s: float) -> np.ndarray:
    qpos, arm = scene.configuration_at(time_s), np.zeros(3)
    mujoco.mju_rotVecQuat(arm, scene.model.body_ipos[1], qpos[3:7])
    return qpos[:3] + arm


def test_only_thrust_and_weight_act() -> None:
    """Newton: without gusts the specific force a + g points along the rotors' axis at every instant."""
    scene = _flight(gust_n=0.0, speed_mps=0.8).scene
    h = 0.004
    angles, tilts = [], []
    for t in np.linspace(0.2, 2.8, 60):
        before, here, after = (_centre_of_mass(scene, u) for u in (t - h, t, t + h))
        force = (after - 2 * here + before) / h**2 + [0, 0, 9.81]
        up = np.zeros(3)
        mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 1.0]), scene.configuration_at(t)[3:7])
        angles.append(np.arccos(np.clip(up @ force / np.linalg.norm(force), -1, 1)))
        tilts.append(np.arccos(up[2]))
    assert max(tilts) > np.deg2rad(2)  # it does tilt to go round
    assert max(angles) < np.deg2rad(0.1)


def test_gusts_push_it_off_by_what_the_seed_says() -> None:
    calm, windy = _flight(gust_n=0.0), _flight(gust_n=0.1)
    times = np.linspace(0, 3, 100)
    errors = [
        np.linalg.norm([f.scene.configuration_at(t)[:3] - f.reference.at(t)[0] for t in times], axis=1).max()
        for f in (calm, windy)
    ]
    assert errors[0] < 0.01 < errors[1]


def test_errors_name_the_setting() -> None:
    with pytest.raises(InputError, match="too small for a flying drone"):
        _flight(box_size_m=np.array([0.9, 2.5, 2.5]))
    with pytest.raises(InputError, match=r"speed_mps = 3\.0: the tightest bend .* allows 1\.\d\d m/s"):
        _flight(speed_mps=3.0)
    with pytest.raises(InputError, match="5 to 8"):
        _flight(markers=4)
    with pytest.raises(InputError, match="allowed: figure_eight, circle, waypoints"):
        _flight(path="loop")
    with pytest.raises(InputError, match="gust_n = -1"):
        _flight(gust_n=-1.0)
