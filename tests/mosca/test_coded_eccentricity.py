"""Eccentricity of circles: hand numbers, fine polygons through the lens, and painted images."""

import numpy as np
import pytest
from coded_views import View, paint
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.camera.eccentricity import eccentricity_px
from mosca.camera.projection import project
from mosca.coded_targets.detect import find_coded
from mosca.data.arrays import Array
from mosca.data.rig import Camera, FisheyeLens, Lens, MoscaLens, OpenCVLens, Pose
from mosca.errors import InputError

PINHOLE = OpenCVLens(1000.0, 1000.0, 320.0, 240.0)
BARREL = OpenCVLens(1000.0, 990.0, 320.0, 240.0, k1=-0.3, k2=0.1, p1=1e-3, p2=-2e-3)
PAPER = MoscaLens(
    9.4, 291.45, 255.456, 0.00943414, 0.00944242, -0.00668, 8.712e-4, -1.82e-5, 3.2e-7, 2.827e-4, 4.459e-5
)
FISHEYE = FisheyeLens(300.0, 300.0, 320.0, 240.0, k1=-0.02)
ORIGIN = Pose(np.eye(3), np.zeros(3))
ASKEW = Pose(Rotation.from_euler("xyz", [0.3, -0.2, 0.1]).as_matrix(), np.array([0.1, 0.2, 0.3]))


def camera(lens: Lens, pose: Pose = ORIGIN) -> Camera:
    return Camera("left", 640, 480, lens, pose)


def by_polygon(eye: Camera, centre: Array, normal: Array, radius: float, n: int = 4000) -> Array:
    """Area centroid of the image of 4000 points of the circle, minus the image of its centre."""
    u = np.cross(normal, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u)
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None]
    rim = centre + radius * (np.cos(t) * u + np.sin(t) * np.cross(normal, u))
    true = project(eye, centre[None])[0]
    p = project(eye, rim) - true
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return ((p + q) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


def test_a_circle_by_hand():
    """C = (0, 0, 1) m, r = 30 mm, n = (sin 45, 0, -cos 45), f = 1000 px.

    f r^2 nx nz / (Cz^2 - r^2 nx^2) = 1000 * 9e-4 * -0.5 / (1 - 4.5e-4) = -0.450203 px: to the side that is nearer.
    """
    s = np.sqrt(0.5)
    off = eccentricity_px(camera(PINHOLE), np.array([[0, 0, 1.0]]), np.array([[s, 0, -s]]), 0.03)
    np.testing.assert_allclose(off, [[-0.4502026, 0.0]], atol=1e-6)


def test_a_circle_that_faces_the_camera_has_none():
    off = eccentricity_px(camera(PINHOLE), np.array([[0.2, -0.1, 1.0]]), np.array([[0, 0, -2.0]]), 0.05)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(0.7, 3.0), st.floats(0, 1.1), st.floats(0, 6.28),
    st.floats(0.002, 0.03), st.sampled_from([PINHOLE, BARREL, PAPER, FISHEYE]),
)  # fmt: skip
def test_any_circle_is_that_of_a_fine_polygon(x, y, z, tilt, side, radius, lens):
    eye = camera(lens, ASKEW)
    in_camera = np.array([x, y, 1.0]) * z
    towards = -in_camera / np.linalg.norm(in_camera)
    across = np.cross(towards, [np.cos(side), np.sin(side), 0.1])
    n = np.cos(tilt) * towards + np.sin(tilt) * across / np.linalg.norm(across)
    centre, normal = ASKEW.transform(in_camera[None])[0], ASKEW.rotation @ n
    wanted = by_polygon(eye, centre, normal, radius)
    limit = 2e-6 if lens is PINHOLE else 1e-3  # distortion: to second order
    found = eccentricity_px(eye, centre[None], normal[None], radius)[0]
    np.testing.assert_allclose(found, wanted, atol=limit)
    # by either face, and by a normal of any length
    np.testing.assert_allclose(eccentricity_px(eye, centre[None], -7 * normal[None], radius)[0], found, atol=1e-9)


def test_beside_and_behind_a_fisheye():
    eye = camera(FISHEYE)
    centre, normal = np.array([1.0, 0.2, -0.1]), np.array([-0.8, 0.1, 0.6])
    normal /= np.linalg.norm(normal)
    found = eccentricity_px(eye, centre[None], normal[None], 0.03)[0]
    np.testing.assert_allclose(found, by_polygon(eye, centre, normal, 0.03), atol=3e-5)
    assert np.abs(found).max() > 0.02


def test_what_is_not_imaged_has_none():
    centres = np.array([[0, 0, -1.0], [0, 0, 1.0], [0, 0, 0.01], [0.1, 0, 1.0]])
    normals = np.array([[0, 0.5, 1.0], [1.0, 0, 0], [0, 0.9, 0.1], [0, 0.2, 1.0]])
    off = eccentricity_px(camera(PINHOLE), centres, normals, 0.02)
    assert np.isnan(off[:3]).all()  # behind, edge on, about the camera
    assert np.isfinite(off[3]).all()
    assert eccentricity_px(camera(PINHOLE), np.empty((0, 3)), np.empty((0, 3)), 0.02).shape == (0, 2)


@pytest.mark.parametrize(("normal", "radius"), [([0, 0, 0.0], 0.01), ([0, 0, 1.0], 0.0), ([0, 0, 1.0], -1.0)])
def test_what_is_no_circle_is_refused(normal, radius):
    with pytest.raises(InputError, match="eccentricity"):
        eccentricity_px(camera(PINHOLE), np.array([[0, 0, 1.0]]), np.array([normal]), radius)


def test_measured_centres_are_right_once_it_is_taken_off():
    """Painted plates of 40 px at 55 deg: eccentricity of 0.5 px is measured to 0.02 px; its sign would show."""
    with_it, without, turned = [], [], []
    for k in range(6):
        view = View(17 + k, (120.0, 120.0), 40.0, np.deg2rad(55), k, 2.0 * k, z=20.0)
        found = find_coded(paint((240, 240), [view], noise=0, samples=4), "left")
        assert found.number.tolist() == [17 + k]
        # the renderer's own camera axis is the ray to the plate
        eye = camera(OpenCVLens(400.0, 400.0, 120.0, 120.0))
        off = eccentricity_px(eye, view.centre[None], view.rotation[:, 2][None], 1.0)[0]
        measured = found.xy_px[0] - view.xy
        with_it.append(measured)
        without.append(measured - off)
        turned.append(measured + off)
    rms = [np.sqrt(np.mean(np.square(e))) for e in (with_it, without, turned)]
    assert rms[0] > 0.3
    assert rms[1] < 0.02
    assert rms[2] > 0.6
