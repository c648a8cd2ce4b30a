"""Eccentricity of balls: the closed form, and outlines traced through the lens point by point."""

from dataclasses import replace

import numpy as np
import pytest

from mosca.camera.eccentricity import ball_eccentricity_px
from mosca.camera.projection import lens_pixels, project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import MatchSettings, match
from mosca.data.detections import Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.errors import InputError

HERE = Pose(np.eye(3), np.zeros(3))
LENSES = {
    "pinhole": OpenCVLens(1000.0, 1000.0, 512.0, 512.0),
    "opencv": OpenCVLens(1000.0, 1000.0, 512.0, 512.0, -0.25, 0.08, 1e-3, -5e-4),
    "mosca": MoscaLens(10.0, 512.0, 512.0, 0.01, 0.01, 0.001, 1.5e-3, -1e-5, 0.0, 1e-4, 5e-5),
    "fisheye": FisheyeLens(400.0, 400.0, 512.0, 512.0, 0.02, -0.01),
}


def outline_centroid(lens, centre, radius, points=4000):
    """Centroid and area [px, px^2] of a ball's image: its touching cone, traced through the lens, as a polygon."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    across = np.cross(axis, [0.3, 0.9, -0.2])
    across /= np.linalg.norm(across)
    other = np.cross(axis, across)
    sine = radius / distance
    t = np.linspace(0, 2 * np.pi, points, endpoint=False)[:, None]
    cone = np.sqrt(1 - sine**2) * axis + sine * (np.cos(t) * across + np.sin(t) * other)
    xy = lens_pixels(lens, cone)
    x, y = (xy - xy.mean(axis=0)).T
    u, v = np.roll(x, -1), np.roll(y, -1)
    cross = x * v - u * y
    area = cross.sum() / 2
    return xy.mean(axis=0) + [((x + u) * cross).sum() / (6 * area), ((y + v) * cross).sum() / (6 * area)], abs(area)


def test_by_hand():
    # field notes: 0.31 px at 0.3 m, 30 deg, r 7 mm, f 1000
    t = np.tan(np.radians(30))
    centre = np.array([[0.3 * np.sin(np.radians(30)), 0.0, 0.3 * np.cos(np.radians(30))]])
    camera = Camera("c", 1024, 1024, LENSES["pinhole"], HERE)
    found = ball_eccentricity_px(camera, centre, 0.007)[0]
    r2, z2 = 0.007**2, centre[0, 2] ** 2
    assert found == pytest.approx([1000 * t * r2 / (z2 - r2), 0.0], abs=1e-6)
    assert found[0] == pytest.approx(0.42, abs=0.005)


@pytest.mark.parametrize("name", list(LENSES))
@pytest.mark.parametrize("centre", [(0.1, -0.05, 0.5), (0.25, 0.2, 0.6), (-0.02, 0.01, 0.3)])
def test_as_the_traced_outline(name, centre):
    lens, centre = LENSES[name], np.array(centre)
    camera = Camera("c", 1024, 1024, lens, HERE)
    true = outline_centroid(lens, centre, 0.01)[0] - lens_pixels(lens, centre[None])[0]
    found = ball_eccentricity_px(camera, centre[None], 0.01)[0]
    # the formula is of second order in the image's size through a lens with distortion
    assert found == pytest.approx(true, abs=1e-4 if name == "pinhole" else 2e-3)


def test_no_radius_is_an_input_error():
    with pytest.raises(InputError, match="radii_m"):
        ball_eccentricity_px(Camera("c", 10, 10, LENSES["pinhole"], HERE), np.ones((1, 3)), 0.0)


@pytest.mark.parametrize("name", ["mosca", "opencv", "fisheye"])
def test_balls_are_measured_where_they_are(name):
    """Images of balls of 30 mm at 0.6 m: without the correction the points lie beside them, with it they do not."""
    cameras = []
    for k, x in enumerate((-0.5, 0.0, 0.5)):
        z = np.array([-x, 0.1 * k, 0.6])
        z /= np.linalg.norm(z)
        side = np.cross([0, 1.0, 0], z)
        side /= np.linalg.norm(side)
        # rotated, so that the balls lie off the axis
        place = Pose(np.column_stack([side, np.cross(z, side), z]), np.array([x, -0.1 * k, 0.0]))
        cameras.append(Camera(f"c{k}", 1024, 1024, LENSES[name], place))
    rig = Rig(tuple(cameras))
    balls = np.array([[0.15, 0.1, 0.6], [-0.12, -0.08, 0.65], [0.02, 0.12, 0.55]])
    found = {}
    for camera in cameras:
        local = camera.world_from_camera.inverse().transform(balls)
        traced = [outline_centroid(camera.lens, c, 0.015) for c in local]
        xy, area = np.array([t[0] for t in traced]), np.array([t[1] for t in traced])
        assert np.isfinite(project(camera, balls)).all()
        found[camera.name] = Detections(
            camera.name,
            xy,
            np.tile(0.02**2 * np.eye(2), (3, 1, 1)),
            2 * np.sqrt(area / np.pi),
            np.ones(3),
            np.ones(3),
        )
    errors = {}
    long = {name: replace(one, elongation=np.full(3, 1.3)) for name, one in found.items()}
    for case, target, images in (("point", "point", found), ("ball", "ball", long), ("auto", "auto", found),
                                 ("slanted", "auto", long)):  # fmt: skip
        settings = MatchSettings(camera_sigma_px=0.05, target=target)
        bundle = make_ray_table(rig, images, settings.camera_sigma_px, settings.target)
        xyz = match(bundle, Predicted.nothing(), settings).xyz
        away = np.linalg.norm(xyz[:, None] - balls[None], axis=2)
        errors[case] = away.min(axis=0).max()
    assert errors["ball"] < 5e-6
    assert errors["ball"] < 0.2 * errors["point"]
    # round images are of balls, or of discs that face the camera; long ones are left as they are
    assert errors["auto"] == pytest.approx(errors["ball"])
    assert errors["slanted"] == pytest.approx(errors["point"])
