"""A moment of the scene: interpolation held against the scene itself, and kinks against no interpolation at all."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from twin.cameras.exposure.scene_sampling import (
    TOLERANCE,
    GeomPoses,
    SceneSamples,
    chebyshev_nodes,
    interpolated,
    interval_about,
    lobatto_nodes,
    seen_from,
)
from twin.scenes.actor import build_actor
from twin.scenes.scene import MARKER_GROUP, Scene

SPACE = {"box_center_m": np.array([0.0, 0.0, 1.25]), "box_size_m": np.full(3, 2.5)}


@pytest.fixture(scope="module")
def actor() -> Scene:
    return build_actor(duration_s=4.0, **SPACE, rng=np.random.default_rng(0), markers=30)


def slider(position: object) -> Scene:
    """A ball on a slide, at x = position(t)."""
    spec = mujoco.MjSpec()
    cart = spec.worldbody.add_body(name="cart")
    cart.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1.0, 0, 0])
    ball = mujoco.mjtGeom.mjGEOM_SPHERE
    cart.add_geom(name="ball", type=ball, size=[0.01, 0, 0], group=MARKER_GROUP, mass=1)
    model = spec.compile()
    return Scene(model, ("ball",), (0,), lambda t: np.array([position(t)]), 10.0)  # type: ignore[operator]


class Counted:
    """Counts the evaluations of a scene's configuration."""

    def __init__(self, scene: Scene) -> None:
        self.times: list[float] = []
        self.scene = replace(scene, configuration_at=self._at)
        self._inner = scene.configuration_at

    def _at(self, time_s: float) -> Array:
        self.times.append(time_s)
        return self._inner(time_s)


def all_of(scene: Scene) -> SceneSamples:
    return SceneSamples(scene.sampler(), np.arange(scene.model.ngeom), np.arange(scene.model.nbody))


@pytest.mark.parametrize("span_s", [0.5e-3, 2e-3, 4e-3, 9e-3, 20e-3])
def test_human_motion_is_interpolated_to_a_hundredth_of_a_micron(actor: Scene, span_s: float) -> None:
    sampler = actor.sampler()
    for begin in (0.1, 0.777, 1.9, 3.3):
        stretch = interval_about(begin + span_s / 2, span_s, 20e-6)
        assert stretch is not None
        times = np.linspace(begin - 1e-4, begin + span_s + 1e-4, 9)
        got = all_of(actor).at(times, stretch)
        for k, t in enumerate(times):
            state = sampler.at(float(t))
            np.testing.assert_allclose(got.geom_xyz[k], state.geom_xyz, atol=1e-8)
            np.testing.assert_allclose(got.geom_rotation[k], state.geom_rotation, atol=2e-8)
            np.testing.assert_allclose(got.body_xyz[k], sampler.data.xpos, atol=1e-8)


def test_four_cameras_share_five_evaluations(actor: Scene) -> None:
    counted = Counted(actor)
    moment = all_of(counted.scene)
    stretch = interval_about(1.0005, 1e-3, 20e-6)
    for late in (-40e-6, 0.0, 15e-6, 60e-6):
        moment.at(1.0 + late + np.array([0.0, 5e-4, 1e-3]), stretch)
    moment.at(np.array([1.0005]))
    assert len(counted.times) == 5


def test_another_camera_changes_nothing(actor: Scene) -> None:
    mine, times = interval_about(1.0005, 1e-3, 20e-6), np.array([1.00001, 1.0005, 1.0009])
    alone = all_of(actor).at(times, mine)
    shared = all_of(actor)
    shared.at(np.array([1.003, 1.0035, 1.004]), interval_about(1.0035, 1e-3, 20e-6))
    shared.at(np.array([1.0, 1.001]))
    together = shared.at(times, mine)
    np.testing.assert_array_equal(together.geom_xyz, alone.geom_xyz)
    np.testing.assert_array_equal(together.geom_rotation, alone.geom_rotation)


