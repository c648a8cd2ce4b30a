"""Speed of the virtual cameras. Run: ``python tests/benchmarks/bench_render.py``.

Whole frames of TwinSource: motion, occlusion, blur, light, noise. The actor with 50 markers before 4 cameras of
656 x 491, 2 workers; then cost by markers, cameras and pixels, 1 worker; beside it mujoco.Renderer at four times
the size, averaged to pixels: no blur over the exposure, no noise, no distortion. Times are the best of several
rounds; "work" is the time of all cores together, which others on the machine disturb less. The rounds' spread and a
fixed loop before and after tell how quiet it was.
"""

import ctypes.util
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl" if ctypes.util.find_library("EGL") else "osmesa")

import cv2
import mujoco
import numpy as np

from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.scenario import Scenario, load_scenario
from twin.scenes.cloud import build_cloud
from twin.scenes.scene import Scene
from twin.source import TwinSource

ACTOR = Path(__file__).parents[2] / "scenarios" / "library" / "subjects" / "actor.toml"
ROUNDS = 4
ASKED_SETS_PER_S = 100.0
SIZES = ((656, 491), (1936, 1216), (4096, 3000), (4920, 3264))


@dataclass(frozen=True)
class Times:
    """Seconds a frame of each round, and seconds of all cores' work a frame in the best of them by that."""

    rounds: tuple[float, ...]
    work: float

    @property
    def best(self) -> float:
        """The best round [s]."""
        return min(self.rounds)

    @property
    def spread(self) -> float:
        """How much longer the worst round took, relative."""
        return max(self.rounds) / self.best - 1


def times(work: Callable[[], int], rounds: int = ROUNDS) -> Times:
    """Return the time per frame of ``work``, which returns its number of frames; after one round of warm-up."""
    work()
    taken, worked = [], []
    for _ in range(rounds):
        start, before = time.perf_counter(), time.process_time()
        frames = work()
        taken.append((time.perf_counter() - start) / frames)
        worked.append((time.process_time() - before) / frames)
    return Times(tuple(taken), min(worked))


def source_of(spec: Scenario, scene: Scene, pulses: int, workers: int) -> TwinSource:
    """Return the scenario's cameras before a scene."""
    capture = spec.capture.model_copy(update={"duration_s": pulses / spec.capture.frame_rate_hz})
    spec = spec.model_copy(update={"capture": capture, "seed": 1})
    return twin_source(spec, scene, virtual_cameras(spec, true_rig(spec, ACTOR.parent)), workers)


def with_cameras(spec: Scenario, **changes: Any) -> Scenario:
    """Return the scenario with other cameras: evenly spaced ones, all as high."""
    given = {"azimuth_deg": None, "height_m": 1.6, **changes}
    return spec.model_copy(update={"cameras": spec.cameras.model_copy(update=given)})


def cloud(n: int) -> Scene:
    """Return n markers in the person's working space."""
    return build_cloud(
        duration_s=5.0,
        box_center_m=np.array([0.0, 0.0, 1.25]),
        box_size_m=np.full(3, 2.2),
        rng=np.random.default_rng(1),
        n=n,
        marker_diameter_m=0.014,
        speed_mps=0.5,
    )


def of_source(source: TwinSource) -> Times:
    """Return the time a frame of a source, all its frames read."""
    with source:
        return times(lambda: sum(1 for _ in source))


def quiet() -> float:
    """Return how much longer a fixed loop of about a second took than it worked: 1 on a quiet machine."""
    image = np.random.default_rng(0).random((491, 656))
    start, before = time.perf_counter(), time.process_time()
    for _ in range(400):
        np.sort(image, axis=1)
    return (time.perf_counter() - start) / (time.process_time() - before)


