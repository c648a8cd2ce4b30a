"""The context image against OpenCV's projection, hand numbers and MuJoCo's own ray caster."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.data.rig import FisheyeLens, Lens, OpenCVLens
from mosca.errors import InputError
from twin.cameras.optics.lens import TwinLens
from twin.cameras.stray_light.context_image import (
    Cloth,
    Context,
    Refreshed,
    context_image,
    context_view,
    enlarged,
    refresh_pulse,
)
from twin.cameras.stray_light.context_rays import cast, ray_grid
from twin.scenes.scene import MARKER_GROUP, UNSEEN_GROUP, Scene

W, H = 160, 120
FOCAL = 200.0
LENS = OpenCVLens(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2, -0.2, 0.05)
PINHOLE = OpenCVLens(FOCAL, FOCAL, 80.0, 60.0)
LOOKING = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""World from camera of a camera with its axis along +y."""
ORIGIN = np.zeros(3)
FULL = 10_000.0
GEOM = mujoco.mjtGeom


def scene_of(spec: mujoco.MjSpec) -> Scene:
    model = spec.compile()
    return Scene(model, (), (), lambda _t: np.zeros(model.nq), 1.0)


def ball_scene(center=(0.1, 3.0, 0.2), radius=0.3, rgba=(0.4, 0.4, 0.4, 1.0)) -> Scene:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="ball", type=GEOM.mjGEOM_SPHERE, size=[radius, 0, 0], pos=center, rgba=rgba)
    return scene_of(spec)


def image_of(scene: Scene, context: Context, lens: Lens = LENS, rotation=LOOKING, position=ORIGIN):
    view = context_view(scene, TwinLens.of(lens, W, H), W, H, context, FULL)
    return context_image(view, scene.sampler(), 0.0, rotation, position)


def test_a_ball_covers_the_pixels_that_opencv_says():
    center, radius = np.array([0.1, -0.2, 3.0]), 0.3  # camera frame
    image = image_of(ball_scene(), Context(step_px=1, ambient=0.05, lamp=0.0))
    # the circle where the viewing cone touches the ball
    d2 = center @ center
    axis = center / np.sqrt(d2)
    one = np.cross(axis, [0, 1.0, 0])
    one /= np.linalg.norm(one)
    two = np.cross(axis, one)
    angles = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    ring = radius * np.sqrt(1 - radius**2 / d2) * (np.outer(np.cos(angles), one) + np.outer(np.sin(angles), two))
    matrix = np.array([[FOCAL, 0, LENS.cx_px], [0, FOCAL, LENS.cy_px], [0, 0, 1]])
    rim, _ = cv2.projectPoints(
        ring + center * (1 - radius**2 / d2), np.zeros(3), np.zeros(3), matrix, np.array([LENS.k1, LENS.k2, 0, 0])
    )
    contour = rim.astype(np.float32)
    away = np.array([[cv2.pointPolygonTest(contour, (x, y), True) for x in range(W)] for y in range(H)])
    clear = np.abs(away) > 0.02
    assert ((away > 0) & clear).sum() > 1000
    np.testing.assert_array_equal((image > 0)[clear], (away > 0)[clear])
    np.testing.assert_allclose(image[image > 0], 0.4 * 0.05 * FULL, rtol=1e-6)


def test_lambert_at_a_balls_middle_by_hand():
    # seen head on from 2.7 m: 0.4 (0.05 + 0.02 (3 / 2.7)^2) of the full well
    context = Context(step_px=1, ambient=0.05, lamp=0.02, at_m=3.0)
    image = image_of(ball_scene(center=(0, 3.0, 0)), context, PINHOLE)
    assert image[60, 80] == pytest.approx(0.4 * (0.05 + 0.02 * 3.0**2 / 2.7**2) * FULL, rel=1e-6)


def test_a_floor_under_the_camera_falls_with_the_cube_of_the_cosine():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=GEOM.mjGEOM_PLANE, size=[0, 0, 0.1], rgba=[1, 0, 0, 1])
    down = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    context = Context(step_px=1, ambient=0.0, lamp=0.01, at_m=2.0)
    image = image_of(scene_of(spec), context, PINHOLE, down, np.array([0.3, 0.1, 4.0]))
    # cosine to the ray once, distance over the height once a square; red's share of grey is 0.2126
    for x, y in ((80, 60), (140, 60), (30, 10)):
        cosine = FOCAL / np.sqrt(FOCAL**2 + (x - 80) ** 2 + (y - 60) ** 2)
        expected = 0.2126 * 0.01 * (2.0 / 4.0) ** 2 * cosine**3 * FULL
        assert image[y, x] == pytest.approx(expected, rel=1e-5)


