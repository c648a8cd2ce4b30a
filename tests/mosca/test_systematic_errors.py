"""Errors that are the same in each exposure of a still target: found, and stated."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_scenes import errors_of, field_marks, seen, some_rig, still, stood

from mosca.calibration import rigid_target as rigid
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.session import with_residuals
from mosca.calibration.single_camera.interior_orientation import LensChoice

NOISE_PX, LASTING_PX, REPEATS = 0.02, 0.02, 8
SETTINGS = RigidSettings(LensChoice("mosca", 0.0099))


def calibrated(seed, lasting_px, repeats=REPEATS, spread=1.0):
    """Return rig, poses and calibration from still poses whose marks are off by ``lasting_px`` in each camera.

    ``spread``: all errors of every other mark are so many times as large, as of dots that are saturated.
    """
    rng = np.random.default_rng(seed)
    rig = some_rig(rng, 3)
    marks = field_marks(rng, 40)
    stands = 4 * REPEATS // repeats
    poses = [*still(repeats), *stood(rng, stands - 1, repeats)]
    given = seen(rig, marks, poses, rng, noise=NOISE_PX)
    off = rng.normal(0, lasting_px, (3, stands, len(marks), 2))
    larger = np.where(given.mark % 2 == 0, 1.0, spread)
    xy = given.xy_px + rng.normal(0, 1, (len(given), 2)) * NOISE_PX * np.sqrt(larger**2 - 1)[:, None]
    xy += larger[:, None] * off[given.camera, given.frame // repeats, given.mark]
    given = replace(given, xy_px=xy, covariance_px2=given.covariance_px2 * larger[:, None, None] ** 2)
    return rig, poses, calibrate_rigid(given, RigidTarget("test field", marks), SETTINGS)


def squares(rig, poses, calibration):
    """Mean squared error of the parameters in units of their stated variances."""
    return np.mean([(error / sigma) ** 2 for error, sigma in errors_of(calibration, rig, poses).values()])


@pytest.mark.parametrize("lasting_px", [LASTING_PX, 0.0])
def test_repeats_tell_what_lasts(lasting_px):
    _, _, calibration = calibrated(1, lasting_px)
    stated = [camera.residual_px for camera in with_residuals(calibration).cameras]
    # 240 coordinates of marks at stands: 5 % of the variance; of noise 0.02 / sqrt(8) at most its root is left
    assert stated == pytest.approx([lasting_px] * 3, rel=0.15, abs=0.004)
    # nothing shook
    assert [camera.shake_px for camera in with_residuals(calibration).cameras] == pytest.approx([0.0] * 3, abs=0.004)
    shaken = with_residuals(replace(calibration, body_px=0.03))
    assert [camera.shake_px for camera in shaken.cameras] == [0.03] * 3


def test_the_covariance_holds_what_lasts(monkeypatch):
    found = [squares(*calibrated(seed, LASTING_PX)) for seed in range(3)]
    assert 0.5 < np.mean(found) < 2.0, found
    # the control: taken for new errors in each exposure, an eighth of their variance would be left
    monkeypatch.setattr(rigid, "systematic_covariance", lambda *_: 0.0)
    alone = [squares(*calibrated(seed, LASTING_PX)) for seed in range(2)]
    assert np.mean(alone) > 3.0, alone


def test_marks_that_are_known_badly_do_not_say_what_lasts(monkeypatch):
    found = [squares(*calibrated(seed, LASTING_PX, spread=6.0)) for seed in range(2)]
    assert 0.6 < np.mean(found) < 1.6, found
    # the control: in pixels, the errors of bad marks are those of good ones, too
    estimate = rigid.systematic_errors
    monkeypatch.setattr(rigid, "systematic_errors", lambda a, camera, cell, _: (
        estimate(a, camera, cell, np.ones(len(cell))) / NOISE_PX))  # fmt: skip
    alone = [squares(*calibrated(seed, LASTING_PX, spread=6.0)) for seed in range(2)]
    assert np.mean(alone) < 0.4, alone


def test_nothing_is_said_to_last_where_nothing_stood():
    """Each exposure shows another pose: systematic errors are inseparable from noise, which is stated instead."""
    _, _, calibration = calibrated(2, 0.0, repeats=1)
    assert np.isnan(calibration.lasting_px).all()
    stated = [camera.residual_px for camera in with_residuals(calibration).cameras]
    assert max(stated) < NOISE_PX
