"""The bundle adjustment finds other solvers' optimum, from poor initial values too, and reports what is
undetermined."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from bundle_scenes import HEIGHT, WIDTH, cv2_pixels, moved, ring, views, wand_points, wand_problem
from rigs import looking_at
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.solver import (
    BundleSettings,
    CameraUnknowns,
    Distances,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.camera.projection import project
from mosca.data.boards import Board
from mosca.data.rig import Camera, MoscaLens, OpenCVLens, Pose
from mosca.errors import CalibrationError, InputError

SHARP = BundleSettings(tolerance=1e-7)


def waved(frames=60, seed=3, start_seed=4, turn=0.02, shift=0.05, focal=1.02):
    """Return true cameras, true points and the problem of a wand waved before four cameras, the first held."""
    cameras = ring(k1=-0.1)
    points = wand_points(frames)
    camera, point, xy = views(cameras, points, 0.1, 0.8, seed)
    rng = np.random.default_rng(start_seed)
    starts = [
        moved(c, rng, turn * (k > 0), shift * (k > 0), fx_px=c.lens.fx_px * focal, fy_px=c.lens.fy_px * focal, k1=0.0)
        for k, c in enumerate(cameras)
    ]
    see = Observations(camera, point, xy, sigma_px=0.1)
    return cameras, points, wand_problem(starts, see, len(points), rod_sigma_m=1e-4)


def without_single_rays(problem):
    see, kept = problem.observations, twice_seen(problem)
    pair = np.bincount(see.point[kept], minlength=len(problem.points)).reshape(-1, 2).all(axis=1)
    kept &= pair[see.point // 2]
    number = np.cumsum(np.repeat(pair, 2)) - 1
    rods = problem.distances
    return replace(
        problem,
        observations=Observations(see.camera[kept], number[see.point[kept]], see.xy_px[kept], sigma_px=0.1),
        points=ObjectPoints.free(int(2 * pair.sum())),
        distances=Distances(
            *(number[x[pair]] for x in (rods.first, rods.second)), rods.length_m[pair], rods.sigma_m[pair]
        ),
    )


def twice_seen(problem) -> np.ndarray:
    """Return which observations are of points with two rays or more; others have no information."""
    return np.bincount(problem.observations.point)[problem.observations.point] >= 2


def test_the_optimum_is_scipys():
    _, _, problem = waved(frames=12, seed=5)
    problem = without_single_rays(problem)
    done = solve(problem, SHARP)
    assert done.converged
    assert done.weak == ()
    see, rods = problem.observations, problem.distances
    cameras = [one.camera for one in problem.cameras]
    ratio = [c.lens.fy_px / c.lens.fx_px for c in cameras]

    def unpack(z):
        out = []
        for k, c in enumerate(cameras):
            rvec, position = (z[8 * k - 6 : 8 * k - 3], z[8 * k - 3 : 8 * k]) if k else (None, None)
            pose = Pose(Rotation.from_rotvec(rvec).as_matrix(), position) if k else c.world_from_camera
            f, k1 = z[8 * k : 8 * k + 2]
            out.append(replace(c, world_from_camera=pose, lens=replace(c.lens, fx_px=f, fy_px=f * ratio[k], k1=k1)))
        return out, z[8 * len(cameras) - 6 :].reshape(-1, 3)

    def residuals(z):
        trial, x = unpack(z)
        parts = []
        for k, c in enumerate(trial):
            mine = see.camera == k
            parts.append(((cv2_pixels(c, x[see.point[mine]]) - see.xy_px[mine]) / 0.1).ravel())
        length = np.linalg.norm(x[rods.first] - x[rods.second], axis=1)
        return np.concatenate([*parts, (length - rods.length_m) / rods.sigma_m])

    start = []
    for k, c in enumerate(done.cameras):
        pose = c.world_from_camera
        if k:
            start += [*Rotation.from_matrix(pose.rotation).as_rotvec(), *pose.translation]
        start += [c.lens.fx_px, c.lens.k1]
    # from beside our optimum, so that it has to come back
    z = np.concatenate([start, done.points.ravel()])
    z = z + np.random.default_rng(0).normal(0, 1e-5, z.size)
    found = least_squares(residuals, z, method="lm", x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15)
    theirs, points = unpack(found.x)
    assert done.cost == pytest.approx(2 * found.cost, rel=1e-10)
    for a, b in zip(done.cameras, theirs, strict=True):
        assert (a.lens.fx_px, a.lens.fy_px) == pytest.approx((b.lens.fx_px, b.lens.fy_px), rel=1e-7)
        np.testing.assert_allclose(a.world_from_camera.translation, b.world_from_camera.translation, atol=1e-7)
        np.testing.assert_allclose(a.world_from_camera.rotation, b.world_from_camera.rotation, atol=1e-7)
    np.testing.assert_allclose(done.points, points, atol=1e-7)


def mosca_pixels(camera: Camera, points) -> np.ndarray:
    """Image points by the paper's equations (section 2.2) of a lens with a and K1, worked out by repetition."""
    lens, pose = camera.lens, camera.world_from_camera
    x, y, z = ((points - pose.translation) @ pose.rotation).T
    ideal = lens.c_mm * np.column_stack([x / z, -y / z])
    measured = ideal
    for _ in range(100):
        r2 = np.sum(measured**2, axis=1, keepdims=True)
        measured = ideal - lens.a * measured[:, ::-1] - lens.K1_per_mm2 * r2 * measured
    right, up = measured.T
    return np.column_stack([lens.xp_px + right / lens.mx_mm_per_px, lens.yp_px - up / lens.my_mm_per_px])