def exponent(sizes: list[float], seconds: list[float]) -> float:
    """Return the slope of log time over log size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def actor(spec: Scenario) -> float:
    """Print frame sets a second of the actor; return the time a frame with one worker [s]."""
    scene = build_scene(spec, ACTOR.parent)
    count = len(source_of(spec, scene, 1, 1).virtual)
    alone = 0.0
    for workers in (1, 2):
        found = of_source(source_of(spec, scene, 60, workers))
        rate = 1 / (found.best * count)
        ratio = rate / ASKED_SETS_PER_S
        print(
            f"actor, {len(scene.marker_names)} markers, {count} cameras, {workers} workers: "
            f"{rate:6.1f} frame sets/s, {1e3 * found.best:.2f} ms a frame "
            f"({1e3 * found.work:.2f} ms of work), {ratio:.2f} of the {ASKED_SETS_PER_S:.0f} asked for; spread "
            f"{100 * found.spread:.0f} %"
        )
        alone = alone or found.best
    return alone


def by_gl(spec: Scenario, alone: float) -> None:
    """Print what mujoco.Renderer takes for a frame of the actor."""
    if not (ctypes.util.find_library("EGL") or ctypes.util.find_library("OSMesa")):
        print("mujoco.Renderer: no system OpenGL here (libegl1 libopengl0 libgl1-mesa-dri, or libosmesa6)")
        return
    model = build_scene(spec, ACTOR.parent).model
    width, height = spec.cameras.size_px
    model.vis.global_.offwidth, model.vis.global_.offheight = 4 * width, 4 * height
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = mujoco.MjvCamera()
    view.distance, view.elevation, view.lookat[:] = spec.cameras.radius_m, -10.0, (0.0, 0.0, 0.9)
    with mujoco.Renderer(model, 4 * height, 4 * width) as renderer:

        def frame() -> int:
            mujoco.mj_kinematics(model, data)
            renderer.update_scene(data, view)
            fine = renderer.render()[:, :, 0]
            cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
            return 1

        found = times(frame, 8)
    print(
        f"mujoco.Renderer, {4 * width} x {4 * height} averaged: {1e3 * found.best:.1f} ms a frame, "
        f"{found.best / alone:.1f} x the twin with one worker; spread {100 * found.spread:.0f} %"
    )


def table(title: str, rows: Mapping[int, Times] | Mapping[float, Times], per: str) -> None:
    """Print times a frame by size, and the exponents of the whole table and of its larger half."""
    print(f"\n{title:>10s}   ms a frame      work   spread   {per}")
    for size, found in rows.items():
        print(
            f"{size:10g} {1e3 * found.best:12.2f} {1e3 * found.work:9.2f} {100 * found.spread:7.0f} % "
            f"{1e6 * found.best / size:12.2f}"
        )
    sizes, seconds = list(rows), [found.work for found in rows.values()]
    half = len(sizes) // 2
    print(
        f"work grows with the power {exponent(sizes, seconds):.2f} of it; from {sizes[half]:g} on with "
        f"{exponent(sizes[half:], seconds[half:]):.2f}"
    )


def main() -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    before, load = quiet(), os.getloadavg()[0]
    spec = load_scenario(ACTOR)
    alone = actor(spec)
    by_gl(spec, alone)

    rows = {n: of_source(source_of(spec, cloud(n), max(4, 600 // n), 1)) for n in (10, 30, 100, 300, 1000)}
    table("markers", rows, "us a marker")

    scene, rows = cloud(50), {}
    for count in (1, 2, 4, 8, 16):
        # a rig has two cameras at least: one camera is the first of two
        source = source_of(with_cameras(spec, count=max(2, count)), scene, 24, 1)
        if count == 1:
            source = TwinSource(
                scene,
                source.virtual[:1],
                frame_rate_hz=spec.capture.frame_rate_hz,
                exposure_s=spec.capture.exposure_s,
                pulses=24,
                seed=1,
            )
        found = of_source(source)
        rows[count] = Times(tuple(count * t for t in found.rounds), count * found.work)
    table("cameras", rows, "us a camera, of a whole frame set")

    by_size = {}
    for size in SIZES:
        pitch = spec.cameras.pixel_pitch_mm * 656 / size[0]  # the same view on finer pixels
        finer = with_cameras(spec, count=4, size_px=size, pixel_pitch_mm=pitch)
        pulses = 24 if size[0] < 1000 else 3
        by_size[size[0] * size[1] / 1e6] = of_source(source_of(finer, scene, pulses, 1))
    table("megapixels", by_size, "us a megapixel")

    after = quiet()
    print(
        f"\nquiet check: a fixed loop took {before:.2f} x its own work before and {after:.2f} x after (1: quiet); "
        f"load {load:.1f} before, {os.getloadavg()[0]:.1f} after, {os.cpu_count()} cores"
    )


if __name__ == "__main__":
    main()
