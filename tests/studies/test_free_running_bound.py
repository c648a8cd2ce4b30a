"""The bound of free-running cameras against closed forms."""

import numpy as np
import pytest

from tests.studies.free_running_bound import ANYWHERE_M, least_variance, spectrum


def test_a_point_at_rest_is_known_as_well_as_the_mean_of_its_images():
    rng = np.random.default_rng(1)
    by, sigma = rng.normal(0, 400, (30, 2, 3)), 0.04
    rest = np.array([0.0]), np.array([0.0])
    found = least_variance(
        np.array([0.3]), np.sort(rng.uniform(0, 1, 30)), by, np.tile(sigma**2 * np.eye(2), (30, 1, 1)), rest
    )
    normal = np.einsum("nai,naj->ij", by, by) / sigma**2 + np.eye(3) / ANYWHERE_M**2
    assert found[0] == pytest.approx(np.trace(np.linalg.inv(normal)), rel=1e-3)


def test_a_sinusoid_has_its_variance_at_its_frequency():
    frequency, power = spectrum(lambda t: np.full((2, 3), 0.02 * np.sin(2 * np.pi * 7 * t)), 0.0, 4.0)
    assert power.sum() == pytest.approx(0.02**2 / 2, rel=1e-3)
    assert power[np.abs(frequency - 7) < 1.5].sum() == pytest.approx(power.sum(), rel=1e-6)
