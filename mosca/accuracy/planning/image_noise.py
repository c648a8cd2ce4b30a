"""Predicted standard deviation of the centre of a marker's image, before any image is taken.

A disc of radius R blurred by a Gaussian of standard deviation s has the radial slope

    I'(r) = -A (R / s^2) exp(-(r - R)^2 / (2 s^2)) I1e(r R / s^2),

with I1e the scaled modified Bessel function (the gradient of a disc is a ring, here convolved with a Gaussian). If
pixels have independent noise of variance v(I) = dark + I, the Fisher information of the centre along one axis is

    J = pi int I'(r)^2 / v(I(r)) r dr     [1/px^2]

(Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 3.9). Unknown amplitude and background do not
reduce it, since the image is symmetric. J depends on R and s only through R / s. A pixel's own area counts as blur:
s^2 grows by 1/12 px^2.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid, trapezoid
from scipy.special import i1e

from mosca.data.arrays import Array

PIXEL_VARIANCE_PX2 = 1.0 / 12.0
"""Variance of a uniform distribution over a pixel, which is the pixel's blur."""
TABLE_RATIOS = np.geomspace(1e-2, 1e3, 161)
"""R / s of the table; log J over log (R / s) is nearly straight at both ends (slopes 4 and 1)."""
STEPS = 4000


@dataclass(frozen=True)
class PixelNoiseModel:
    """Signal of a pixel, in electrons, and its noise (EMVA 1288)."""

    signal_e: float
    """Signal of a pixel that a marker covers."""
    background_e: float = 0.0
    read_noise_e: float = 10.0
    step_e: float = 0.0
    """Electrons for each grey value: quantisation step."""

    @property
    def dark_e2(self) -> float:
        """Variance of a pixel without light from the marker [e^2]."""
        return self.background_e + self.read_noise_e**2 + self.step_e**2 / 12.0


def centre_information(noise: PixelNoiseModel, ratio: float) -> float:
    """Return the Fisher information J [1/px^2] of a disc whose radius is ``ratio`` times its blur."""
    reach = 8.0
    r = np.linspace(max(0.0, ratio - reach), ratio + reach, STEPS)
    slope = noise.signal_e * ratio * np.exp(-((r - ratio) ** 2) / 2) * i1e(r * ratio)
    # integrated from outside, where the image is dark
    light = -cumulative_trapezoid(slope[::-1], r[::-1], initial=0.0)[::-1]
    return float(np.pi * trapezoid(slope**2 / (noise.dark_e2 + light) * r, r))


def information_table(noise: PixelNoiseModel) -> Array:
    """Return log J at ``TABLE_RATIOS`` (161,), for ``mosca.accuracy.planning.views``."""
    return np.log([centre_information(noise, ratio) for ratio in TABLE_RATIOS])


def centre_sigma_px(noise: PixelNoiseModel, diameter_px: float, blur_px: float) -> float:
    """Return the standard deviation [px], an axis, of the centre of a disc's image.

    ``diameter_px``: of the disc without blur; ``blur_px``: standard deviation of the lens's blur.
    """
    whole = np.sqrt(blur_px**2 + PIXEL_VARIANCE_PX2)
    return float(centre_information(noise, diameter_px / 2 / whole) ** -0.5)
