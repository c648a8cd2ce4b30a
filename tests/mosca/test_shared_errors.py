"""Marks that are shifted on their plates for all cameras alike, as by shadows' edges: found, and stated."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_scenes import field_marks, seen, some_rig, still, stood

from mosca.calibration.bundle import systematic_covariance as systematic
from mosca.calibration.quality.accuracy_map import triangulated_points
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.camera.projection import project

NOISE_PX, REPEATS, STANDS, CAMERAS = 0.005, 4, 3, 8
SHIFT_M = 1e-4
"""0.02 px at 4 m: twice the noise of one image, four times that of a stand's mean."""
SETTINGS = RigidSettings(LensChoice("mosca", 0.0099), exterior_only=True)


def shifted(seed, shift_m, alone_px=0.0):
    """Return rig, poses and calibration of a field whose marks are off by ``shift_m`` on their planes at each stand.

    ``alone_px``: what comes on top in each camera by itself.
    """
    rng = np.random.default_rng(seed)
    rig, marks = some_rig(rng, CAMERAS), field_marks(rng, 30)
    normals = rng.normal(size=(len(marks), 3)) * [0.2, 0.2, 0.0] + [0.0, 0.0, 1.0]
    poses = [*still(REPEATS), *stood(rng, STANDS - 1, REPEATS)]
    given = seen(rig, marks, poses, rng, noise=NOISE_PX)
    across = rng.normal(0, shift_m, (STANDS, len(marks), 3))
    across -= (across * normals).sum(axis=2, keepdims=True) * normals / (normals**2).sum(axis=1, keepdims=True)
    xy = (
        given.xy_px
        + rng.normal(0, alone_px, (CAMERAS, STANDS, len(marks), 2))[given.camera, given.frame // REPEATS, given.mark]
    )
    for frame, pose in enumerate(poses):
        for k, camera in enumerate(rig.cameras):
            mine = (given.frame == frame) & (given.camera == k)
            where = [
                pose.transform(marks[given.mark[mine]] + d) for d in (across[frame // REPEATS][given.mark[mine]], 0)
            ]
            xy[mine] += project(camera, where[0]) - project(camera, where[1])
    target = RigidTarget("test field", marks, normals=normals)
    return rig, poses, calibrate_rigid(replace(given, xy_px=xy), target, SETTINGS, rig)


def squares(rig, poses, calibration):
    """Squared error of the world's place, at the marks of the first stand, by its covariance and degree of freedom.

    What shifts these marks, as all cameras see them, shifts the world.
    """
    marks = calibration.marks_m
    point, camera = (x.ravel() for x in np.indices((len(marks), CAMERAS)))
    seen_px = np.stack([project(one, poses[0].transform(marks)) for one in rig.cameras], axis=1)[point, camera]
    found = triangulated_points(calibration, camera, point, seen_px, np.tile(np.eye(2), (len(point), 1, 1)))
    off, by_parameter = (found.xyz - marks[found.key]).mean(axis=0), found.by_parameter.mean(axis=0)
    return off @ np.linalg.solve(by_parameter @ calibration.covariance @ by_parameter.T, off) / 3


@pytest.mark.slow
def test_the_covariance_holds_what_cameras_share(monkeypatch):
    found = [squares(*shifted(seed, SHIFT_M)) for seed in range(12)]
    # 36 degrees of freedom: 1 +- 0.24
    assert 0.4 < np.mean(found) < 1.7, found
    # the control: taken for each camera's own, a shift of eight counts as eight
    monkeypatch.setattr(systematic, "shared_error", lambda *_: 0.0)
    alone = [squares(*shifted(seed, SHIFT_M)) for seed in range(12)]
    assert np.mean(alone) > 3.0, alone


@pytest.mark.parametrize(("shift_m", "alone_px"), [(SHIFT_M, 0.0), (0.0, 0.02)])
def test_residuals_of_several_cameras_tell_the_shift(monkeypatch, shift_m, alone_px):
    found, estimator = [], systematic.shared_error

    def spied(cells, variance, cluster, slopes):
        found.append(np.sqrt(variance.mean()) * estimator(cells, variance, cluster, slopes))
        return found[-1] / np.sqrt(variance.mean())

    monkeypatch.setattr(systematic, "shared_error", spied)
    shifted(1, shift_m, alone_px)
    # 90 shifts of two coordinates: 7 % of the standard deviation
    assert found[0] == pytest.approx(shift_m, rel=0.25, abs=0.35 * SHIFT_M)
