"""Coded targets: sizes, centres, false identifications, time.

Run: ``python tests/benchmarks/bench_coded.py [TABLE ...]``, of ``time``, ``sizes``, ``centres``, ``clutter``.

All plates are rendered by the twin (656 x 491, f = 1000 px, 8 bit), facing the camera or turned away in all
directions. ``sizes``: the smallest dot of which 99 % are read, by contrast over noise (that of a white pixel), blur
and tilt; body shake and lens gap of the defaults. ``centres``: their errors by dot size, tilt and blur at a read
noise of 10 electrons and a full well of 20,000, and without noise (12 bit), against the truth and the twin's
eccentricity; steady camera. ``clutter``: 10,000 views without a target, read in both colours. ``time``: one
thread (time of its own), targets of 6 to 20 px in two sizes of image.
"""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "mosca"))

from coded_clutter import KINDS, view
from coded_views import View, paint

from mosca.camera.eccentricity import eccentricity_px
from mosca.coded_targets.detect import CodedSettings, find_coded
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.found_targets import CodedDetections
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.data.targets import CodedTarget, PlacedTarget, TestField
from mosca.detection.detect import detect
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.emission import Glow
from twin.scenes.field_layout import LaidOutField
from twin.scenes.target_field import field_scene
from twin.scenes.target_motion import standing
from twin.source import TwinSource

WIDTH, HEIGHT, FOCAL_PX, DOT_RADIUS_M = 656, 491, 1000.0, 0.005
SIGNAL_E = 0.6 * 20_000
SIZES = {0: (4, 4.5, 5, 5.5, 6, 7, 8, 10, 14), 30: (4.5, 5, 5.5, 6, 7, 8, 10, 14), 60: (7, 8, 9, 10, 11, 12, 14, 20)}


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


@dataclass(frozen=True)
class Rendering:
    """What is rendered: dots of ``dot_px`` (facing), tilt, blur; the read noise is that of ``snr``, or 10 electrons.

    ``noise`` False: none, in 12 bits. ``steady``: without shake and lens gap.
    """

    dot_px: float
    tilt_deg: float
    blur_px: float = 0.6
    snr: float | None = None
    seed: int = 0
    noise: bool = True
    steady: bool = True
    vignetting: float = 0.0
    most: int = 60


