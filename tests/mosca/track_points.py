"""Points and tracks made up for tests, and a tracker's run over them."""

import numpy as np

from mosca.data.tracks import Points, Tracks, table
from mosca.tracking.tracker import Tracker, TrackSettings

STEP_NS = 10_000_000


def points(xyz, cameras=4, sigma=2e-4):
    xyz = np.asarray(xyz, float).reshape(-1, 3)
    n = len(xyz)
    covariance = np.tile(sigma**2 * np.eye(3), (n, 1, 1))
    each = np.full(n, cameras)
    return Points(xyz, covariance, each, np.full(n, 0.05), np.zeros((n, 4)), np.full(n, 0.01), each)


def made_tracks(frame, track, xyz, sigma=2e-4, **columns):
    """Tracks of 100 Hz, measured and without labels unless ``columns`` say otherwise."""
    n = len(frame)
    usual = {
        "time_ns": np.asarray(frame) * STEP_NS, "label": np.full(n, ""), "n_cameras": np.full(n, 4),
        "covariance": np.tile(sigma**2 * np.eye(3), (n, 1, 1)), "residual_px": np.full(n, 0.05),
        "status": np.full(n, "measured"),
    }  # fmt: skip
    return Tracks(frame=frame, track=track, xyz=xyz, **(usual | columns))


def follow(frames, tracker=None):
    """The tracks of ``frames``: a Points each 10 ms."""
    tracker, samples = tracker or Tracker(TrackSettings()), []
    for k, p in enumerate(frames):
        tracker.predict(k * STEP_NS * 1e-9)
        samples.append(tracker.update(p, k, k * STEP_NS))
    return table(samples)
