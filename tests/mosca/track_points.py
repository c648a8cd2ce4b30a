"""Points as the tracker gets them, made up for its tests."""

import numpy as np

from mosca.data.tracks import Points


def points(xyz, cameras=4, sigma=2e-4):
    xyz = np.asarray(xyz, float).reshape(-1, 3)
    n = len(xyz)
    return Points(
        xyz,
        np.tile(sigma**2 * np.eye(3), (n, 1, 1)),
        np.full(n, cameras),
        np.full(n, 0.05),
        np.zeros((n, 4)),
        np.full(n, 0.01),
        np.full(n, cameras),
    )