def scipys_resection(image, start, free, xy, points) -> tuple[Camera, np.ndarray, float]:
    """Return scipy's camera, the Jacobian there by rotation about the camera's axes, position and lens, and cost."""

    def camera_of(base, z):
        pose = base.world_from_camera
        turned = pose.rotation @ Rotation.from_rotvec(z[:3]).as_matrix()
        lens = replace(base.lens, **dict(zip(free, z[6:].tolist(), strict=True)))
        return replace(base, world_from_camera=Pose(turned, z[3:6]), lens=lens)

    found = start
    for _ in range(2):  # the second time about the optimum, where the rotation is zero
        base = found
        z = np.array([0, 0, 0, *base.world_from_camera.translation, *(getattr(base.lens, n) for n in free)])
        fit = least_squares(
            lambda z, base=base: (image(camera_of(base, z), points) - xy).ravel(),
            z, jac="3-point", method="trf", x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15
        )  # fmt: skip
        found = camera_of(base, fit.x)
    return found, fit.jac, 2 * fit.cost


@pytest.mark.parametrize("model", ["opencv", "mosca"])
def test_one_camera_and_fixed_points_is_the_resection(model):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.6, 0.6, (60, 3)) + [0, 0, 1]
    pose = looking_at([2, 1, 1.5], [0, 0, 1])
    if model == "opencv":
        lens, free = (OpenCVLens(1000, 1004, 640, 510, -0.1, 0.03), ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2"))
    else:
        lens = MoscaLens(9.0, 640, 510, 0.01, 0.0101, -0.006, 8e-4)
        free = ("c_mm", "xp_px", "yp_px", "my_mm_per_px", "a", "K1_per_mm2")
    camera = Camera("c", WIDTH, HEIGHT, lens, pose)
    xy = project(camera, points) + rng.normal(0, 0.3, (60, 2))
    start = moved(camera, rng, 0.05, 0.1)
    see = Observations(np.zeros(60), np.arange(60), xy)
    done = solve(Problem((CameraUnknowns(start, free),), see, ObjectPoints.fixed(points)), SHARP)
    image = cv2_pixels if model == "opencv" else mosca_pixels
    found, jacobian, cost = scipys_resection(image, start, free, xy, points)
    assert done.cost == pytest.approx(cost, rel=1e-7)
    np.testing.assert_allclose(
        done.cameras[0].world_from_camera.translation, found.world_from_camera.translation, atol=1e-6
    )
    for name in free:
        sigma = done.standard_deviations[f"c.{name}"]
        assert getattr(done.cameras[0].lens, name) == pytest.approx(getattr(found.lens, name), abs=1e-3 * sigma)
    # the same covariance in the same order of the same unknowns
    covariance = cost / (120 - 12) * np.linalg.inv(jacobian.T @ jacobian)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        done.precision.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-3
    )
    share = (120 - 12) / 120
    rms = np.sqrt(np.mean(done.residuals_px**2, axis=0) / share)
    assert (done.precision.sigma_x_px[0], done.precision.sigma_y_px[0]) == pytest.approx(rms, rel=1e-6)


