"""The lens that is adjusted is that of projection; normal equations and covariances are those of a
dense Jacobian made by finite differences, for every lens model and every kind of unknown.
"""

from dataclasses import fields, replace

import numpy as np
import pytest
from bundle_scenes import HEIGHT, WIDTH
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import looking_at
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.kernels import imaged
from mosca.calibration.bundle.layout import layout_of
from mosca.calibration.bundle.lenses import FOLD, IMAGED, L, image, lens_row
from mosca.calibration.bundle.levenberg_marquardt import empty_normals, first_state, moved, reduced
from mosca.calibration.bundle.normals import linearise
from mosca.calibration.bundle.priors import LensPrior, free_lens_parameters, pulls
from mosca.calibration.bundle.rotations import observed_blocks
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
from mosca.calibration.bundle.tables import Loss
from mosca.camera.lens_models import fisheye as fisheye_model
from mosca.camera.lens_models import mosca as mosca_model
from mosca.camera.lens_models import opencv as opencv_model
from mosca.camera.lens_models.arrays import pixels
from mosca.camera.projection import project
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose

LENSES = [
    OpenCVLens(1000, 1004, 640, 510, -0.2, 0.08, 1e-3, -5e-4, -0.01),
    OpenCVLens(
        900, 905, 640, 510, -0.1, 0.02, 1e-3, -5e-4, 0.01, 0.05, -0.02, 0.01, 1e-3, -2e-3, 5e-4, 1e-3, 0.02, -0.01
    ),
    MoscaLens(9.0, 640, 510, 0.01, 0.0101, -0.006, 8e-4, -1.8e-5, 3e-7, 2.8e-4, 4.5e-5),
    FisheyeLens(600, 602, 641, 509, -0.02, 0.004, -0.001, 0.0002),
]


