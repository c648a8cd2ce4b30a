"""Stated intervals hold what they promise, also where whole images shake; the full study is ``bench_intervals``."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_scenes import board_marks, carried, errors_of, field_marks, seen, some_rig, still
from scipy.spatial.transform import Rotation

from mosca.calibration import rigid_target as rigid
from mosca.calibration.bundle.exposure_shake import body_shake, shaken_covariance, steadied
from mosca.calibration.bundle.solver import CameraUnknowns, ObjectPoints, Observations, Placements, Problem, solve
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.camera.projection import project
from mosca.data.rig import Pose

NOISE, SHAKE = 0.02, 0.03
FREE = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2")


def ratios(case: str, runs: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return error / stated sigma of the parameters of each run, and the same with the noise's covariance alone."""
    found, naive, added = [], [], []

    def kept(problem, result, exposure, shake):
        covariance = shaken_covariance(problem, result, exposure, shake)
        added.append(covariance - result.precision.covariance)
        return covariance

    for seed in range(runs):
        rng = np.random.default_rng([7, seed])
        rig = some_rig(rng, n=3, model="opencv")
        settings = RigidSettings(LensChoice("opencv"), FREE)
        if case == "field":
            # with lenses known, rotations absorb the shakes; without, the principal point does
            marks, poses = field_marks(rng, 90), still(12)
            settings = replace(settings, exterior_only=True)
        else:
            marks, poses = board_marks(6, 4, 0.16), carried(rng, 12)
        sightings = seen(rig, marks, poses, rng, noise=NOISE, shake=SHAKE)
        # the lenses' start makes no difference to the optimum; the true one saves time
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rigid, "shaken_covariance", kept)
            done = calibrate_rigid(sightings, RigidTarget("target", marks), settings, known=rig)
        for one, into in ((done, found), (replace(done, covariance=done.covariance - added[-1]), naive)):
            into.append(np.array([error / sigma for error, sigma in errors_of(one, rig, poses).values()]))
    return found, naive


@pytest.mark.parametrize(("case", "runs"), [("field", 40), ("board", 8)])
def test_intervals_cover(case, runs):
    stated, naive = ratios(case, runs)
    inside = [np.mean(np.abs(one) <= 1.96) for one in stated]
    # runs are independent, parameters of one are not: the spread over runs gives the mean's own
    doubt = max(np.std(inside) / np.sqrt(runs), 0.01)
    assert abs(np.mean(inside) - 0.95) < 4 * doubt
    assert doubt < 0.03
    if case == "field":
        # the control: for the covariance only the noise of image points counts
        covered = [np.mean(np.abs(one) <= 1.96) for one in naive]
        assert np.mean(covered) + 4 * np.std(covered) / np.sqrt(runs) < 0.95


def shaken_problem(seed: int):
    """Return a board before two cameras in ten poses, the last of which is held, each exposed twice."""
    rng = np.random.default_rng(seed)
    rig = some_rig(rng, n=2, model="opencv", radius=3.0)
    marks = board_marks(4, 3, 0.2)
    poses = [
        Pose(Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix(), rng.uniform(-0.4, 0.4, 3)) for _ in range(10)
    ]
    frames = np.repeat(np.arange(10), 2)
    sightings = seen(rig, marks, [poses[k] for k in frames], rng, noise=NOISE, shake=SHAKE)
    placement = frames[sightings.frame]
    of_world = poses[9].transform(marks)
    # marks of the held pose are points of the world, behind those of the board
    point = sightings.mark + np.where(placement == 9, len(marks), 0)
    placement = np.where(placement == 9, -1, placement)
    problem = Problem(
        tuple(CameraUnknowns(c, ("fx_px", "cx_px")) for c in rig.cameras),
        Observations(sightings.camera, point, sightings.xy_px, placement, NOISE),
        ObjectPoints.fixed(np.concatenate([marks, of_world])),
        Placements.of(poses[:9]),
    )
    return rig, problem, sightings.frame


