"""The robot: the paper's targets and commands, wheels that touch and push, a box that is not left."""

from typing import Any

import mujoco
import numpy as np
import pytest

from mosca.errors import InputError
from twin.scenes.driving import FREE_SPEED_RAD_S, true_velocities
from twin.scenes.robot import build_robot
from twin.scenes.scene import UNSEEN_GROUP, Scene

CENTER, SIZE = np.array([1.0, -0.5, 1.0]), np.array([2.5, 2.5, 2.0])


def _robot(**settings: Any) -> Scene:
    given = {"duration_s": 8.0, "box_center_m": CENTER, "box_size_m": SIZE, "rng": np.random.default_rng(1)}
    return build_robot(**{**given, **settings})


@pytest.fixture(scope="module")
def driven() -> Scene:
    return _robot()


def _deck_frame(xyz: np.ndarray) -> np.ndarray:
    """Return the robot's axes (3, 3) as the paper defines them: x from #6 to #10, y from #13 to #3."""
    x = xyz[9] - xyz[5]
    x /= np.linalg.norm(x)
    y = xyz[2] - xyz[12]
    y -= y @ x * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def test_targets_are_where_figure_8_has_them(driven: Scene) -> None:
    """#8 is the centre, #6 and #10 lie on the x axis, #3 and #13 on the y axis."""
    assert driven.marker_names == tuple(f"T{k}" for k in range(1, 14))
    assert driven.bodies == {"robot": driven.marker_names}
    state = driven.sampler().at(2.0)
    axes = _deck_frame(state.marker_xyz)
    own = (state.marker_xyz - state.marker_xyz[7]) @ axes
    np.testing.assert_allclose(own[[5, 7, 9], 1:], 0, atol=1e-12)
    np.testing.assert_allclose(own[[2, 7, 12]][:, [0, 2]], 0, atol=1e-12)
    assert own[9, 0] > 0 > own[5, 0]
    assert own[2, 1] > 0 > own[12, 1]
    # Flat discs: their axis is the deck's normal.
    np.testing.assert_allclose(state.marker_axis, np.tile(axes[:, 2], (13, 1)), atol=1e-9)
    kinds = driven.model.geom_type[list(driven.marker_geoms)]
    assert set(kinds) == {int(mujoco.mjtGeom.mjGEOM_CYLINDER)}
    assert driven.model.body_mass.sum() == pytest.approx(4.0)


def test_wheels_stay_on_the_floor(driven: Scene) -> None:
    """The lowest point of each wheel is within a millimetre of z = 0 (0.3 mm measured, the contact's give)."""
    model, sampler = driven.model, driven.sampler()
    treads = [g for g in range(model.ngeom) if model.geom_group[g] == UNSEEN_GROUP]
    assert len(treads) == 4
    for t in np.linspace(-0.1, 8.1, 200):
        bottoms = sampler.at(t).geom_xyz[treads, 2] - model.geom_size[treads, 0]
        assert np.abs(bottoms).max() < 1e-3


