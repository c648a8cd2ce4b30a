"""The mean of a frame and its change when the image moves: the inputs of the Cramer-Rao bound."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.sensor.background_light import Ambient
from twin.cameras.sensor.sensor import Sensor

STEP_PX = 0.1
"""Half the step of the central differences: at a blur of 0.7 px they are 0.3 % too small."""


@dataclass(frozen=True, eq=False)
class Expected:
    """The mean of one frame over all randomness of its sensor; the camera's pose and instant are as they were."""

    camera: str
    """Its name."""
    mean_e: Array
    """(H, W) electrons."""
    target_e: Array
    """(H, W): the part of ``mean_e`` that comes from the targets [electrons]."""
    right_e: Array
    """(H, W): change when the image moves to the right [electrons a pixel]."""
    down_e: Array
    """(H, W): change when the image moves down [electrons a pixel]."""
    variance_e2: Array
    """(H, W): variance of the noise from photons, temporal dark noise and quantisation [electrons^2]."""
    saturated: Array
    """(H, W): where counts are at the limit."""


def expected_frame(
    camera: str, sensor: Sensor, ambient: Ambient, at_rest: Array, moved: tuple[Array, Array, Array, Array]
) -> Expected:
    """Return the expected frame for the targets' light (H, W) [electrons] before losses in glass and dust.

    ``moved``: the same with the image moved by STEP_PX to the right, left, down and up.
    """
    flat = 1.0 if ambient.flat is None else ambient.flat.astype(float)
    right, left, down, up = (np.asarray(light, dtype=float) for light in moved)
    target = at_rest * flat
    mean = target + ambient.mean_e
    rounding = (1.0 / sensor.gain_dn_per_e) ** 2 / 12.0
    return Expected(
        camera,
        mean,
        target,
        (right - left) / (2.0 * STEP_PX) * flat,
        (down - up) / (2.0 * STEP_PX) * flat,
        np.maximum(mean, 0.0) + sensor.read_noise_e**2 + rounding,
        mean >= sensor.full_well_e,
    )
