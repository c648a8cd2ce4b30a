"""The robot on commands that are given as lines of text: its path, by hand."""

import json

import numpy as np
import pytest

from mosca.errors import InputError
from twin.scenes.driving import read_command
from twin.scenes.robot import build_robot

RADIUS_M, FREE_RAD_S = 0.0675, 18.0
HEADING = 0.4


def robot(commands, duration_s=2.5, size=(3.0, 3.0, 1.0), heading=HEADING):
    lines = [(round(t * 1e9), json.dumps({"left": left, "right": right})) for t, left, right in commands]
    return build_robot(
        duration_s=duration_s,
        box_center_m=np.zeros(3),
        box_size_m=np.array(size),
        rng=np.random.default_rng(5),
        commands=lines,
        heading_rad=heading,
    )


def path(scene, times):
    """Return the centre target's position (n, 2) [m] and the heading [rad] at ``times``."""
    sampler = scene.sampler()
    xyz = np.stack([sampler.at(t).marker_xyz for t in times])
    ahead = xyz[:, 9, :2] - xyz[:, 5, :2]
    return xyz[:, 7, :2], np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def test_straight_on_it_rolls_as_a_motor_on_a_voltage_does():
    """v = v0 (1 - exp(-t / tau)): v0 of the free wheel, tau = inertia over the motors' drag; then it runs down."""
    pwm, begin, end = 60.0, 0.2, 1.7
    scene = robot([(begin, pwm, pwm), (end, 0, 0)])
    xy, heading = path(scene, [0.0, 1.0, end, 2.5])
    ahead = np.array([np.cos(HEADING), np.sin(HEADING)])
    v0 = pwm / 255 * FREE_RAD_S * RADIUS_M
    wheel = 0.5 * 0.25 * RADIUS_M**2  # a cylinder about its axis
    mass = 4.0 + 4 * (0.01 + wheel) / RADIUS_M**2
    tau = mass / (4 * 8.0 / FREE_RAD_S / RADIUS_M**2)
    gone = [v0 * (t - begin - tau) for t in (1.0, end)]  # exp(-t / tau) is 1e-10 by then
    for k, expected in zip((1, 2), gone, strict=True):
        moved = xy[k] - xy[0]
        assert moved @ ahead == pytest.approx(expected, rel=0.02)
        assert moved @ [-ahead[1], ahead[0]] == pytest.approx(0.0, abs=1e-3)
    # what it lost while it gained speed it rolls on for afterwards: v0 (end - begin) in all
    assert np.linalg.norm(xy[3] - xy[0]) == pytest.approx(v0 * (end - begin), rel=0.02)
    np.testing.assert_allclose(heading, HEADING, atol=1e-3)


def test_opposite_sides_turn_it_on_the_spot_and_skid():
    scene = robot([(0.0, -60, 60), (2.0, 60, -60), (4.0, 0, 0)], duration_s=4.6)
    xy, heading = path(scene, [0.0, 0.5, 1.0, 1.5, 2.0, 4.6])
    np.testing.assert_allclose(xy, 0.0, atol=2e-3)
    rates = np.diff(heading[1:4]) / 0.5
    assert rates[0] == pytest.approx(rates[1], rel=0.02)
    no_skid = 60 / 255 * FREE_RAD_S * RADIUS_M / 0.14
    assert 0.05 * no_skid < rates[0] < no_skid
    assert heading[5] == pytest.approx(HEADING, abs=0.02)  # back as far as it came


def test_sides_exchanged_give_the_mirrored_path():
    """An arc to the left is an arc to the right, mirrored; its radius is speed over rate of turn."""
    times = np.linspace(0.0, 2.4, 40)
    left, left_heading = path(robot([(0.1, 50, 90)], heading=0.0), times)
    right, right_heading = path(robot([(0.1, 90, 50)], heading=0.0), times)
    np.testing.assert_allclose(left * [1, -1], right, atol=2e-4)
    np.testing.assert_allclose(left_heading, -right_heading, atol=5e-4)
    assert left_heading[-1] > 0.05
    late = slice(20, None)
    speed = np.linalg.norm(np.gradient(left[late], times[late], axis=0), axis=1)[1:-1].mean()
    rate = np.gradient(left_heading[late], times[late])[1:-1].mean()
    a, b, c = left[20], left[30], left[39]
    area = 0.5 * abs(np.cross(np.append(b - a, 0), np.append(c - a, 0))[2])
    sides = np.linalg.norm(b - a) * np.linalg.norm(c - b) * np.linalg.norm(a - c)
    assert sides / (4 * area) == pytest.approx(speed / rate, rel=0.02)  # the circle through three points


def test_what_it_was_told_is_kept_on_its_clock():
    scene = robot([(1.0, 10, -20), (0.25, 5, 5)], duration_s=1.5)
    np.testing.assert_array_equal(scene.commands.time_ns, [250_000_000, 1_000_000_000])
    np.testing.assert_array_equal(scene.commands.values, [[5, 0, 5, 5], [-5, -30, 10, -20]])
    still, _ = path(scene, [0.0, 0.25])
    np.testing.assert_allclose(still[0], still[1], atol=1e-6)


@pytest.mark.parametrize(
    "line",
    ["forward", "{}", '{"left": 1}', "[1, 2]", '{"left": 300, "right": 0}', '{"left": NaN, "right": 0}', "[" * 9999],
)
def test_a_line_that_is_no_command_is_refused(line):
    with pytest.raises(InputError, match=r"robot: command .* is wanted|robot: command .* are wanted"):
        read_command(line)


def test_commands_that_leave_the_working_space_are_refused():
    with pytest.raises(
        InputError, match=r"commands: they drive the robot out of the working space at 1\.\d+ s, in x"
    ):
        robot([(0.1, 200, 200)], duration_s=5.0, heading=0.0)
    with pytest.raises(InputError, match=r"command at -0\.5 s: the robot takes commands from 0 s on"):
        robot([(-0.5, 20, 20)])
