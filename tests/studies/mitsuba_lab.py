"""A lab that Mitsuba plays: hidden cameras, and the noise-free light of each of their images.

Each image is a scene of ``witness.mitsuba`` of its own: one camera, turned by its shake in this frame, at the instant
at which it is triggered. The rays, lenses, lamps, tape and sensors are the witness's; nothing here is the twin's.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from witness.mitsuba.cramer_rao import image_bounds, render_noise_share
from witness.mitsuba.film import Film
from witness.mitsuba.scene import (
    Body,
    LensCamera,
    Quality,
    SceneLamps,
    SensorValues,
    Swing,
    WitnessScene,
    code_digest,
    quaternion,
)
from witness.mitsuba.scene_file import scene_of
from witness.mitsuba.sensor import VirtualSensor

Array = np.ndarray[Any, Any]

SIZE = (512, 400)
FOCAL_PX = 606.0
RADIUS_M = 2.5
EXPOSURE_S = 2e-4
BALL_M = 0.02
LENGTH_M = 0.4
"""Distance of the wand's two balls."""
TARGETS = 10
RATE_HZ, WAND_HZ = 100.0, 25.0
DARK, LIT, STILL, MOVING, WAND = 16, 16, 92, 60, 640
"""Images a camera of each recording; dark, lit (at two levels), at rest and moving are 200 together."""
SAMPLES, WAND_SAMPLES = 1024, 2048
"""Samples of a pixel at edges. Rendering noise adds 4 and 2 % to places' rms; half as many samples add 40 and 4 %."""
AT_ONCE = 46
"""Images of targets at rest that are rendered together: memory."""
PEAK_E = 1000.0
"""Any will do: only its ratio to ``peak_dn`` is used, which is the gain."""
BRIGHT = 95
"""Percentile of the brightest pixels of the targets at rest that has the camera's ``signal``."""


@dataclass(frozen=True)
class HiddenCamera:
    """A camera's hidden settings."""

    lens: LensCamera
    sensor: SensorValues
    signal: float
    """Light of the brighter targets at rest over the saturation capacity."""
    shake_px: float
    """Rms shift of the image of distant objects from frame to frame, an axis."""
    jitter_s: float
    delay_s: float

    @property
    def gain(self) -> float:
        """Counts of a photoelectron."""
        return self.sensor.gain_dn_per_e

    @property
    def capacity_e(self) -> float:
        """Photoelectrons that reach the largest count."""
        return (2.0**self.sensor.bits - 1.0 - self.sensor.black_dn * 2.0 ** (self.sensor.bits - 8)) / self.gain


@dataclass(frozen=True)
class Later(Swing):
    """A motion that is seen later."""

    motion: Swing = field(default_factory=Swing)
    late_s: float = 0.0

    def pose(self, t: float) -> tuple[Array, Array]:
        """Return world_from_body and the position at ``t``."""
        return self.motion.pose(t + self.late_s)


def _ring(seed: int, count: int) -> dict[str, Any]:
    """Return the witness's table of a lab's cameras."""
    return {
        "radius_m": RADIUS_M, "heights_m": [0.5 * (k % 3) for k in range(count)],
        "azimuths_deg": [360.0 * k / count for k in range(count)], "size": list(SIZE), "focal_px": FOCAL_PX,
        "seed": seed,
    }  # fmt: skip


def hidden_cameras(seed: int, count: int = 3) -> tuple[HiddenCamera, ...]:
    """Return the cameras of a lab, drawn by a seed: all of 8 or all of 12 bits."""
    random = np.random.default_rng([seed, 3])
    bits = int(random.choice([8, 12]))
    table = {"cameras": _ring(seed, count), "frames": 1, "rate_hz": RATE_HZ, "exposure_s": EXPOSURE_S}
    lenses = scene_of(table, "lab", Path()).cameras
    made = []
    for lens in lenses:
        capacity, black = float(random.uniform(8e3, 3e4)), float(random.uniform(3.0, 6.0))
        gain8 = (2.0**bits - 1.0 - black * 2.0 ** (bits - 8)) / capacity / 2.0 ** (bits - 8)
        # of 12 bits no less than a count: what rounding hides is not asked for; of 8 bits it often is hidden
        read_e = max(float(random.uniform(5.0, 30.0)), 1.0 / gain8 / 2.0 ** (bits - 8) if bits > 8 else 0.3 / gain8)
        # diameter of the blur circle at the middle of the room [px], before or behind which the focus lies
        blur, focus = float(random.uniform(1.0, 2.5)), float(RADIUS_M * random.choice([0.6, 1.6]))
        aperture = blur / FOCAL_PX / abs(1.0 / RADIUS_M - 1.0 / focus)
        sensor = SensorValues(
            bits=bits,
            peak_e=PEAK_E,
            peak_dn=gain8 * PEAK_E,
            read_dn=gain8 * read_e,
            black_dn=black,
            stray_e=float(random.uniform(50.0, 400.0)),
            prnu=float(random.uniform(0.003, 0.015)),
            dsnu_dn=gain8 * read_e * float(random.uniform(0.25, 0.8)),
            full_well_e=1.2 * capacity,
        )
        made.append(
            HiddenCamera(
                replace(lens, aperture_m=aperture, focus_m=focus),
                sensor,
                float(random.uniform(0.35, 0.65)),
                float(random.uniform(0.02, 0.12)),
                float(random.uniform(20e-6, 200e-6)),
                float(random.uniform(-2e-4, 2e-4)),
            )
        )
    return tuple(made)


