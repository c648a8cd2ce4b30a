"""sigma0 far from 1 is told with its likeliest cause; the causes are planted."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rigid_scenes import board_marks, seen, some_rig
from scipy.spatial.transform import Rotation

from mosca.calibration.quality.findings import warn
from mosca.calibration.quality.limits import QualityLimits
from mosca.calibration.quality.unit_weight import unit_weight
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.data.rig import Pose

FREE = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2")
NOISE, LATE_S = 0.02, 0.01
UPRIGHT = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def poses_at(times):
    """A board that is waved, now slowly and now fast."""
    phase = 3 * times + 0.9 * np.sin(3 * times)
    turns = Rotation.from_rotvec(
        np.column_stack([0.5 * np.sin(phase), 0.4 * np.cos(1.7 * phase), 0.3 * np.sin(phase)])
    )
    places = 0.4 * np.column_stack([np.sin(1.3 * phase), np.cos(0.9 * phase), np.sin(2.1 * phase)])
    spin = Rotation.from_rotvec(np.outer(2 * phase, [0.0, 0.0, 1.0]))
    return [Pose((a * b * UPRIGHT).as_matrix(), c) for a, b, c in zip(spin, turns, places, strict=True)]


@cache
def calibrated(stated=NOISE, late_s=0.0):
    """Calibrate from a board whose image points are stated to have ``stated`` px; cam3 is ``late_s``."""
    rng, times = np.random.default_rng(2), np.arange(25) * 0.1
    rig, marks = some_rig(rng, n=3, model="opencv"), board_marks(6, 5, 0.15)
    sightings = seen(rig, marks, poses_at(times), rng, noise=NOISE)
    later = seen(rig, marks, poses_at(times + late_s), rng, noise=NOISE)
    parts = [sightings.only(sightings.camera != 2), later.only(later.camera == 2)]
    names = ("camera", "frame", "mark", "xy_px", "covariance_px2", "diameter_px")
    both = replace(sightings, **{name: np.concatenate([getattr(one, name) for one in parts]) for name in names})
    both = replace(both, covariance_px2=both.covariance_px2 * (stated / NOISE) ** 2)
    return calibrate_rigid(both, RigidTarget("target", marks), RigidSettings(LensChoice("opencv"), FREE), known=rig)


@pytest.mark.parametrize(
    ("planted", "found", "said"),
    [
        ({"stated": 10 * NOISE}, (), "standard deviations of image points are stated too large"),
        ({"stated": NOISE / 10}, (), "points are less exact than detection expects"),
        ({"late_s": LATE_S}, (), "more than points scatter: cameras are not synchronised, or not firm"),
        ({"stated": NOISE / 10}, (warn("lens-model", "planted"),), "the lens model cannot follow a lens"),
        ({"stated": NOISE / 10}, (warn("lens-model", "x"), warn("target-shape", "x")), "not as its file says"),
    ],
)
def test_the_cause_is_named(planted, found, said):
    calibration = calibrated(**planted)
    (one,) = unit_weight(calibration, found, QualityLimits())
    assert one.code == "unit-weight"
    assert f"sigma0 is {calibration.sigma0:.2g}, 0.33 to 3 allowed; likeliest cause: " in one.message
    assert said in one.message


def test_points_as_exact_as_stated_raise_nothing():
    calibration = calibrated()
    assert calibration.sigma0 == pytest.approx(1.0, abs=0.1)
    for stated in (0.5, 1.0, 2.0):
        assert unit_weight(replace(calibration, sigma0=stated), (), QualityLimits()) == ()
