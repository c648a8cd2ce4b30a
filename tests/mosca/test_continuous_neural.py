"""The neural trajectory: derivatives against finite differences, fits against truth, controls."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from mosca.continuous.comparison_methods.interpolated import interpolated
from mosca.continuous.comparison_methods.neural import NeuralSettings, neural
from mosca.continuous.comparison_methods.neural_cameras import NetPoses, SteadyPoses, right_jacobians
from mosca.continuous.comparison_methods.neural_net import Nets, Tangent, damped_solve, encoded, fitted
from mosca.continuous.model.camera_paths import StillCameras
from mosca.data.motion.motion import PointMotion
from tests.studies.unsynchronised import observe, score, shared_frames, surround


def packed(nets):
    return np.concatenate([nets.inner.ravel(), nets.bias.ravel(), nets.outer.ravel(), nets.shift.ravel()])


def unpacked(nets, x):
    parts, at = [], 0
    for one in (nets.inner, nets.bias, nets.outer, nets.shift):
        parts.append(x[at : at + one.size].reshape(one.shape))
        at += one.size
    return replace(nets, inner=parts[0], bias=parts[1], outer=parts[2], shift=parts[3])


def jacobian(nets, time_s, onto):
    """Of one network, (q i, weights), by finite differences."""

    def seen(x):
        return np.einsum("qio,qo->qi", onto, unpacked(nets, x).at(time_s)[0]).ravel()

    return approx_fprime(packed(nets), seen, 1e-6)


def test_encoding_is_four_numbers_by_hand():
    half = np.sqrt(0.5)
    assert encoded(np.array([0.0, 0.25, 1.0])) == pytest.approx(
        np.array([[0, 1, 0, 1], [half, half, 1, 0], [0, -1, 0, 1]]), abs=1e-12
    )


def test_kernel_and_step_are_those_of_the_numerical_jacobian():
    rng = np.random.default_rng(5)
    nets = Nets.fresh(1, 3, (1.0, 3.0), 0.2, rng)
    nets = replace(nets, outer=rng.normal(0, 0.2, nets.outer.shape), shift=rng.normal(0, 1, nets.shift.shape))
    t = np.array([1.1, 1.7, 2.2, 2.9])
    onto = rng.normal(size=(4, 2, 3))
    numeric = jacobian(nets, t, onto)
    tangent = Tangent.of(nets, t[None], onto[None])
    assert tangent.kernel()[0] == pytest.approx(numeric @ numeric.T, rel=1e-4, abs=1e-3)
    dual = rng.normal(size=8)
    step = packed(tangent.moved(dual[None])) - packed(nets)
    assert step == pytest.approx(numeric.T @ dual, rel=1e-4, abs=1e-4)


def test_damped_solve_is_numpys():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 6, 6))
    kernel, right = root @ np.swapaxes(root, 1, 2), rng.normal(size=(3, 6, 2))
    damping = np.array([0.1, 1.0, 10.0])
    wanted = np.linalg.solve(kernel + damping[:, None, None] * np.eye(6), right)
    assert damped_solve(kernel, damping, right) == pytest.approx(wanted)


def test_fit_meets_smooth_curves():
    rng = np.random.default_rng(0)
    t = np.linspace(1, 3, 61)
    values = np.stack([np.sin(3 * t)[:, None] * [1, 2, 0] + [0, 0, 5], np.cos(5 * t)[:, None] * [1, 0, 1]])
    holed = values.copy()
    holed[0, 20] = np.nan
    nets = fitted(Nets.fresh(2, 3, (1.0, 3.0), 0.1, rng), t, holed)
    assert nets.at(t) == pytest.approx(values, abs=0.01)
    # the hidden layer alone, frozen at zero, has no effect
    assert np.abs(Nets.fresh(2, 3, (1.0, 3.0), 0.1, rng).at(t)).max() == 0


@pytest.mark.parametrize("size", [1e-6, 0.1, 2.5])
def test_right_jacobian_by_differences(size):
    w = size * np.array([0.6, -0.64, 0.48])

    def turn(x):
        return (Rotation.from_rotvec(w).inv() * Rotation.from_rotvec(w + x)).as_rotvec()

    assert right_jacobians(w[None])[0] == pytest.approx(approx_fprime(np.zeros(3), turn, 1e-6), abs=1e-5)


def path(t):
    vectors = np.column_stack([0.4 * np.sin(2 * t), 0.5 * t, 0.1 * t**2])
    centres = np.column_stack([np.sin(t), np.cos(t), 0.2 * t])
    return Rotation.from_rotvec(vectors).as_matrix()[:, None], centres[:, None]


def test_cameras_as_networks_meet_a_path_and_know_their_slopes():
    t = np.linspace(1, 3, 31)
    rotations, centres = path(t)
    nets = Nets.fresh(6, 1, (1.0, 3.0), 0.3, np.random.default_rng(0))
    cameras = NetPoses.fit(("a",), nets, t, rotations, centres)
    found = cameras.at(t)
    assert found[0] == pytest.approx(rotations, abs=2e-3)
    assert found[1] == pytest.approx(centres, abs=2e-3)
    slopes = cameras.slopes(t)
    unknowns = slopes.shape[3]
    z = np.random.default_rng(1).normal(size=(1, unknowns))
    z *= 1e-5 / np.linalg.norm(z)
    moved = cameras.moved(t, z).at(t)
    wanted = slopes[:, 0] @ z[0]
    turn = Rotation.from_matrix(np.swapaxes(found[0][:, 0], 1, 2) @ moved[0][:, 0]).as_rotvec()
    scale = np.abs(wanted).max()
    assert turn == pytest.approx(wanted[:, :3], abs=0.01 * scale)
    assert moved[1][:, 0] - found[1][:, 0] == pytest.approx(wanted[:, 3:], abs=0.01 * scale)


def test_steady_cameras_move_by_their_slopes():
    rotations, centres = path(np.array([1.0]))
    cameras = SteadyPoses(("a",), rotations[0], centres[0])
    z = np.array([[0.01, -0.02, 0.03, 1.0, 2.0, 3.0]])
    moved = cameras.moved(np.array([1.0]), z)
    turn = Rotation.from_matrix(rotations[0, 0]) * Rotation.from_rotvec(z[0, :3])
    assert moved.rotations[0] == pytest.approx(turn.as_matrix())
    assert moved.centres[0] == pytest.approx(centres[0, 0] + [1, 2, 3])


@pytest.fixture(scope="module")
def fast():
    """Six points in motion that nine frames hardly resolve: 3.5 Hz, alternating cameras."""
    rng = np.random.default_rng(4)
    t = np.arange(150) / 120.0
    middle = rng.uniform([-0.4, -0.4, 0.2], [0.4, 0.4, 1.6], (10, 3))
    phase = rng.uniform(0, 6.3, (10, 3))
    slow = np.sin(2 * np.pi * 0.8 * t[:, None, None] + phase[::-1])
    xyz = middle + 0.1 * np.sin(2 * np.pi * 3.5 * t[:, None, None] + phase) + 0.2 * slow
    truth = PointMotion(tuple(f"p{k}" for k in range(10)), t, xyz)
    rig = surround(truth)
    return truth, rig, observe(truth, rig)


def test_neural_beats_its_start_with_known_cameras(fast):
    truth, rig, see = fast
    frames = shared_frames(see, truth)
    start = interpolated(see, rig)
    found = neural(see, rig, start)
    assert score(found, truth, frames).rms_m < 0.8 * score(start, truth, frames).rms_m
    # and explains the exposures at their own times
    assert found.rms_px < 0.25
    assert np.isnan(found.at(np.array([-1.0, 99.0]))).all()
    other = neural(see, rig, start, settings=NeuralSettings(seed=1))
    assert other.at(truth.time_s[frames]) == pytest.approx(found.at(truth.time_s[frames]), abs=0.02)


@pytest.mark.parametrize("cameras", ["fixed", "moving"])
def test_neural_with_unknown_cameras(fast, cameras):
    truth, rig, see = fast
    frames, still = shared_frames(see, truth), StillCameras.of(rig)
    start = interpolated(see, rig, "cubic", cameras)
    found = neural(see, rig, start, cameras)
    before = score(start, truth, frames, aligned="once", paths=start.paths, true_paths=still)
    after = score(found, truth, frames, aligned="once", paths=found.paths, true_paths=still)
    assert after.rms_m < before.rms_m
    assert after.camera_m < 1.2 * before.camera_m


def test_swapped_epipoles_do_not_fit(fast):
    _, rig, see = fast
    start = interpolated(see, rig, "cubic", "fixed")
    swapped = np.where(see.point == 10, 11, np.where(see.point == 11, 10, see.point))
    wrong = replace(see, point=swapped).only(see.carried_by[swapped] != see.camera)
    right = neural(see, rig, start, "fixed")
    assert neural(wrong, rig, start, "fixed").rms_px > 10 * right.rms_px


def test_shifted_clock_is_felt(fast):
    """Control: one camera's times wrong by a frame and a half; exposures at their own times no longer fit."""
    truth, rig, see = fast
    frames = shared_frames(see, truth)
    late = replace(see, time_s=see.time_s + np.where(see.camera == 1, 1.5 / 120, 0.0))
    good = score(neural(see, rig, interpolated(see, rig)), truth, frames).rms_m
    inner = frames[5:-5]
    assert score(neural(late, rig, interpolated(late, rig)), truth, inner).rms_m > 2 * good


def test_points_are_known_where_the_start_knows_them(fast):
    """One point that a single camera sees, one that is lost after a second: no guesses for either."""
    _, rig, see = fast
    lone = (see.point != 3) | (see.camera == 0)
    kept = see.only(lone & ((see.point != 5) | (see.time_s < 0.8)))
    found = neural(kept, rig, interpolated(kept, rig))
    known = np.isfinite(found.at(np.array([0.4, 1.0]))).all(axis=2)
    assert known[:, 3].tolist() == [False, False]
    assert known[:, 5].tolist() == [True, False]
    assert known[:, [0, 1, 2, 4, 6, 7, 8, 9]].all()
