"""A sensor by its data sheet, in the terms of EMVA 1288 (release 4.0, linear)."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array

MOST_CURVED = 0.2
"""Largest departure from a straight line: at 0.25 the peak of the response sinks below the last count."""


@dataclass(frozen=True)
class Sensor:
    """A sensor by its data sheet; fixed patterns are drawn once for a camera.

    The system gain is ``K = (2^bits - 1 - black) / full_well_e``: the saturation capacity of a linear response is the
    last count.
    """

    full_well_e: float = 20_000.0
    """Saturation capacity."""
    read_noise_e: float = 10.0
    """Temporal dark noise at no exposure, rms."""
    bits: int = 8
    """8, 10 or 12."""
    black_dn: float = 4.0
    """Offset in counts of 8 bit (scaled with the bits)."""
    background_e: float = 200.0
    """Even light on all pixels."""
    quantum_efficiency: float = 0.6
    """Electrons a photon."""
    dark_current_e_per_s: float = 0.0
    """Dark current of each pixel."""
    dsnu_e: float = 0.0
    """DSNU: rms of the dark signal."""
    prnu: float = 0.0
    """PRNU: rms share of the response."""
    linearity: float = 0.0
    """Share by which the response is below a straight line at saturation (square law), at most 0.2."""
    hot_pixels: float = 0.0
    """Share of hot pixels."""
    hot_e: float = 1_000.0
    """Mean excess electrons of a hot pixel (exponential law)."""
    dead_pixels: float = 0.0
    """Share of pixels without a response."""

    @property
    def top(self) -> int:
        """The largest count."""
        return int(2**self.bits) - 1

    @property
    def black(self) -> float:
        """Offset in the counts of this sensor [DN]."""
        return self.black_dn * 2.0 ** (self.bits - 8)

    @property
    def gain_dn_per_e(self) -> float:
        """System gain K [DN/e-]."""
        return (self.top - self.black) / self.full_well_e

    def electrons(self, photons: float) -> float:
        """Return the mean number of electrons that a mean number of photons on a pixel frees."""
        return self.quantum_efficiency * photons

    def photons(self, electrons: float) -> float:
        """Return the mean number of photons on a pixel that frees a mean number of electrons."""
        return electrons / self.quantum_efficiency

    def edges_e(self) -> Array:
        """Return the numbers of electrons (top,) at which a pixel's count reaches 1, 2, ..., top: inverse response.

        The response to e electrons is ``e - linearity e^2 / full_well`` above 0 and e below. Raises ValueError where
        it is not monotonic for this ``linearity``.
        """
        if abs(self.linearity) > MOST_CURVED:
            raise ValueError(f"linearity: {self.linearity} given, -{MOST_CURVED} to {MOST_CURVED} wanted")
        straight = (np.arange(self.top) + 0.5 - self.black) / self.gain_dn_per_e
        share = self.linearity * np.maximum(straight, 0.0) / self.full_well_e
        return np.asarray(2.0 * straight / (1.0 + np.sqrt(1.0 - 4.0 * share)))
