"""The filter of late poses against one batch solution, matrix exponentials, and poses in another order."""

import itertools

import numpy as np
import pytest
from scipy.linalg import expm

from mosca.machines.closed_loop.input_integral import InputIntegral
from mosca.machines.closed_loop.late_pose_filter import LatePoseFilter, MotionNoise

NOISE = MotionNoise(0.3, 0.7)
SIGMA = (0.05, 0.4)


@pytest.mark.parametrize("dt_s", [0.005, 0.01, 0.05, 0.3])
def test_a_step_is_van_loans_integral(dt_s):
    """Transition and process covariance by the matrix exponential of Van Loan (1978)."""
    a = 1 / NOISE.correlation_s
    drift = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -a]])
    diffusion = np.diag([0, 0, 2 * a * NOISE.acceleration_mps2**2])
    big = expm(np.block([[-drift, diffusion], [np.zeros((3, 3)), drift.T]]) * dt_s)
    transition, process = NOISE.step(dt_s)
    np.testing.assert_allclose(transition, big[3:, 3:].T, atol=1e-12)
    np.testing.assert_allclose(process, big[3:, 3:].T @ big[:3, 3:], rtol=0.011)


def test_white_noise_of_the_input_is_added():
    _, quiet = NOISE.step(0.02)
    _, noisy = MotionNoise(0.3, 0.7, white=0.1).step(0.02)
    h = 0.02
    np.testing.assert_allclose(noisy[:2, :2] - quiet[:2, :2], 0.01 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]))


def test_inputs_are_integrated_across_their_changes():
    """Hand numbers: 2 m/s^2 for 0.5 s, then -1 m/s^2 for 1 s, from rest."""
    inputs = InputIntegral()
    inputs.append(1.0, np.array([2.0, 0, 0]))
    inputs.append(1.5, np.array([-1.0, 0, 0]))
    way, speed = inputs.effect(1.0, 2.5)
    assert speed[0] == pytest.approx(0.0)
    assert way[0] == pytest.approx(0.25 + 1.0 - 0.5)
    way, speed = inputs.effect(1.25, 1.75)
    assert speed[0] == pytest.approx(0.25)
    assert way[0] == pytest.approx(0.5 * 2 * 0.0625 + 0.5 * 0.25 - 0.5 * 0.0625)
    with pytest.raises(ValueError, match="order of time"):
        inputs.append(1.2, np.zeros(3))


def scene(seed):
    """Return stamps, positions, covariances, and inputs (time, value), all random: any numbers must do."""
    random = np.random.default_rng(seed)
    stamps = np.cumsum(random.uniform(0.008, 0.05, 12))
    halves = random.normal(size=(12, 3, 3))
    covariances = 1e-4 * (np.eye(3) + 0.3 * halves @ halves.transpose(0, 2, 1))
    inputs = [(0.02 * k, random.normal(size=3)) for k in range(40)]
    return stamps, random.normal(scale=0.05, size=(12, 3)), covariances, inputs


def filtered(stamps, positions, covariances, inputs, order):
    one = LatePoseFilter(NOISE, 0.0, np.zeros(3), np.zeros(3), SIGMA)
    for time_s, value in inputs:
        one.inputs.append(time_s, value)
    for k in order:
        assert one.fuse(float(stamps[k]), positions[k], covariances[k])
    return one


def batch(stamps, positions, covariances, inputs, until_s):
    """Return mean (9,) and covariance (9, 9) at ``until_s``: one Gaussian conditional over all instants at once.

    The prior over the states at all stamps is built from the matrix exponential, the known input by fine quadrature.
    """
    a = 1 / NOISE.correlation_s
    drift = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -a]])
    diffusion = np.diag([0, 0, 2 * a * NOISE.acceleration_mps2**2])
    times = [0.0, *stamps, until_s]
    fine = np.linspace(0, until_s, 200001)
    value = np.array([v for _, v in inputs])[np.searchsorted([t for t, _ in inputs], fine, side="right") - 1]
    h = fine[1]
    speed = np.vstack([np.zeros(3), np.cumsum(h * value[:-1], axis=0)])
    way = np.vstack([np.zeros(3), np.cumsum(h * (speed[:-1] + speed[1:]) / 2, axis=0)])
    mean, cov = [np.zeros(9)], np.diag(np.repeat([SIGMA[0] ** 2, SIGMA[1] ** 2, NOISE.acceleration_mps2**2], 3))
    joint = cov
    last = cov
    for before, after in itertools.pairwise(times):
        big = expm(np.block([[-drift, diffusion], [np.zeros((3, 3)), drift.T]]) * (after - before))
        phi = np.kron(big[3:, 3:].T, np.eye(3))
        q = np.kron(big[3:, 3:].T @ big[:3, 3:], np.eye(3))
        cross = phi @ joint[-9:]
        last = phi @ last @ phi.T + q
        joint = np.block([[joint, cross.T], [cross, last]])
    for time_s in times[1:]:
        k = round(time_s / h)
        mean.append(np.concatenate([way[k], speed[k], np.zeros(3)]))
    mean = np.concatenate(mean)
    rows = np.concatenate([9 * (k + 1) + np.arange(3) for k in range(len(stamps))])
    noise = np.zeros((len(rows), len(rows)))
    for k, one in enumerate(covariances):
        noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = one
    gain = joint[:, rows] @ np.linalg.inv(joint[np.ix_(rows, rows)] + noise)
    found = mean + gain @ (positions.ravel() - mean[rows])
    covariance = joint - gain @ joint[rows]
    return found[-9:], covariance[-9:, -9:]


def test_it_is_the_batch_solution_and_the_order_of_arrival_does_not_matter():
    given = scene(3)
    until_s = float(given[0][-1]) + 0.06
    wanted, covariance = batch(*given, until_s)
    late = [0, 2, 1, 3, 6, 4, 5, 7, 8, 11, 10, 9]
    for order in (range(12), late):
        one = filtered(*given, order)
        found = one.at(until_s)
        np.testing.assert_allclose(np.concatenate(found[:3]), wanted, atol=2e-5)
        np.testing.assert_allclose(found.covariance, covariance, rtol=0.02, atol=1e-7)
        np.testing.assert_allclose(one.mean_at(until_s).ravel(), wanted, atol=2e-5)
    assert filtered(*given, late).log_likelihood == pytest.approx(filtered(*given, range(12)).log_likelihood)


def test_a_pose_older_than_what_is_remembered_is_refused():
    one = LatePoseFilter(NOISE, 0.0, np.zeros(3), np.zeros(3), SIGMA, memory_s=0.1)
    for k in range(1, 40):
        assert one.fuse(0.01 * k, np.zeros(3), np.eye(3) * 1e-6)
    assert not one.fuse(0.1, np.ones(3), np.eye(3) * 1e-6)
    assert one.refused == 1
