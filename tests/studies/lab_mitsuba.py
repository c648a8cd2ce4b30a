"""Blind labs that Mitsuba plays (``mitsuba_lab``): fit, prediction and measurement of a wand's length error.

``python -m tests.studies.lab_twin --mitsuba --labs 10``. The fit gets the recordings alone. The plan of the
experiment has the lab's rig, wand, path and exposure; its cameras are the fitted ones.
"""

import csv
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.files.rig_file import write_rig
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.recording.writer import RecordingWriter
from scenarios.lab_twin.apply import load_with_lab
from scenarios.lab_twin.fit import FitRequest, fit_lab
from scenarios.lab_twin.lab_file import read_lab
from scenarios.lab_twin.predict import Prediction, predict
from scenarios.run.scenario import run_scenario
from scenarios.score.without_truth import lengths_found
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions
from tests.studies.lab_twin import report
from tests.studies.mitsuba_lab import (
    BALL_M,
    DARK,
    EXPOSURE_S,
    LENGTH_M,
    LIT,
    RATE_HZ,
    SIZE,
    WAND,
    WAND_HZ,
    HiddenCamera,
    Takes,
    by_chance,
    exposed,
    hidden_cameras,
    scale_e,
    scaled,
    takes,
    wand,
    wand_seed,
)
from witness.mitsuba.__main__ import cache_folder
from witness.mitsuba.projection import project_slopes
from witness.mitsuba.scene import FIRST_MID_S, quaternion

Array = np.ndarray[Any, Any]

LIGHT = (0.3, 0.6)
"""Levels of the even surface over the saturation capacity."""
UNEVEN = 0.05
"""Share by which the even surface is brighter on one side, and darker on the other."""
SENSORS = 3
"""Sensors of the same kind, the lab's own first, with which the wand is measured; shake and jitter are the same."""
WAND_DRAW = 5
"""Draw of the noise, other than those of the recordings."""
STEP_S = 1e-4
"""Half the time over which the wand's speed is taken."""

PLAN = """
title = "a wand's length in a lab that Mitsuba plays"
seed = {seed}
model_gap = "none"
[working_space]
center_m = [0.0, 0.0, 0.0]
size_m = [1.2, 1.2, 1.2]
[capture]
duration_s = {seconds}
frame_rate_hz = {rate}
exposure_s = {exposure}
[scene]
kind = "own"
model = "wand.xml"
markers = "geoms:wand/*"
motion = "wand.csv"
{glow}
[cameras]
rig = "rig.toml"
[[length]]
name = "end to end"
length_m = {length}
[limits]
completeness = 0.1
"""
MODEL = """<mujoco model="wand"><worldbody><body name="wand"><freejoint/>
<inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
<geom name="wand/1" type="sphere" size="{radius}" pos="-{half} 0 0"/>
<geom name="wand/2" type="sphere" size="{radius}" pos="{half} 0 0"/>
</body></worldbody></mujoco>
"""


@dataclass(frozen=True)
class Measured:
    """The length error that the lab measures [m], rms."""

    once: float
    """As the lab measures it once."""
    all: float
    """With all sensors."""
    value: float
    """The same without what shake and jitter, as they were drawn, make more than their variances do."""
    sigma: float
    """Standard error of ``value``."""
    lengths: int


def rig_of(cameras: tuple[HiddenCamera, ...]) -> Rig:
    """Return the lab's rig: the true one."""
    made = []
    for one in cameras:
        (fx, fy), (cx, cy), (k1, k2, p1, p2, k3) = one.lens.focal_px, one.lens.principal_px, one.lens.distortion
        pose = Pose(one.lens.rotation, np.array(one.lens.position_m))
        made.append(Camera(one.lens.name, *SIZE, OpenCVLens(fx, fy, cx, cy, k1, k2, p1, p2, k3), pose))
    return Rig(tuple(made))


def write(folder: Path, cameras: tuple[HiddenCamera, ...], images: Iterable[Iterator[Array]], rate_hz: float) -> None:
    """Write a recording of each camera's counts; stamps are of the pulses, since jitter and delays are not known."""
    infos = [CameraInfo(one.lens.name, *SIZE, one.sensor.bits, rate_hz) for one in cameras]
    with RecordingWriter(folder, infos) as writer:
        for frame, pictures in enumerate(zip(*images, strict=True)):
            for info, counts in zip(infos, pictures, strict=True):
                time_ns = round(1e9 * frame / rate_hz)
                writer.write(Frame(info.name, frame, time_ns, round(1e9 * EXPOSURE_S), counts))


