"""Real images' points: MyPTV's example (R. Shnapp, MIT), three cameras before a water tank.

Witnesses: a direct linear transformation written out here, and the 3-D points that MyPTV computed with its own camera
model (Tsai and a polynomial) from the same image points.
"""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mosca.calibrate.adjust import CameraAdjustment
from mosca.calibrate.points import calibrate_from_points
from mosca.camera import project, rays
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.data.target_file import PointsTarget, read_target
from mosca.detect import DetectionSettings, detect
from mosca.match import MatchSettings, Predicted, choose, hypotheses
from mosca.triangulate import bundle_rays

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
EXAMPLE = DATA / "myptv_example" / "example"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not EXAMPLE.is_dir(), reason=f"no MyPTV example in {DATA} (set MOSCA_DATA)"),
]
CAMERAS = ("cam1", "cam2", "cam3")
# particles of 1 to 9 px, half of them less than 37 grey values above a background with 4.5 grey values of noise
DETECTION = DetectionSettings(contrast_dn=4, lowest_dn=4, minimum_size_px=0, read_noise_dn=4.5)
# measured: 0.162, 0.282, 0.294 (mosca), 0.260, 0.270, 0.267 (opencv), 0.325, 0.458, 0.360 (fisheye); the
# direct linear transformation 0.160, 0.283, 0.307. Margin 10 %.
MEDIAN_PX = {"mosca": (0.18, 0.31, 0.32), "opencv": (0.29, 0.30, 0.30), "fisheye": (0.36, 0.51, 0.40)}


def target(tmp_path: Path, lens: str) -> PointsTarget:
    cameras = "\n".join(
        f'[[camera]]\nname = "{name}"\nfile = "Calibration/{name}_cal_points"' for name in CAMERAS
    )
    path = tmp_path / "target.toml"
    path.write_text(f'kind = "points"\nunit = "mm"\nlens = "{lens}"\nsize_px = [1280, 1024]\n{cameras}\n')
    return read_target(path)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> dict[str, tuple[Rig, tuple[CameraAdjustment, ...]]]:
    folder = tmp_path_factory.mktemp("myptv")
    return {lens: calibrate_from_points(EXAMPLE, target(folder, lens)) for lens in MEDIAN_PX}


def shipped() -> tuple[np.ndarray, np.ndarray]:
    """Return MyPTV's points (n, 3) [m] and the image points (n, 3 cameras, 2) that it made them of."""
    particles = np.loadtxt(EXAMPLE / "particles")
    images = np.empty((len(particles), 3, 2))
    for c, name in enumerate(CAMERAS):
        blobs = np.loadtxt(EXAMPLE / f"blobs_{name}")
        for i, particle in enumerate(particles):
            # the index counts within the frame; a blob's columns are row, column
            images[i, c] = blobs[blobs[:, 5] == particle[7]][int(particle[3 + c]), 1::-1]
    return particles[:, :3] / 1000, images


def triangulated(rig: Rig, images: np.ndarray) -> np.ndarray:
    """Least squares on the rays, weighted by what a pixel measures at each point."""
    bundles = [rays(camera, images[:, c]) for c, camera in enumerate(rig.cameras)]
    weights = np.ones((3, len(images)))
    for _ in range(4):
        normal, right = np.zeros((len(images), 3, 3)), np.zeros((len(images), 3))
        for bundle, weight in zip(bundles, weights, strict=True):
            rows = bundle.pixel_by_direction * weight[:, None, None]
            square = np.einsum("nki,nkj->nij", rows, rows)
            normal += square
            right += square @ bundle.origin
        points = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        weights = np.array([1 / ((points - b.origin) * b.direction).sum(axis=1) for b in bundles])
    return points


