"""Coded targets: sizes, false identifications, time. Run: ``python tests/benchmarks/bench_coded.py [TABLE ...]``.

``sizes``: plates rendered by the twin at many distances (656 x 491, f = 1000 px, optics of sigma 0.6 px, 8 bit, body
shake and lens gap of the defaults), facing the camera or turned away by 60 deg in all directions, with read noise
that makes the contrast 50 or 10 times the noise of a white pixel. ``clutter``: 10,000 views without a target, read
in both colours. ``time``: one thread, 100 targets in 656 x 491.
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "mosca"))

from coded_clutter import KINDS, view
from coded_views import View, paint

from mosca.coded import CodedSettings, find_coded
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.found_targets import CodedDetections
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.data.targets import CodedTarget, PlacedTarget, TestField
from mosca.detect import detect
from mosca.eccentricity import eccentricity_px
from twin.cameras.camera import VirtualCamera
from twin.cameras.sensor import Sensor
from twin.scenes.field_layout import LaidOutField
from twin.scenes.glow import Glow
from twin.scenes.target_field import field_scene
from twin.scenes.target_motion import standing
from twin.source import TwinSource

WIDTH, HEIGHT, FOCAL_PX, DOT_RADIUS_M = 656, 491, 1000.0, 0.005
SIGNAL_E = 0.6 * 20_000
SIZES = {0: (3.5, 4, 4.5, 5, 5.5, 6, 7, 8, 10, 14), 60: (6, 7, 8, 9, 10, 11, 12, 14, 20)}
FRAMES = 4


def plates(dot_px: float, tilt_deg: float, rng: np.random.Generator) -> tuple[TestField, float]:
    """Return a field that fills the image, in the camera's axes, and its distance [m].

    ``dot_px``: image diameter of a dot that faces the camera.
    """
    z = 2 * DOT_RADIUS_M * FOCAL_PX / dot_px
    cell = 5.6 * dot_px + 4
    columns, rows = int(WIDTH / cell), int(HEIGHT / cell)
    targets = []
    for k, number in enumerate(rng.permutation(507)[: columns * rows]):
        row, column = divmod(k, columns)
        image = np.array([(column + 0.5) * cell, (row + 0.5) * cell]) + rng.uniform(-0.5, 0.5, 2)
        place = np.array([*(image - [WIDTH / 2, HEIGHT / 2]) * z / FOCAL_PX, z])
        side, roll = rng.uniform(0, 2 * np.pi, 2)
        back = -place / np.linalg.norm(place)
        across = np.cross(back, [np.cos(side), np.sin(side), 0.0])
        across /= np.linalg.norm(across)
        tilt = np.deg2rad(tilt_deg)
        normal = np.cos(tilt) * back + np.sin(tilt) * across
        u = np.cross(normal, back if tilt_deg else [1.0, 0.0, 0.0])
        u /= np.linalg.norm(u)
        x_axis = np.cos(roll) * u + np.sin(roll) * np.cross(normal, u)
        target = CodedTarget.of_dot(int(number), DOT_RADIUS_M)
        targets.append(PlacedTarget(target.name, target, place, normal, x_axis))
    return TestField(tuple(targets)), z


def read_field(dot_px: float, tilt_deg: float, snr: float, seed: int) -> tuple[int, int, int, Array]:
    """Return how many targets there are, were read and were misread, and the centres' errors (n, 2) [px]."""
    rng = np.random.default_rng([seed, int(10 * dot_px), int(tilt_deg)])
    field, _ = plates(dot_px, tilt_deg, rng)
    scene = field_scene(
        LaidOutField(field, ()), standing(np.zeros(3)), 1.0, origin=np.zeros(3), glow=Glow(), floor=False
    )
    lens = OpenCVLens(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    camera = Camera("c", WIDTH, HEIGHT, lens, Pose(np.eye(3), np.zeros(3)))
    noise = np.sqrt((SIGNAL_E / snr) ** 2 - SIGNAL_E - 200)
    eye = VirtualCamera(camera, sensor=Sensor(read_noise_e=float(noise)))
    source = TwinSource(scene, (eye,), frame_rate_hz=10.0, exposure_s=1e-3, pulses=1, seed=seed)
    (frame,) = source
    truth = source.truth()
    assert frame.image is not None
    found: CodedDetections = find_coded(frame.image, "c")
    names = [placed.name for placed in field.targets]
    off = eccentricity_px(camera, field.positions, np.array([p.normal for p in field.targets]), DOT_RADIUS_M)
    right, wrong, errors = 0, 0, []
    for number, xy in zip(found.number, found.xy_px, strict=True):
        name = f"code/{number:03d}"
        true = truth.image_xy_px[0, truth.names.index(name), 0] if name in names else np.full(2, np.inf)
        if np.linalg.norm(xy - true) < dot_px:
            right += 1
            errors.append(xy - true - off[names.index(name)])
        else:
            wrong += 1
    return len(names), right, wrong, np.array(errors).reshape(-1, 2)


def print_sizes() -> None:
    """Print the share of targets read by size, tilt and noise."""
    for tilt, sizes in SIZES.items():
        for snr in (50.0, 10.0):
            print(
                f"\ntilt {tilt} deg, SNR {snr:g}: dot px (ring px)   read of   share   misread   centre rms px"
            )
            for size in sizes:
                parts = [read_field(size, tilt, snr, seed) for seed in range(FRAMES)]
                n, right, wrong = (sum(part[k] for part in parts) for k in range(3))
                errors = np.concatenate([part[3] for part in parts])
                rms = f"{np.sqrt(np.mean(errors**2)):.4f}" if len(errors) else "-"
                share = right / n
                print(f"{size:24g} ({3 * size:g}) {right:8d} {n:5d} {share:8.4f} {wrong:6d} {rms:>12}")


def print_clutter(views: int = 10_000, seed: int = 1) -> None:
    """Print the false identifications among views without a target."""
    false, settings = dict.fromkeys((kind.__name__ for kind in KINDS), 0), CodedSettings(colour="both")
    for index in range(views):
        found = find_coded(view(index, seed), "c", settings)
        false[KINDS[index % len(KINDS)].__name__] += len(found) + len(found.twice)
    total = sum(false.values())
    bound = f"upper 95 % bound {1 - 0.05 ** (1 / views):.1e} a view" if total == 0 else "not none"
    print(f"\nclutter: {total} false in {views} views, {bound}; by kind {false}")


def print_times(rounds: int = 60) -> None:
    """Print the time of one image."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    views = [
        View(
            int(number),
            ((k % 12 + 0.7) * 54, (k // 12 + 0.5) * 54),
            8.0,
            rng.uniform(0, 1),
            *rng.uniform(0, 6.28, 2),
        )
        for k, number in enumerate(rng.permutation(507)[:100])
    ]
    image = paint((HEIGHT, WIDTH), views, rng=rng, noise=1.0, samples=4)
    works = {
        "find_coded": lambda: find_coded(image, "c"),
        "find_coded, dots to 25 px": lambda: find_coded(image, "c", CodedSettings(maximum_dot_px=25)),
        "find_coded, both colours": lambda: find_coded(image, "c", CodedSettings(colour="both")),
        "detect (for comparison)": lambda: detect(image, "c"),
    }
    print(f"\n100 targets in {WIDTH} x {HEIGHT}:                 best ms   median ms")
    for name, work in works.items():
        result: CodedDetections | Detections = work()
        taken = []
        for _ in range(rounds):
            start = time.perf_counter()
            result = work()
            taken.append(1e3 * (time.perf_counter() - start))
        print(f"{name:30s} {len(result):4d} found {min(taken):8.2f} {np.median(taken):9.2f}")


def main() -> None:
    """Print the tables named on the command line, or all."""
    wanted = sys.argv[1:] or ["time", "sizes", "clutter"]
    tables = {"time": print_times, "sizes": print_sizes, "clutter": print_clutter}
    for name in wanted:
        tables[name]()


if __name__ == "__main__":
    main()
