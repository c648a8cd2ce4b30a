"""Counts from light by the linear model of EMVA 1288 (Release 4.0, sections 2 and 4).

Photoelectrons: Poisson of light times (1 + PRNU) plus stray light and the excess of hot pixels; capped at the full
well. Counts: gain times electrons, plus black level, DSNU and temporal dark noise (both normal); rounded, clipped.
PRNU, DSNU and hot pixels belong to the camera: the same in all frames and draws.
"""

import numpy as np

from witness.mitsuba.scene import Array, SensorValues


class VirtualSensor:
    """One camera's sensor; ``seed`` names camera and scene."""

    def __init__(self, sensor: SensorValues, size: tuple[int, int], seed: tuple[int, ...]) -> None:
        self.sensor, shape = sensor, (size[1], size[0])
        random = np.random.default_rng([*seed, 71])
        self._response = 1 + sensor.prnu * random.standard_normal(shape)
        self._offset = self._scale * sensor.dsnu_dn * random.standard_normal(shape)
        self._hot = np.where(random.random(shape) < sensor.hot_share, sensor.hot_e * random.random(shape), 0.0)

    @property
    def _scale(self) -> float:
        """Counts of this sensor for one count at 8 bits."""
        return 2.0 ** (self.sensor.bits - 8)

    def counts(self, electrons: Array, seed: tuple[int, ...]) -> Array:
        """Return an image (H, W), uint8 or uint16, for expected photoelectrons (H, W); ``seed`` names the draw."""
        sensor, random = self.sensor, np.random.default_rng([*seed, 72])
        mean = (electrons + sensor.stray_e) * self._response + self._hot
        drawn = np.minimum(random.poisson(np.maximum(mean, 0)), sensor.full_well_e)
        dark = self._offset + self._scale * (sensor.black_dn + sensor.read_dn * random.standard_normal(mean.shape))
        counts = np.rint(sensor.gain_dn_per_e * drawn + dark)
        return np.clip(counts, 0, 2**sensor.bits - 1).astype(np.uint8 if sensor.bits <= 8 else np.uint16)


def variance_e2(sensor: SensorValues, electrons: Array) -> Array:
    """Return the variance of a pixel's temporal noise in photoelectrons^2: Poisson, dark noise, rounding."""
    scale = 2.0 ** (sensor.bits - 8)
    dark = ((sensor.read_dn * scale) ** 2 + 1 / 12) / sensor.gain_dn_per_e**2
    return np.asarray(electrons + sensor.stray_e + dark)