def direct_linear(xy: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Abdel-Aziz and Karara's eleven parameters by linear least squares; returns the residuals (n,) [px]."""
    x = (points - points.mean(axis=0)) / points.std()
    u = (xy - xy.mean(axis=0)) / xy.std()
    ones, none = np.ones((len(x), 1)), np.zeros((len(x), 4))
    design = np.vstack([np.hstack([x, ones, none, -u[:, :1] * x]), np.hstack([none, x, ones, -u[:, 1:] * x])])
    p = np.linalg.lstsq(design, u.T.ravel(), rcond=None)[0]
    below = x @ p[8:] + 1
    predicted = np.column_stack([(x @ p[:3] + p[3]) / below, (x @ p[4:7] + p[7]) / below])
    return np.linalg.norm(predicted - u, axis=1) * xy.std()


@pytest.mark.parametrize("lens", list(MEDIAN_PX))
def test_each_lens_model_calibrates_the_three_cameras(calibrated, lens):
    _, adjustments = calibrated[lens]
    for adjustment, limit in zip(adjustments, MEDIAN_PX[lens], strict=True):
        assert np.median(np.linalg.norm(adjustment.residuals_px, axis=1)) < limit
        # at most 7 of 432 points are blunders (up to 2.9 px off)
        assert len(adjustment.rejected) <= 8
        # the cameras stand about half a metre before the 68 mm target, on its positive Z side
        assert 0.45 < adjustment.camera.world_from_camera.translation[2] < 0.7


def test_no_worse_than_a_direct_linear_transformation(calibrated):
    for name, adjustment in zip(CAMERAS, calibrated["mosca"][1], strict=True):
        values = np.loadtxt(EXAMPLE / "Calibration" / f"{name}_cal_points")
        linear = np.median(direct_linear(values[:, :2], values[:, 2:]))
        assert np.median(np.linalg.norm(adjustment.residuals_px, axis=1)) < 1.02 * linear


@pytest.mark.parametrize("lens", list(MEDIAN_PX))
def test_the_published_points_come_back(calibrated, lens):
    rig, _ = calibrated[lens]
    published, images = shipped()
    points = triangulated(rig, images)
    # inside the calibrated box (Z -12..0 mm) as they are; measured: 0.029, 0.035, 0.081 mm median
    inside = (published[:, 2] > -0.014) & (published[:, 2] < 0.002)
    assert inside.sum() == 23
    assert np.median(np.linalg.norm(points - published, axis=1)[inside]) < 1e-4
    # outside it every model extrapolates differently: one affine map joins them. Measured: 97.4 to 100 %
    # within 0.2 mm (the three others lie 50 mm behind the target), median 0.052 to 0.070 mm
    design = np.column_stack([points, np.ones(len(points))])
    mapped = design @ np.linalg.lstsq(design, published, rcond=None)[0]
    distance = np.linalg.norm(mapped - published, axis=1)
    assert np.mean(distance < 2e-4) >= 0.96
    assert np.median(distance) < 8e-5


def test_a_plane_left_out_is_predicted(tmp_path):
    """Calibrated on two planes of the target, the middle one is predicted as well as it fits."""
    values = np.loadtxt(EXAMPLE / "Calibration" / "cam1_cal_points")
    middle = values[:, 4] == -6
    np.savetxt(tmp_path / "points", values[~middle])
    plan = target(tmp_path, "mosca")
    one = plan.model_copy(update={"camera": (plan.camera[0].model_copy(update={"file": "points"}),)})
    rig, _ = calibrate_from_points(tmp_path, one)
    error = project(rig.cameras[0], values[middle, 2:] / 1000) - values[middle, :2]
    # measured 0.182 px; 0.162 px when the plane takes part
    assert np.median(np.linalg.norm(error, axis=1)) < 0.21


def detections(frame: int) -> dict[str, Detections]:
    """Detect in the images of a frame, with the darkest value of each pixel as static background."""
    found = {}
    for name in CAMERAS:
        images = [
            cv2.imread(str(EXAMPLE / f"Images_{name}" / f"{k:02}.tif"), cv2.IMREAD_UNCHANGED)
            for k in (1, 2, 3)
        ]
        found[name] = detect(images[frame], name, DETECTION, background=np.minimum.reduce(images))
    return found


@pytest.mark.parametrize("frame", [0, 1, 2])
def test_the_published_blobs_are_detected(frame):
    for name, found in detections(frame).items():
        blobs = np.loadtxt(EXAMPLE / f"blobs_{name}")
        published = blobs[blobs[:, 5] == frame][:, 1::-1]
        distance = cKDTree(found.xy_px).query(published)[0]
        # measured: 0.95 to 0.99 within 1 px, median 0.13 px, about 250 detections for about 72 blobs (the others
        # lie outside MyPTV's region of interest, or are fainter than its limit)
        assert np.mean(distance < 1.0) > 0.93
        assert np.median(distance) < 0.2
        assert len(found) < 350


def test_from_images_to_the_published_points(calibrated):
    """Detection, matching and triangulation of each frame on its own."""
    rig, _ = calibrated["mosca"]
    particles = np.loadtxt(EXAMPLE / "particles")
    low, high = np.array([-0.002, -0.003, -0.055]), np.array([0.072, 0.072, 0.030])
    settings = MatchSettings(camera_sigma_px=0.3, minimum_cameras=3)
    own, published = [], []
    for frame in range(3):
        bundle = bundle_rays(rig, detections(frame), settings.camera_sigma_px)
        points = choose(hypotheses(bundle, settings, (low, high)), bundle, Predicted.nothing(), settings).xyz
        here = particles[particles[:, 7] == frame, :3] / 1000
        own.append(points[cKDTree(points).query(here)[1]])
        published.append(here)
    own, published = np.vstack(own), np.vstack(published)
    near = np.linalg.norm(own - published, axis=1) < 8e-4
    design = np.column_stack([own, np.ones(len(own))])
    mapped = design @ np.linalg.lstsq(design[near], published[near], rcond=None)[0]
    distance = np.linalg.norm(mapped - published, axis=1)
    # measured 97.4 % (114 of 117; two of the others lie 51 mm behind the target), median 0.061 mm
    assert np.mean(distance < 2e-4) >= 0.95
    assert np.median(distance) < 8e-5


def test_swapped_cameras_do_not_give_the_published_points(calibrated):
    """Control: with two cameras' image points exchanged, nothing comes near."""
    rig, _ = calibrated["opencv"]
    published, images = shipped()
    points = triangulated(rig, images[:, [1, 0, 2]])
    assert np.mean(np.linalg.norm(points - published, axis=1) < 2e-4) < 0.05
