"""Poses at other instants than the exposures: closed forms, scipy's rotations, Monte Carlo, a dense solve."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from mosca.data.bodies import BodyPoses
from mosca.rigid_bodies.prediction import BodyPredictor, PredictionSettings
from mosca.tracking.motion_models import motion

PERIOD_NS = 10_000_000


def poses_of(times_ns, rotations, xyz, sigma_m=1e-6, sigma_rad=1e-6, status="measured"):
    """Poses of one body as the tracker gives them."""
    n = len(times_ns)
    quaternion = rotations.as_quat(scalar_first=True)
    covariance = np.tile(np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3), (n, 1, 1))
    return BodyPoses(
        np.arange(n), np.asarray(times_ns), np.full(n, "cup"), quaternion, xyz, covariance,
        np.full(n, 4), np.zeros(n), np.full(n, status),
    )  # fmt: skip


def angle(one, other):
    return np.linalg.norm((Rotation.from_matrix(one) * other.inv()).as_rotvec())


VELOCITY, TURNING = np.array([1.0, -0.5, 0.2]), np.array([0.8, -2.0, 3.0])
START = Rotation.from_rotvec([0.3, 1.0, -0.4])


def uniform(times_s):
    """A body that moves and turns uniformly: exact by definition."""
    t = np.atleast_1d(times_s)[:, None]
    return Rotation.from_rotvec(TURNING * t) * START, np.array([0.1, 0.2, 1.0]) + VELOCITY * t


@pytest.mark.parametrize("ahead_s", [0.0, 0.007, 0.05, 0.1])
def test_uniform_motion_is_predicted_exactly(ahead_s):
    times = np.arange(60) * PERIOD_NS
    predictor = BodyPredictor(PredictionSettings(acceleration_mps2=1.0, turn_rad_s2=1.0))
    predictor.update(poses_of(times, *uniform(times * 1e-9)))
    at = int(times[-1] + ahead_s * 1e9)
    found = predictor.at(at)
    rotation, xyz = uniform(at * 1e-9)
    assert found.status == "extrapolated"
    assert found.newest_ns == times[-1]
    np.testing.assert_allclose(found.position, xyz[0], atol=2e-5)
    assert angle(found.rotation, rotation[0]) < 2e-5


@pytest.mark.parametrize("at_ns", [300_000_000, 303_000_000, 309_999_999, 585_000_000])
def test_between_two_exposures_uniform_motion_is_exact(at_ns):
    times = np.arange(60) * PERIOD_NS
    predictor = BodyPredictor()
    predictor.update(poses_of(times, *uniform(times * 1e-9)))
    found = predictor.at(at_ns)
    rotation, xyz = uniform(at_ns * 1e-9)
    assert found.status == "interpolated"
    np.testing.assert_allclose(found.position, xyz[0], atol=2e-6)
    assert angle(found.rotation, rotation[0]) < 2e-6


def test_a_pose_beyond_the_horizon_is_held_where_it_ended():
    times = np.arange(30) * PERIOD_NS
    predictor = BodyPredictor(PredictionSettings(horizon_s=0.05))
    predictor.update(poses_of(times, *uniform(times * 1e-9)))
    last = int(times[-1])
    end, after = predictor.at(last + 50_000_000), predictor.at(last + 2_000_000_000)
    assert (end.status, after.status) == ("extrapolated", "stale")
    np.testing.assert_array_equal(after.position, end.position)
    np.testing.assert_array_equal(after.rotation, end.rotation)
    np.testing.assert_allclose(np.linalg.norm(after.position - uniform(last * 1e-9)[1][0]), 0.05 * 1.1358, rtol=1e-2)


def test_a_body_found_just_now_is_told_apart():
    times = np.arange(4) * PERIOD_NS
    predictor = BodyPredictor()
    told = []
    for k in range(4):
        predictor.update(poses_of(times[k : k + 1], *uniform(times[k : k + 1] * 1e-9)))
        told.append(predictor.at(int(times[k]) + 1).status)
    assert told == ["starting", "starting", "extrapolated", "extrapolated"]
    # a gap of more than two horizons begins anew
    late = int(times[-1]) + 250_000_000
    predictor.update(poses_of([late], *uniform(late * 1e-9)))
    assert predictor.at(late).status == "starting"


def test_before_the_first_pose_nothing_is_known():
    predictor = BodyPredictor()
    assert predictor.at(0) is None
    assert predictor.newest() is None
    predictor.update(poses_of([10], *uniform([0.0]), status="withheld"))
    assert predictor.at(20) is None
    predictor.update(poses_of([30], *uniform([0.0])))
    assert predictor.at(20) is None
    assert predictor.at(30) is not None


def test_clocks_that_are_shifted_together_change_nothing():
    times = np.arange(40) * PERIOD_NS
    shift = 1_700_000_000_000_000_000
    here, there = BodyPredictor(), BodyPredictor()
    here.update(poses_of(times, *uniform(times * 1e-9)))
    there.update(poses_of(times + shift, *uniform(times * 1e-9)))
    for at in (205_000_000, int(times[-1]) + 30_000_000):
        np.testing.assert_allclose(there.at(at + shift).position, here.at(at).position, atol=1e-9)


def singer(rng, steps, step_s, memory_s, sigma):
    """Paths (n, 3) with an acceleration of exponential memory: position by fine exact steps of scipy's ``expm``."""
    fine = 8
    f = expm(np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / memory_s]]) * step_s / fine)
    keep = np.exp(-step_s / fine / memory_s)
    state = np.zeros((3, 3))
    state[2] = rng.normal(0, sigma, 3)
    path = []
    for _ in range(steps):
        path.append(state[0].copy())
        for _ in range(fine):
            state = f @ state
            state[2] += rng.normal(0, sigma * np.sqrt(1 - keep**2), 3)
    return np.array(path)