@given(
    lens=st.sampled_from(LENSES),
    x=st.floats(-3, 3),
    y=st.floats(-3, 3),
    # nearer to 90 degrees the powers of x / z in a lens lose more digits than the tolerance has
    z=st.one_of(st.floats(-1, -1e-2), st.floats(1e-2, 3), st.just(1.0)),
)
@settings(max_examples=400, deadline=None)
def test_the_lens_that_is_adjusted_is_that_of_projection(lens, x, y, z):
    # the adjustment leaves out OpenCV's seldom used terms and brackets the fold; projection has its exact root
    pixel, by_direction, by_lens = pixels(lens, np.array([[x, y, z]]))
    out = np.zeros((2, IMAGED))
    seen = image(lens_row(lens, ()), x, y, z, out)
    assert seen == np.isfinite(pixel).all()
    if seen:
        n = by_lens.shape[2]
        scale = np.abs(by_lens[0]).max(axis=0) + 0.1
        np.testing.assert_allclose(out[:, 0], pixel[0], rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(out[:, 1:4], by_direction[0], rtol=1e-8, atol=1e-8 * np.abs(by_direction).max())
        used = slice(0, n if lens != LENSES[0] else 9)
        assert np.all(np.abs(out[:, L : L + n] - by_lens[0])[:, used] < 1e-8 * scale[used])


@pytest.mark.parametrize("lens", LENSES)
def test_slopes_by_the_lens_are_those_of_finite_differences(lens):
    v = np.random.default_rng(7).uniform(-0.45, 0.45, (40, 3)) + [0, 0, 1.5]
    _, _, by_lens = pixels(lens, v)
    for k, field in enumerate(fields(lens)):
        value = getattr(lens, field.name)
        h = 1e-5 * max(abs(value), 1e-2)
        plus, minus = (pixels(replace(lens, **{field.name: value + s * h}), v)[0] for s in (1, -1))
        numeric = (plus - minus) / (2 * h)
        np.testing.assert_allclose(by_lens[:, :, k], numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize(
    ("lens", "fold"),
    [
        (OpenCVLens(1, 1, 0, 0, -0.3), opencv_model.fold_r2),
        (OpenCVLens(1, 1, 0, 0, 0.1, -0.05, 0, 0, -0.01, 0.02), opencv_model.fold_r2),
        (MoscaLens(9, 0, 0, 0.01, 0.01, 0, -2e-3), mosca_model.fold_mm2),
        (FisheyeLens(1, 1, 0, 0, -0.2, 0.01), fisheye_model.fold_rad2),
        (OpenCVLens(1, 1, 0, 0, 0.1), opencv_model.fold_r2),
    ],
)
def test_the_fold_is_where_the_lens_model_has_it(lens, fold):
    assert lens_row(lens, ())[FOLD] == pytest.approx(fold(lens), rel=1e-12)


FEW = [("f_px", "k1"), ("fx_px", "fy_px", "tauX"), ("c_mm", "K1_per_mm2"), ("f_px", "k2")]


def everything(seed=0, free=None) -> Problem:
    """Return a problem with every kind of unknown and of knowledge, all residuals large."""
    rng = np.random.default_rng(seed)
    free = free or [
        ("f_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"),
        ("fx_px", "fy_px", "k1", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"),
        ("c_mm", "xp_px", "yp_px", "my_mm_per_px", "a", "K1_per_mm2", "K2_per_mm4", "K3_per_mm6", "P1_per_mm"),
        ("f_px", "cx_px", "cy_px", "k1", "k2", "k3", "k4"),
    ]
    cameras = []
    for k, lens in enumerate(LENSES):
        a = k * np.pi / 2 + 0.3
        pose = looking_at([2.5 * np.cos(a), 2.5 * np.sin(a), 1.5 + 0.2 * k], [0, 0, 1])
        cameras.append(CameraUnknowns(Camera(f"c{k}", WIDTH, HEIGHT, lens, pose), free[k]))
    pose = looking_at([1.5, 1.5, 2.4], [0, 0, 1])
    again = Camera("again", WIDTH, HEIGHT, LENSES[0], pose)
    cameras.append(CameraUnknowns(again, ("f_px", "k1"), held=True))
    # 0-7 free, 8-11 weighted, 12-14 fixed, 15-20 wands (two of two, free), 21-24 on a thing, weighted; 25 held on it
    xyz = rng.uniform(-0.5, 0.5, (21, 3)) + [0, 0, 1]
    shape = rng.uniform(-0.2, 0.2, (5, 3))
    covariance = np.array([np.diag([1e-4, 4e-4, 9e-4]) + 5e-5] * 4)
    points = (
        ObjectPoints.free(xyz[:8])
        + ObjectPoints.weighted(xyz[8:12], covariance)
        + ObjectPoints.fixed(xyz[12:15])
        + ObjectPoints.free(xyz[15:])
        + ObjectPoints.weighted(shape[:4], 0.01)
        + ObjectPoints.fixed(shape[4:])
    )
    rods = Distances([15, 17, 12, 21], [16, 18, 19, 22], [0.4, 0.5, 0.6, 0.2], [0.01, 0.02, 0.01, 0.01])
    poses = [
        Pose(Rotation.random(random_state=k).as_matrix(), rng.uniform(-0.3, 0.3, 3) + [0, 0, 1]) for k in range(3)
    ]
    rows = [(c, p, -1) for c in range(5) for p in range(21)]
    rows += [(c, p, f) for c in range(5) for p in range(21, 26) for f in range(3)]
    rows = [row for row in rows if rng.random() < 0.9]
    camera, point, placement = np.array(rows).T
    world = points.xyz[point].copy()
    for f, one in enumerate(poses):
        world[placement == f] = one.transform(world[placement == f])
    xy = np.array([project(cameras[c].camera, x[None])[0] for c, x in zip(camera, world, strict=True)])
    seen = np.isfinite(xy).all(axis=1)
    xy = xy[seen] + rng.normal(0, 2.0, (seen.sum(), 2))
    sigma_px = rng.uniform(0.5, 2.0, seen.sum())
    see = Observations(camera[seen], point[seen], xy, placement[seen], sigma_px)
    # begin beside the given values, so that what is known beforehand pulls
    return Problem(tuple(cameras), see, points, Placements.of(poses), rods)


def dense(problem, layout, state, priors=()):
    """Return the residuals and their Jacobian by finite differences of the residuals, in standard deviations.

    Columns: the reduced system's, then the blocks'.
    """
    unknowns, blocks = len(layout.names), int(layout.blocks.size.sum())
    small = {"K1_per_mm2": 1e-8, "K2_per_mm4": 1e-9, "K3_per_mm6": 1e-11, "my_mm_per_px": 1e-7, "P1_per_mm": 1e-7}
    steps = np.full(unknowns + blocks, 1e-6)
    for k, name in enumerate(layout.names):
        own = name.split(".")[-1]
        steps[k] = small.get(own, 1e-3 if own.endswith("_px") else 1e-4 if own in ("k3", "k4") else 1e-6)

    def residuals(at):
        cameras, points, _ = at
        pixel = np.empty((len(layout.order), 2))
        imaged(at, layout.observations, pixel)
        parts = [(pixel * layout.observations.weight[:, None]).ravel()]
        for one in priors:
            parts.append([(cameras[one.camera, 12 + one.parameter] - one.value) / one.sigma])
        if problem.points.information is not None:
            for k, information in enumerate(problem.points.information):
                if information.any():
                    parts.append(np.linalg.cholesky(information).T @ (points[k] - problem.points.xyz[k]))
        rods = problem.distances
        length = np.linalg.norm(points[rods.first] - points[rods.second], axis=1)
        parts.append((length - rods.length_m) / rods.sigma_m)
        return np.concatenate(parts)

    def stepped(k, by):
        step = np.zeros(unknowns + blocks)
        step[k] = by
        group = np.where(layout.index >= 0, np.append(step[:unknowns], 0)[layout.index], 0.0)
        return residuals(moved(layout, state, group, step[unknowns:]))

    columns = [(stepped(k, h) - stepped(k, -h)) / (2 * h) for k, h in enumerate(steps)]
    return residuals(state), np.column_stack(columns)


def disturbed(problem, layout, state, seed=5):
    rng = np.random.default_rng(seed)
    group = np.zeros(layout.index.shape)
    cameras = len(problem.cameras)
    group[:cameras, :6] = rng.normal(0, 0.01, (cameras, 6)) * (layout.index[:cameras, :6] >= 0)
    group[cameras:, :3] = rng.normal(0, 0.01, (len(layout.kept), 3))
    return moved(layout, state, group, rng.normal(0, 0.01, int(layout.blocks.size.sum())))


def test_normal_equations_of_every_kind_of_unknown():
    problem = everything()
    layout = layout_of(problem)
    state = disturbed(problem, layout, first_state(problem, layout))
    priors = tuple(
        LensPrior(column, camera, parameter, 0.9 * state.cameras[camera, 12 + parameter], 3.0)
        for column, camera, parameter in free_lens_parameters(layout)[:2]
    )
    residuals, jacobian = dense(problem, layout, state, priors)
    normals = empty_normals(layout)
    cost, unseen = linearise(
        state, layout.observations, layout.columns, layout.blocks, layout.known, Loss(0, 1.0), normals
    )
    cost += observed_blocks(state, layout.blocks, layout.known, normals)
    pull, more = pulls(problem, layout, priors, state)
    assert unseen == 0
    assert cost + more == pytest.approx(residuals @ residuals, rel=1e-10)
    matrix, slope = reduced(layout, normals, pull, 0.0, np.empty_like(normals.blocks))
    u = len(layout.names)
    full, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
    block_inverse = np.linalg.inv(full[u:, u:])
    want = full[:u, :u] - full[:u, u:] @ block_inverse @ full[u:, :u]
    scale = np.sqrt(np.diag(want))
    np.testing.assert_allclose(matrix / np.outer(scale, scale), want / np.outer(scale, scale), atol=1e-5)
    want_slope = gradient[:u] - full[:u, u:] @ block_inverse @ gradient[u:]
    np.testing.assert_allclose(slope / scale, want_slope / scale, atol=1e-5 * np.abs(want_slope / scale).max())
    # the names identify the unknowns
    assert layout.names[:7] == (
        *(f"c0.{n}" for n in ("turn_x_rad", "turn_y_rad", "turn_z_rad", "X_m", "Y_m", "Z_m")),
        "c0.f_px",
    )
    assert [name for name in layout.names if name.startswith("again.")] == ["again.f_px", "again.k1"]


@pytest.mark.parametrize("robust", [(0, 1.0), (1, 4.0), (2, 4.0)])
def test_what_a_camera_does_not_image_costs_and_pulls_nothing(robust):
    problem = everything()
    layout = layout_of(problem)
    state = disturbed(problem, layout, first_state(problem, layout))
    # some points far behind one camera or another, one in a camera, one nowhere
    rng = np.random.default_rng(3)
    state[1][:6] = rng.normal(0, 6.0, (6, 3))
    state[1][6], state[1][7] = state[0][0, 9:12], np.nan
    residual = np.empty((len(layout.order), 2))
    imaged(state, layout.observations, residual)
    seen = np.isfinite(residual).all(axis=1)
    assert 5 < (~seen).sum() < len(seen) / 2
    found = []
    for weight in (layout.observations.weight, np.where(seen, layout.observations.weight, 0.0)):
        normals = empty_normals(layout)
        see = layout.observations._replace(weight=weight)
        cost, unseen = linearise(state, see, layout.columns, layout.blocks, layout.known, Loss(*robust), normals)
        np.testing.assert_allclose(
            normals.residuals_px, np.where(seen[:, None], residual, np.nan), rtol=1e-9, atol=1e-9
        )
        found.append((cost, unseen, normals))
    (cost, unseen, whole), (other, none, part) = found
    assert (unseen, none) == ((~seen).sum(), 0)
    each = {0: 2e6, 1: 4 * np.sqrt(2e6) - 4, 2: 4 * np.log1p(2e6 / 4)}[robust[0]]
    assert cost == pytest.approx(other + unseen * each, rel=1e-12)
    for one, two in zip(whole[:6], part[:6], strict=True):
        assert np.isfinite(one).all()
        np.testing.assert_array_equal(one, two)


def test_covariances_and_redundancy_numbers_are_those_of_the_dense_inverse():
    problem = everything(free=FEW)
    done = solve(problem, BundleSettings(tolerance=1e-6, hold_weak=False))
    layout = layout_of(problem)
    from mosca.calibration.bundle.solver import _state_of

    state = _state_of(problem, layout, done)
    residuals, jacobian = dense(problem, layout, state)
    u, n = len(layout.names), len(layout.order)
    scale = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    redundancy = len(residuals) - jacobian.shape[1]
    assert done.redundancy == redundancy
    assert done.cost == pytest.approx(residuals @ residuals, rel=1e-9)
    variance = done.cost / redundancy
    assert done.sigma0 == pytest.approx(np.sqrt(variance))
    sigma = np.sqrt(variance * np.diag(inverse))
    np.testing.assert_allclose(list(done.standard_deviations.values()), sigma[:u], rtol=2e-3)
    np.testing.assert_allclose(
        done.precision.covariance / np.outer(sigma[:u], sigma[:u]),
        variance * inverse[:u, :u] / np.outer(sigma[:u], sigma[:u]),
        atol=2e-3,
    )
    at = u
    for point in layout.members:
        np.testing.assert_allclose(
            done.precision.points[point], variance * inverse[at : at + 3, at : at + 3], rtol=5e-3, atol=1e-9
        )
        at += 3
    for placement in layout.placed:
        own = np.sqrt(np.diag(done.precision.placements[placement]))
        np.testing.assert_allclose(
            done.precision.placements[placement] / np.outer(own, own),
            variance * inverse[at : at + 6, at : at + 6] / np.outer(own, own),
            atol=5e-3,
        )
        at += 6
    hat = np.einsum("ij,jk,ik->i", jacobian[: 2 * n], inverse, jacobian[: 2 * n])
    numbers = np.empty((n, 2))
    numbers[layout.order] = 1 - hat.reshape(-1, 2)
    np.testing.assert_allclose(done.precision.redundancy_numbers, numbers, atol=1e-4)
    whitened = done.residuals_px / problem.observations.sigma_px[:, None]
    np.testing.assert_allclose(
        done.precision.standardised, whitened / np.sqrt(variance * numbers), rtol=1e-2, atol=1e-3
    )
