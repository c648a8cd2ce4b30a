"""Time of tracking a frame set, by markers: ``python tests/benchmarks/bench_track.py``.

Smooth independent paths in a volume that grows with the markers (the same density), every point seen, 100 fps.
Printed: the median and the least of a set's time for predict and update, and what the guide's nearest-neighbour
tracker takes.
"""

import argparse
import time

import numpy as np

from mosca.data.tracks import Points
from mosca.tracking.nearest_neighbour import NearestTracker
from mosca.tracking.tracker import Tracker, TrackSettings

RATE_HZ = 100.0


def paths(markers: int, sets: int, seed: int) -> np.ndarray:
    """Return positions (sets, markers, 3) [m] on smooth paths, about 1 m/s at most."""
    rng = np.random.default_rng(seed)
    side = (markers / 200.0) ** (1 / 3)
    at, phase = rng.uniform(-side, side, (markers, 3)), rng.uniform(0, 2 * np.pi, (markers, 3))
    t = np.arange(sets)[:, None, None] / RATE_HZ
    return at + 0.08 * np.sin(2 * np.pi * 1.2 * t + phase)


def sets_of(markers: int, sets: int) -> list[Points]:
    """Return the points of all sets, with noise, in random order."""
    rng = np.random.default_rng(1)
    covariance = np.tile((3e-4) ** 2 * np.eye(3), (markers, 1, 1))
    result = []
    for xyz in paths(markers, sets, 0):
        order = rng.permutation(markers)
        noisy = (xyz + rng.normal(0, 3e-4, xyz.shape))[order]
        four, one = np.full(markers, 4), np.ones(markers)
        result.append(Points(noisy, covariance, four, 0.05 * one, np.zeros((markers, 4)), 0.01 * one, 4.0 * one))
    return result


def seconds(tracker: Tracker | NearestTracker, frames: list[Points]) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of predict and of update for each set [s]."""
    predict, update = [], []
    for k, points in enumerate(frames):
        a = time.perf_counter()
        tracker.predict(k / RATE_HZ)
        b = time.perf_counter()
        tracker.update(points, k, round(k * 1e9 / RATE_HZ))
        c = time.perf_counter()
        predict.append(b - a)
        update.append(c - b)
    return np.array(predict[20:]), np.array(update[20:])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--markers", type=int, nargs="+", default=[10, 50, 200, 500, 1000])
    parser.add_argument("--sets", type=int, default=300)
    given = parser.parse_args()
    seconds(Tracker(TrackSettings()), sets_of(5, 30))
    print("markers  model         predict ms  update ms  both ms (least)")
    for n in given.markers:
        frames = sets_of(n, given.sets)
        for name, tracker in (
            ("acceleration", Tracker(TrackSettings())),
            ("velocity", Tracker(TrackSettings(model="velocity"))),
            ("no limbs", Tracker(TrackSettings(limb_m=0.0))),
            ("nearest", NearestTracker()),
        ):
            p, u = seconds(tracker, frames)
            both = 1e3 * (p + u)
            print(
                f"{n:7d}  {name:12s}  {1e3 * np.median(p):10.3f} {1e3 * np.median(u):10.3f} "
                f"{np.median(both):8.3f} ({both.min():.3f})"
            )


if __name__ == "__main__":
    main()