def rendered(what: Rendering) -> tuple[CodedDetections, TestField, Array, Array]:
    """Return the detections, the field, its true image points (n, 2) and its eccentricities (n, 2) [px]."""
    rng = np.random.default_rng([what.seed, int(10 * what.dot_px), int(what.tilt_deg)])
    field, _ = plates(what.dot_px, what.tilt_deg, rng)
    some = np.sort(rng.permutation(len(field.targets))[: what.most])
    field = TestField(tuple(field.targets[k] for k in some))
    scene = field_scene(
        LaidOutField(field, ()), standing(np.zeros(3)), 1.0, origin=np.zeros(3), glow=Glow(), floor=False
    )
    lens = OpenCVLens(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    camera = Camera("c", WIDTH, HEIGHT, lens, Pose(np.eye(3), np.zeros(3)))
    read_e = 10.0 if what.snr is None else float(np.sqrt((SIGNAL_E / what.snr) ** 2 - SIGNAL_E - 200))
    sensor = Sensor(read_noise_e=read_e)
    if not what.noise:
        sensor = Sensor(read_noise_e=0.0, full_well_e=1e9, background_e=1e7, bits=12)
    optics = Optics(psf_sigma_px=what.blur_px, vignetting=what.vignetting)
    eye = VirtualCamera(camera, optics, sensor=sensor)
    if what.steady:
        eye = VirtualCamera(camera, replace(optics, gap_px=0.0), Timing(jitter_s=0.0), Mount(body_px=0.0), sensor)
    source = TwinSource(scene, (eye,), frame_rate_hz=10.0, exposure_s=1e-3, pulses=1, seed=what.seed)
    (frame,) = source
    truth = source.truth()
    assert frame.image is not None
    settings = CodedSettings() if what.noise else CodedSettings(read_noise_dn=0.0, gain_dn_per_e=0.0)
    found = find_coded(frame.image, "c", settings, sensor.bits)
    true = truth.image_xy_px[0, [truth.names.index(name) for name in field.names], 0]
    normals = np.array([placed.normal for placed in field.targets])
    return found, field, true, eccentricity_px(camera, field.positions, normals, DOT_RADIUS_M)


def centre_errors(what: Rendering) -> tuple[Array, float]:
    """Return the centres' errors (n, 2) without eccentricity, and their standard deviation as reported [px]."""
    found, field, true, off = rendered(what)
    index = [field.names.index(f"code/{number:03d}") for number in found.number]
    sigma = np.sqrt(np.trace(found.covariance_px2, axis1=1, axis2=2).mean() / 2) if len(found) else np.nan
    return found.xy_px - true[index] - off[index], float(sigma)


def read_field(what: Rendering) -> tuple[int, int, int]:
    """Return how many targets there are, were read and were misread."""
    found, field, true, _ = rendered(what)
    right = 0
    for number, xy in zip(found.number, found.xy_px, strict=True):
        name = f"code/{number:03d}"
        right += name in field.names and np.linalg.norm(xy - true[field.names.index(name)]) < what.dot_px
    return len(field.names), right, len(found) - right


def print_sizes() -> None:
    """Print the smallest dots of which 99 % are read."""
    print("\nsmallest dot read at 99 % [px, facing] (its shorter axis), and misread of all:")
    for tilt, sizes in SIZES.items():
        for snr in (100.0, 50.0, 10.0):
            row = []
            for blur in (0.4, 0.6, 0.9, 1.3):
                smallest, wrong_in_all, total = np.nan, 0, 0
                for size in sorted(sizes, reverse=True):
                    parts = [
                        read_field(Rendering(size, tilt, blur, snr, seed, steady=False, most=100))
                        for seed in range(2)
                    ]
                    n, right, wrong = (sum(part[k] for part in parts) for k in range(3))
                    wrong_in_all, total = wrong_in_all + wrong, total + n
                    if right < 0.99 * n:
                        break
                    smallest = size
                short = smallest * np.cos(np.deg2rad(tilt))
                row.append(f"blur {blur:g}: {smallest:4g} ({short:4.1f}) {wrong_in_all}/{total}")
            print(f"tilt {tilt:2d} SNR {snr:4g}  " + "   ".join(row), flush=True)


def print_centres() -> None:
    """Print the centres' errors by size, tilt and blur."""
    print("\ncentres, rms px: with noise, as reported, without noise")
    for vignetting, blur in ((0.0, 0.4), (0.0, 0.6), (0.0, 0.9), (0.3, 0.6)):
        for tilt in (0.0, 30.0, 60.0):
            for size in (4.5, 5.0, 6.0, 8.0, 10.0, 14.0, 20.0, 30.0):
                what = Rendering(size, tilt, blur, vignetting=vignetting)
                seeds = range(1 if size < 16 else 3)
                parts = [centre_errors(replace(what, seed=seed)) for seed in seeds]
                errors = np.concatenate([part[0] for part in parts])
                bias = np.concatenate([centre_errors(replace(what, seed=s, noise=False))[0] for s in seeds])
                if len(errors) < 20 * (size < 20) + 6 or not len(bias):
                    continue
                rms, still = (np.sqrt(np.mean(e**2)) for e in (errors, bias))
                print(
                    f"vignetting {vignetting:g} blur {blur:g} tilt {tilt:2g} dot {size:4g}: "
                    f"{rms:.4f} {parts[0][1]:.4f} {still:.4f}  ({len(errors)})",
                    flush=True,
                )


def print_clutter(views: int = 10_000, seed: int = 1) -> None:
    """Print the false identifications among views without a target."""
    false, settings = dict.fromkeys((kind.__name__ for kind in KINDS), 0), CodedSettings(colour="both")
    for index in range(views):
        found = find_coded(view(index, seed), "c", settings)
        false[KINDS[index % len(KINDS)].__name__] += len(found) + len(found.twice)
    total = sum(false.values())
    bound = f"upper 95 % bound {1 - 0.05 ** (1 / views):.1e} a view" if total == 0 else "not none"
    print(f"\nclutter: {total} false in {views} views, {bound}; by kind {false}")


def painted_field(height: int, width: int, count: int) -> Array:
    """Return an image of at most ``count`` targets of 6 to 20 px, as many as fit, tilted up to 57 deg."""
    rng = np.random.default_rng(1)
    columns = int(np.ceil(np.sqrt(count * width / height)))
    cell = np.array([width / columns, height / np.ceil(count / columns)])
    views = []
    for k, number in enumerate(rng.permutation(507)[:count]):
        row, column = divmod(k, columns)
        at = ((column + 0.5) * cell[0], (row + 0.5) * cell[1])
        size = min(rng.uniform(6, 20), cell.min() / 5.2)
        views.append(View(int(number), at, size, rng.uniform(0, 1), *rng.uniform(0, 6.28, 2)))
    return paint((height, width), views, rng=rng, noise=1.0, samples=4)


def print_times(rounds: int = 30) -> None:
    """Print the time of one image."""
    cv2.setNumThreads(1)
    for height, width, count in ((HEIGHT, WIDTH, 100), (HEIGHT, WIDTH, 150), (1200, 1664, 100), (1200, 1664, 150)):
        image = painted_field(height, width, count)
        works = {
            "find_coded": lambda image=image: find_coded(image, "c"),
            "find_coded, dots to 25 px": lambda image=image: find_coded(image, "c", CodedSettings(maximum_dot_px=25)),
            "detect (for comparison)": lambda image=image: detect(image, "c"),
        }
        print(f"\n{count} targets in {width} x {height}:                 best ms   median ms")
        for name, work in works.items():
            result: CodedDetections | Detections = work()
            taken = []
            for _ in range(rounds):
                start = time.thread_time()
                result = work()
                taken.append(1e3 * (time.thread_time() - start))
            print(f"{name:30s} {len(result):4d} found {min(taken):8.2f} {np.median(taken):9.2f}")


def main() -> None:
    """Print the tables named on the command line, or all."""
    wanted = sys.argv[1:] or ["time", "sizes", "centres", "clutter"]
    tables = {"time": print_times, "sizes": print_sizes, "centres": print_centres, "clutter": print_clutter}
    for name in wanted:
        tables[name]()


if __name__ == "__main__":
    main()
