"""Common movement of a segment's markers over the bone, which residuals do not show.

A marker's own movement shows in its residual. The common movement of all markers of a segment, a shift and a turn of
the cluster, looks like a movement of the bone and shows in no residual. Bone pins show that it is the larger part
(Benoit et al. 2015, Camomilla et al. 2017). It is assumed to be COMMON times the markers' own movement, in shift and
in turn alike.
"""

import numpy as np

from mosca.camera.projection import cross_matrices
from mosca.data.arrays import Array

COMMON = 2.0
"""Ratio of the standard deviation of a segment's common movement to the rms of its markers' own movements, which the
fit has already reduced. Variance ratios of 2 to 4 are published; at 1 errors of joints come out a third, at 4 three
times as often covered."""


def common_m(own_m: Array, body: Array) -> Array:
    """Return the common movement (m,) of each marker's segment [m]; ``own_m`` (m,), ``body`` (m,) ids of segments."""
    return np.asarray(COMMON * np.sqrt([np.mean(own_m[body == b] ** 2) for b in body]))


def common_modes(local: Array, body: Array, common: Array) -> Array:
    """Return the displacements (m, 3, k) [m] of markers in their bodies' axes as segments shift and turn under skin.

    ``local`` (m, 3) places in the body's axes, ``body`` (m,) ids, ``common`` (m,) from ``common_m``. The coefficient
    of each of the k columns has a standard deviation of 1. Each segment has three shifts and three turns; a turn
    moves the markers by ``common`` in the root mean square over the segment.
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