def design_of(rig, problem) -> np.ndarray:
    """Return the derivatives (2n, u) of all image points by cameras, then poses; by differences."""
    see, step = problem.observations, 1e-6

    def image(unknowns) -> np.ndarray:
        out = np.empty((len(see), 2))
        for c, camera in enumerate(rig.cameras):
            by = unknowns[8 * c : 8 * c + 8]
            old = camera.world_from_camera
            turned = old.rotation @ Rotation.from_rotvec(by[:3]).as_matrix()
            lens = replace(camera.lens, fx_px=camera.lens.fx_px + by[6], cx_px=camera.lens.cx_px + by[7])
            moved = replace(camera, lens=lens, world_from_camera=Pose(turned, old.translation + by[3:6]))
            at = problem.points.xyz[see.point].copy()
            for f in range(9):
                by = unknowns[16 + 6 * f : 22 + 6 * f]
                old = problem.placements.pose(f)
                turned = old.rotation @ Rotation.from_rotvec(by[:3]).as_matrix()
                mine = see.placement == f
                at[mine] = Pose(turned, old.translation + by[3:]).transform(at[mine])
            mine = see.camera == c
            out[mine] = project(moved, at[mine])
        return out.ravel()

    each = step * np.eye(16 + 54)
    return np.array([(image(one) - image(-one)) / (2 * step) for one in each]).T


def test_shakes_are_generalised_least_squares():
    """Estimate and covariance are those of dense generalised least squares, V = noise^2 + rotations of each image."""
    rig, problem, exposure = shaken_problem(1)
    plain = solve(problem)
    xy = steadied(problem, plain, exposure, SHAKE)
    steady = replace(problem, observations=replace(problem.observations, xy_px=xy))
    done = solve(steady)
    covariance = shaken_covariance(steady, done, exposure, SHAKE)
    design = design_of(rig, problem)
    see = problem.observations
    image = np.repeat(1000 * see.camera + exposure, 2)
    v = NOISE**2 * np.eye(len(image))
    for axis in (0, 1):
        # a rotation about the camera's own x or y axis, by which the image's middle moves by a pixel
        turns = sum(
            design[:, 8 * c + axis] / (camera.lens.fx_px, camera.lens.fy_px)[1 - axis]
            for c, camera in enumerate(rig.cameras)
        )
        v += SHAKE**2 * np.outer(turns, turns) * (image[:, None] == image)
    wanted = np.linalg.inv(design.T @ np.linalg.solve(v, design))[:16, :16]
    sigma = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma, rtol=0.06)
    # the estimate: linear from the truth, whose images are known without error
    weights = np.linalg.solve(v, design)
    start = np.concatenate([project(rig.cameras[c], problem_point(problem, m)) for m, c in enumerate(see.camera)])
    step = np.linalg.solve(design.T @ weights, weights.T @ (see.xy_px - start).ravel())[:16]
    for c in range(2):
        true, one = rig.cameras[c], done.cameras[c]
        shift = one.world_from_camera.translation - true.world_from_camera.translation
        wanted_c, sigma_c = step[8 * c : 8 * c + 8], sigma[8 * c : 8 * c + 8]
        np.testing.assert_allclose(shift, wanted_c[3:6], atol=0.2 * sigma_c[3:6].max())
        focal = one.lens.fx_px - true.lens.fx_px
        assert focal == pytest.approx(wanted_c[6], abs=0.2 * sigma_c[6])
    # least squares alone goes elsewhere
    focal = plain.cameras[0].lens.fx_px - rig.cameras[0].lens.fx_px
    assert abs(focal - step[6]) > 0.1 * sigma[6]


def problem_point(problem, m) -> np.ndarray:
    """Return where the point of observation m is (1, 3)."""
    see = problem.observations
    at = problem.points.xyz[see.point[m]][None]
    return at if see.placement[m] < 0 else problem.placements.pose(see.placement[m]).transform(at)


def test_the_size_of_the_shakes_is_found_without_bias():
    found = []
    for seed in range(25):
        _, problem, exposure = shaken_problem(seed)
        found.append(body_shake(problem, solve(problem), exposure) ** 2)
    doubt = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - SHAKE**2) < 3.5 * doubt
    assert doubt < 0.15 * SHAKE**2


def test_one_exposure_of_a_fixed_field_shows_no_shake():
    rng = np.random.default_rng(3)
    rig = some_rig(rng, n=2, model="opencv")
    marks = field_marks(rng, 40)
    sightings = seen(rig, marks, still(1), rng, noise=NOISE, shake=SHAKE)
    done = calibrate_rigid(
        sightings, RigidTarget("field", marks), RigidSettings(LensChoice("opencv"), FREE), known=rig
    )
    assert done.body_px == 0.0
