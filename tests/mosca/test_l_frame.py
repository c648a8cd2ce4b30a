"""The L-frame defines the world frame, whatever a calibration's axes, and is rejected when it is inconsistent."""

from dataclasses import replace

import numpy as np
import pytest
from changed_rigs import changed_rig
from scipy.spatial.transform import Rotation
from test_wand import calibrated
from wand_scenes import NOISE_PX, rig, seen, waved

from mosca.calibration.world_frame.l_frame import in_axes, world_from_l_frame
from mosca.camera.projection import project
from mosca.data.detections import Detections
from mosca.data.rig import Pose, Rig
from mosca.data.wands import LFrame
from mosca.errors import CalibrationError
from mosca.triangulation.triangulate import triangulate

NAMES = ("origin", "x1", "x2", "y")
PLACES = np.array([[0.0, 0, 0.02], [0.35, 0, 0.02], [0.6, 0, 0.02], [0, 0.4, 0.02]])
FRAME = LFrame(NAMES, PLACES, 0.02)
TRUE = rig(4, seed=7)


def shown(places=PLACES, clutter=2, noise_px=NOISE_PX, seed=0) -> dict[str, Detections]:
    """Return what the true cameras see of the L-frame and of ``clutter`` reflections each."""
    rng = np.random.default_rng(seed)
    out = {}
    for camera in TRUE:
        xy = project(camera, places) + rng.normal(0, noise_px, (len(places), 2))
        xy = np.vstack([xy, rng.uniform(0, 1, (clutter, 2)) * (656, 491)])
        xy, n = xy[rng.permutation(len(xy))], len(xy)
        ones = np.ones(n)
        covariance = np.tile(np.eye(2) * noise_px**2, (n, 1, 1))
        out[camera.name] = Detections(camera.name, xy, covariance, 8 * ones, ones, ones)
    return out


def elsewhere(scale=1.0, seed=1) -> Rig:
    """Return the true rig in other axes and other lengths."""
    rng = np.random.default_rng(seed)
    pose = Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    moved = []
    for camera in TRUE:
        own = camera.world_from_camera
        moved.append(replace(camera, world_from_camera=pose @ Pose(own.rotation, scale * own.translation)))
    return Rig(tuple(moved))


def assert_true(cameras, within_m):
    for found, is_ in zip(cameras, TRUE, strict=True):
        off = found.world_from_camera.translation - is_.world_from_camera.translation
        assert np.linalg.norm(off) < within_m


def test_the_rig_comes_home():
    axes = world_from_l_frame(elsewhere(), shown(), FRAME)
    assert_true(axes.rig.cameras, 5e-3)
    assert axes.rms_m < 1e-3
    assert axes.measured_over_known == pytest.approx(1, abs=4 * axes.scale_sigma)
    assert axes.findings == ()


def test_exactly_where_nothing_is_noisy():
    axes = world_from_l_frame(elsewhere(), shown(noise_px=1e-9), FRAME)
    assert_true(axes.rig.cameras, 1e-6)


@pytest.mark.parametrize(
    ("scale", "code", "severity"),
    [(1.005, "scale-error", "warn"), (1.03, "scale-error", "refuse"), (1000.0, "mixed-units", "refuse")],
)
def test_a_wrong_scale_is_found(scale, code, severity):
    found = world_from_l_frame(elsewhere(scale), shown(), FRAME).findings
    assert [(one.code, one.severity) for one in found] == [(code, severity)]


def test_another_figure_is_refused():
    other = PLACES * (1.0, 1.15, 1.0)
    with pytest.raises(CalibrationError, match="none of the"):
        world_from_l_frame(elsewhere(), shown(other), FRAME)


def test_a_mirrored_file_is_refused():
    solid = np.array([[0.0, 0, 0], [0.6, 0, 0], [0, 0.4, 0], [0.2, 0.1, 0.3]])
    names = ("o", "x", "y", "up")
    assert world_from_l_frame(elsewhere(), shown(solid), LFrame(names, solid, 0.02)).rms_m < 1e-3
    with pytest.raises(CalibrationError, match="mirrored"):
        world_from_l_frame(elsewhere(), shown(solid), LFrame(names, solid * (1, -1, 1), 0.02))


