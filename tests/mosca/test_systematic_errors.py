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


def calibrated(seed, lasting_px, repeats=REPEATS):
    """Return rig, poses and calibration from still poses whose marks are off by ``lasting_px`` in each camera."""
    rng = np.random.default_rng(seed)
    rig = some_rig(rng, 3)
    marks = field_marks(rng, 40)
    stands = 4 * REPEATS // repeats
    poses = [*still(repeats), *stood(rng, stands - 1, repeats)]
    given = seen(rig, marks, poses, rng, noise=NOISE_PX)
    off = rng.normal(0, lasting_px, (3, stands, len(marks), 2))
    given = replace(given, xy_px=given.xy_px + off[given.camera, given.frame // repeats, given.mark])
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


def test_the_covariance_holds_what_lasts(monkeypatch):
    found = [squares(*calibrated(seed, LASTING_PX)) for seed in range(3)]
    assert 0.5 < np.mean(found) < 2.0, found
    # the control: taken for new errors in each exposure, an eighth of their variance would be left
    monkeypatch.setattr(rigid, "systematic_covariance", lambda *_: 0.0)
    alone = [squares(*calibrated(seed, LASTING_PX)) for seed in range(2)]
    assert np.mean(alone) > 3.0, alone


def test_nothing_is_said_to_last_where_nothing_stood():
    """Each exposure shows another pose: systematic errors are inseparable from noise, which is stated instead."""
    _, _, calibration = calibrated(2, 0.0, repeats=1)
    assert np.isnan(calibration.lasting_px).all()
    stated = [camera.residual_px for camera in with_residuals(calibration).cameras]
    assert max(stated) < NOISE_PX
