"""A board that is not as its file says is told, by sightings whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_scenes import board_marks, carried, seen, some_rig

from mosca.calibration.quality.target_shape import repeated_displacements, target_shape, with_shape
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice

OPENCV = RigidSettings(LensChoice("opencv"), steady=False)


def found(bend_m, sigma_m=0.0, views=40, model="opencv", free=None):
    """Calibrate from a board whose corners stand out of its plane like a saddle; return that, how, and the marks."""
    rng = np.random.default_rng(5)
    rig, marks, poses = some_rig(rng, model=model), board_marks(), carried(rng, views)
    true = marks.copy()
    reach = np.abs(marks[:, :2]).max(axis=0)
    true[:, 2] = bend_m * (marks[:, 0] / reach[0]) * (marks[:, 1] / reach[1])
    facing = np.tile([0.0, 0.0, -1.0], (len(marks), 1))
    sightings = seen(rig, true, poses, rng, facing=facing)

    def calibrated(sigma):
        return calibrate_rigid(sightings, RigidTarget("board", marks, sigma), replace(OPENCV, free=free))

    return calibrated(sigma_m), calibrated, true


def test_a_bent_board_is_told_with_its_size():
    done, _, true = found(2e-3)
    (finding,) = target_shape(done)
    assert finding.code == "target-shape"
    assert finding.severity == "warn"
    rms = 1e3 * np.sqrt(np.mean(true[:, 2] ** 2))
    told = float(finding.message.split("marks lie ")[1].split(" mm rms")[0])
    assert told == pytest.approx(rms, rel=0.5)  # what poses and lenses take up is not seen


def test_a_flat_board_and_one_whose_marks_are_estimated_are_not():
    assert target_shape(found(0.0)[0]) == ()
    assert target_shape(found(2e-3, sigma_m=2e-3)[0]) == ()


def test_a_bent_board_is_estimated_without_being_told_and_a_flat_one_is_left_as_it_is():
    done, calibrated, true = found(2e-3)
    shaped = with_shape(done, calibrated)
    assert [(one.code, one.severity) for one in shaped.findings[len(done.findings) :]] == [("target-shape", "note")]
    # both are of any pose
    rest, moved = (points - points.mean(axis=0) for points in (true, shaped.marks_m))
    u, _, v = np.linalg.svd(moved.T @ rest)
    off = moved @ (u @ v) - rest
    assert np.sqrt(np.mean(off**2)) < 0.05e-3  # of 0.7 mm
    assert shaped.sigma0 < done.sigma0 / 3
    assert repeated_displacements(shaped)[0] < 0.1
    flat, calibrated, _ = found(0.0)
    assert with_shape(flat, calibrated) is flat


def test_a_lens_that_the_model_cannot_follow_is_not_taken_for_a_bent_board():
    """Residuals go with the place in the image, and the board moves about in it."""
    done, calibrated, _ = found(0.0, model="mosca", free=("fx_px", "fy_px", "cx_px", "cy_px", "k1"))
    assert done.sigma0 > 3
    assert with_shape(done, calibrated) is done
