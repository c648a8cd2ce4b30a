"""Tracks for tests, made of what a test says of them."""

import numpy as np

from mosca.data.tracks import Tracks


def measured_tracks(frame, track, xyz, *, label=None, sigma_m=1e-3):
    """Return measured samples (n,) at 100 Hz, four cameras, known to ``sigma_m`` on each axis; default: no labels."""
    frame, n = np.asarray(frame, dtype=int), len(frame)
    return Tracks(
        frame, frame * 10_000_000, track, np.full(n, "") if label is None else label, xyz,
        np.tile(sigma_m**2 * np.eye(3), (n, 1, 1)), np.full(n, 4), np.full(n, 0.1), np.full(n, "measured"),
    )  # fmt: skip
