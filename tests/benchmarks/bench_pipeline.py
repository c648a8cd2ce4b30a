"""From frames in memory to tracked points with covariance: rate, latency, and whether what comes out is right.

Run: ``python tests/benchmarks/bench_pipeline.py [--markers 200] [--cameras 4] [--sets 300]``. The twin renders the
frames ahead (200 markers, 656 x 491 pixels, four cameras on a ring); the pipeline then runs on them as fast as it
can, by full scan and with regions that its tracks predict, with the settings that meet the accuracy bars; and once
paced at 100 sets a second, for the latency. Accuracy is scored against the truth in the same run.
"""

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from mosca.data.frames import CameraInfo, Frame
from mosca.data.tracks import table
from mosca.pipeline import PipelineSettings, run
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.score.tracks import metrics, pair
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario


class Held:
    """Frames in memory as a source; ``rate_hz``: its frame rate (None: without waiting).

    ``polls``: waits for the time of a frame by polling, as drivers do where latency is more important than a core.
    """

    def __init__(
        self, frames: list[Frame], cameras: tuple[CameraInfo, ...], rate_hz: float | None = None, polls: bool = False
    ) -> None:
        self.cameras, self._frames, self._rate_hz, self._polls = cameras, frames, rate_hz, polls

    def __iter__(self) -> Iterator[Frame]:
        start, many = time.perf_counter(), len(self.cameras)
        for k, frame in enumerate(self._frames):
            if self._rate_hz is not None and k % many == 0:
                due = start + (k // many) / self._rate_hz
                while (wait := due - time.perf_counter()) > 0:
                    time.sleep(0.0 if self._polls else wait)
            yield frame

    def close(self) -> None:
        pass

    def __enter__(self) -> "Held":
        return self

    def __exit__(self, *exc: object) -> None:
        pass


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--markers", type=int, default=200)
    asked.add_argument("--cameras", type=int, default=4)
    asked.add_argument("--sets", type=int, default=300)
    asked.add_argument("--rounds", type=int, default=3)
    given = asked.parse_args()
    path = find("points_200")
    spec = load_scenario(
        path,
        (
            f"scene.markers={given.markers}",
            f"cameras.count={given.cameras}",
            f"capture.duration_s={given.sets / 100}",
        ),
    )
    rig = true_rig(spec, path.parent)
    virtual = virtual_cameras(spec, rig)
    source = twin_source(spec, build_scene(spec, path.parent), virtual, 2)
    start = time.perf_counter()
    frames = list(source)
    truth = source.truth()
    print(f"rendered {len(frames)} frames in {time.perf_counter() - start:.1f} s")
    believed = calibrated(spec, virtual).rig
    settings = pipeline_settings(spec)
    together = replace(settings, detection=replace(settings.detection, split_pairs=True))
    for name, chosen in {**modes(settings), "pairs fitted together, 1 thread": together}.items():
        best = np.inf
        for _ in range(given.rounds):
            start = time.perf_counter()
            steps = list(run(Held(frames, source.cameras), believed, chosen))
            best = min(best, time.perf_counter() - start)
        told(name, best, steps, truth, spec)
    for split, polls in ((1, False), (2, False), (1, True), (2, True)):
        divided = replace(settings, split=split)
        steps = list(run(Held(frames, source.cameras, 100.0, polls), believed, divided))
        late = 1e3 * np.quantile([sum(step.seconds.values()) for step in steps[20:]], [0.5, 0.99, 1.0])
        print(
            f"at 100 sets/s from a source that {'polls' if polls else 'sleeps'}, cameras of a set on {split} "
            f"thread{'s' * (split > 1)}: latency p50 {late[0]:.2f}, "
            f"p99 {late[1]:.2f}, max {late[2]:.2f} ms"
        )


def modes(settings: PipelineSettings) -> dict[str, PipelineSettings]:
    """Return the settings that are compared."""
    return {"full scan, 1 thread": settings, "full scan, 2 threads": replace(settings, workers=1)}


def told(name: str, seconds: float, steps: list, truth: object, spec: object) -> None:
    """Print one mode's line."""
    tracks = table([step.samples for step in steps])
    space = max(spec.working_space.size_m)
    scores = {k: s.value for k, s in metrics(pair(tracks, truth, space), space).items()}
    stages = {}
    for step in steps:
        for stage, value in step.seconds.items():
            stages[stage] = stages.get(stage, 0.0) + value
    print(
        f"{name}: {len(steps) / seconds:.0f} sets/s ({1e3 * seconds / len(steps):.2f} ms a set); "
        + ", ".join(f"{stage} {1e3 * value / len(steps):.3f}" for stage, value in stages.items())
        + f" ms; rms {1e3 * scores['position_rms']:.4f} mm, completeness {scores['completeness']:.4f}, "
        f"ghosts {scores['ghosts_per_frame']:.4f}, switches {scores['identity_switches']:.0f}, "
        f"nees {scores['nees']:.2f}, coverage {scores['coverage95']:.3f}"
    )


if __name__ == "__main__":
    main()
