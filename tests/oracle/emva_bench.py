"""A measuring bench in the manner of EMVA 1288: a camera before even light, and its data sheet held against it."""

from dataclasses import replace
from functools import partial

import numpy as np

from scenarios.fidelity.sensor import SHAPE, Grab, MeasuredSensor, measured
from scenarios.fidelity.sensor import camera as by_targets
from twin.cameras.sensor.background_light import Ambient, ambient_map
from twin.cameras.sensor.readout import expose
from twin.cameras.sensor.sensor import Sensor
from witness.emva import Array

__all__ = ["SHAPE", "Grab", "by_levels", "by_targets", "complaints", "measure"]
measure = partial(measured, images=16)


def by_levels(sensor: Sensor, key: int = 1, exposure_s: float = 0.0) -> Grab:
    """Even light that fills the image: every pixel is sampled from its level's tabulated distribution."""

    def grab(photons: float, frame: int) -> Array:
        lit = replace(sensor, background_e=sensor.electrons(photons))
        ambient = Ambient.of(lit, *ambient_map(lit, SHAPE[1], SHAPE[0], key, exposure_s=exposure_s))
        return expose(np.zeros(SHAPE, dtype=np.float32), lit, 1_000_003 * frame + key, ambient)

    return grab


def complaints(found: MeasuredSensor, claimed: Sensor) -> list[str]:
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