def test_a_kink_is_not_smoothed() -> None:
    # 1 m/s to the right until 1 s, then back: polynomials over the turn are 0.1 mm off
    scene = slider(lambda t: -abs(t - 1.0))
    times = np.linspace(0.9995, 1.0005, 7)
    got = all_of(scene).at(times, interval_about(1.0, 1e-3, 20e-6))
    np.testing.assert_allclose(got.geom_xyz[:, 0, 0], -np.abs(times - 1.0), atol=2e-12)


def test_what_leaves_its_stretch_is_evaluated_as_it_is() -> None:
    scene = slider(lambda t: t**9)
    times = np.array([1.0, 1.002])
    got = all_of(scene).at(times, interval_about(1.0, 1e-3, 20e-6))
    np.testing.assert_allclose(got.geom_xyz[:, 0, 0], times**9, atol=2e-12)


def test_what_passes_is_within_the_tolerance() -> None:
    # faster and faster shaking: either the polynomial is good or it is not used
    for hertz in (1.0, 20.0, 80.0, 200.0, 1000.0):
        shaking = slider(lambda t, w=2 * np.pi * hertz: 0.1 * np.sin(w * t + 0.3))
        times = np.linspace(0.999, 1.001, 21)
        got = all_of(shaking).at(times, interval_about(1.0, 2e-3, 20e-6)).geom_xyz[:, 0, 0]
        np.testing.assert_allclose(got, 0.1 * np.sin(2 * np.pi * hertz * times + 0.3), atol=3 * TOLERANCE)


def test_long_spans_are_not_interpolated() -> None:
    assert interval_about(1.0, 0.1, 20e-6) is None
    assert interval_about(1.0, 1e-3, 10e-3) is None


def test_interpolation_is_that_of_scipy() -> None:
    random = np.random.default_rng(1)
    nodes = chebyshev_nodes(0.7, 0.2, 6)
    assert (np.diff([0.6, *nodes, 0.8]) > 0).all()
    values, times = random.normal(size=(6, 5)), np.linspace(0.6, 0.8, 11)
    np.testing.assert_allclose(
        interpolated(nodes, values, times), BarycentricInterpolator(nodes, values)(times), atol=1e-10
    )


def test_lobatto_nodes_reach_both_ends() -> None:
    np.testing.assert_allclose(lobatto_nodes(2.0, 5), [0, 1 - np.sqrt(0.5), 1, 1 + np.sqrt(0.5), 2], atol=1e-15)


def test_what_a_camera_has_before_it() -> None:
    random = np.random.default_rng(2)
    rotation = Rotation.random(3, random_state=1).as_matrix()
    position, xyz = random.normal(size=(3, 3)), random.normal(size=(3, 4, 3))
    turn = Rotation.random(12, random_state=2).as_matrix().reshape(3, 4, 3, 3)
    places = GeomPoses(xyz, turn, np.zeros((3, 0, 3)), np.zeros((3, 0, 3, 3)))
    targets, solids = np.array([2, 0]), np.array([1, 2, 3])
    view = seen_from(rotation, position, places, targets, solids, 2)
    assert view.path.shape == (2, 2, 3)
    assert view.solid_rotation.shape == (2, 3, 3, 3)
    for k in range(2):
        for m, geom in enumerate(targets):
            np.testing.assert_allclose(view.path[m, k], rotation[k].T @ (xyz[k, geom] - position[k]), atol=1e-15)
            np.testing.assert_allclose(view.rotation[m, k], rotation[k].T @ turn[k, geom], atol=1e-15)
        for s, geom in enumerate(solids):
            np.testing.assert_allclose(view.solid_xyz[k, s], rotation[k].T @ (xyz[k, geom] - position[k]), atol=1e-15)
            np.testing.assert_allclose(view.solid_rotation[k, s], rotation[k].T @ turn[k, geom], atol=1e-15)
