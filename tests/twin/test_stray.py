"""Stray light: mirror images by hand, what hides them, other cameras' lights, shiny spots, glare."""

from dataclasses import replace

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_ambient import light_of_pixels
from test_targets_figures import light_of

from mosca.data.arrays import Array
from mosca.data.rig import OpenCVLens
from mosca.errors import InputError
from twin.cameras.exposure.lighting import ALWAYS, glow_table
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.lens import TwinLens
from twin.cameras.optics.psf import psf_of
from twin.cameras.render.render import BALL, FIGURE, FLAT, Figures, TargetsInCamera, Window, render_targets
from twin.cameras.sensor.background_light import Ambient
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.context_image import Context
from twin.cameras.stray_light.glare import Glare, veil
from twin.cameras.stray_light.mirror import PlaneMirror, SceneRays, mirrored, seen_share, with_mirrored
from twin.cameras.stray_light.stray import Surroundings, stray_targets, unhidden
from twin.cameras.stray_light.world import (
    RigPoses,
    RingLight,
    ShinySpot,
    TargetsInWorld,
    in_camera,
    joined,
    shiny_spots,
)
from twin.scenes.emission import Glow
from twin.scenes.figure import circle, figure, polygon, ring_sector

SIGNAL = 1000.0
NODES = 3
LOOKING_MINUS_X = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
"""World from camera: axis along -x, image x along the world's y, z up."""
EYE = np.array([2.0, 0.0, 0.0])
WALL = PlaneMirror((0.0, 0.0, 0.0), (1.0, 0, 0), (0, 1.0, 0), (3.0, 2.0), reflectance=0.8)
"""In the plane x = 0, seen from +x, 3 m along y and 2 m high."""


def still(rotation: Array = LOOKING_MINUS_X, position: Array = EYE) -> tuple[Array, Array]:
    return np.repeat(position[None], NODES, axis=0), np.repeat(rotation[None], NODES, axis=0)


def world_targets(
    where: list[tuple[float, float, float]],
    glow: Glow | None = None,
    shape: int = BALL,
    turn: Array | None = None,
    radius: float = 0.02,
) -> TargetsInWorld:
    m = len(where)
    path = np.repeat(np.array(where, dtype=float).reshape(m, 1, 3), NODES, axis=1)
    turns = np.broadcast_to(np.eye(3) if turn is None else turn, (m, NODES, 3, 3)).copy()
    table = glow_table([glow or Glow()] * m, np.full(m, shape == BALL))
    none = np.full(m, -1, dtype=np.int64)
    number = np.zeros(m, dtype=np.int64) if shape == FIGURE else none
    lit = np.tile(ALWAYS, (m, 1))
    return TargetsInWorld(path, turns, np.full(m, radius), np.full(m, shape), number, none, table, lit)


def rays_in(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> SceneRays:
    """Boxes: centre and half sizes."""
    spec = mujoco.MjSpec()
    for center, half in boxes:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=half)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return SceneRays(model, data)


def veil_image(light: Array, glare: Glare) -> Array:
    """Return the haze at every pixel (H, W) float32 [electrons]; its sum is share x the sum of the light."""
    fine = cv2.resize(veil(light, glare), light.shape[::-1], interpolation=cv2.INTER_LINEAR)
    total, spread = glare.share * float(light.sum(dtype=float)), float(fine.sum(dtype=float))
    return np.asarray(fine * (total / spread) if spread > 0.0 else fine, dtype=np.float32)


def test_a_mirror_image_by_hand():
    target = world_targets([(1.0, 0.5, 0.25)], turn=LOOKING_MINUS_X.T)
    image = mirrored(WALL, target, SIGNAL, *still(), rays_in())
    # behind the mirror at (-1, 0.5, 0.25): 3 m before the camera, 0.5 to its right, 0.25 above
    np.testing.assert_allclose(image.path[0], [[0.5, -0.25, 3.0]] * NODES, atol=1e-15)
    assert image.electrons[0] == pytest.approx(0.8 * SIGNAL, rel=1e-12)
    np.testing.assert_allclose(np.linalg.det(image.rotation[0]), 1.0, rtol=1e-12)


def test_an_image_turns_as_mirrors_do():
    # a target's normal along the world's +x is seen along -x in the mirror: the camera's +z
    facing_x = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    image = mirrored(WALL, world_targets([(1, 0, 0)], turn=facing_x), SIGNAL, *still(), rays_in())
    np.testing.assert_allclose(image.rotation[0, 1][:, 2], [0, 0, 1], atol=1e-15)
    # shade towards +x in the world falls towards the camera's +z, towards +z of the world stays up
    shaded = world_targets([(1, 0, 0)], Glow(shade=0.5, shade_world=(1, 0, 1)))
    got = mirrored(WALL, shaded, SIGNAL, *still(), rays_in()).shade[0]
    np.testing.assert_allclose(got, 0.5 / np.sqrt(2) * np.array([0, -1, 1]), atol=1e-12)


