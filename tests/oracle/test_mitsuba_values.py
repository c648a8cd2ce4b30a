"""What the Mitsuba witness computes itself: projection, noise, bounds, files. Needs no Mitsuba."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import mosca
from witness import emva
from witness.mitsuba.__main__ import main
from witness.mitsuba.cramer_rao import image_bounds, point_bounds, render_noise_share
from witness.mitsuba.film import Render, markers
from witness.mitsuba.projection import (
    ball_outline_area,
    directions,
    distorted,
    distortion_slopes,
    project,
    project_slopes,
)
from witness.mitsuba.recording import write_recording
from witness.mitsuba.scene import LensCamera, SensorValues, WitnessScene
from witness.mitsuba.scene_file import read_scene, scene_of
from witness.mitsuba.sensor import VirtualSensor, variance_e2

SCENES = Path(__file__).parents[2] / "witness" / "scenes"
CLOUD = {"frames": 2, "rate_hz": 50.0, "exposure_s": 0.001, "cloud": {"count": 4, "diameter_m": 0.05}}


def _scene(**changes: object) -> WitnessScene:
    return scene_of({**CLOUD, **changes}, "cloud", Path())


def _camera() -> LensCamera:
    return _scene().cameras[1]


def test_projection_is_opencvs() -> None:
    camera, random = _camera(), np.random.default_rng(1)
    points = random.uniform(-1, 1, (50, 3))
    pixels, slopes = project(camera, points), project_slopes(camera, points)
    rotation = camera.rotation.T
    matrix = np.array(
        [[camera.focal_px[0], 0, camera.principal_px[0]], [0, camera.focal_px[1], camera.principal_px[1]], [0, 0, 1]]
    )
    expected, _ = cv2.projectPoints(
        points, cv2.Rodrigues(rotation)[0], -rotation @ camera.position_m, matrix, np.array(camera.distortion)
    )
    assert np.abs(pixels - expected[:, 0]).max() < 1e-9
    step = 1e-6
    for axis in range(3):
        moved = project(camera, points + step * np.eye(3)[axis]) - project(camera, points - step * np.eye(3)[axis])
        assert np.allclose(slopes[..., axis], moved / (2 * step), rtol=1e-6, atol=1e-4)
    towards = directions(camera, pixels)
    there = points - camera.position_m
    assert np.abs(np.cross(towards, there)).max() < 1e-9


def test_distortion_derivatives() -> None:
    xy, step = np.array([[0.3, -0.2], [-0.1, 0.4]]), 1e-6
    slopes = distortion_slopes(xy, (-0.2, 0.1, 1e-3, -2e-3, 0.05))
    for axis in range(2):
        move = step * np.eye(2)[axis]
        pair = [distorted(xy + sign * move, (-0.2, 0.1, 1e-3, -2e-3, 0.05)) for sign in (1, -1)]
        assert np.allclose(slopes[..., axis], (pair[0] - pair[1]) / (2 * step), atol=1e-8)


def test_outline_of_a_ball_on_the_axis() -> None:
    camera = replace(_camera(), distortion=(0.0, 0.0, 0.0, 0.0, 0.0), focal_px=(640.0, 640.0))
    centre = np.array(camera.position_m) + 3.0 * camera.rotation[:, 2]
    area, place = ball_outline_area(camera, centre, 0.5, around=20000)
    # the cone that touches a sphere of radius r at distance d has the tangent r / sqrt(d^2 - r^2)
    radius = 640.0 * 0.25 / np.sqrt(9.0 - 0.0625)
    assert area == pytest.approx(np.pi * radius**2, rel=1e-6)
    assert np.allclose(place, camera.principal_px, atol=1e-9)


@pytest.mark.parametrize(("bits", "read_dn"), [(8, 0.7), (12, 0.7), (8, 1.5)])
def test_noise_is_what_emva_1288_measures(bits: int, read_dn: float) -> None:
    sensor = SensorValues(bits=bits, read_dn=read_dn, prnu=0.0, dsnu_dn=0.0, stray_e=0.0, black_dn=8.0)
    camera, shape = VirtualSensor(sensor, (500, 400), (1,)), (400, 500)
    levels = np.linspace(0.0, 4000.0, 9)
    pairs = [[camera.counts(np.full(shape, e), (3, k, j)) for j in (0, 1)] for k, e in enumerate(levels)]
    mean, variance = np.transpose([emva.temporal(*pair) for pair in pairs])
    measured = emva.PhotonTransfer(levels, mean, variance)
    assert measured.gain == pytest.approx(sensor.gain_dn_per_e, rel=0.015)
    assert measured.responsivity == pytest.approx(sensor.gain_dn_per_e, rel=0.002)
    dark_e = read_dn * 2 ** (bits - 8) / sensor.gain_dn_per_e
    assert measured.dark_noise_e == pytest.approx(dark_e, rel=0.03)
    assert np.allclose(variance, variance_e2(sensor, levels) * sensor.gain_dn_per_e**2, rtol=0.03)


def test_fixed_patterns_are_what_emva_1288_measures() -> None:
    sensor = SensorValues(bits=12, prnu=0.01, dsnu_dn=0.4, stray_e=0.0, black_dn=8.0)
    camera = VirtualSensor(sensor, (200, 150), (4,))
    dark, half = (
        emva.spatial(np.stack([camera.counts(np.full((150, 200), e), (level, k)) for k in range(40)]))
        for level, e in enumerate((0.0, 2500.0))
    )
    assert emva.prnu(dark, half) == pytest.approx(0.01, rel=0.05)
    assert emva.dsnu_e(dark, sensor.gain_dn_per_e) == pytest.approx(0.4 * 16 / sensor.gain_dn_per_e, rel=0.05)


def test_saturation_and_hot_pixels() -> None:
    sensor = SensorValues(hot_share=0.01, full_well_e=4500.0)
    camera = VirtualSensor(sensor, (100, 100), (5,))
    assert camera.counts(np.full((100, 100), 1e5), (1,)).max() <= 4500 * sensor.gain_dn_per_e + 12
    dark = camera.counts(np.zeros((100, 100)), (2,))
    assert 30 < (dark > 12).sum() < 130


def _spot(scene: WitnessScene, sigma: float, amplitude: float) -> Render:
    """A Gaussian spot in the middle of camera 0's first frame, radiances in photoelectrons."""
    half = 20
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    spot = amplitude * np.exp(-(x**2 + y**2) / (2 * sigma**2))
    shape = (scene.frames, len(scene.cameras), 4)
    place = np.array([[0, 0, 0, 300, 200, 2 * half + 1, 2 * half + 1]])
    flat = [a.ravel().astype(np.float32) for a in (spot, spot * x / sigma**2, spot * y / sigma**2)]
    visible = np.ones(shape)
    background = np.zeros((len(scene.cameras), 491, 656), np.float32)
    total = np.stack([flat[0], flat[0]])
    return Render(
        background, place, np.array([0, x.size]), total, *flat, np.zeros((*shape, 2)), np.ones(shape), visible
    )


