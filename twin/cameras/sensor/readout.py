"""Light to counts, in the terms of EMVA 1288 (release 4.0, linear): photons, electrons, system gain K, dark signal.

A pixel with a mean of mu electrons collects a Poisson number of them, the amplifier adds Gaussian noise and the
converter gives ``round(black + K * response(electrons))``, limited to the range of its bits. Random numbers are
computed from (key of the frame, pixel number): no pixel depends on another, nor on the order of work.
"""

import math
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel
from twin.cameras.sensor.background_light import Ambient
from twin.cameras.sensor.counter_rng import STEP, mix, normal, poisson
from twin.cameras.sensor.level_lookup import SEARCH
from twin.cameras.sensor.sensor import Sensor

GROUP = 8
"""Pixels that are tested together for light of a target."""


def dark_table(sensor: Sensor) -> Ambient:
    """Return the even background of a sensor without fixed patterns, for images of any size."""
    return Ambient.of(sensor, sensor.background_e)


def expose(light: Array, sensor: Sensor, key: int, ambient: Ambient | None = None) -> Array:
    """Return counts (H, W), uint8 or uint16, of the targets' light (H, W) float32 [electrons] on a sensor.

    ``key``: the frame's own random key (64 bit). ``ambient``: further light of the pixels (None: the sensor's even
    background). The same arguments give the same bytes, in any thread; no pixel's count depends on another's light.
    Raises ValueError where sizes or sensors do not match.
    """
    ambient = dark_table(sensor) if ambient is None else ambient
    bank = ambient.bank
    if bank.sensor != sensor:
        raise ValueError("ambient: it was made for another sensor; make it with Ambient.of(sensor, ...)")
    if ambient.shape not in (None, light.shape):
        raise ValueError(f"light: shape {light.shape} given, the ambient light's is {ambient.shape}")
    shine, many = _whole_groups(light), ambient.index.shape == light.shape
    index = _whole_groups(ambient.index) if many else ambient.index.ravel()
    flat = np.ones(1, dtype=np.float32) if ambient.flat is None else _whole_groups(ambient.flat)
    out = np.empty(shine.size, dtype=np.uint8 if sensor.bits == 8 else np.uint16)
    frame = np.uint64(key)
    own = np.uint64(mix(frame ^ STEP))
    _look_up(out, index, many, frame, own, bank.guide, bank.guide_bits, bank.first, bank.thresholds)
    lit = np.empty(shine.size // GROUP, dtype=np.int64)
    lit = lit[: _lit_groups(shine, lit)]
    peak = sensor.full_well_e / (2.0 * sensor.linearity) if sensor.linearity > 0.0 else math.inf
    response = (
        sensor.read_noise_e, sensor.gain_dn_per_e, sensor.black, float(sensor.top),
        sensor.linearity / sensor.full_well_e, peak,
    )  # fmt: skip
    _draw_lit(out, shine, index, flat, lit, own, bank.levels_e, response)
    return out[: light.size].reshape(light.shape)


def _whole_groups(values: Array) -> Array:
    """Return the pixels as one row, padded with zeros to whole groups."""
    row = np.ascontiguousarray(values).ravel()
    lacking = -row.size % GROUP
    return np.pad(row, (0, lacking)) if lacking else row


@kernel
def _look_up(
    out: Array,
    index: Array,
    many: bool,
    frame: np.uint64,
    own: np.uint64,
    guide: Array,
    guide_bits: int,
    first: Array,
    thresholds: Array,
) -> None:
    """Fill the counts of all pixels as without targets; ``many``: each pixel has a level of its own.

    Four pixels share one 64-bit number, 16 bits each. These bits suffice for the guide. Where a threshold is near,
    the rest of the number comes from the pixel's own stream.
    """
    shift, rest_shift = np.uint64(16 - guide_bits), np.uint64(63 - guide_bits)
    level = np.int64(index[0])
    for word in range(out.size // 4):
        shared = mix(frame + np.uint64(word) * STEP)
        for j in range(4):
            p = 4 * word + j
            if many:
                level = np.int64(index[p])
            cell = (shared & np.uint64(0xFFFF)) >> shift
            shared >>= np.uint64(16)
            count = guide[level, cell]
            if count < SEARCH:
                out[p] = count
            else:
                rest = mix(own + np.uint64(p) * STEP) >> np.uint64(guide_bits + 1)
                number, above = (cell << rest_shift) | rest, np.int64(count) - SEARCH - first[level]
                while thresholds[level, above] <= number:
                    above += 1
                out[p] = first[level] + above


@kernel
def _lit_groups(light: Array, lit: Array) -> Any:
    """Write the first pixels of the groups that a target lights to ``lit``, and return the number of groups."""
    found = 0
    for group in range(light.size // GROUP):
        total = np.float32(0.0)
        for j in range(GROUP):
            total += light[GROUP * group + j]
        if total != 0.0:
            lit[found] = GROUP * group
            found += 1
    return found


@kernel
def _draw_lit(
    out: Array,
    light: Array,
    index: Array,
    flat: Array,
    lit: Array,
    own: np.uint64,
    levels: Array,
    response: tuple[float, float, float, float, float, float],
) -> None:
    """Fill the counts of the pixels that a target lights, in the groups ``lit``; each draws from its own stream."""
    read_noise, gain, black, top, curve, peak = response
    saturated = levels[-1]
    for begin in lit:
        for p in range(begin, begin + GROUP):
            if light[p] == 0.0:
                continue
            level = np.int64(index[p]) if index.size > 1 else np.int64(index[0])
            factor = flat[p] if flat.size > 1 else flat[0]
            mean = levels[level] + np.float64(factor) * np.float64(light[p])
            if mean >= saturated:
                out[p] = top
                continue
            state = mix(own + np.uint64(p) * STEP)
            seen = mean if mean > 0.0 else 0.0
            electrons = poisson(seen, mix(state + STEP)) + (mean - seen)
            electrons += read_noise * normal(mix(state + STEP + STEP))
            if curve != 0.0 and electrons > 0.0:
                electrons = min(electrons, peak)
                electrons -= curve * electrons * electrons
            count = np.floor(black + gain * electrons + 0.5)
            count = count if count > 0.0 else 0.0
            out[p] = count if count < top else top