def test_a_board_before_one_camera_is_opencvs_calibration():
    board = Board(9, 8, 0.035, 0.02).corners()
    lens = OpenCVLens(1000, 1006, 652, 500, -0.15, 0.05, 5e-4, -8e-4)
    camera = Camera("c", WIDTH, HEIGHT, lens, Pose(np.eye(3), np.zeros(3)))
    rng = np.random.default_rng(5)
    poses, seen = [], []
    for _ in range(12):
        turn = Rotation.from_euler("xyz", [np.pi, 0, 0]) * Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3))
        poses.append(Pose(turn.as_matrix(), [*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.45, 0.7)]))
        seen.append(cv2_pixels(camera, poses[-1].transform(board)) + rng.normal(0, 0.15, (len(board), 2)))
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    guess = np.array([[980.0, 0, 640], [0, 980, 512], [0, 0, 1]])
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    rms, matrix, distortion, turns, shifts = cv2.calibrateCamera(
        [board.astype(np.float32)] * 12, [s.astype(np.float32) for s in seen], (WIDTH, HEIGHT), guess, np.zeros(5),
        flags=flags, criteria=stop
    )  # fmt: skip
    start = replace(camera, lens=OpenCVLens(980, 980, 640, 512))
    free = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")
    n, frames = len(board), 12
    see = Observations(
        np.zeros(n * frames),
        np.tile(np.arange(n), frames),
        np.concatenate([s.astype(np.float32).astype(float) for s in seen]),
        np.repeat(np.arange(frames), n),
    )
    begin = [moved(Camera("", 0, 0, lens, p), rng, 0.05, 0.05).world_from_camera for p in poses]
    points = ObjectPoints.fixed(board.astype(np.float32).astype(float))
    problem = Problem((CameraUnknowns(start, free, held=True),), see, points, Placements.of(begin))
    done = solve(problem, SHARP)
    assert np.sqrt(done.cost / (n * frames)) == pytest.approx(rms, rel=1e-6)
    got = done.cameras[0].lens
    assert (got.fx_px, got.fy_px, got.cx_px, got.cy_px) == pytest.approx(
        (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), rel=1e-5
    )
    np.testing.assert_allclose([got.k1, got.k2, got.p1, got.p2], distortion.ravel()[:4], atol=1e-5)
    np.testing.assert_allclose(done.placements.translation, np.array(shifts)[:, :, 0], atol=1e-6)
    np.testing.assert_allclose(done.placements.rotation[3], cv2.Rodrigues(turns[3])[0], atol=1e-5)
    # a camera moved through the scene is the same with the roles exchanged: the scene rotates, its points weighted
    weighted = ObjectPoints.weighted(points.xyz, 1e-6)
    again = solve(replace(problem, points=weighted), SHARP)
    assert again.cameras[0].lens.fx_px == pytest.approx(got.fx_px, abs=1e-2)
    assert len(again.parameters) == 8 + 3 * n


def test_a_poor_start_leads_to_the_same_optimum():
    """Focal lengths 20 % wrong, rotations 0.1 rad, positions 30 cm: some points begin behind cameras or far off."""
    cameras, _, near = waved(frames=80, turn=0, shift=0, focal=1.0)
    best = solve(near, SHARP)
    for seed in range(6):
        focal = 1.2 if seed % 2 else 0.8
        _, _, problem = waved(frames=80, start_seed=seed, turn=0.1, shift=0.3, focal=focal)
        done = solve(problem, SHARP)
        assert done.cost == pytest.approx(best.cost, rel=1e-8), seed
        np.testing.assert_array_equal(done.used, twice_seen(problem))
        for a, b in zip(done.cameras, cameras, strict=True):
            np.testing.assert_allclose(a.world_from_camera.translation, b.world_from_camera.translation, atol=5e-3)


def test_points_that_begin_behind_a_camera_are_found_again():
    _, points, problem = waved(frames=40, turn=0, shift=0, focal=1.0)
    start = points.copy()
    for k in range(0, 20):
        # mirrored through the first camera
        start[k] = 2 * problem.cameras[0].camera.world_from_camera.translation - points[k]
    done, best = solve(replace(problem, points=ObjectPoints.free(start)), SHARP), solve(problem, SHARP)
    np.testing.assert_array_equal(done.used, twice_seen(problem))
    assert done.cost == pytest.approx(best.cost, rel=1e-8)


def test_the_datum_changes_no_distance_and_no_residual():
    _, points, problem = waved(frames=30)
    held = solve(problem, SHARP)
    free_cameras = tuple(replace(one, held=False) for one in problem.cameras)
    loose = replace(problem, cameras=free_cameras, points=ObjectPoints.free(points), datum="points")
    network = solve(loose, SHARP)
    np.testing.assert_allclose(network.residuals_px, held.residuals_px, atol=1e-6)
    i, j = np.triu_indices(len(points), 1)
    apart = [np.linalg.norm(one.points[i] - one.points[j], axis=1) for one in (held, network)]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-8)
    # the network neither shifts nor rotates against the given points; its scale is the wand's
    away = network.points - points
    np.testing.assert_allclose(away.mean(axis=0), 0, atol=1e-12)
    centred = points - points.mean(axis=0)
    np.testing.assert_allclose(np.cross(centred, away).sum(axis=0), 0, atol=1e-6)
    # and its points' variance is the least of all datums
    assert np.trace(network.precision.points.sum(axis=0)) < np.trace(held.precision.points.sum(axis=0))
    control = ObjectPoints.fixed(points[:4]) + ObjectPoints.free(points[4:])
    by_control = solve(replace(problem, cameras=free_cameras, points=control), SHARP)
    assert by_control.redundancy > network.redundancy