def test_light_of_the_camera_passes_the_mirror_twice():
    # a retro ball 1 m before the mirror, the camera 2 m: the way is 3 m; as bright as stated at 1 m
    retro = world_targets([(1.0, 0, 0.0)], Glow("retro", at_m=1.0))
    image = mirrored(WALL, retro, SIGNAL, *still(), rays_in())
    assert image.electrons[0] == pytest.approx(0.8**2 * SIGNAL / 9, rel=1e-12)
    # a lamp that faces the mirror head on, half as bright 60 degrees off
    lamp = world_targets([(1.0, 0, 0)], Glow("lamp", half_deg=60.0), turn=np.diag([-1.0, 1, -1])[[2, 1, 0]].T)
    assert mirrored(WALL, lamp, SIGNAL, *still(), rays_in()).electrons[0] == pytest.approx(0.8 * SIGNAL, rel=1e-12)


def test_a_mirror_shows_what_passes_its_rectangle():
    # the line to the image of (1, y, 0) crosses the mirror 2/3 of the way: at 2 y / 3; its half side is 1.5
    where = [(1.0, y, 0.0) for y in (-2.5, -2.2, 0.0, 2.2, 2.5)]
    share = seen_share(WALL, world_targets(where), EYE, rays_in())
    np.testing.assert_allclose(share, [0, 1, 1, 1, 0], atol=1e-12)
    # on the edge: 19 points, about half of them pass
    edge = seen_share(WALL, world_targets([(1.0, 2.25, 0.0)], radius=0.1), EYE, rays_in())[0]
    assert 7 / 19 < edge < 12 / 19
    image = mirrored(WALL, world_targets([(1.0, 2.25, 0.0)], radius=0.1), SIGNAL, *still(), rays_in())
    assert image.electrons[0] == pytest.approx(edge * 0.8 * SIGNAL)
    # behind the mirror, and from behind it, there is nothing
    assert seen_share(WALL, world_targets([(-1.0, 0, 0)]), EYE, rays_in())[0] == 0.0
    assert seen_share(WALL, world_targets([(1.0, 0, 0)]), -EYE, rays_in())[0] == 0.0


def test_both_ways_of_a_mirror_image_can_be_barred():
    target = world_targets([(1.0, 1.5, 0.0)])  # by way of (0, 1, 0)
    small = (0.05, 0.05, 0.05)
    way_out, way_on, beside, behind = (1.0, 0.5, 0.0), (0.5, 1.25, 0.0), (1.0, 1.0, 0.0), (-0.5, 1.25, 0.0)
    share = [seen_share(WALL, target, EYE, rays_in((at, small)))[0] for at in (way_out, way_on, beside, behind)]
    np.testing.assert_allclose(share, [0, 0, 1, 1], atol=1e-12)
    # the mirror's own pane, up to 1 cm before its plane, does not count
    pane = ((-0.02, 0.0, 0.0), (0.025, 1.5, 1.0))
    assert seen_share(WALL, target, EYE, rays_in(pane))[0] == pytest.approx(1.0)
    # an edge that bars the way on to one half of the target
    half = ((0.5, 1.25 + 0.5, 0.0), (0.01, 0.5, 0.5))
    assert 0.2 < seen_share(WALL, target, EYE, rays_in(half))[0] < 0.8