def test_too_few_balls_are_refused():
    with pytest.raises(CalibrationError, match="balls found that two cameras see"):
        world_from_l_frame(elsewhere(), shown(PLACES[:2], clutter=0), FRAME)
    with pytest.raises(CalibrationError, match="0 balls found"):
        world_from_l_frame(elsewhere(), {}, FRAME)


def test_two_figures_alike_are_refused():
    both = np.vstack([PLACES, PLACES + [0.2, 0.7, 0.5]])
    with pytest.raises(CalibrationError, match="two ways"):
        world_from_l_frame(elsewhere(), shown(both, clutter=0), FRAME)


def test_a_wand_calibration_is_carried_into_the_axes_with_its_covariance():
    world = waved(200, seed=3)
    found = calibrated(TRUE, seen(TRUE, world))
    axes = world_from_l_frame(found.rig, shown(), FRAME)
    home = in_axes(found, axes)
    assert_true(home.rig.cameras, 6e-3)
    # distances between cameras do not depend on the axes, nor does their variance
    names, difference = found.parameters, np.zeros((2, len(found.parameters)))
    for row, one in enumerate((found, home)):
        a, b = (one.rig.cameras[k].world_from_camera.translation for k in (0, 2))
        for axis, along in zip("XYZ", (a - b) / np.linalg.norm(a - b), strict=True):
            difference[row, names.index(f"cam1.{axis}_m")] = along
            difference[row, names.index(f"cam3.{axis}_m")] = -along
    variance = [d @ one.covariance @ d for d, one in zip(difference, (found, home), strict=True)]
    assert variance[1] == pytest.approx(variance[0], rel=1e-6)
    off = np.linalg.norm(
        home.points_in_world()[home.used] - world.reshape(-1, 3)[home.sightings.mark[home.used]], axis=1
    )
    assert np.median(off) < 3e-3


def l_frame_images(noise_px=NOISE_PX) -> tuple[dict[str, Detections], np.ndarray]:
    """Return the L-frame's images in each camera, and the same as a table (ball, camera, 2) [px]."""
    rng = np.random.default_rng(8)
    table = np.stack([project(one, PLACES) + rng.normal(0, noise_px, (4, 2)) for one in TRUE], axis=1)
    ones, covariance = np.ones(4), np.tile(np.eye(2) * noise_px**2, (4, 1, 1))
    images = {
        one.name: Detections(one.name, table[:, k], covariance, 8 * ones, ones, ones) for k, one in enumerate(TRUE)
    }
    return images, table


def drawn_sizes(found, table, draws=300) -> tuple[np.ndarray, np.ndarray]:
    """Return size over known size of the L-frame, and the distance of two cameras, in rigs as uncertain as this."""
    changes = np.random.default_rng(2).multivariate_normal(
        np.zeros(len(found.parameters)), found.covariance, draws, method="eigh"
    )
    pairs = np.triu_indices(len(PLACES), 1)
    known = np.linalg.norm(PLACES[pairs[0]] - PLACES[pairs[1]], axis=1)
    sizes, apart = [], []
    for change in changes:
        one = changed_rig(found, change)
        places = triangulate(one, table)[0]
        measured = np.linalg.norm(places[pairs[0]] - places[pairs[1]], axis=1)
        sizes.append(measured @ known / (known @ known))
        a, b = (one.cameras[k].world_from_camera.translation for k in (0, 2))
        apart.append(np.linalg.norm(a - b))
    return np.array(sizes), np.array(apart)


def test_the_calibration_s_own_uncertainty_is_in_the_size_s():
    found = calibrated(TRUE, seen(TRUE, waved(60, seed=5)))
    images, table = l_frame_images()
    with_it, without = (world_from_l_frame(one, images, FRAME).scale_sigma for one in (found, found.rig))
    # 300 draws give a standard deviation to 4 %
    assert np.sqrt(with_it**2 - without**2) == pytest.approx(np.std(drawn_sizes(found, table)[0]), rel=0.15)
