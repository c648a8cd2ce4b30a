"""What reading and writing files and assembling frames cost, beside what is wanted of them.

``python tests/benchmarks/bench_files.py`` prints processor times: tracks of 50,000 rows to .csv and back, a motion
of 2,751 frames (from ``MOSCA_DATA``, where it is there), 2,000 frame sets of four cameras.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mosca.data.frames import CameraInfo, Frame
from mosca.data.motion.asf import read_asf_amc
from mosca.data.tracks import Tracks
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.formats.tracks.tracks_file import write_tracks
from mosca.synchronisation import assemble

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"


def best(work, rounds=3):
    """Return the least processor time of some rounds [s]."""
    seconds = []
    for _ in range(rounds):
        start = time.thread_time()
        work()
        seconds.append(time.thread_time() - start)
    return min(seconds)


def many_tracks(n_frames, n_tracks):
    frame = np.repeat(np.arange(n_frames), n_tracks)
    n, rng = n_frames * n_tracks, np.random.default_rng(0)
    half = rng.normal(0, 1e-4, (n, 3, 3))
    return Tracks(
        frame=frame, time_ns=frame * 10_000_000, track=np.tile(np.arange(n_tracks), n_frames),
        label=np.full(n, ""), xyz=rng.normal(0, 2, (n, 3)), covariance=half @ half.transpose(0, 2, 1),
        n_cameras=np.full(n, 4), residual_px=rng.uniform(0, 1, n), status=np.full(n, "measured"),
    )  # fmt: skip


def four_cameras(pulses):
    image = np.zeros((2, 2), dtype=np.uint8)
    for pulse in range(pulses):
        for k in range(4):
            yield Frame(f"c{k}", pulse, pulse * 10_000_000, 1_000_000, image, "ok", note="")


def main():
    """Print a line a piece of work."""
    tracks = many_tracks(1000, 50)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tracks.csv"
        told("write 50,000 rows of tracks.csv", best(lambda: write_tracks(tracks, path, 100)), 1.5)
        told("read them", best(lambda: read_tracks_csv(path)), 1.5)
    frames, infos = list(four_cameras(2000)), tuple(CameraInfo(f"c{k}", 2, 2, 8, 100.0) for k in range(4))
    told("assemble 2,000 sets of 4 frames", best(lambda: sum(1 for _ in assemble(frames, infos))), 0.12)
    asf, amc = DATA / "asfamc/01/01.asf", DATA / "asfamc/01/01_01.amc"
    if not asf.exists():
        sys.exit("no motion read: set MOSCA_DATA")
    told("read a motion of 2,751 frames", best(lambda: read_asf_amc(asf, amc)), 1.0)


def told(what, seconds, wanted):
    print(f"{what}: {seconds:.3f} s of a processor ({wanted:g} wanted)")


if __name__ == "__main__":
    main()