def test_rays_meet_what_mujocos_rays_meet():
    spec = mujoco.MjSpec()
    random = np.random.default_rng(3)
    kinds = [GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_ELLIPSOID, GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_BOX]
    for k in range(30):
        turn = random.normal(size=4)
        spec.worldbody.add_geom(
            type=kinds[k % 5], size=random.uniform(0.05, 0.3, 3), pos=random.uniform([-2, 2, -1.5], [2, 6, 1.5]),
            quat=turn / np.linalg.norm(turn),
        )  # fmt: skip
    spec.worldbody.add_geom(type=GEOM.mjGEOM_PLANE, size=[3.0, 4.0, 0.1], pos=[0, 4.0, -1.2])
    spec.worldbody.add_geom(type=GEOM.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 9.0, 0], quat=[0.7071, 0.7071, 0, 0])
    scene = scene_of(spec)
    model, state = scene.model, scene.sampler().at(0.0)
    sampler = scene.sampler()
    sampler.at(0.0)
    grid = ray_grid(TwinLens.of(LENS, W, H), W, H, 2)
    xyz = np.ascontiguousarray(state.geom_xyz @ LOOKING)
    turns = np.ascontiguousarray(LOOKING.T @ state.geom_rotation)
    kind = model.geom_type.astype(np.int64)
    met = cast(grid, kind, model.geom_size.copy(), model.geom_rbound.copy(), xyz, turns)
    rays = np.ascontiguousarray(grid.rays.reshape(-1, 3) @ LOOKING.T)
    n = len(rays)
    ids, far, normal = np.full(n, -1, dtype=np.int32), np.zeros(n), np.zeros((n, 3))
    mujoco.mj_multiRay(
        model, sampler.data, ORIGIN, rays.reshape(-1), None, 1, -1, ids, far, normal.reshape(-1), n, 1e6
    )  # fmt: skip
    np.testing.assert_array_equal(met.geom.reshape(-1), ids)
    assert len(np.unique(ids)) > 25
    hit = ids >= 0
    np.testing.assert_allclose(met.distance.reshape(-1)[hit], far[hit], atol=1e-9)
    np.testing.assert_allclose((met.normal.reshape(-1, 3) @ LOOKING.T)[hit], normal[hit], atol=1e-6)
    assert not met.other.any()


def box_scene(*, mesh: bool) -> Scene:
    spec = mujoco.MjSpec()
    half = np.array([0.3, 0.2, 0.25])
    turned = {"pos": [0, 3, 0], "quat": [0.9, 0.1, 0.3, 0.2], "rgba": [0.5, 0.5, 0.6, 1], "name": "thing"}
    if mesh:
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        spec.add_mesh(name="box", uservert=corners.reshape(-1))
        spec.worldbody.add_geom(type=GEOM.mjGEOM_MESH, meshname="box", **turned)
    else:
        spec.worldbody.add_geom(type=GEOM.mjGEOM_BOX, size=half, **turned)
    spec.worldbody.add_geom(name="floor", type=GEOM.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 0, -0.3])
    return scene_of(spec)


def test_a_mesh_looks_like_the_box_that_it_is():
    context = Context(step_px=1)
    as_box, as_mesh = (image_of(box_scene(mesh=mesh), context) for mesh in (False, True))
    differs = np.abs(as_box - as_mesh) > 1e-3 * as_box.max()
    assert (as_box > 0).sum() > 3000
    assert differs.sum() <= 5  # rays that graze an edge


def test_markers_helpers_and_clear_things_are_not_in_it():
    spec = mujoco.MjSpec()
    for group, alpha in ((MARKER_GROUP, 1.0), (UNSEEN_GROUP, 1.0), (0, 0.0)):
        spec.worldbody.add_geom(size=[0.4, 0, 0], pos=[0, 3, 0], group=group, rgba=[1, 1, 1, alpha])
    assert image_of(scene_of(spec), Context()).max() == 0.0


def test_a_reflective_stripe():
    spec = mujoco.MjSpec()
    upright = {"type": GEOM.mjGEOM_CAPSULE, "size": [0.3, 0.5, 0], "pos": [0, 3.3, 0]}
    spec.worldbody.add_geom(name="chest/0", rgba=[0.1, 0.1, 0.1, 1], **upright)
    clothes = (Cloth("chest/*", 0.2), Cloth("chest/0", 0.5, retro=200.0, band_m=(0.1, 0.2)))
    image = image_of(scene_of(spec), Context(step_px=1, ambient=0.0, lamp=0.01, at_m=3.0, clothes=clothes), PINHOLE)
    # the front is 3 m away; the stripe from z = 0.1 to 0.2 m lies 6.67 to 13.3 px above the middle
    assert image[60, 80] == pytest.approx(0.2 * 0.01 * FULL, rel=1e-6)
    bright = np.flatnonzero(image[:, 80] > 100 * image[60, 80])
    assert (bright.min(), bright.max()) == (47, 53)
    cosine = 200 / np.hypot(200, 10)  # row 50, head on but for the height
    expected = 0.01 * cosine**2 * cosine * (0.5 + 200.0 * cosine) * FULL
    assert image[50, 80] == pytest.approx(expected, rel=1e-5)


