"""Interpolated configurations against closed forms and scipy's rotations."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.errors import InputError
from twin.scenes.paths import quaternion_addresses, spline_path, step_path
from twin.scenes.world import Box, block, capsule, cylinder, ellipsoid, outermost, rotation_to

FREE_AND_HINGE = """<mujoco><worldbody><body><freejoint/><geom size=".1"/><body pos="0 0 .2"><joint axis="0 1 0"/>
<geom size=".05"/></body></body></worldbody></mujoco>"""


def _model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(FREE_AND_HINGE)


def test_addresses_of_quaternions() -> None:
    q, v = quaternion_addresses(_model())
    assert (q.tolist(), v.tolist()) == ([3], [3])


def test_steps_of_a_steady_screw_are_joined_exactly() -> None:
    """A body that flies straight and spins steadily about any axis has a closed form at every instant."""
    model, step = _model(), 0.05
    velocity, spin = np.array([0.3, -0.2, 0.1]), np.array([1.0, -2.0, 3.0])  # spin in body axes
    start = Rotation.from_euler("xyz", [0.4, 0.5, 0.6])
    times = np.arange(21) * step

    def attitude(t: float) -> np.ndarray:
        return (start * Rotation.from_rotvec(spin * t)).as_quat(scalar_first=True)

    qpos = np.array([[*(velocity * t), *attitude(t), 0.7 * t] for t in times])
    qpos[::2, 3:7] *= -1  # the same rotations
    qvel = np.tile([*velocity, *spin, 0.7], (21, 1))
    path = step_path(model, -0.1, step, qpos, qvel)
    for t in np.linspace(0, 1, 83):
        found = path(t - 0.1)
        np.testing.assert_allclose(found[:3], velocity * t, atol=1e-14)
        np.testing.assert_allclose(found[7], 0.7 * t, atol=1e-14)
        assert abs(found[3:7] @ attitude(t)) == pytest.approx(1.0, abs=1e-13)


def test_steps_keep_the_angular_velocity_on_both_sides() -> None:
    model, rng = _model(), np.random.default_rng(3)
    qpos, qvel = np.zeros((6, 8)), rng.normal(0, 1, (6, 7))
    attitudes = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.3, (6, 3)), axis=0))
    qpos[:, 3:7] = attitudes.as_quat(scalar_first=True)
    path = step_path(model, 0.0, 0.1, qpos, qvel)
    e = 1e-6
    for k in range(1, 5):
        for sign in (1, -1):
            beside = Rotation.from_quat(path(0.1 * k + sign * e)[3:7], scalar_first=True)
            rate = sign * (attitudes[k].inv() * beside).as_rotvec() / e
            np.testing.assert_allclose(rate, qvel[k, 3:6], atol=2e-4)
    with pytest.raises(ValueError, match="physics ran from"):
        path(0.7)


def test_splined_rotations_meet_the_record_and_go_on_steadily_outside() -> None:
    times = np.arange(60) / 120
    turn = Rotation.from_rotvec(np.outer(np.sin(4 * times), [0.5, 1.0, -0.3]))
    qpos = np.concatenate([np.sin(times)[:, None], turn.as_quat(scalar_first=True)], axis=1)
    qpos[30:, 1:] *= -1
    path = spline_path(times, qpos, np.array([1]))
    for k in range(60):
        found = path(float(times[k]))
        assert found[0] == pytest.approx(qpos[k, 0], abs=1e-14)
        assert abs(found[1:] @ qpos[k, 1:]) == pytest.approx(1, abs=1e-13)
    # Between frames of a smooth motion the error is far below a microradian-scale arc.
    between = float(times[20] + times[21]) / 2
    exact = Rotation.from_rotvec(np.sin(4 * between) * np.array([0.5, 1.0, -0.3]))
    error = (exact.inv() * Rotation.from_quat(path(between)[1:], scalar_first=True)).magnitude()
    assert error < 1e-7
    speed = (path(-0.02)[0] - path(-0.01)[0]) / -0.01
    assert speed == pytest.approx((path(-0.05)[0] - path(-0.04)[0]) / -0.01, rel=1e-9)


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=60, deadline=None)
@given(direction=directions, axis=directions)
def test_rays_leave_primitives_where_geometry_says(
    direction: tuple[float, float, float], axis: tuple[float, float, float]
) -> None:
    d = np.array(direction) / np.linalg.norm(direction)
    a = np.array(axis) / np.linalg.norm(axis)
    # A capsule's skin is everywhere one radius from its line, and the normal points away from the line.
    point, normal = outermost([capsule(-0.2 * a, 0.2 * a, 0.05)], np.zeros(3), d)
    foot = np.clip(point @ a, -0.2, 0.2) * a
    np.testing.assert_allclose(point - foot, 0.05 * normal, atol=1e-6)
    # An ellipsoid: (p/s)^2 adds up to 1 and the normal is along p/s^2.
    s = np.array([0.1, 0.2, 0.3])
    point, normal = outermost([ellipsoid(np.zeros(3), s)], np.zeros(3), d)
    assert np.sum((point / s) ** 2) == pytest.approx(1.0, abs=1e-9)
    gradient = point / s**2
    np.testing.assert_allclose(normal, gradient / np.linalg.norm(gradient), atol=1e-6)
    rotation = rotation_to(a)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation[:, 2], a, atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_outermost_of_several_shapes_is_taken() -> None:
    shapes = [block(np.zeros(3), np.array([0.2, 0.2, 0.2])), cylinder(np.zeros(3), np.array([0.0, 0, 0.5]), 0.02)]
    point, normal = outermost(shapes, np.zeros(3), np.array([0.0, 0, 1]))
    np.testing.assert_allclose(point, [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-12)
    point, _ = outermost(shapes, np.zeros(3), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(point, [0.1, 0, 0], atol=1e-12)
    with pytest.raises(ValueError, match="no shape"):
        outermost(shapes, np.array([5.0, 5, 0]), np.array([1.0, 0, 0]))


def test_a_box_must_be_a_box() -> None:
    with pytest.raises(InputError, match="sizes above zero"):
        Box(np.zeros(3), np.array([1.0, 0.0, 1.0]))
