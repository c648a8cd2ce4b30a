"""Correspondence and triangulation: time by markers and cameras, alone and with tracks that expect their targets.

    python tests/benchmarks/bench_match.py

One core, frames' detections in memory. Times are the least of many calls, of the thread's own time. Beside others:
``bench_match_peers.py``.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "mosca"))
from test_match import detected, members, rig_of

from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import MatchSettings, match
from mosca.data.rays import Predicted

ROOM = (np.full(3, -2.0), np.full(3, 2.0))


def least_ms(work: Callable[[], object], calls: int) -> float:
    """Return the least time of a call, of this thread alone [ms]."""
    work()
    times = []
    for _ in range(calls):
        begin = time.thread_time()
        work()
        times.append(time.thread_time() - begin)
    return 1e3 * min(times)


def scaling() -> None:
    """Print times by markers and by cameras; images of 10 % of the markers missing, 5 % clutter."""
    spent: dict[tuple[int, int], float] = {}
    print("cameras markers   rays ms  match ms  with tracks ms  us a marker  points  wrong")
    settings = MatchSettings(camera_sigma_px=0.0)
    for cameras, markers in [(4, n) for n in (10, 20, 50, 100, 200, 500, 1000)] + [
        (c, 200) for c in (2, 3, 8, 16, 32)
    ]:
        rng = np.random.default_rng(markers + cameras)
        rig, truth = rig_of(cameras), rng.uniform(-0.5, 0.5, (markers, 3))
        found, behind = detected(rig, truth, rng, clutter=markers // 20, miss=0.1)
        bundle = make_ray_table(rig, found, 0.0)
        tracks = Predicted(truth, np.tile(1e-6 * np.eye(3), (markers, 1, 1)))
        calls = 100 if cameras * markers < 2000 else 20
        rays_ms = least_ms(lambda rig=rig, found=found: make_ray_table(rig, found, 0.0), calls)
        alone = least_ms(lambda b=bundle: match(b, Predicted.nothing(), settings, ROOM, 0.014), calls)
        held = least_ms(lambda b=bundle, t=tracks: match(b, t, settings, ROOM, 0.014), calls)
        points = match(bundle, tracks, settings, ROOM, 0.014)
        wrong = sum(len(g) > 1 or -1 in g for g in members(rig, points, behind))
        spent[cameras, markers] = rays_ms + held
        print(
            f"{cameras:7d} {markers:7d} {rays_ms:9.3f} {alone:9.3f} {held:15.3f} "
            f"{1e3 * (rays_ms + held) / markers:12.2f} {len(points):7d} {wrong:6d}"
        )
    print(f"time ~ markers^{exponent([(m, t) for (c, m), t in spent.items() if c == 4 and m >= 50]):.2f} from 50 on")
    print(f"time ~ cameras^{exponent([(c, t) for (c, m), t in spent.items() if m == 200 and c >= 3]):.2f} from 3 on")


def exponent(pairs: list[tuple[int, float]]) -> float:
    """Return the slope of log time over log size."""
    size, ms = np.array(pairs).T
    return float(np.polyfit(np.log(size), np.log(ms), 1)[0])


if __name__ == "__main__":
    scaling()