def targets(seed: int, speed_mps: float, count: int = 3) -> tuple[Body, ...]:
    """Return balls that all cameras of a lab see, at rest or on their ways at ``speed_mps``."""
    moving = speed_mps > 0.0
    cloud = {
        "count": TARGETS, "diameter_m": BALL_M, "half_size_m": [0.4, 0.4, 0.4], "seen_by": count, "gap_m": 0.06,
        "amplitude_m": 0.15 if moving else 0.0, "speed_mps": speed_mps,
    }  # fmt: skip
    table = {
        "cameras": _ring(seed, count),
        "cloud": cloud,
        "frames": MOVING,
        "rate_hz": RATE_HZ,
        "seed": seed + moving,
    }
    return scene_of({**table, "exposure_s": EXPOSURE_S}, "lab", Path()).bodies


def wand(seed: int) -> tuple[Body, ...]:
    """Return a wand of two balls, waved through the room by about 0.8 m/s, on a path drawn by the seed."""
    random = np.random.default_rng([seed, 4])
    table = {
        "wand": {
            "along_m": [0.0, LENGTH_M],
            "diameter_m": BALL_M,
            "amplitude_m": [0.4, 0.4, 0.35],
            "frequency_hz": (random.uniform(0.22, 0.32, 3)).tolist(),
            "phase_rad": random.uniform(0.0, 2.0 * np.pi, 3).tolist(),
            "turn_rad": [1.2, 1.1, 1.6],
            "turn_frequency_hz": random.uniform(0.12, 0.2, 3).tolist(),
            "turn_phase_rad": random.uniform(0.0, 2.0 * np.pi, 3).tolist(),
        },
        "frames": 1,
        "rate_hz": 1.0,
        "exposure_s": EXPOSURE_S,
    }
    return scene_of(table, "wand", Path()).bodies


@dataclass(frozen=True)
class Takes:
    """The noise-free light of a lab's recordings."""

    still: "KeptLight"
    moving: "KeptLight"
    wand: "KeptLight"


def wand_seed(seed: int) -> int:
    """Return the seed of shake and jitter while the wand is waved."""
    return 3 * seed + 2


def takes(cameras: tuple[HiddenCamera, ...], seed: int, cache: Path) -> Takes:
    """Return the recordings of a lab, each with its own shake and jitter."""
    return Takes(
        filmed(cameras, targets(seed, 0.0, len(cameras)), STILL, RATE_HZ, 3 * seed, cache),
        filmed(cameras, targets(seed, 1.5, len(cameras)), MOVING, RATE_HZ, 3 * seed + 1, cache),
        filmed(cameras, wand(seed), WAND, WAND_HZ, wand_seed(seed), cache, WAND_SAMPLES),
    )


@dataclass(frozen=True)
class KeptLight:
    """The noise-free light of a recording: n windows, in the order in which they overlay the images.

    ``place`` (n, 6): frame, camera, x, y, w, h; ``start`` (n + 1): where each window's pixels begin in ``light``.
    ``noise``: share by which the rendering's noise adds to places' rms over the bound, of some images.
    """

    place: Array
    start: Array
    light: Array
    noise: Array

    def images(self, camera: int) -> Iterator[Array]:
        """Yield a camera's images (H, W) [radiance]."""
        own = self.place[:, 1] == camera
        for frame in range(int(self.place[:, 0].max()) + 1):
            image = np.zeros(SIZE[::-1])
            for k in np.flatnonzero(own & (self.place[:, 0] == frame)):
                x, y, w, h = self.place[k, 2:]
                image[y : y + h, x : x + w] = self.light[self.start[k] : self.start[k + 1]].reshape(h, w)
            yield image

    def peaks(self, camera: int) -> Array:
        """Return the brightest pixel of each of a camera's windows."""
        rows = np.flatnonzero(self.place[:, 1] == camera)
        return np.array([self.light[self.start[k] : self.start[k + 1]].max() for k in rows])