def test_a_target_does_not_hide_itself():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(size=[0.02, 0, 0], pos=[1.0, 1.5, 0.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    target = replace(world_targets([(1.0, 1.5, 0.0)]), geom=np.array([0]))
    assert seen_share(WALL, target, EYE, SceneRays(model, data))[0] == pytest.approx(1.0)


def test_mirrors_that_mean_nothing_are_refused():
    with pytest.raises(InputError, match="right angles"):
        PlaneMirror((0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1))
    with pytest.raises(InputError, match="reflectance"):
        PlaneMirror((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1), reflectance=1.2)


def test_a_mirrored_figure_keeps_its_area_and_turns_round():
    printed = figure([
        polygon(np.array([[0.0, 0], [0.3, 0], [0.3, 0.1]])),
        ring_sector(0.1, 0.2, 0.05, 0.1, 0.3, 1.7, gain=-0.5),
        circle(-0.1, 0.1, 0.05),
    ])  # fmt: skip
    original, turned = with_mirrored([printed])
    assert original is printed
    assert light_of(turned) == pytest.approx(light_of(printed), rel=1e-12)
    assert (turned.radius, len(turned.pieces)) == (printed.radius, len(printed.pieces))
    twice = with_mirrored([turned])[1]
    np.testing.assert_allclose(twice.pieces, printed.pieces, atol=1e-15)
    triangle = turned.pieces[-3:]
    assert {tuple(p) for p in triangle[:, 1:3]} == {(0.0, 0.0), (0.3, 0.0), (0.3, -0.1)}
    np.testing.assert_allclose(triangle[:, 3:5], np.roll(triangle[:, 1:3], -1, axis=0))


W, H = 200, 150
LENS = OpenCVLens(400.0, 400.0, 99.5, 74.5)


def rendered(targets: TargetsInCamera, figures: Figures | None = None) -> Array:
    light = np.zeros((H, W), dtype=np.float32)
    lens, window = TwinLens.of(LENS, W, H).vector, Window(np.array([0.0, 5e-4, 1e-3]), 1e-3)
    shapes = figures or Figures.of(())
    render_targets(light, lens, psf_of(Optics(), W, H), window, targets, *unhidden(NODES), shapes)
    return light


@pytest.mark.parametrize("shape", [BALL, FLAT, FIGURE])
def test_the_image_in_a_mirror_is_the_flipped_image_of_a_flipped_world(shape):
    """A camera that faces a mirror sees what its image behind it sees, left and right swapped."""
    # the mirror is y = 1; a camera on y = 0.6 looks along +y; the world's image behind the mirror swaps y with 2 - y
    mirror = PlaneMirror((0.0, 1.0, 0.0), (0.0, -1.0, 0), (1.0, 0, 0), (4.0, 4.0), reflectance=1.0)
    looking = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    at = np.array([0.0, 0.6, 0.0])
    tilted = cv2.Rodrigues(np.array([0.3, 0.2, 0.5]))[0] @ looking @ np.diag([1.0, -1, -1]) @ np.diag([-1.0, 1, -1])
    print_ = figure([polygon(np.array([[-0.1, -0.1], [0.12, -0.08], [-0.05, 0.1]]))])
    target = world_targets([(0.05, -0.4, 0.02)], shape=shape, turn=tilted, radius=print_.radius)
    figures = Figures.of(with_mirrored([print_]))
    image = rendered(mirrored(mirror, target, SIGNAL, *still(looking, at), rays_in(), figures=1), figures)
    # witness: the camera's image behind the mirror at y = 1.4 looks along -y; turned upright, it swaps left and right
    back = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
    straight = rendered(in_camera(target, SIGNAL, *still(back, np.array([0.0, 1.4, 0.0]))), figures)
    assert straight.sum() > 500 * SIGNAL
    np.testing.assert_allclose(image, straight[:, ::-1], atol=0.02 * SIGNAL)
    assert image.sum() == pytest.approx(straight.sum(), rel=1e-4)


def heads() -> RigPoses:
    """Camera 0 at (2, 0, 0) looks along -x; camera 1 at (-2, 0, 0) faces it; camera 2 at (-2, 1, 0) looks away."""
    facing = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    position = np.array([EYE, -EYE, [-2.0, 1, 0]])
    rotation = np.stack([LOOKING_MINUS_X, facing, LOOKING_MINUS_X])
    lit = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
    return RigPoses(np.repeat(position[:, None], NODES, axis=1), np.repeat(rotation[:, None], NODES, axis=1), lit)


def stray(surroundings: Surroundings, targets: TargetsInWorld | None = None, camera: int = 0):
    own = world_targets([]) if targets is None else targets
    return stray_targets(
        surroundings, camera=camera, rig_poses=heads(), targets=own, signal_e=SIGNAL, rays=rays_in(), figures=0
    )


def test_nothing_is_the_default():
    got = stray(Surroundings(), world_targets([(1.0, 0, 0)]))
    assert len(got.direct.radius) == len(got.mirrored.radius) == 0
    assert got.direct.path.shape == (0, NODES, 3)
    assert not Surroundings().has_targets
    assert Surroundings().context is None
    assert Surroundings(context=Context()).context.rate_hz == 10.0


def test_a_camera_sees_the_lights_of_the_others():
    seen = stray(Surroundings(ring_light=RingLight(0.05, 20.0, 30.0))).direct
    np.testing.assert_allclose(seen.path[0], [[0, 0, 4.0]] * NODES, atol=1e-15)
    np.testing.assert_allclose(seen.rotation[0, 0][:, 2], [0, 0, -1], atol=1e-15)
    assert seen.electrons[0] == pytest.approx(20 * SIGNAL)
    assert seen.electrons[1] == 0.0  # it faces the other way
    assert seen.lit_s.tolist() == [[2.0, 3.0], [4.0, 5.0]]
    assert set(seen.shape.tolist()) == {FLAT}


def test_a_camera_sees_its_own_light_in_a_mirror():
    got = stray(Surroundings(ring_light=RingLight(), mirrors=(WALL,)))
    # cameras 1 and 2 are behind the wall's plane
    np.testing.assert_allclose(got.mirrored.path[0, 1], [0, 0, 4.0], atol=1e-15)
    assert got.mirrored.electrons[0] == pytest.approx(0.8 * 20 * SIGNAL)
    assert got.mirrored.lit_s.tolist() == [[0.0, 1.0]]


def test_shiny_spots():
    sided = ShinySpot((0, 0, 0), 0.01, 3.0, facing=(1.0, 0, 0), half_deg=10.0, at_m=1.0)
    turned = replace(sided, facing=(np.cos(np.radians(10)), np.sin(np.radians(10)), 0.0))
    even = ShinySpot((0, 0, 0), 0.01, 3.0)
    away = replace(sided, facing=(-1.0, 0.0, 0.0))
    got = stray(Surroundings(spots=(sided, turned, even, away))).direct
    # 2 m away: a quarter; 10 degrees off: half of it
    np.testing.assert_allclose(got.electrons, [750.0, 375.0, 3000.0, 0.0], rtol=1e-9)
    np.testing.assert_allclose(got.path[:, 0], [[0, 0, 2.0]] * 4, atol=1e-15)
    assert (got.shape == BALL).all()
    assert (got.limb == 0).all()
    with pytest.raises(InputError, match="radius_m"):
        ShinySpot((0, 0, 0), 0.0, 1.0)
    with pytest.raises(InputError, match="half_deg"):
        RingLight(half_deg=90.0)
    with pytest.raises(InputError, match="facing"):
        ShinySpot((0, 0, 0), 0.01, 1.0, facing=(0, 0, 0))


def test_stray_targets_are_joined_to_the_scenes_own():
    own = in_camera(world_targets([(1.0, 0, 0)]), SIGNAL, *still())
    extra = stray(Surroundings(spots=(ShinySpot((0, 0, 0), 0.01, 3.0),))).direct
    both = joined(own, extra)
    np.testing.assert_allclose(both.path[:, 0, 2], [1.0, 2.0])
    assert rendered(both).max() > 2 * SIGNAL


def test_spots_without_a_facing_face_whoever_looks():
    spots = shiny_spots([ShinySpot((0, 0, 0), 0.01, 3.0, half_deg=5.0)], np.array([0.0, 4.0, 0.0]), NODES)
    assert spots.rotation.shape == (1, NODES, 3, 3)
    np.testing.assert_allclose(spots.rotation[0, 0][:, 2], [0, 1, 0], atol=1e-15)


@given(st.integers(1, 100), st.integers(1, 100), st.floats(0.001, 0.9), st.floats(0.02, 2.0), st.integers(0, 99))
def test_glare_spreads_its_share_and_loses_none(width, height, share, sigma, seed):
    light = np.random.default_rng(seed).gamma(0.1, 1000.0, (height, width)).astype(np.float32)
    haze = veil_image(light, Glare(share, sigma))
    assert haze.shape == light.shape
    assert haze.dtype == np.float32
    assert haze.min() >= 0.0
    assert haze.sum(dtype=float) == pytest.approx(share * light.sum(dtype=float), rel=1e-5)
    coarse = veil(light, Glare(share, sigma))
    assert coarse.mean(dtype=float) == pytest.approx(share * light.mean(dtype=float), rel=1e-5)


@pytest.mark.parametrize("height", [480, 491])
def test_glare_of_a_point_is_a_wide_gaussian(height):
    width, sigma = 640, 640 / 8
    light = np.zeros((height, width), dtype=np.float32)
    light[232:248, 312:328] = 1000.0
    y, x = np.mgrid[:height, :width]
    gauss = np.exp(-((x - 319.5) ** 2 + (y - 239.5) ** 2) / (2 * sigma**2))
    expected = 0.02 * light.sum() * gauss / gauss.sum()
    np.testing.assert_allclose(veil_image(light, Glare(0.02)), expected, atol=0.02 * expected.max())
    # the form that the sensor's ambient light takes is the same haze
    taken = Ambient.of(Sensor(), 200.0, shape=(height, width)).with_extra(veil(light, Glare(0.5)))
    np.testing.assert_allclose(light_of_pixels(taken), 200.0 + 25 * expected, atol=3.0)


def test_glare_of_even_light_is_even():
    even = np.full((48, 67), 5.0, dtype=np.float32)
    np.testing.assert_allclose(veil(even, Glare(0.1)), 0.5, rtol=1e-5)
    assert veil_image(np.zeros((5, 7), dtype=np.float32), Glare(0.1)).max() == 0.0
    with pytest.raises(InputError, match="share"):
        Glare(1.0)
