"""A board that is not as its file says is told, by sightings whose truth is known."""

import numpy as np
import pytest
from rigid_scenes import board_marks, carried, seen, some_rig

from mosca.calibration.quality.target_shape import target_shape
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice

OPENCV = RigidSettings(LensChoice("opencv"), steady=False)


def found(bend_m, sigma_m=0.0, views=40):
    """Calibrate from a board whose corners stand out of its plane like a saddle."""
    rng = np.random.default_rng(5)
    rig, marks, poses = some_rig(rng, model="opencv"), board_marks(), carried(rng, views)
    true = marks.copy()
    reach = np.abs(marks[:, :2]).max(axis=0)
    true[:, 2] = bend_m * (marks[:, 0] / reach[0]) * (marks[:, 1] / reach[1])
    facing = np.tile([0.0, 0.0, -1.0], (len(marks), 1))
    sightings = seen(rig, true, poses, rng, facing=facing)
    done = calibrate_rigid(sightings, RigidTarget("board", marks, sigma_m), OPENCV)
    return target_shape(done), np.sqrt(np.mean(true[:, 2] ** 2))


def test_a_bent_board_is_told_with_its_size():
    (finding,), rms = found(2e-3)
    assert finding.code == "target-shape"
    assert finding.severity == "warn"
    told = float(finding.message.split("sigma_m = ")[1])
    assert told == pytest.approx(rms, rel=0.5)  # what poses and lenses take up is not seen


def test_a_flat_board_and_one_whose_marks_are_estimated_are_not():
    assert found(0.0)[0] == ()
    assert found(2e-3, sigma_m=2e-3)[0] == ()