def test_the_stated_covariance_ahead_is_that_of_many_motions():
    rng = np.random.default_rng(3)
    sigma, memory, noise_m, ahead = 8.0, 0.1, 5e-4, 4
    squares = []
    for _ in range(120):
        xyz = singer(rng, 60 + ahead, PERIOD_NS * 1e-9, memory, sigma)
        times = np.arange(60) * PERIOD_NS
        still = Rotation.from_rotvec(rng.normal(0, 2e-3, (60, 3)))
        poses = poses_of(times, still, xyz[:60] + rng.normal(0, noise_m, (60, 3)), noise_m, 2e-3)
        predictor = BodyPredictor(PredictionSettings(acceleration_mps2=sigma, turn_rad_s2=0.25))
        predictor.update(poses)
        found = predictor.at(int(times[-1]) + ahead * PERIOD_NS)
        off = found.position - xyz[59 + ahead]
        squares.append(off @ np.linalg.solve(found.covariance[:3, :3], off))
    # the mean of 120 chi-square values of 3 degrees: 3 +- 0.22 (one sigma)
    assert 2.2 < np.mean(squares) < 3.8


def test_learned_acceleration_and_covariance_follow_the_motion():
    """Process noise is learned: a body shaken hard has a larger one than the same body at rest."""
    rng = np.random.default_rng(5)
    times = np.arange(300) * PERIOD_NS
    still = Rotation.from_rotvec(rng.normal(0, 1e-3, (300, 3)))
    found = []
    for sigma in (0.01, 32.0):
        xyz = singer(rng, 300, PERIOD_NS * 1e-9, 0.1, sigma) + rng.normal(0, 2e-4, (300, 3))
        predictor = BodyPredictor()
        predictor.update(poses_of(times, still, xyz, 2e-4, 1e-3))
        found.append(predictor.strengths[0])
    assert found[0] <= 1.0
    assert 16.0 <= found[1] <= 64.0


@pytest.mark.parametrize(("times_stated", "allowed"), [(1.0, (1.0,)), (4.0, (2.0, 4.0, 8.0))])
def test_errors_that_are_stated_too_small_are_not_taken_for_accelerations(times_stated, allowed):
    """Uniform motion with errors of four times their stated size: their size is learned, and no acceleration."""
    rng = np.random.default_rng(11)
    times = np.arange(300) * PERIOD_NS
    rotations, xyz = uniform(times * 1e-9)
    stated_m, stated_rad = 5e-5, 1e-4
    noisy = xyz + rng.normal(0, times_stated * stated_m, xyz.shape)
    turned = Rotation.from_rotvec(rng.normal(0, times_stated * stated_rad, xyz.shape)) * rotations
    predictor = BodyPredictor()
    predictor.update(poses_of(times, turned, noisy, stated_m, stated_rad))
    assert set(predictor.scales) <= set(allowed)
    assert max(predictor.strengths) <= 1.0
    found = predictor.at(int(times[-1]) + 20_000_000)
    off = found.position - uniform(times[-1] * 1e-9 + 0.02)[1][0]
    # within four standard deviations of what is then stated, along each axis
    assert (np.abs(off) < 4 * np.sqrt(np.diag(found.covariance)[:3])).all()


def test_an_instant_between_is_the_dense_solution_of_the_same_model():
    """Least squares over the joint covariance of the instants (Rasmussen and Williams 2006, eq. 2.25)."""
    rng = np.random.default_rng(9)
    times = np.arange(12) * PERIOD_NS
    noise_m, sigma, speed, memory = 1e-3, 8.0, 3.0, 0.1
    xyz = rng.normal(0, 1e-2, (12, 3))
    at = 53_000_000
    predictor = BodyPredictor(PredictionSettings(acceleration_mps2=sigma))
    predictor.update(poses_of(times, Rotation.from_rotvec(np.zeros((12, 3))), xyz, noise_m))
    found = predictor.at(at)
    # prior of the path: position known badly, velocity and acceleration as the filter's first state
    order = sorted([*times, at])
    states, cross = [np.diag([1e4, speed**2, sigma**2])], {}
    for a, b in pairwise(order):
        m = motion("acceleration", (b - a) * 1e-9, memory)
        f = np.array([[1, m.pv, m.pa], [0, 1, m.va], [0, 0, m.aa]])
        q = sigma**2 * np.array([[m.qpp, m.qpv, m.qpa], [m.qpv, m.qvv, m.qva], [m.qpa, m.qva, m.qaa]])
        cross[b] = f
        states.append(f @ states[-1] @ f.T + q)
    n = len(order)
    joint = np.zeros((n, n))
    for i in range(n):
        walk = np.eye(3)
        for j in range(i, n):
            walk = walk if j == i else cross[order[j]] @ walk
            joint[i, j] = joint[j, i] = (walk @ states[i])[0, 0]
    rows = [k for k, t in enumerate(order) if t != at]
    k = order.index(at)
    gain = np.linalg.solve(joint[np.ix_(rows, rows)] + noise_m**2 * np.eye(12), joint[rows, k])
    np.testing.assert_allclose(found.position, gain @ xyz, atol=1e-6)
    np.testing.assert_allclose(found.covariance[0, 0], joint[k, k] - gain @ joint[rows, k], rtol=1e-2)