def test_without_a_length_the_network_keeps_the_given_size():
    _, points, problem = waved(frames=30)
    cameras = tuple(replace(one, held=False) for one in problem.cameras)
    sizeless = Problem(cameras, problem.observations, ObjectPoints.free(1.1 * points), datum="points")
    done = solve(sizeless)
    assert np.sum(1.1 * points * (done.points - 1.1 * points)) == pytest.approx(0, abs=1e-3)
    with pytest.raises(CalibrationError, match="nothing fixes 7 of"):
        solve(replace(sizeless, datum="given"))
    with pytest.raises(CalibrationError, match=r"nothing fixes 1 .*size.*length"):
        solve(replace(sizeless, datum="given", cameras=problem.cameras))
    with pytest.raises(CalibrationError, match="datum 'points'"):
        solve(replace(sizeless, cameras=problem.cameras))


def test_one_length_gives_the_scale():
    _, points, problem = waved(frames=30)
    one = Distances(problem.distances.first[:1], problem.distances.second[:1], [0.5], [1e-5])
    done = solve(replace(problem, distances=one))
    assert np.linalg.norm(done.points[0] - done.points[1]) == pytest.approx(0.5, abs=1e-7)
    np.testing.assert_allclose(done.points, points, atol=0.02)


def test_a_parameter_that_the_data_leave_open_is_named_and_held():
    # all points in a narrow cone round the axis: nothing shows k3
    pose = looking_at([3, 0, 1], [0, 0, 1])
    camera = Camera("far", WIDTH, HEIGHT, OpenCVLens(1000, 1000, 639.5, 511.5), pose)
    rng = np.random.default_rng(6)
    points = rng.uniform(-0.15, 0.15, (80, 3)) * [4, 1, 1] + [0, 0, 1]
    xy = cv2_pixels(camera, points) + rng.normal(0, 0.2, (80, 2))
    see = Observations(np.zeros(80), np.arange(80), xy, sigma_px=0.2)
    unknowns = CameraUnknowns(camera, ("f_px", "k1", "k2", "k3"))
    done = solve(Problem((unknowns,), see, ObjectPoints.fixed(points)))
    assert "far.k3" in done.held
    assert "far.f_px" not in done.held
    assert done.converged
    assert abs(done.cameras[0].lens.k3) < 3
    creeping = solve(Problem((unknowns,), see, ObjectPoints.fixed(points)), BundleSettings(hold_weak=False))
    assert creeping.held == ()
    assert "far.k3" in creeping.weak
    assert abs(creeping.cameras[0].lens.k3) > 10 * abs(done.cameras[0].lens.k3)


def test_an_undetermined_camera_is_named():
    _, _, problem = waved(frames=30)
    see = problem.observations
    few = (see.camera != 3) | (np.cumsum(see.camera == 3) <= 2)
    less = Observations(see.camera[few], see.point[few], see.xy_px[few], sigma_px=0.1)
    # two image points, eight unknowns
    with pytest.raises(CalibrationError, match=r"do not determine.*c3\."):
        solve(replace(problem, observations=less), BundleSettings(hold_weak=False))
    none = see.camera != 3
    with pytest.raises(CalibrationError, match="camera 'c3': no observation"):
        solve(replace(problem, observations=Observations(see.camera[none], see.point[none], see.xy_px[none])))


@pytest.mark.parametrize(
    ("change", "words"),
    [({"free": ("c_mm",)}, "'c_mm' cannot be free"), ({"free": ("f_px", "fx_px")}, "moves fx_px and fy_px together")],
)
def test_a_wrong_unknown_is_refused_in_one_line(change, words):
    with pytest.raises(InputError, match=words) as error:
        CameraUnknowns(ring()[0], **change)
    assert "\n" not in str(error.value)


def test_a_start_from_an_earlier_adjustment_stays_there():
    _, _, problem = waved(frames=30)
    done = solve(problem, SHARP)
    again = solve(problem, SHARP, done)
    assert again.steps <= 1
    np.testing.assert_allclose(again.points, done.points, atol=1e-8)
