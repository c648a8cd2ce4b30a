"""The public functions: defaults that work, str and Path alike, errors in one line; each against hand geometry."""

from pathlib import Path

import numpy as np
import pytest
from rigs import ring

import mosca
from mosca.errors import InputError

XYZ = np.array([[0.1, 0.0, 0.05], [-0.2, 0.1, 0.0], [0.0, -0.15, 0.1]])


RIG = ring(
    3, mosca.OpenCVLens(1000.0, 1000.0, 319.5, 239.5), radius_m=2.0, height_m=0.0, first_rad=0.0, size=(640, 480),
    names=("cam1", "cam2", "cam3"),
)  # fmt: skip


def disc(x: float, y: float) -> np.ndarray:
    """An image (60, 80) of a disc of radius 4 px about (x, y), each pixel averaged over 15 x 15 sub-pixels."""
    steps = (np.arange(15) - 7) / 15
    v, u = np.mgrid[:60, :80]
    cover = np.mean([np.hypot(u + a - x, v + b - y) < 4 for a in steps for b in steps], axis=0)
    return np.rint(10 + 150 * cover).astype(np.uint8)


def test_all_that_is_promised_is_there_and_documented() -> None:
    for name in mosca.__all__:
        assert getattr(mosca, name).__doc__, name
    assert set(mosca.__all__) <= set(dir(mosca))
    with pytest.raises(AttributeError, match="no attribute 'detekt'"):
        _ = mosca.detekt


def test_an_image_gives_its_centre_with_a_covariance_that_is_about_right() -> None:
    found = mosca.detect(disc(40.3, 25.7))
    assert found.xy_px.tolist() == [pytest.approx([40.3, 25.7], abs=0.02)]
    assert 1e-4 < np.sqrt(found.covariance_px2[0, 0, 0]) < 0.02


def test_sixteen_bit_images_need_no_word_about_their_depth() -> None:
    found = mosca.detect(disc(40.3, 25.7).astype(np.uint16) * 256)
    assert found.xy_px.tolist() == [pytest.approx([40.3, 25.7], abs=0.02)]


def test_pixels_by_name_become_points_with_the_covariance_of_the_normal_equations() -> None:
    pixels = {camera.name: mosca.project(camera, XYZ) for camera in RIG.cameras}
    pixels["cam3"][1] = np.nan
    points = mosca.triangulate(RIG, pixels, sigma_px=0.1)
    assert points.xyz == pytest.approx(XYZ, abs=1e-9)
    assert points.residual_px == pytest.approx(np.zeros(3), abs=1e-6)
    step = 1e-6
    for k, seen in ((0, (0, 1, 2)), (1, (0, 1))):
        normal = np.zeros((3, 3))
        for c in seen:
            moved = [mosca.project(RIG.cameras[c], XYZ[k : k + 1] + step * axis)[0] for axis in np.eye(3)]
            jacobian = (np.array(moved) - mosca.project(RIG.cameras[c], XYZ[k : k + 1])[0]).T / step
            normal += jacobian.T @ jacobian / 0.1**2
        assert points.covariance[k] == pytest.approx(np.linalg.inv(normal), rel=1e-3)


def test_a_camera_may_be_left_out_and_a_wrong_one_is_named() -> None:
    pixels = {camera.name: mosca.project(camera, XYZ) for camera in RIG.cameras[:2]}
    assert mosca.triangulate(RIG, pixels).xyz == pytest.approx(XYZ, abs=1e-9)
    with pytest.raises(InputError, match="camera 'left' given; the rig has cam1, cam2, cam3"):
        mosca.triangulate(RIG, {"left": pixels["cam1"]})
    with pytest.raises(InputError, match="cam1 3, cam2 2 rows given"):
        mosca.triangulate(RIG, {"cam1": pixels["cam1"], "cam2": pixels["cam2"][:2]})


