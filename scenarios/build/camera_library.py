"""Cameras by name: keys that a camera takes from the library's sensor and lens, and checks that these fit."""

import math

from mosca.data.rig import Camera, MoscaLens
from mosca.errors import InputError
from scenarios.spec.cameras import Cameras
from scenarios.spec.scenario import Scenario
from twin.cameras import library
from twin.cameras.library import LensSpec, SensorEntry

CHIP_KEYS = ("full_well_e", "read_noise_e", "bits", "quantum_efficiency")
"""Keys of light and noise that are taken from a library sensor where the scenario does not set them."""
ROUNDING = 1.02
"""Tolerance on image circles and frame rates, which makers round."""


def named_sensor(name: str | None) -> SensorEntry | None:
    """Return the library's sensor, None for none; InputError for an unknown name."""
    return None if name is None else library.sensor(name)


def named_lens(name: str | None) -> LensSpec | None:
    """Return the library's lens, None for none; InputError for an unknown name."""
    return None if name is None else library.lens(name)


def with_chip(spec: Scenario) -> Cameras:
    """Return the ring; missing size and pitch are of the named sensor, a missing focal length of the named lens."""
    given, changes = spec.cameras.model_fields_set, {}
    chip, lens = named_sensor(spec.sensor.name), named_lens(spec.optics.lens)
    if chip is not None:
        changes = {"size_px": (chip.width, chip.height), "pixel_pitch_mm": chip.pixel_pitch_um * 1e-3}
    if lens is not None:
        changes["c_mm"] = lens.focal_length_mm
    return spec.cameras.model_copy(update={key: value for key, value in changes.items() if key not in given})


def pitch_and_focal_mm(camera: Camera, chip: SensorEntry | None, pitch_mm: float) -> tuple[float, float]:
    """Return a camera's pixel pitch and principal distance [mm].

    A Mosca lens has both. The other lenses are in pixels: for them the pitch is that of the sensor, or ``pitch_mm``.
    """
    lens = camera.lens
    if isinstance(lens, MoscaLens):
        return lens.mx_mm_per_px, lens.c_mm
    pitch_mm = pitch_mm if chip is None else chip.pixel_pitch_um * 1e-3
    return pitch_mm, lens.fx_px * pitch_mm


def check_fits(
    camera: Camera, chip: SensorEntry | None, lens: LensSpec | None, pitch_mm: float, f_number: float, rate_hz: float
) -> None:
    """Raise InputError where a named sensor or lens does not fit the camera.

    The readout time of a sensor's window is in proportion to its rows.
    """
    size, who = (camera.width, camera.height), f"camera '{camera.name}'"
    if chip is not None:
        if size[0] > chip.width or size[1] > chip.height:
            raise InputError(
                f"{who}: image of {size[0]} x {size[1]} px given, its sensor '{chip.title}' has {chip.width} x "
                f"{chip.height}: leave the size to the sensor or name another one"
            )
        fastest = chip.max_frame_rate_hz * chip.height / size[1]
        if rate_hz > ROUNDING * fastest:
            raise InputError(
                f"{who}: {rate_hz:g} frames/s given, its sensor '{chip.title}' does {fastest:.4g} with {size[1]} "
                "rows: lower capture.frame_rate_hz (or timing.rate_hz), read fewer rows or name another sensor"
            )
    if lens is None:
        return
    if not lens.f_number_min <= f_number <= lens.f_number_max:
        raise InputError(
            f"{who}: optics.f_number = {f_number:g} given, its lens '{lens.title}' has {lens.f_number_min:g} to "
            f"{lens.f_number_max:g}"
        )
    diagonal = pitch_mm * math.hypot(*size)
    if diagonal > ROUNDING * lens.image_circle_mm:
        raise InputError(
            f"{who}: its image is {diagonal:.3g} mm across, the lens '{lens.title}' fills {lens.image_circle_mm:g} "
            "mm: name another lens (or give cameras.c_mm alone), a smaller sensor or a window of it (cameras.size_px)"
        )