def record_lab(cameras: tuple[HiddenCamera, ...], light: Takes, folder: Path, seed: int) -> tuple[str, ...]:
    """Record what the fit needs into a folder, with rig.toml; return the recordings as the verb takes them."""

    def even(one: HiddenCamera, share: float, frames: int) -> Iterator[Array]:
        slope = np.linspace(1.0 - UNEVEN, 1.0 + UNEVEN, SIZE[0]) if share else np.zeros(SIZE[0])
        image = np.tile(share * one.capacity_e * slope - one.sensor.stray_e, (SIZE[1], 1))
        yield from (image for _ in range(frames))

    def of(name: str, kind: str, images: Any, draw: int) -> str:
        rows = [exposed(one, (seed, c), images(c, one), draw) for c, one in enumerate(cameras)]
        write(folder / name, cameras, rows, RATE_HZ)
        return f"{kind}:{folder / name}"

    scale = [scale_e(one, c, light) for c, one in enumerate(cameras)]
    told = [of("dark", "dark", lambda _, one: even(one, 0.0, DARK), 0)]
    for k, share in enumerate(LIGHT):
        told.append(of(f"lit{k}", "lit", lambda _, one, share=share: even(one, share, LIT), 1 + k))
    told.append(of("still", "static", lambda c, _: scaled(light.still.images(c), scale[c]), 3))
    told.append(of("moving", "moving", lambda c, _: scaled(light.moving.images(c), scale[c]), 4))
    write_rig(rig_of(cameras), folder / "rig.toml")
    return tuple(told)


def write_plan(folder: Path, seed: int, glow: str = "") -> Path:
    """Write the planned experiment, which knows rig, wand, path and exposure; return its file."""
    motion = wand(seed)[0].motion
    ahead = FIRST_MID_S - EXPOSURE_S / 2  # the witness's first exposure; the twin's begins at 0
    with (folder / "wand.csv").open("w", newline="", encoding="utf-8") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(["time_s", "x", "y", "z", "qw", "qx", "qy", "qz"])
        last = np.array([1.0, 0.0, 0.0, 0.0])
        for k in range(round(500 * (WAND / WAND_HZ + 0.2))):
            rotation, position = motion.pose((t := k / 500 - 0.1) + ahead)
            turn = np.array(quaternion(rotation))
            last = turn if turn @ last >= 0.0 else -turn
            table.writerow([f"{t:.3f}", *(f"{value:.12f}" for value in (*position, *last))])
    (folder / "wand.xml").write_text(MODEL.format(radius=BALL_M / 2, half=LENGTH_M / 2), encoding="utf-8")
    plan = folder / "plan.toml"
    values = {"seconds": WAND / WAND_HZ, "rate": WAND_HZ, "exposure": EXPOSURE_S, "length": LENGTH_M}
    plan.write_text(PLAN.format(seed=1000 + seed, glow=glow, **values), encoding="utf-8")
    return plan


def waved(cameras: tuple[HiddenCamera, ...], light: Takes, seed: int, draw: int) -> list[Iterator[Array]]:
    """Return each camera's counts while the wand is waved, by its own sensors (draw 0) or others of the kind."""
    return [
        exposed(
            one,
            (seed, c, draw) if draw else (seed, c),
            scaled(light.wand.images(c), scale_e(one, c, light)),
            WAND_DRAW,
        )
        for c, one in enumerate(cameras)
    ]


def measured(cameras: tuple[HiddenCamera, ...], light: Takes, folder: Path, seed: int) -> Measured:
    """Return the length error that the lab measures by the pipeline, from one render, with several sensors."""
    spec = load_scenario(folder / "plan.toml")
    once, errors = 0.0, np.full((SENSORS, WAND), np.nan)
    for draw in range(SENSORS):
        place = folder / f"wand{draw}"
        write(place, cameras, waved(cameras, light, seed, draw), WAND_HZ)
        found = run_scenario(spec, "lab", folder, RunOptions(source=f"recording:{place}", page=False))
        tracks = found.tracks.select(np.asarray(found.tracks.status) == "measured")
        frame, length_m, _ = lengths_found(tracks, spec.length[0])
        errors[draw, frame] = length_m - LENGTH_M
        once = once or found.record.metric("length_rms").value
    seen = np.isfinite(errors).any(axis=0)
    square = np.nanmean(errors[:, seen] ** 2, axis=0)
    mean_square, sigma_2 = without_chance(square, *(one[seen] for one in by_shake_and_jitter(cameras, seed)))
    value = float(np.sqrt(mean_square))
    return Measured(once, float(np.sqrt(np.nanmean(errors**2))), value, 0.5 * sigma_2 / value, len(square))


def without_chance(square: Array, excess: Array, expected: Array) -> tuple[float, float]:
    """Return the mean of ``square`` (n,) without what ``excess`` explains of it, and its standard error.

    Control variates: ``excess`` has the mean 0, and ``expected`` that of all frames. How much of them counts is
    regressed: part of the shake is removed from the points (decision 186), more than ``excess`` supposes.
    """
    columns = np.stack([np.ones(len(square)), excess, expected - expected.mean()], axis=1)
    found, *_ = np.linalg.lstsq(columns, square, rcond=None)
    left = square - columns @ found
    n = len(square)
    return float(found[0]), float(np.sqrt(left @ left / (n - columns.shape[1]) / n))


