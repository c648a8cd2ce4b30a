"""Self-calibration of a real session: an LED waved before four wide cameras (Straw's test set of MultiCamSelfCal).

Data: caldata20130726 with MultiCamSelfCal's finished result as pymvg ships it (MIT; see SOURCE.md there). Only the
image points and the images' sizes go in. The shipped result holds its lenses at the values of an earlier checkerboard
calibration (.rad) and was made from every fifth frame.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import rq
from wand_scenes import similarity

from mosca.calibration.uncalibrated.self_calibration import self_calibrate
from mosca.data.calibration import Calibration
from mosca.data.sightings import Sightings

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
RESULT = DATA / "mcsc_selfcalib" / "pymvg" / "external" / "mcsc" / "mcsc_output_20130726"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not RESULT.is_dir(), reason=f"no pymvg LED set in {DATA} (set MOSCA_DATA)"),
]
POINT_SIGMA_PX = 0.3


def sightings() -> Sightings:
    found = np.loadtxt(RESULT / "IdMat.dat") > 0
    sizes = np.loadtxt(RESULT / "Res.dat").astype(int)
    points = np.loadtxt(RESULT / "points.dat").reshape(len(sizes), 3, -1)
    camera, frame = np.nonzero(found)
    n = len(camera)
    return Sightings(
        tuple(f"cam{k + 1}" for k in range(len(sizes))),
        sizes,
        points.shape[2],
        camera,
        frame,
        np.zeros(n),
        points[camera, :2, frame],
        np.tile(np.eye(2) * POINT_SIGMA_PX**2, (n, 1, 1)),
        np.full(n, np.nan),
    )


def shipped_centres() -> np.ndarray:
    """Return the cameras' centres of the shipped projection matrices (their null vectors)."""
    matrices = np.loadtxt(RESULT / "Pmatrices.dat").reshape(4, 3, 4)
    null = np.array([np.linalg.svd(m)[2][-1] for m in matrices])
    return null[:, :3] / null[:, 3:]


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return self_calibrate(sightings(), np.random.default_rng(0))


def centres(calibration) -> np.ndarray:
    return np.array([camera.world_from_camera.translation for camera in calibration.rig.cameras])


def test_reprojection(calibration):
    # measured: 0.111 px over 464 points a camera; the shipped result reaches 0.278 px
    residual = np.linalg.norm(calibration.residuals_px, axis=1)
    assert np.median(residual[np.isfinite(residual)]) < 0.125
    assert np.mean(calibration.used) > 0.97
    assert calibration.refused == ()


def test_lenses_are_near_the_checkerboards(calibration):
    # of the .rad files: another calibration of the same lenses, good to 1 to 3 % as its residuals show
    for one, (f, cx, cy) in zip(
        calibration.rig.cameras,
        ((423.2, 330.1, 210.3), (402.8, 320.8, 239.7), (398.9, 313.1, 258.3), (390.6, 349.6, 237.3)),
        strict=True,
    ):
        assert one.lens.fx_px == pytest.approx(f, rel=0.02)
        assert one.lens.cx_px == pytest.approx(cx, abs=4)
        assert one.lens.cy_px == pytest.approx(cy, abs=13)


def test_half_of_the_frames_agree_with_all_within_their_own_bounds(calibration):
    """The covariance is honest: no camera of either half is farther from the whole than 3.5 sigma (24 numbers)."""
    whole = sightings()
    for half in (0, 1):
        part = self_calibrate(whole.only(whole.frame % 2 == half), np.random.default_rng(0))
        both = (part.points_in_world(), calibration.points_in_world()[whole.frame % 2 == half])
        good = np.isfinite(np.hstack(both)).all(axis=1)
        scale, turn, shift = similarity(*(points[good] for points in both))
        away = (scale * centres(part) @ turn.T + shift - centres(calibration)) @ turn / scale
        sigma = part.standard_deviations
        for camera, off in zip(part.rig.cameras, away, strict=True):
            for axis, one in zip("XYZ", off, strict=True):
                assert abs(one) < 3.5 * sigma[f"{camera.name}.{axis}_m"]


def test_centres_agree_with_the_shipped_ones_as_far_as_these_go(calibration):
    """The shipped centres are good to about 3 % of the rig's size, ours to 0.1 %.

    Measured: ours miss them by 3.0 % rms. The shipped result's own figures: its cameras have skews up to 4 px
    and pixels 0.8 % out of square, its residuals are 2.5 times ours, and it misses the surveyed centres that come
    with the session by 5.7 % where ours miss them by 5.0 %.
    """
    ours, shipped = centres(calibration), shipped_centres()
    surveyed = np.loadtxt(RESULT / "original_cam_centers.dat")

    def miss(source, target) -> float:
        scale, turn, shift = similarity(source, target)
        off = scale * source @ turn.T + shift - target
        size = np.linalg.norm(target - target.mean(axis=0), axis=1).mean()
        return float(np.sqrt(np.mean((off**2).sum(axis=1))) / size)

    assert miss(ours, shipped) < 0.035
    assert miss(ours, surveyed) < miss(shipped, surveyed)
    matrices = np.loadtxt(RESULT / "Pmatrices.dat").reshape(4, 3, 4)
    interior = [rq(m[:, :3])[0] for m in matrices]
    assert max(abs(k[0, 1] / k[2, 2]) for k in interior) > 3
