"""What a camera's images told of its sensor beside what a scenario or a data sheet states of it (EMVA 1288).

The pipeline knows nothing of these figures; they meet here, as tracks meet the truth.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mosca.detection.disc_fit.row import FIRST_ROUGHNESS
from mosca.diagnostics.sensor import LearnedSensor
from twin.cameras.sensor.sensor import Sensor

FAR = math.sqrt(2.0)
"""Factor by which all of an interval must lie off what is stated to be told of: a wrong gain setting of 6 dB or a
shifted bit is a factor of 2, and this lies halfway on the scale of ratios."""


@dataclass(frozen=True)
class StatedSensor:
    """What is stated of one camera, in its own grey values [DN]."""

    gain_dn_per_e: float
    """System gain K."""
    noise_dn: float
    """Noise of a pixel at the background's level, less rounding: dark noise, nonuniformity, photon noise."""
    saturation_dn: float
    """Grey value of the full well, or the last one."""
    bits: int


def stated_sensor(sensor: Sensor, background_dn: float) -> StatedSensor:
    """Return what a data sheet makes of a camera whose background has this level [DN].

    The noise at a level L over the black one is that of EMVA 1288, 2.5 and 4.1: K^2 (dark noise^2 + DSNU^2) + K L +
    (PRNU L)^2.
    """
    gain = sensor.gain_dn_per_e
    light = max(background_dn - sensor.black, 0.0)
    variance = gain**2 * (sensor.read_noise_e**2 + sensor.dsnu_e**2) + gain * light + (sensor.prnu * light) ** 2
    full = min(sensor.black + gain * sensor.full_well_e, sensor.top)
    return StatedSensor(gain, math.sqrt(variance), full, sensor.bits)


def stated_sensors(learned: tuple[LearnedSensor, ...], sheets: Mapping[str, Sensor]) -> dict[str, StatedSensor]:
    """Return what is stated of each camera that has a sheet (camera -> ``Sensor``) and images."""
    return {
        one.name: stated_sensor(sheets[one.name], one.background_dn)
        for one in learned
        if one.name in sheets and one.background_dn is not None
    }


def sensor_findings(learned: tuple[LearnedSensor, ...], stated: Mapping[str, StatedSensor]) -> list[str]:
    """Return in words, a line each, which learned figures lie far off the stated ones, see ``FAR``.

    A misfit of the discs of ``FIRST_ROUGHNESS``, which detection takes for usual, (2 % of a target's contrast)^2,
    moves the learned gain by as much of the contrast: nothing nearer to the stated gain is told of. Of the twin's
    scenarios the farthest are ``rigs/zones_two``, too low by all of that, and ``targets/retro_spheres``, too high by
    0.65 of it.
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