def by_shake_and_jitter(cameras: tuple[HiddenCamera, ...], seed: int) -> tuple[Array, Array]:
    """Return by how much shake and jitter as drawn make each frame's squared length error [m^2] larger than their
    variances do, and its mean square by these variances and the delays.

    To first order, for points by least squares from all cameras. The first has the mean 0, however good the
    approximation: ``without_chance`` takes off as much of it as the measured squares show.
    """
    motion, ends = wand(seed)[0].motion, np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]) * LENGTH_M
    times = FIRST_MID_S + np.arange(WAND) / WAND_HZ

    def places(t: float) -> Array:
        rotation, position = motion.pose(t)
        return np.asarray(position + ends @ rotation.T)

    at = np.array([places(t) for t in times])
    speed = np.array([places(t + STEP_S) - places(t - STEP_S) for t in times]) / (2.0 * STEP_S)
    slopes = np.stack([project_slopes(one.lens, at) for one in cameras])
    inverse = np.linalg.inv(np.einsum("cfbki,cfbkj->fbij", slopes, slopes))
    along = (at[:, 1] - at[:, 0]) / LENGTH_M
    # of the length, by each camera's image of each end
    by_image = np.einsum("fi,fbij,cfbkj->cfbk", along, inverse, slopes) * np.array([-1.0, 1.0])[:, None]
    by_shift = by_image.sum(axis=2)
    by_time = np.einsum("cfbk,cfbki,fbi->cf", by_image, slopes, speed)
    drawn, constant, variance = np.zeros((3, WAND))
    for c, one in enumerate(cameras):
        shift, late = by_chance(one, c, WAND, wand_seed(seed))
        drawn += (by_shift[c] * shift).sum(axis=1) + by_time[c] * late
        constant += by_time[c] * one.delay_s
        variance += (by_shift[c] ** 2).sum(axis=1) * one.shake_px**2 + by_time[c] ** 2 * one.jitter_s**2
    return drawn**2 + 2.0 * drawn * constant - variance, variance + constant**2


def predicted(folder: Path, draws: int) -> Prediction:
    """Return the prediction of the fitted lab in a folder."""
    plan, lab = folder / "plan.toml", folder / "lab.toml"
    _, told = predict(load_with_lab(plan, lab), read_lab(lab), "plan", folder, draws, workers=1)
    return next(one for one in told if one.metric == "length_rms")


def truth_of(cameras: tuple[HiddenCamera, ...], camera: str, key: str) -> float | None:
    """Return the hidden value of one parameter of one camera in the fit's terms; None where it has no counterpart.

    The light of a target and the blur have none: the witness's target is not evenly bright, its blur no Gaussian.
    """
    one = next(c for c in cameras if c.lens.name == camera)
    sensor, scale = one.sensor, 2.0 ** (one.sensor.bits - 8)
    dsnu = sensor.dsnu_dn * scale / one.gain
    # the fit takes the pattern's bright half for dark signal with shot noise; the witness's pattern is an offset
    read = np.sqrt((sensor.read_dn * scale / one.gain) ** 2 - dsnu / np.sqrt(2.0 * np.pi))
    known = {
        "errors.full_well_e": one.capacity_e,
        "errors.read_noise_e": read,
        "errors.background_e": sensor.stray_e,
        "errors.body_px": one.shake_px,
        "errors.trigger_jitter_s": one.jitter_s,
        "sensor.black_dn": sensor.black_dn,
        "sensor.dsnu_e": dsnu,
        "sensor.prnu": sensor.prnu,
        "timing.delay_s": one.delay_s - float(np.mean([c.delay_s for c in cameras])),
    }
    return None if key not in known else float(known[key])


def blind(seed: int, folder: Path, cache: Path, draws: int) -> tuple[list[tuple[Any, ...]], Measured, Prediction]:
    """Play one blind lab: return its z scores, the measured length error, and the prediction."""
    cameras = hidden_cameras(seed)
    light = takes(cameras, seed, cache)
    told = fit_lab(FitRequest(record_lab(cameras, light, folder, seed), folder / "lab.toml", folder / "rig.toml"))
    scores = []
    for one in told:
        truth = truth_of(cameras, one.camera, one.key) if hasattr(one, "value") else None
        if truth is not None and one.sigma > 0.0:
            scores.append((one.camera, one.key, truth, one.value, one.sigma, (one.value - truth) / one.sigma))
    write_plan(folder, seed)
    return scores, measured(cameras, light, folder, seed), predicted(folder, draws)


def blind_and_told(seed: int, folder: Path, draws: int) -> list[tuple[Any, ...]]:
    """Play one blind lab, print its figures and return its z scores."""
    begun = time.monotonic()
    scores, found, said = blind(seed, folder, cache_folder(), draws)
    report(seed, scores, found.value, said)
    inside = "inside" if said.low <= found.once <= said.high else "OUTSIDE"
    print(
        f"  measured to {100 * found.sigma / found.value:.1f} % by {found.lengths} lengths; measured once "
        f"{1e6 * found.once:.1f} um: {inside}; {(time.monotonic() - begun) / 60:.1f} minutes",
        flush=True,
    )
    return scores