def _end_of_hold(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return command values, v_x [m/s] and yaw rate [rad/s] at the end of each hold, from targets alone."""
    assert scene.commands is not None
    sampler, h = scene.sampler(), 2e-3
    starts = scene.commands.time_ns / 1e9
    inside = starts + 0.19 < scene.duration_s + 0.1
    speeds, rates = [], []
    for t in starts[inside] + 0.18:
        before, after = sampler.at(t - h).marker_xyz, sampler.at(t + h).marker_xyz
        frame = _deck_frame(sampler.at(t).marker_xyz)
        speeds.append((after[7] - before[7]) @ frame[:, 0] / (2 * h))
        turn = frame.T @ (_deck_frame(after)[:, 0] - _deck_frame(before)[:, 0])
        rates.append(turn[1] / (2 * h))
    return scene.commands.values[inside], np.array(speeds), np.array(rates)


def test_motion_follows_the_commands(driven: Scene) -> None:
    """A free-rolling robot ends each hold at a/255 of the free wheel speed: 0.143 m/s at 30 PWM."""
    values, speed, rate = _end_of_hold(driven)
    average, difference = values[:, 0], values[:, 1]
    assert np.corrcoef(average, speed)[0, 1] > 0.99
    assert np.corrcoef(difference, rate)[0, 1] > 0.9
    predicted = FREE_SPEED_RAD_S * 0.0675 / 255
    assert np.polyfit(average, speed, 1)[0] == pytest.approx(predicted, rel=0.05)
    # Skidding: it turns by less than without slip (track 0.28 m), in the right direction.
    no_slip = predicted / 0.28
    assert 0.05 * no_slip < np.polyfit(difference, rate, 1)[0] < no_slip


def test_commands_are_the_papers_white_noise() -> None:
    commands = _robot(duration_s=15.0).commands
    assert commands is not None
    assert commands.names == ("pwm_average", "pwm_difference", "pwm_left", "pwm_right")
    np.testing.assert_array_equal(commands.time_ns, np.arange(len(commands.time_ns)) * 200_000_000)
    average, difference, left, right = commands.values.T
    np.testing.assert_allclose((left + right) / 2, average)
    np.testing.assert_allclose(right - left, difference)
    for values, largest in ((average, 30), (difference, 60)):
        assert np.abs(values).max() <= largest
        assert np.abs(values).max() > 0.8 * largest
        assert np.std(values) == pytest.approx(largest / np.sqrt(3), rel=0.25)  # of a uniform distribution
        white = np.corrcoef(values[1:], values[:-1])[0, 1]
        assert abs(white) < 3 / np.sqrt(len(values))


def test_the_robot_is_turned_back_inside_a_small_box() -> None:
    size = np.array([1.3, 1.3, 1.0])
    scene = _robot(box_size_m=size, average_pwm=200.0, difference_pwm=255.0, hold_s=0.1, duration_s=12.0)
    sampler = scene.sampler()
    xyz = np.stack([sampler.at(t).marker_xyz for t in np.linspace(-0.1, 12.1, 300)])
    assert np.ptp(xyz[:, 7], axis=0)[:2].max() > 0.1
    assert (np.abs(xyz - CENTER)[..., :2] < size[:2] / 2).all()


def test_without_commands_it_stands_still() -> None:
    scene = _robot(average_pwm=0.0, difference_pwm=0.0, duration_s=1.0)
    sampler = scene.sampler()
    np.testing.assert_allclose(sampler.at(0.0).marker_xyz, sampler.at(1.0).marker_xyz, atol=2e-6)


def test_errors_name_the_setting() -> None:
    with pytest.raises(InputError, match="too small for a robot that can turn back"):
        _robot(box_size_m=np.array([0.8, 2.0, 1.0]))
    with pytest.raises(InputError, match="average_pwm = 300"):
        _robot(average_pwm=300.0)
    with pytest.raises(InputError, match="target_diameter_m"):
        _robot(target_diameter_m=0.2)
    with pytest.raises(InputError, match=r"hold_s = 0\.0 "):
        _robot(hold_s=0.0)


def test_true_velocities_of_a_circle_are_those_of_its_closed_form() -> None:
    """A body on a circle of 2 m at 0.5 rad/s; a point 0.3 m to its left is 0.3 m nearer to the centre."""
    rate, radius = 0.5, 2.0

    def path(t: float) -> np.ndarray:
        angle = rate * t
        turn = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
        return np.array([radius * np.sin(angle), radius * (1 - np.cos(angle)), 0.0, *turn, 7.0])

    start = np.array([0.0, 1.0, 6.2 / rate])
    found = true_velocities(path, start, start + 0.01, np.array([0.0, 0.3, 0.1]))
    # a chord is shorter than its arc by (angle)^2 / 24 of it
    np.testing.assert_allclose(found, np.tile([1.7 * rate, rate], (3, 1)), rtol=2e-6)