@pytest.mark.parametrize("sigma", [1.5, 4.0])
def test_bound_of_a_gaussian_spot(sigma: float) -> None:
    # even noise of variance v: sum of (dI/dx)^2 = A^2 pi / 2 for any width, so var(x) = 2 v / (pi A^2)
    scene = _scene(sensor={"stray_e": 1e6})
    bounds, moved = image_bounds(scene, _spot(scene, sigma, 100.0), 1.0)
    noise = variance_e2(scene.sensor, np.array(0.0))
    assert np.allclose(bounds[0, 0, 0], np.eye(2) * 2 * noise / (np.pi * 100.0**2), rtol=2e-3, atol=1e-5)
    assert np.abs(moved[0, 0, 0]).max() == 0
    assert np.isnan(bounds[1]).all()


def test_share_of_the_renderings_noise() -> None:
    # halves that differ by a shift of 0.02 px: each is half of it off
    scene = _scene(sensor={"stray_e": 1e6})
    render = _spot(scene, 2.0, 100.0)
    shifted = replace(render, total=render.total + np.outer([0.01, -0.01], render.by_x).astype(np.float32))
    bounds, moved = image_bounds(scene, shifted, 1.0)
    assert moved[0, 0, 0] == pytest.approx([0.01, 0.0], abs=1e-6)
    expected = np.sqrt(1 + 0.01**2 / bounds[0, 0, 0, 0, 0] / 2) - 1
    assert render_noise_share(bounds, moved) == pytest.approx(expected, rel=1e-3)


