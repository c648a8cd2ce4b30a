"""A measuring bench in the manner of EMVA 1288: a camera before even light, and its data sheet held against it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from twin.cameras.sensor.background_light import Ambient, ambient_map
from twin.cameras.sensor.readout import expose
from twin.cameras.sensor.sensor import Sensor
from witness.emva import Array, PhotonTransfer, Spatial, dsnu_e, prnu, spatial, temporal

SHAPE = (200, 300)
STEPS = 27
"""Exposure steps from dark to 4 % beyond saturation (the standard: at least 9 without, 50 with all curves)."""
IMAGES = 16
"""Images of a stack for the spatial variances."""
Grab = Callable[[float, int], Array]
"""A camera: mean photons a pixel and number of the frame -> counts (H, W)."""


def by_levels(sensor: Sensor, key: int = 1, exposure_s: float = 0.0) -> Grab:
    """Even light that fills the image: every pixel is sampled from its level's tabulated distribution."""

    def grab(photons: float, frame: int) -> Array:
        lit = replace(sensor, background_e=sensor.electrons(photons))
        ambient = Ambient.of(lit, *ambient_map(lit, SHAPE[1], SHAPE[0], key, exposure_s=exposure_s))
        return expose(np.zeros(SHAPE, dtype=np.float32), lit, 1_000_003 * frame + key, ambient)

    return grab


def by_targets(sensor: Sensor, key: int = 1, exposure_s: float = 0.0) -> Grab:
    """Even light as if from one large target: every pixel is drawn."""
    dark = replace(sensor, background_e=0.0)
    ambient = Ambient.of(dark, *ambient_map(dark, SHAPE[1], SHAPE[0], key, exposure_s=exposure_s))

    def grab(photons: float, frame: int) -> Array:
        light = np.full(SHAPE, max(sensor.electrons(photons), 1e-6), dtype=np.float32)
        return expose(light, dark, 1_000_003 * frame + key, ambient)

    return grab


@dataclass(frozen=True)
class Measured:
    """What the bench found."""

    transfer: PhotonTransfer
    dark: Spatial
    half: Spatial

    @property
    def dsnu_e(self) -> float:
        return dsnu_e(self.dark, self.transfer.gain)

    @property
    def prnu(self) -> float:
        return prnu(self.dark, self.half)


def measure(grab: Grab, full_photons: float) -> Measured:
    """Take the series and the two stacks; ``full_photons``: about saturation."""
    photons = np.linspace(0.0, 1.04, STEPS) * full_photons
    pairs = [temporal(grab(p, 2 * k + 1), grab(p, 2 * k + 2)) for k, p in enumerate(photons)]
    means, variances = np.transpose(pairs)
    stacks = [
        spatial(np.stack([grab(p, 1000 * (i + 1) + k) for k in range(IMAGES)]))
        for i, p in enumerate((0.0, full_photons / 2))
    ]
    return Measured(PhotonTransfer(photons, means, variances), *stacks)


def complaints(found: Measured, claimed: Sensor) -> list[str]:
    """Return what on the data sheet does not hold; the limits are the bench's own."""
    top, black = 2**claimed.bits - 1, claimed.black_dn * 2 ** (claimed.bits - 8)
    gain = (top - black) / claimed.full_well_e
    transfer = found.transfer
    if not transfer.variance.any():
        return ["temporal noise"]
    checks = {
        "gain": abs(transfer.gain / gain - 1) < 0.02,
        "quantum efficiency": abs(transfer.quantum_efficiency / claimed.quantum_efficiency - 1) < 0.02,
        "dark noise": (
            abs(transfer.dark_noise_e / claimed.read_noise_e - 1) < 0.05
            if transfer.dark_noise_measurable
            else transfer.dark_noise_e >= claimed.read_noise_e
        ),
        "saturation capacity": abs(transfer.saturation_e / claimed.full_well_e - 1) < 0.05,
        "linearity": transfer.linearity_error < 0.001,
        "DSNU": abs(found.dsnu_e - claimed.dsnu_e) < 0.04 * claimed.dsnu_e + 0.02 * claimed.read_noise_e,
        "PRNU": abs(found.prnu - claimed.prnu) < 0.04 * claimed.prnu + 0.0004,
        "rows and columns": max(abs(found.half.row), abs(found.half.column))
        < 0.02 * max(found.half.pixel, transfer.variance[0]),
    }
    return [name for name, holds in checks.items() if not holds]
