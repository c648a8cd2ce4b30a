"""Movement of markers over the bones that residuals do not show: a segment's markers slide together.

A marker's own movement shows in its residual. That of all markers of a segment together, a shift and a turn of the
cluster, looks like a movement of the bone and shows in none; by bone pins it is the larger part (Benoit et al. 2015,
Camomilla et al. 2017). It is taken for COMMON times the segment's own movement, in shift and in turn alike.
"""

import numpy as np

from mosca.camera.projection import cross_matrices
from mosca.data.arrays import Array

COMMON = 2.0
"""Standard deviation of a segment's common movement against the rms of its markers' own, which the fit has already
reduced. Variance ratios of 2 to 4 are published; at 1 errors of joints come out a third, at 4 three times as often
covered."""


def common_m(own_m: Array, body: Array) -> Array:
    """Return the common movement (m,) of each marker's segment [m]; ``own_m`` (m,), ``body`` (m,) ids of segments."""
    return np.asarray(COMMON * np.sqrt([np.mean(own_m[body == b] ** 2) for b in body]))


def common_modes(local: Array, body: Array, common: Array) -> Array:
    """Return how markers move in their bodies' axes as segments shift and turn over skin, (m, 3, k) [m].

    ``local`` (m, 3) places in the body's axes, ``body`` (m,) ids, ``common`` (m,) as ``common_m``. Each of the k
    columns has a standard deviation of 1: three shifts and three turns of each segment, a turn such that it moves
    the markers by ``common`` in the root mean square over the segment.
    """
    columns = []
    for b in np.unique(body):
        rows = body == b
        arms = local[rows] - local[rows].mean(axis=0)
        radius = np.sqrt(np.mean(np.sum(arms**2, axis=1)) * 2 / 3)
        modes = np.zeros((len(local), 3, 6))
        modes[rows, :, :3] = np.eye(3)
        if radius > 0:
            modes[rows, :, 3:] = -cross_matrices(arms / radius)
        columns.append(modes * common[rows][0])
    return np.concatenate(columns, axis=2)