def test_pixels_count_by_their_covariances() -> None:
    pixels = {camera.name: mosca.project(camera, XYZ) for camera in RIG.cameras}
    pixels["cam3"][1] = np.nan
    plain = mosca.triangulate(RIG, pixels, sigma_px=0.1)
    equal = {name: np.tile(0.01 * np.eye(2), (3, 1, 1)) for name in pixels}
    same = mosca.triangulate(RIG, pixels, covariances_px2=equal)
    assert same.covariance == pytest.approx(plain.covariance, rel=1e-9)
    # an image that is 2 px off and says so moves the point by what its weight allows: least squares by hand
    pixels["cam2"][0] += (2.0, -1.0)
    stated = {name: one.copy() for name, one in equal.items()}
    stated["cam2"][0] = [[9.0, 1.0], [1.0, 4.0]]
    found = mosca.triangulate(RIG, pixels, covariances_px2=stated)
    normal, moment, step = np.zeros((3, 3)), np.zeros(3), 1e-6
    for camera in RIG.cameras:
        here = mosca.project(camera, XYZ[:1])[0]
        jacobian = np.array([mosca.project(camera, XYZ[:1] + step * axis)[0] - here for axis in np.eye(3)]).T / step
        weight = np.linalg.inv(stated[camera.name][0])
        normal += jacobian.T @ weight @ jacobian
        moment += jacobian.T @ weight @ (pixels[camera.name][0] - here)
    expected = np.linalg.solve(normal, moment)
    assert found.xyz[0] - XYZ[0] == pytest.approx(expected, abs=0.02 * np.linalg.norm(expected))
    assert found.covariance[0] == pytest.approx(
        np.linalg.inv(normal), rel=0.02, abs=1e-3 * np.abs(normal).max() ** -1
    )
    assert np.linalg.norm(expected) < 0.05 * np.linalg.norm(mosca.triangulate(RIG, pixels).xyz[0] - XYZ[0])
    off = [mosca.project(camera, found.xyz[:1])[0] - pixels[camera.name][0] for camera in RIG.cameras]
    assert found.residual_px[0] == pytest.approx(np.sqrt(np.mean(np.square(off))), rel=1e-9)


def test_covariances_that_are_none_are_named() -> None:
    pixels = {camera.name: mosca.project(camera, XYZ) for camera in RIG.cameras}
    with pytest.raises(InputError, match=r"covariances of 'cam1' \(0,\) given; \(3, 2, 2\) are wanted"):
        mosca.triangulate(RIG, pixels, covariances_px2={})
    flat = {name: np.zeros((3, 2, 2)) for name in pixels}
    with pytest.raises(InputError, match="covariance of row 0 of 'cam1' is not positive definite"):
        mosca.triangulate(RIG, pixels, covariances_px2=flat)


def test_detections_are_matched_and_tracked_without_a_setting() -> None:
    speed, instants = np.array([0.2, 0.0, 0.0]), []
    for frame in range(12):
        true = XYZ + frame * 0.01 * speed
        seen = {}
        for camera in RIG.cameras:
            xy = mosca.project(camera, true)
            n = len(xy)
            covariance = np.tile(1e-4 * np.eye(2), (n, 1, 1))
            seen[camera.name] = mosca.Detections(
                camera.name, xy, covariance, np.full(n, 4.0), np.full(n, 99.0), np.ones(n)
            )
        points = mosca.match(RIG, seen, volume=((-1, -1, -1), (1, 1, 1)))
        # round images are freed of a ball's eccentricity, which these points do not have: 1e-6 m of a 4 px ball
        np.testing.assert_allclose(points.xyz[np.argsort(points.xyz[:, 0])], true[np.argsort(true[:, 0])], atol=2e-6)
        instants.append((frame * 10_000_000, points))
    tracks = mosca.track(instants)
    assert sorted(np.unique(tracks.track, return_counts=True)[1].tolist()) == [12, 12, 12]


def test_files_are_str_or_path(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    mosca.write_rig(RIG, str(path))
    assert mosca.read_rig(str(path)).names == mosca.read_rig(path).names == RIG.names
    with pytest.raises(InputError, match="no such"):
        mosca.reconstruct(str(tmp_path / "nothing"), str(path))
    with pytest.raises(InputError, match=r"no_target\.toml"):
        mosca.calibrate(str(tmp_path / "nothing"), str(tmp_path / "no_target.toml"))