def test_a_cloth_that_nobody_wears_is_an_error():
    with pytest.raises(InputError, match=r"'hat\*'.*'ball'"):
        image_of(ball_scene(), Context(clothes=(Cloth("hat*", 0.9),)))


@pytest.mark.parametrize(
    "wrong", [{"rate_hz": 0.0}, {"step_px": 0}, {"ambient": -0.1}, {"lamp": -1.0}, {"at_m": 0.0}]
)
def test_settings_that_mean_nothing_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        Context(**wrong)
    with pytest.raises(InputError, match="reflectance"):
        Context(clothes=(Cloth("*", -1.0),))
    with pytest.raises(InputError, match="band_m"):
        Context(clothes=(Cloth("*", 1.0, band_m=(0.1, -0.1)),))


def test_a_coarse_image_is_the_fine_one_but_for_its_edges():
    fine, coarse = (image_of(ball_scene(), Context(step_px=step, ambient=0.05)) for step in (1, 2))
    assert coarse.shape == fine.shape == (H, W)
    assert coarse.dtype == np.float32
    inside = cv2.erode((fine > 0).astype(np.uint8), np.ones((5, 5))) > 0
    np.testing.assert_allclose(coarse[inside], fine[inside], rtol=0.01)
    assert coarse.sum() == pytest.approx(fine.sum(), rel=0.01)


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_enlarging_keeps_a_ramp(step):
    rows, columns = -(-H // step), -(-W // step)
    x = step * np.arange(columns) + (step - 1) / 2
    ramp = enlarged(np.tile(x, (rows, 1)).astype(np.float32), step, W, H)
    assert ramp.shape == (H, W)
    np.testing.assert_allclose(ramp[:, step : W - step], np.tile(np.arange(W), (H, 1))[:, step : W - step], atol=1e-3)


def test_a_fisheye_sees_the_floor_below_and_behind():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=GEOM.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 0, -1], rgba=[1, 1, 1, 1])
    fisheye = FisheyeLens(36.0, 36.0, (W - 1) / 2, (H - 1) / 2)
    image = image_of(scene_of(spec), Context(step_px=1, ambient=0.1, lamp=0.0), fisheye)
    # equidistant: the horizon, 90 degrees about the axis, is the middle row; below it all is floor, above it none
    assert (image[:60, 20:140] == 0).all()
    np.testing.assert_allclose(image[60:115, 70:90], 0.1 * FULL, rtol=1e-6)


def test_same_bytes_from_any_sampler():
    scene, context = ball_scene(), Context()
    np.testing.assert_array_equal(image_of(scene, context), image_of(scene, context))


def test_refreshes_by_hand():
    assert [refresh_pulse(k, 100.0, 10.0) for k in (0, 9, 10, 19, 20)] == [0, 0, 10, 10, 20]
    assert [refresh_pulse(k, 100.0, 30.0) for k in range(11)] == [0, 0, 0, 0, 4, 4, 4, 7, 7, 7, 10]
    assert [refresh_pulse(k, 100.0, 250.0) for k in range(3)] == [0, 1, 2]


@given(st.integers(0, 10**6), st.floats(1.0, 1000.0), st.floats(0.1, 2000.0))
def test_a_refresh_stands_until_the_next(pulse, frame_rate, rate):
    began = refresh_pulse(pulse, frame_rate, rate)
    assert 0 <= began <= pulse
    assert refresh_pulse(began, frame_rate, rate) == began
    assert refresh_pulse(pulse + 1, frame_rate, rate) in (began, pulse + 1)


def test_threads_share_what_is_refreshed():
    made = []

    def make(key: int) -> int:
        made.append(key)
        return key * key

    kept = Refreshed(keep=4)
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda k: kept.get(k // 10, lambda: make(k // 10)), range(40)))
    assert got == [(k // 10) ** 2 for k in range(40)]
    assert sorted(made) == [0, 1, 2, 3]
    kept.get(9, lambda: make(9))
    kept.get(0, lambda: make(0))  # the oldest was dropped, and is made again
    assert made[-2:] == [9, 0]
    with pytest.raises(ZeroDivisionError):
        kept.get(7, lambda: 1 // 0)
    assert kept.get(7, lambda: 5) == 5
