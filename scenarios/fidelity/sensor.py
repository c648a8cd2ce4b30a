"""The sensor, measured like a real camera: photon transfer and spatial noise by EMVA 1288."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mosca.data.arrays import Array
from reports.fidelity import Check, Row
from twin.cameras.sensor.background_light import Ambient, ambient_map
from twin.cameras.sensor.readout import expose
from twin.cameras.sensor.sensor import Sensor
from witness.emva import PhotonTransfer, Spatial, dsnu_e, prnu, spatial, temporal

SHAPE, STEPS, IMAGES = (200, 300), 27, 12
"""Image (H, W), exposure steps from dark to 4 % beyond saturation, images of a stack for the spatial variances."""
GAIN, DARK_NOISE, SATURATION, PATTERN = 0.02, 0.05, 0.05, 0.04
"""Limits, as shares of the data sheet's values."""
SHEETS = {
    8: Sensor(bits=8, full_well_e=8_000.0, read_noise_e=25.0, dsnu_e=20.0, prnu=0.012, quantum_efficiency=0.55),
    10: Sensor(bits=10, full_well_e=12_000.0, read_noise_e=12.0, dsnu_e=6.0, prnu=0.008),
    12: Sensor(bits=12, dsnu_e=5.0, prnu=0.01),
}
"""Cameras whose dark noise exceeds the quantisation noise, as the standard requires."""
Grab = Callable[[float, int], Array]
"""A camera before even light: mean photons per pixel and number of the frame -> counts (H, W)."""


def sensors(quick: bool) -> Check:
    """Check gain, noise and fixed patterns of cameras of 8, 10 and 12 bits against their data sheets."""
    rows: list[Row] = []
    for bits, sheet in SHEETS.items():
        if quick and bits == 10:
            continue
        found = measured(camera(sheet), sheet.photons(sheet.full_well_e))
        rows += [Row(f"{bits} bit: {name} off by", off, "of it", bar) for name, off, bar in _off(found, sheet)]
    sheet = SHEETS[12]
    faults = {
        "K 3 % too large": (replace(sheet, full_well_e=sheet.full_well_e / 1.03), "system gain K"),
        "dark noise 10 % too small": (replace(sheet, read_noise_e=9.0), "dark noise"),
        "DSNU 12 % too large": (replace(sheet, dsnu_e=5.6), "DSNU"),
    }
    for name, (faulty, what) in faults.items():
        off = {
            stated: (value, bar)
            for stated, value, bar in _off(measured(camera(faulty), sheet.photons(sheet.full_well_e)), sheet)
        }
        rows.append(Row(f"fault: {name}", off[what][0], "of it", off[what][1], control=True))
    return Check(
        "Sensor (EMVA 1288)",
        "figures found by photon transfer and stacks of even images with those of the data sheet",
        "the measuring procedure of EMVA 1288, release 4.0 linear, which knows counts only",
        f"its spread over {SHAPE[0] * SHAPE[1]:,} pixels: K 0.2 %, dark noise 0.3 %; saturation in steps of 4 %",
        tuple(rows),
    )


def _off(found: "MeasuredSensor", sheet: Sensor) -> list[tuple[str, float, float]]:
    """Return name, relative deviation from the data sheet, and bar of each value."""
    transfer = found.transfer
    pairs = [
        ("system gain K", transfer.gain, sheet.gain_dn_per_e, GAIN),
        ("quantum efficiency", transfer.quantum_efficiency, sheet.quantum_efficiency, GAIN),
        ("dark noise", transfer.dark_noise_e, sheet.read_noise_e, DARK_NOISE),
        ("saturation capacity", transfer.saturation_e, sheet.full_well_e, SATURATION),
        ("DSNU", found.dsnu_e, sheet.dsnu_e, PATTERN),
        ("PRNU", found.prnu, sheet.prnu, PATTERN),
    ]
    return [(name, abs(value / stated - 1), bar) for name, value, stated, bar in pairs]


@dataclass(frozen=True, eq=False)
class MeasuredSensor:
    """A photon transfer curve, and the variances of stacks of images in the dark and at half of saturation."""

    transfer: PhotonTransfer
    dark: Spatial
    half: Spatial

    @property
    def dsnu_e(self) -> float:
        """Spread of the dark signal over the pixels [e-]."""
        return dsnu_e(self.dark, self.transfer.gain)

    @property
    def prnu(self) -> float:
        """Spread of the response over the pixels, a share."""
        return prnu(self.dark, self.half)


def measured(grab: Grab, full_photons: float, images: int = IMAGES) -> MeasuredSensor:
    """Measure a camera that saturates at about ``full_photons`` per pixel, from stacks of ``images`` images."""
    photons = np.linspace(0.0, 1.04, STEPS) * full_photons
    pairs = [temporal(grab(p, 2 * k + 1), grab(p, 2 * k + 2)) for k, p in enumerate(photons)]
    transfer = PhotonTransfer(photons, *np.transpose(pairs))
    dark, half = (
        spatial(np.stack([grab(p, 1000 * (i + 1) + k) for k in range(images)]))
        for i, p in enumerate((0.0, full_photons / 2))
    )
    return MeasuredSensor(transfer, dark, half)


def camera(sensor: Sensor, key: int = 1, exposure_s: float = 0.0) -> Grab:
    """Return the twin's camera before even light, as if from one large target; ``key``: of its fixed patterns."""
    dark = replace(sensor, background_e=0.0)
    ambient = Ambient.of(dark, *ambient_map(dark, SHAPE[1], SHAPE[0], key=key, exposure_s=exposure_s))

    def grab(photons: float, frame: int) -> Array:
        light = np.full(SHAPE, max(sensor.electrons(photons), 1e-6), dtype=np.float32)
        return expose(light, dark, 1_000_003 * frame + key, ambient)

    return grab