def by_chance(camera: HiddenCamera, number: int, frames: int, seed: int) -> tuple[Array, Array]:
    """Return shifts by shake (frames, 2) [px] and jitter (frames,) [s] of a camera in a recording."""
    random = np.random.default_rng([seed, number, 5])
    return camera.shake_px * random.standard_normal((frames, 2)), camera.jitter_s * random.standard_normal(frames)


def filmed(
    cameras: tuple[HiddenCamera, ...],
    bodies: tuple[Body, ...],
    frames: int,
    rate_hz: float,
    seed: int,
    cache: Path,
    samples: int = SAMPLES,
) -> KeptLight:
    """Return the light of a recording, rendered or as kept in ``cache``.

    What does not move is rendered for many turned cameras at once, which takes a fifth of the time.
    """
    at_rest = all(not any(body.motion.amplitude_m) for body in bodies)
    lab = [(one.lens, one.shake_px, one.jitter_s, one.delay_s) for one in cameras]
    key = hashlib.sha256(repr((lab, bodies, frames, rate_hz, seed, samples, EXPOSURE_S, code_digest())).encode())
    path = cache / f"lab_{key.hexdigest()[:20]}.npz"
    if path.is_file():
        with np.load(path) as data:
            return KeptLight(*(data[name] for name in ("place", "start", "light", "noise")))
    place, light, noise = [], [], []
    for c, one in enumerate(cameras):
        shift, late = by_chance(one, c, frames, seed)
        late += one.delay_s
        together = AT_ONCE if at_rest else 1
        for first in range(0, frames, together):
            some = slice(first, min(first + together, frames))
            scene = _instant(one, bodies, shift[some], first / rate_hz + late[first], seed * 7919 + c * 1009 + first)
            scene = replace(scene, quality=Quality(samples))
            render = Film(scene).render()
            peak = max(float(render.total[:, a:b].mean(0).max()) for a, b in pairwise(render.start))
            if first == 0:
                noise.append(render_noise_share(*image_bounds(scene, render, one.signal * one.capacity_e / peak)))
            for k, (_, turned, _, *box) in enumerate(render.place):
                place.append((first + turned, c, *box))
                light.append(render.total[:, render.start[k] : render.start[k + 1]].mean(0))
    start = np.concatenate([[0], np.cumsum([len(one) for one in light])])
    made = KeptLight(np.array(place), start, np.concatenate(light).astype(np.float32), np.array(noise))
    cache.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, place=made.place, start=made.start, light=made.light, noise=made.noise)
    return made


def _instant(camera: HiddenCamera, bodies: tuple[Body, ...], shift: Array, t: float, seed: int) -> WitnessScene:
    """Return the scene of an instant, seen by the camera with shifts (n, 2) of distant objects by its shake [px].

    Turned cameras are at the same place, and so are their lamps, which are of 1 / n of a lamp's radiance each.
    """
    lens, turned = camera.lens, []
    for k, (x, y) in enumerate(shift):
        turn = Rotation.from_rotvec([y / lens.focal_px[1], -x / lens.focal_px[0], 0.0]).as_matrix()
        turned.append(replace(lens, name=f"{lens.name}_{k}", rotation_wxyz=quaternion(lens.rotation @ turn)))
    moved = tuple(Body(Later(motion=one.motion, late_s=t), one.parts) for one in bodies)
    return WitnessScene(
        "lab", tuple(turned), moved, 1, 1.0, EXPOSURE_S, light=SceneLamps(ring=1.0 / len(shift)),
        sensor=camera.sensor, seed=seed,
    )  # fmt: skip


def scale_e(camera: HiddenCamera, number: int, light: Takes) -> float:
    """Return a camera's photoelectrons of a radiance: its brighter targets at rest have its ``signal``."""
    return camera.signal * camera.capacity_e / float(np.percentile(light.still.peaks(number), BRIGHT))


def scaled(images: Iterator[Array], factor: float) -> Iterator[Array]:
    """Yield images times ``factor``. A generator expression in a loop would use the loop's last factor for all."""
    for image in images:
        yield factor * image


def exposed(camera: HiddenCamera, seed: tuple[int, ...], images: Iterator[Array], draw: int) -> Iterator[Array]:
    """Yield counts for images of expected photoelectrons (H, W); ``seed`` names the sensor, ``draw`` the noise."""
    sensor = VirtualSensor(camera.sensor, SIZE, seed)
    for frame, image in enumerate(images):
        yield sensor.counts(image, (*seed, frame, draw))
