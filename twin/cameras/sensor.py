"""Light to counts, in EMVA 1288 terms: photo-electrons, dark signal, system gain K, quantisation, saturation.

A pixel that expects mu electrons collects a Poisson number of them, the amplifier adds Gaussian read noise
and the converter gives ``round(black + K * electrons)`` limited to the range of its bits. Random numbers are
counted, not drawn in order: each pixel's come from (key of the frame, pixel number).
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.stats import norm, poisson

from mosca.data.arrays import Array

GUIDE_BITS = 12
GUIDE = 2**GUIDE_BITS


@dataclass(frozen=True)
class Sensor:
    """``full_well_e`` saturation capacity, ``read_noise_e`` rms of the dark noise, ``bits`` 8, 10 or 12,
    ``black_dn`` offset in counts of 8 bit (scaled with the bits), ``background_e`` ambient light a pixel.

    The system gain is ``K = (2^bits - 1 - black) / full_well``, so that a full well is the last count.
    """

    full_well_e: float = 20_000.0
    read_noise_e: float = 10.0
    bits: int = 8
    black_dn: float = 4.0
    background_e: float = 200.0

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


@dataclass(frozen=True, eq=False)
class DarkTable:
    """Distribution of the counts of a pixel that sees the background alone.

    ``first``: smallest count; ``thresholds`` (n,) cumulative probabilities of first, first + 1, ... as 63-bit
    numbers; ``guide`` (4096,): the count that all random numbers with these leading 12 bits give, or -1.
    """

    first: int
    thresholds: Array
    guide: Array


def dark_table(sensor: Sensor) -> DarkTable:
    """Return the exact mixture of Poisson electrons and Gaussian noise, after quantisation."""
    mu, k = sensor.background_e, sensor.gain_dn_per_e
    spread = 9.0 * math.sqrt(mu + sensor.read_noise_e**2) + 10.0
    electrons = np.arange(max(0, math.floor(mu - spread)), math.ceil(mu + spread) + 1)
    share = poisson.pmf(electrons, mu)
    low = max(0, math.floor(sensor.black + k * (mu - spread)))
    counts = np.arange(low, min(sensor.top, math.ceil(sensor.black + k * (mu + spread))) + 1)
    edges = (counts[:, None] + 0.5 - sensor.black) / k - electrons[None, :]
    scale = max(sensor.read_noise_e, 1e-9)
    below = (norm.cdf(edges / scale) * share).sum(axis=1)
    below[-1] = 1.0
    thresholds = np.floor(np.minimum(below, 1.0) * 2.0**63).astype(np.uint64)
    ends = np.arange(GUIDE + 1, dtype=np.uint64) << np.uint64(63 - GUIDE_BITS)
    at_start = np.searchsorted(thresholds, ends[:-1], side="right")
    at_end = np.searchsorted(thresholds, ends[1:] - np.uint64(1), side="right")
    guide = np.where(at_start == at_end, counts[0] + at_start, -1).astype(np.int64)
    return DarkTable(int(counts[0]), thresholds, guide)


def expose(light: Array, sensor: Sensor, key: int, table: DarkTable | None = None) -> Array:
    """Return counts (H, W), uint8 or uint16, of the markers' light (H, W) [electrons] on a sensor.

    ``key``: the frame's own random key (64 bit). ``table``: ``dark_table(sensor)``, if already made.
    """
    dark = dark_table(sensor) if table is None else table
    out = np.empty(light.shape, dtype=np.uint8 if sensor.bits == 8 else np.uint16)
    _expose(
        light, out, np.uint64(key), sensor.background_e, sensor.read_noise_e, sensor.gain_dn_per_e,
        sensor.black, sensor.top, dark.first, dark.thresholds, dark.guide,
    )  # fmt: skip
    return out


@njit(nogil=True, cache=True)
def _mix(x):  # type: ignore[no-untyped-def]
    """SplitMix64's finaliser (Steele, Lea and Flood 2014): 64 well mixed bits of a counter."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(nogil=True, cache=True)
def _uniform(state):  # type: ignore[no-untyped-def]
    """A number in (0, 1) of 53 bits."""
    return (float(state >> np.uint64(11)) + 0.5) / 9007199254740992.0


@njit(nogil=True, cache=True)
def _poisson(mu, state):  # type: ignore[no-untyped-def]
    """A Poisson number of mean mu and the next state: Hoermann's PTRS (1993) above 10, products below."""
    step = np.uint64(0x9E3779B97F4A7C15)
    if mu < 10.0:
        limit, product, n = math.exp(-mu), 1.0, -1
        while product > limit:
            state += step
            product *= _uniform(_mix(state))
            n += 1
        return float(n), state
    b = 0.931 + 2.53 * math.sqrt(mu)
    a = -0.059 + 0.02483 * b
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    v_r = 0.9277 - 3.6224 / (b - 2.0)
    log_mu = math.log(mu)
    while True:
        state += step
        u = _uniform(_mix(state)) - 0.5
        state += step
        v = _uniform(_mix(state))
        us = 0.5 - abs(u)
        k = math.floor((2.0 * a / us + b) * u + mu + 0.43)
        if us >= 0.07 and v <= v_r:
            return k, state
        if k < 0.0 or (us < 0.013 and v > us):
            continue
        if math.log(v * inverse_alpha / (a / (us * us) + b)) <= k * log_mu - mu - math.lgamma(k + 1.0):
            return k, state


@njit(nogil=True, cache=True)
def _expose(light, out, key, background, read_noise, gain, black, top, first, thresholds, guide):  # type: ignore[no-untyped-def]
    height, width = light.shape
    step = np.uint64(0x9E3779B97F4A7C15)
    for y in range(height):
        for x in range(width):
            state = _mix(key + np.uint64(y * width + x) * step)
            signal = light[y, x]
            if signal == 0.0:
                # the dark majority: one look-up; the few numbers near a threshold are searched
                r = state >> np.uint64(1)
                count_here = guide[r >> np.uint64(63 - GUIDE_BITS)]
                if count_here < 0:
                    count_here = first + np.searchsorted(thresholds, r, side="right")
                    count_here = min(count_here, first + thresholds.shape[0] - 1)
                out[y, x] = count_here
            else:
                electrons, state = _poisson(signal + background, state)
                state += step
                radius = math.sqrt(-2.0 * math.log(_uniform(_mix(state))))
                state += step
                electrons += read_noise * radius * math.cos(2.0 * math.pi * _uniform(_mix(state)))
                count = math.floor(black + gain * electrons + 0.5)
                out[y, x] = min(max(count, 0.0), float(top))
