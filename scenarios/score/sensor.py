"""Sensor parameters from a camera's images compared with those of a scenario or a data sheet (EMVA 1288).

The pipeline does not get the stated figures; they are only compared here, like tracks with the truth.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mosca.detection.disc_fit.row import FIRST_ROUGHNESS
from mosca.diagnostics.sensor import LearnedSensor
from twin.cameras.sensor.sensor import Sensor

FAR = math.sqrt(2.0)
"""Factor by which a whole interval must be off the stated value to be reported: a wrong gain setting of 6 dB or a
shifted bit is a factor of 2, and this is halfway on the scale of ratios."""


@dataclass(frozen=True)
class StatedSensor:
    """Stated values of one camera's sensor, in its own grey values [DN]."""

    gain_dn_per_e: float
    """System gain K."""
    noise_dn: float
    """Noise of a pixel at the background's level, less rounding: dark noise, nonuniformity, photon noise."""
    saturation_dn: float
    """Grey value of the full well, or the largest grey value."""
    bits: int


def stated_sensor(sensor: Sensor, background_dn: float) -> StatedSensor:
    """Return the values of a camera by its data sheet, for a background of this level [DN].

    The noise at a level L above black is that of EMVA 1288, 2.5 and 4.1: K^2 (dark noise^2 + DSNU^2) + K L +
    (PRNU L)^2.
    """
    gain = sensor.gain_dn_per_e
    light = max(background_dn - sensor.black, 0.0)
    variance = gain**2 * (sensor.read_noise_e**2 + sensor.dsnu_e**2) + gain * light + (sensor.prnu * light) ** 2
    full = min(sensor.black + gain * sensor.full_well_e, sensor.top)
    return StatedSensor(gain, math.sqrt(variance), full, sensor.bits)


def stated_sensors(learned: tuple[LearnedSensor, ...], sheets: Mapping[str, Sensor]) -> dict[str, StatedSensor]:
    """Return the stated values of each camera that has a sheet (camera -> ``Sensor``) and images."""
    return {
        one.name: stated_sensor(sheets[one.name], one.background_dn)
        for one in learned
        if one.name in sheets and one.background_dn is not None
    }


def sensor_findings(learned: tuple[LearnedSensor, ...], stated: Mapping[str, StatedSensor]) -> list[str]:
    """Return lines on estimated figures that are far off the stated ones, see ``FAR``.

    A misfit of the discs of ``FIRST_ROUGHNESS``, which detection takes for usual, (2 % of a target's contrast)^2,
    changes the estimated gain by the same share of the contrast: smaller differences from the stated gain are not
    reported. Of the twin's scenarios the farthest are ``rigs/zones_two``, too low by all of that share, and
    ``targets/retro_spheres``, too high by 0.65 of it.
    """
    lines = []
    for one in learned:
        if one.name not in stated:
            continue
        sheet = stated[one.name]
        if one.bits != sheet.bits:
            lines.append(
                f"camera '{one.name}': images of {one.bits} bits, {sheet.bits} are stated: check its settings"
            )
            continue
        contrast = max(one.peak_dn - (one.background_dn or 0.0), 0.0)
        gain, misfit = sheet.gain_dn_per_e, FIRST_ROUGHNESS * contrast
        for what, unit, found, value, low, high in (
            ("gain", "DN/e-", one.gain_dn_per_e, gain, gain - misfit, gain + misfit),
            ("noise", "DN", one.noise_dn, sheet.noise_dn, sheet.noise_dn, sheet.noise_dn),
        ):
            if found is not None and (found.high < min(low, value / FAR) or found.low > max(high, value * FAR)):
                lines.append(
                    f"camera '{one.name}': the images tell a {what} of {found.low:.3g} to {found.high:.3g} {unit}, "
                    f"{value:.3g} is stated: check the camera's gain and bits, and its data sheet"
                )
    return lines
