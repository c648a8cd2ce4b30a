"""Cameras' clocks: unknowns that are estimated, and unknowns that the data do not determine.

Gauge: the first camera's offset and drift are zero (a common shift of time is unobservable); its row time is free.
Every unknown has the a-priori standard deviation ``BEFORE``. If the data do not reduce it by a factor of
``LEAST_GAIN`` or more, the unknown is held at its value and reported.
"""

import numpy as np

from mosca.continuous.estimator.state import StateLayout
from mosca.continuous.model.estimated import Clock
from mosca.data.arrays import Array

BEFORE = (0.1, 1e-3, 1e-4)
"""Standard deviations before any data: offset [s], drift, row time [s/px]."""
LEAST_GAIN = 5.0
"""A clock counts as unobserved if the observations did not reduce its prior standard deviation by this factor."""
KINDS = ("offset", "drift", "row time")
FREE = {"known": 0, "offset": 1, "drift": 2, "rolling": 3}


def free_unknowns(clocks: str, cameras: int) -> Array:
    """Return the mask (cameras, 3) of offsets, drifts and row times that are estimated."""
    free = np.zeros((cameras, 3), dtype=bool)
    free[:, : FREE[clocks]] = True
    free[0, :2] = False
    return free


def undetermined_clocks(places: StateLayout, covariance: Array) -> Array:
    """Return the mask (cameras, 3) of free unknowns that the data do not determine, from the covariance of the
    shared.
    """
    sigma = np.sqrt(np.append(np.diag(covariance), 0.0))[places.clock]
    return np.asarray((places.clock >= 0) & (sigma > np.array(BEFORE) / LEAST_GAIN))


def prior(places: StateLayout, clocks: Array) -> tuple[Array, Array]:
    """Return the a-priori precision (b,) of the shared unknowns, and their right side at ``clocks``."""
    precision, right = np.zeros(places.shared), np.zeros(places.shared)
    for c, kind in zip(*np.nonzero(places.clock >= 0), strict=True):
        at = places.clock[c, kind]
        precision[at] = BEFORE[kind] ** -2
        right[at] = -clocks[c, kind] * precision[at]
    return precision, right


def results(
    names: tuple[str, ...], places: StateLayout, clocks: Array, covariance: Array, held: Array
) -> list[Clock]:
    """Return the cameras' clocks with standard deviations."""
    sigma = np.where(places.clock >= 0, np.sqrt(np.append(np.diag(covariance), 0.0))[places.clock], 0.0)
    result = []
    for c, name in enumerate(names):
        (offset, drift, row), (of_offset, of_drift, of_row) = clocks[c].tolist(), sigma[c].tolist()
        kept = tuple(kind for kind, is_held in zip(KINDS, held[c], strict=True) if is_held)
        result.append(Clock(name, offset, drift, row, of_offset, of_drift, of_row, kept))
    return result


def findings(names: tuple[str, ...], held: Array) -> list[str]:
    """Return one line for each unknown that was held."""
    return [
        f"camera '{name}': its {kind} cannot be told from this motion and is held (motion must turn or speed up "
        "while seen by several cameras)"
        for c, name in enumerate(names)
        for kind, is_held in zip(KINDS, held[c], strict=True)
        if is_held
    ]
