"""Quantiles and tails against scipy.stats, beyond the ends of the distributions too; and what starting imports."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.stats

from mosca.data import distributions

P = np.array([1e-12, 1e-6, 1e-3, 0.025, 0.5, 0.975, 1 - 1e-6])
X = np.array([-1.0, 0.0, 1e-3, 0.5, 3.0, 20.0, 200.0, 2000.0])
DOF = np.array([1, 2, 3, 10, 59, 1000])[:, None]
CASES = (
    [("chi2", name, P, (DOF,)) for name in ("ppf", "isf")]
    + [("chi2", "sf", X, (DOF,)), ("norm", "ppf", P, ()), ("norm", "isf", P, ()), ("norm", "sf", X, ())]
    + [("norm", "cdf", X, ()), ("norm", "cdf", X, (1.0, 2.0)), ("t", "ppf", P, (DOF,)), ("t", "sf", X, (DOF,))]
    + [("f", "sf", X, (DOF, below)) for below in (1, 3, 100)]
    + [("binom", "sf", np.arange(-2, 25), (20, p)) for p in (0.0, 0.01, 0.5, 0.99, 1.0)]
    + [("binom", "sf", np.array([-0.5, 0.5, 19.5]), (20, 0.3))]
    + [("poisson", "isf", P, (mean,)) for mean in (0.0, 1e-3, 0.5, 5.0, 300.0, 1e6)]
)


@pytest.mark.parametrize(("kind", "what", "at", "parameters"), CASES)
def test_values_are_those_of_scipy(kind, what, at, parameters):
    found = getattr(getattr(distributions, kind), what)(at, *parameters)
    np.testing.assert_allclose(found, getattr(getattr(scipy.stats, kind), what)(at, *parameters), rtol=1e-12, atol=0)


def test_a_run_starts_without_packages_that_take_long_to_import():
    heavy = ("scipy.stats", "scipy.signal", "trimesh", "networkx", "blosc2", "control")
    code = (
        f"import sys, scenarios.run.scenario, scenarios.run.folder; print([n for n in {heavy} if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
