"""Mitsuba's images of small scenes, held against closed forms."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.oracle.needs_mitsuba import needs_mitsuba
from witness.mitsuba.cramer_rao import image_bounds, render_noise_share, scale_e
from witness.mitsuba.film import Film
from witness.mitsuba.projection import ball_outline_area, project
from witness.mitsuba.recording import rendered
from witness.mitsuba.scene import (
    Body,
    Chessboard,
    CodedPlate,
    Limb,
    MarkerBall,
    Part,
    Quality,
    SceneLamps,
    Swing,
    WitnessScene,
)
from witness.mitsuba.scene_file import scene_of
from witness.mitsuba.textures import BLACK, WHITE

surfaces = needs_mitsuba()

from witness.mitsuba.transport import SUB, PixelRenderer, Pixels  # noqa: E402

LAMPS = SceneLamps(ring=0.0, panels=((0.0, 0.0, 8.0, 2.0, 1.0),))


def _scene(*parts: Part, motion: Swing | None = None, **changes: Any) -> WitnessScene:
    table = {"frames": 1, "rate_hz": 50.0, "exposure_s": 0.001, "cloud": {"count": 0, "diameter_m": 0.01}}
    scene = scene_of(table, "scene", Path())
    return replace(scene, bodies=(Body(motion or Swing(), parts),), **changes)


def _places(scene: WitnessScene, samples: int) -> list[tuple[float, np.ndarray]]:
    """Area and centroid of all rays that meet a target, camera by camera, on sub-pixels."""
    transport, instant = PixelRenderer(scene.cameras, 0), surfaces.mitsuba_scene(scene, 0.1, 0)
    found = []
    for c, camera in enumerate(scene.cameras):
        part = scene.bodies[0].parts[0]
        assert isinstance(part, MarkerBall)
        middle = np.rint(project(camera, np.array(part.at_m))).astype(int)
        half = int(part.diameter_m * 130) + 4
        y, x = np.mgrid[middle[1] - half : middle[1] + half + 1, middle[0] - half : middle[0] + half + 1]
        light = transport.render(instant, Pixels(np.full(x.size, c), x.ravel(), y.ravel()), samples, 5)
        fine = (np.arange(SUB) + 0.5) / SUB - 0.5
        hits = light.hits / SUB**2
        area = float(hits.sum())
        u, v = (hits.sum(1) * (x.reshape(-1, 1) + fine)).sum(), (hits.sum(2) * (y.reshape(-1, 1) + fine)).sum()
        found.append((area, np.array([u, v]) / area))
    return found


@pytest.mark.parametrize("diameter_m", [0.0125, 0.12])
@pytest.mark.parametrize("at_m", [(0.03, 0.02, 0.1), (-0.9, 0.5, 0.6)])
def test_ball_lies_where_its_outline_does(diameter_m: float, at_m: tuple[float, float, float]) -> None:
    scene = _scene(MarkerBall("ball", at_m, diameter_m))
    for camera, (area, place) in zip(scene.cameras, _places(scene, 4096), strict=True):
        expected_area, expected = ball_outline_area(camera, np.array(at_m), diameter_m)
        assert area == pytest.approx(expected_area, rel=0.003)
        assert np.abs(place - expected).max() < 0.002


def test_blur_of_a_thin_lens() -> None:
    # a point at depth z blurs over f_px A |1/z - 1/focus|; even over that disc: rms radius = diameter / sqrt(8)
    scene = _scene(MarkerBall("ball", (0.0, 0.0, 0.0), 0.008))
    cameras = tuple(replace(c, aperture_m=0.02, focus_m=1.5, distortion=(0.0,) * 5) for c in scene.cameras)
    film = Film(replace(scene, cameras=cameras, quality=Quality(window_samples=8192)))
    render = film.render()
    for camera, window, first in zip(cameras, render.place, render.start, strict=False):
        assert window[1] == cameras.index(camera)
        x, y, w, h = window[3:]
        light = render.contrast[first : first + w * h].reshape(h, w).astype(float)
        v, u = np.mgrid[y : y + h, x : x + w]
        middle = [(light * a).sum() / light.sum() for a in (u, v)]
        spread = (light * ((u - middle[0]) ** 2 + (v - middle[1]) ** 2)).sum() / light.sum()
        depth = np.linalg.norm(camera.position_m)
        blur = camera.focal_px[0] * 0.02 * abs(1 / depth - 1 / 1.5)
        # pixels add 1/6, the ball its own disc
        own = (camera.focal_px[0] * 0.008 / depth) ** 2 / 8
        assert spread == pytest.approx(blur**2 / 8 + 1 / 6 + own, rel=0.02)
        assert np.allclose(render.light_px[0, window[1], 0], project(camera, np.zeros(3)), atol=0.05)


def test_light_of_a_moving_ball_lies_at_its_mean_place(tmp_path: Path) -> None:
    motion = Swing(amplitude_m=(0.5, 0.3, 0.0), frequency_hz=(1.0, 1.0, 0.0), phase_rad=(0.3, 0.2, 0.0))
    scene = _scene(MarkerBall("ball", (0.0, 0.0, 0.0), 0.04), motion=motion, exposure_s=0.01)
    film = Film(scene)
    assert film.slices(0) >= 8
    render, kept = rendered(scene, tmp_path)
    assert not kept
    places = [
        [ball_outline_area(c, motion.pose(t)[1], 0.04)[1] for t in 0.1 + np.linspace(-0.005, 0.005, 101)]
        for c in scene.cameras
    ]
    assert np.abs(render.light_px[0, :, 0] - np.mean(places, 1)).max() < 0.01
    again, kept = rendered(scene, tmp_path)
    assert kept
    assert np.array_equal(again.total, render.total)
    assert np.array_equal(again.place, render.place)
    assert not rendered(replace(scene, seed=9), tmp_path)[1]


def test_too_much_motion_is_refused() -> None:
    motion = Swing(amplitude_m=(1.0, 0.0, 0.0), frequency_hz=(9.0, 0.0, 0.0))
    scene = _scene(MarkerBall("ball", (0.0, 0.0, 0.0), 0.04), motion=motion, exposure_s=0.02)
    with pytest.raises(ValueError, match=r"moves by .* px during the exposure"):
        Film(scene).render()


def test_rendering_adds_little_noise() -> None:
    balls = [MarkerBall(f"b{k}", (0.3 * (k % 4) - 0.45, 0.3 * (k // 4) - 0.3, 0.0), 0.03) for k in range(12)]
    shares = []
    for samples in (16, 512):
        scene = _scene(*balls, quality=Quality(window_samples=samples))
        render = Film(scene).render()
        bounds, moved = image_bounds(scene, render, scale_e(scene, render))
        assert np.isfinite(bounds).all(axis=(-1, -2)).mean() > 0.9
        shares.append(render_noise_share(bounds, moved))
    # the control: 16 samples a pixel are far too few
    assert shares[1] < 0.05 < shares[0]


def test_a_hidden_ball_is_not_seen() -> None:
    scene = _scene(MarkerBall("near", (0.0, 0.0, 0.0), 0.1), MarkerBall("far", (0.0, 0.0, 0.0), 0.05))
    camera = scene.cameras[0]
    behind = -np.array(camera.position_m) * 0.1
    far = MarkerBall("far", tuple(behind.tolist()), 0.05)
    scene = replace(scene, bodies=(Body(Swing(), (scene.bodies[0].parts[0], far)),), cameras=scene.cameras[:2])
    render = Film(replace(scene, quality=Quality(window_samples=64))).render()
    assert render.visible[0].tolist() == [[1.0, 0.0], [1.0, 1.0]]


def test_surface_goes_on_around_a_ball() -> None:
    limb = Limb((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 0.4, 0.05)
    scene = _scene(limb, MarkerBall("ball", (0.0, 0.0, 0.215), 0.03), light=SceneLamps(panels=LAMPS.panels))
    render = Film(replace(scene, quality=Quality(window_samples=64))).render()
    image = render.images(0)[0]
    place = np.rint(project(scene.cameras[0], np.array([0.0, 0.0, 0.215]))).astype(int)
    row = image[place[1], place[0] - 12 : place[0] + 13]
    # beside the ball the limb is as bright inside of the ball's window as outside, and nowhere black
    assert row[12] > 5 * row[0] > 0
    assert row[[6, 7, 17, 18]] == pytest.approx(row[[0, 1, 23, 24]], rel=0.3)
    assert row.min() > 0.5 * row[0]


def _reflectance(scene: WitnessScene, points: np.ndarray) -> np.ndarray:
    """Radiance at world points as the first camera sees them, relative to the brightest."""
    pixels = np.rint(project(scene.cameras[0], points)).astype(int)
    transport, instant = PixelRenderer(scene.cameras, 0), surfaces.mitsuba_scene(scene, 0.1, 0)
    light = transport.render(instant, Pixels(np.zeros(len(pixels)), pixels[:, 0], pixels[:, 1]), 256, 1, maps=False)
    return np.asarray(light.total / light.total.max())


def test_board_is_printed_upright() -> None:
    scene = _scene(Chessboard(9, 6, 0.2, 0.1), light=LAMPS)
    # the upper left square is black; x right, y up, origin in the middle of the face
    corner, step = np.array([-0.8, 0.5, 0.0]), 0.2
    black = [corner, corner + [2 * step, 0, 0], corner + [step, -step, 0], corner + [7 * step, -5 * step, 0]]
    white = [corner + [step, 0, 0], corner + [0, -step, 0], corner + [8 * step, -5 * step, 0], [-0.95, 0.5, 0.0]]
    light = _reflectance(scene, np.array(black + white))
    assert light[:4].max() < 0.1
    assert light[4:].min() > 0.8


def test_coded_target_is_printed_counter_clockwise() -> None:
    sectors = tuple(k in (0, 1, 2, 7) for k in range(20))
    target = CodedPlate("coded/1", (0.1, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), 0.15, sectors)
    scene = _scene(target, light=LAMPS)
    angle = np.pi / 2 + (np.arange(20) + 0.5) * np.pi / 10
    ring = np.array([0.1, 0.0, 0.0]) + 0.375 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    light = _reflectance(scene, np.concatenate([[[0.1, 0.0, 0.0]], ring]))
    assert light[0] > 0.8
    assert ((light[1:] > 0.5) == np.array(sectors)).all()
    assert light.min() < 1.5 * BLACK / WHITE