def test_points_bound_of_two_cameras() -> None:
    scene = _scene()
    made = markers(scene)
    bounds = np.full((2, 4, 4, 2, 2), np.nan)
    bounds[:, :2] = 0.01**2 * np.eye(2)
    points = point_bounds(scene, made, bounds)
    slopes = np.concatenate([project_slopes(c, made.mean_xyz[1, 2]) for c in scene.cameras[:2]])
    assert np.allclose(points[1, 2], 0.01**2 * np.linalg.inv(slopes.T @ slopes))
    bounds[:, 1] = np.nan
    assert np.isnan(point_bounds(scene, made, bounds)).all()


def test_the_project_reads_what_is_written(tmp_path: Path) -> None:
    scene = _scene()
    values = write_recording(scene, _spot(scene, 2.0, 100.0), tmp_path / "take")
    rig = mosca.read_rig(tmp_path / "take" / "rig.toml")
    for k, camera in enumerate(rig.cameras):
        assert np.abs(mosca.project(camera, values["xyz"][0]) - values["centre_px"][0, k]).max() < 0.05
        still = mosca.project(camera, values["mean_xyz"][0])
        assert np.abs(still - values["centre_px"][0, k]).max() < 1e-6
    with mosca.open_recording(tmp_path / "take") as source:
        frames = list(source)
    assert [(frame.camera, frame.index) for frame in frames[:4]] == [(f"cam{c}", 0) for c in (1, 2, 3, 4)]
    assert {frame.exposure_ns for frame in frames} == {1_000_000}
    assert frames[0].time_ns + 500_000 == values["time_ns"][0] == 100_000_000
    assert frames[0].image is not None
    assert frames[0].image[220, 320] > 150 > frames[0].image[100, 100]
    again = write_recording(scene, _spot(scene, 2.0, 100.0), tmp_path / "again", draw=1)
    other = cv2.imread(str(tmp_path / "again" / "cam1" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert again["e_per_radiance"] == values["e_per_radiance"]
    assert (other != frames[0].image).mean() > 0.3


def test_what_the_render_depends_on() -> None:
    assert _scene().render_key() == _scene(sensor={"read_dn": 2.0}).render_key()
    assert len({_scene(**change).render_key() for change in ({}, {"seed": 2}, {"light": {"ring": 2.0}})}) == 3


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_scenes_of_the_family_are_read(path: Path) -> None:
    scene = read_scene(path)
    assert scene.frames >= 20
    assert len(scene.cameras) == 4


def test_stands_do_not_move_within_an_exposure() -> None:
    scene = read_scene(SCENES / "coded_field.toml")
    places = []
    for frame in range(scene.frames):
        t = scene.mid_exposure_s(frame)
        ends = [scene.bodies[0].motion.pose(t + s * scene.exposure_s)[1] for s in (-0.5, 0.0, 0.5)]
        assert np.array_equal(ends[0], ends[2])
        places.append(tuple(ends[1]))
    assert [places.count(place) for place in dict.fromkeys(places)] == [5] * 6


def test_a_wrong_scene_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "scene.toml"
    file.write_text("frames = 2\nrate_hz = 50.0\nexposure_s = 0.001\n[cloud]\ncoutn = 4\n", encoding="utf-8")
    assert main([str(file), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "scene.toml" in said
    assert "coutn" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
