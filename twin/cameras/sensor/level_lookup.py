"""Levels of light with the exact distribution of the counts at each: a lookup table for pixels without a target.

A level is a mean number of electrons. Its counts follow from Poisson electrons and Gaussian noise through the
sensor's response, black level, gain, quantisation and saturation. The levels of one sensor lie on a fixed grid, so
that a level's distribution ("law") depends on (sensor, anchor, level) alone, not on the order of requests.
"""

import math
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel
from twin.cameras.sensor.sensor import Sensor

SPACING = 0.15
"""Distance of levels, in standard deviations of the temporal noise at the level."""
SEARCH = 0x8000
"""Added to a guide's count where the leading bits give only a lower bound of the count."""
RANDOM_BITS = 63
"""Cumulative probabilities are integers in units of 2^-63, so that sums fit in 64 bits."""
_DSNU_REACH = 8.0
_REACH = 9.0
"""Cut-off of Gaussian noise, in its standard deviations: a share of 1e-19 lies beyond."""
_MOST_LEVELS = 2**16 - 1
_ROUNDING = 1e-9
"""Tolerance on a number of steps: larger than its rounding error (1e-12), negligible against one step."""


class LevelBank:
    """The levels of a sensor and the laws of those in use; laws are added on demand, by any thread.

    ``levels_e`` (n,): mean electrons, ascending. One is exactly ``anchor_e``, and the last is surely saturated. The
    first is 0, or as far below 0 as the sensor's dark signal reaches (a lower offset without shot noise). The count
    at level k is ``first[k] + j``, where j is the number of ``thresholds[k]`` (63-bit numbers) that a random number
    reaches. ``guide[k]`` is the count for a number's leading ``guide_bits``; with SEARCH added, its lower bound.
    """

    def __init__(self, sensor: Sensor, anchor_e: float) -> None:
        if not anchor_e >= 0.0:
            raise ValueError(f"mean_e: {anchor_e} given, a mean number of electrons >= 0 wanted")
        self.sensor, self.anchor_e = sensor, float(anchor_e)
        self._edges_e = sensor.edges_e()
        self._floor_e = max(sensor.read_noise_e, 1.0)
        lowest = -_DSNU_REACH * sensor.dsnu_e
        # the mean from which only the last count can occur: mean - 9 sigma lies above the last edge
        full = self._edges_e[-1] + 10.0 + sensor.read_noise_e**2
        highest = (4.5 + math.sqrt(20.25 + full)) ** 2 - sensor.read_noise_e**2
        ends = _scale(np.array([lowest, self.anchor_e, max(highest, self.anchor_e)]), self._floor_e)
        self.step = max(SPACING, (ends[2] - ends[0]) / (_MOST_LEVELS - 3))
        # a whole number of steps stays whole where rounding adds to it, so that no level is made twice
        self.anchor = math.ceil((ends[1] - ends[0]) / self.step - _ROUNDING)
        count = self.anchor + math.ceil((ends[2] - ends[1]) / self.step) + 1
        levels = _unscale(ends[1] + (np.arange(count) - self.anchor) * self.step, self._floor_e)
        self.levels_e = np.maximum(levels, lowest)
        self.levels_e[self.anchor] = self.anchor_e
        self.levels_e.setflags(write=False)
        self.scale = (self._floor_e, float(self.anchor), float(ends[1]), float(self.step))
        spread = _REACH * np.sqrt(np.maximum(self.levels_e, 0.0) + sensor.read_noise_e**2) + 10.0
        self.first = np.searchsorted(self._edges_e, self.levels_e - spread)
        last = np.searchsorted(self._edges_e, self.levels_e + spread)
        self._counts = last - self.first + 1
        # the system allocates only memory that is written to
        self.guide_bits = 10 if sensor.bits == 8 else 11
        self.guide = np.empty((count, 2**self.guide_bits), dtype=np.uint16)
        self.thresholds = np.empty((count, int(self._counts.max())), dtype=np.uint64)
        self._made = np.zeros(count, dtype=bool)
        self._noise_e = max(sensor.read_noise_e, 1e-9)
        self._edge_laws = np.empty((sensor.top, 2 * math.ceil(_REACH * self._noise_e) + 2))
        self._edge_made = np.zeros(sensor.top, dtype=bool)
        self._lock = Lock()

    def number(self, mean_e: Array) -> Array:
        """Return the numbers of the levels nearest to ``mean_e`` [electrons], same shape, uint16."""
        floor_e, anchor, anchor_scale, step = self.scale
        away = (_scale(np.asarray(mean_e, float), floor_e) - anchor_scale) / step
        return np.clip(away + anchor + 0.5, 0, len(self.levels_e) - 1).astype(np.uint16)

    def make(self, numbers: Array) -> None:
        """Compute the laws of the levels ``numbers`` (any shape) that are missing."""
        missing = np.unique(numbers)
        missing = missing[~self._made[missing]]
        if not len(missing):
            return
        with self._lock:
            for k in missing[~self._made[missing]]:
                n = int(self._counts[k])
                part = slice(int(self.first[k]), int(self.first[k]) + n - 1)
                _law(
                    self.levels_e[k], self._noise_e, self._edges_e[part], self._edge_laws[part],
                    self._edge_made[part], self.thresholds[k, :n],
                )  # fmt: skip
                self.thresholds[k, n:] = np.uint64(2**RANDOM_BITS)
                _guide(self.thresholds[k], int(self.first[k]), self.guide_bits, self.guide[k])
                self._made[k] = True

    def law(self, number: int) -> tuple[int, Array]:
        """Return a level's first count and the probabilities of it and the counts after it."""
        self.make(np.array([number]))
        below = self.thresholds[number, : self._counts[number]].astype(float) / 2.0**RANDOM_BITS
        return int(self.first[number]), np.diff(below, prepend=0.0)


@lru_cache(maxsize=16)
def level_bank(sensor: Sensor, anchor_e: float) -> LevelBank:
    """Return the bank of a sensor, the same one for equal sensors: cameras of one kind share their laws."""
    return LevelBank(sensor, anchor_e)


def _scale(mean_e: Array, floor_e: float) -> Array:
    """Return the scale on which the noise is 1: 2 sqrt(mean + noise^2); linear below 0, without shot noise."""
    above = 2.0 * np.sqrt(np.maximum(mean_e, 0.0) + floor_e**2)
    return np.asarray(above + np.minimum(mean_e, 0.0) / floor_e)


def _unscale(scale: Array, floor_e: float) -> Array:
    """Return the means at these positions on the scale."""
    zero = 2.0 * floor_e
    return np.asarray(
        np.where(scale >= zero, (np.maximum(scale, zero) / 2.0) ** 2 - floor_e**2, (scale - zero) * floor_e)
    )


class ElectronNumbers(NamedTuple):
    """Numbers of electrons from ``low`` to ``high``, their probabilities ``share`` and cumulative sums ``up_to``."""

    low: int
    high: int
    share: Array
    up_to: Array


@kernel
def _law(level: float, noise: float, edges: Array, edge_laws: Array, edge_made: Array, thresholds: Array) -> None:
    """Fill a level's cumulative probabilities: P(electrons + noise < edge), summed over the numbers of electrons.

    ``edge_laws`` holds P(n + noise < edge) for each edge and the numbers n around it, shared by all levels.
    """
    mean, offset = max(level, 0.0), min(level, 0.0)
    reach = 10.0 * math.sqrt(mean) + 20.0
    low, high = max(0, math.floor(mean - reach)), math.ceil(mean + reach)
    share = np.empty(high - low + 1)
    # Poisson terms by their ratios, from the largest one outwards: no factorials, plain arithmetic
    middle = math.floor(mean) - low
    share[middle] = 1.0
    for i in range(middle, high - low):
        share[i + 1] = share[i] * mean / (low + i + 1)
    for i in range(middle, 0, -1):
        share[i - 1] = share[i] * (low + i) / mean
    share /= share.sum()
    up_to = np.cumsum(share)
    shifted = np.empty((1, edge_laws.shape[1]))
    electrons = ElectronNumbers(low, high, share, up_to)
    _add_up(offset, noise, electrons, edges, edge_laws, edge_made, shifted, thresholds)


@bare_step
def _add_up(
    offset: float,
    noise: float,
    electrons: ElectronNumbers,
    edges: Array,
    edge_laws: Array,
    edge_made: Array,
    shifted: Array,
    thresholds: Array,
) -> None:
    """Fill ``_law``'s thresholds from the probabilities of the numbers of electrons."""
    low, high, share, up_to = electrons
    wide = edge_laws.shape[1]
    for j in range(edges.size):
        edge = edges[j] - offset
        start = math.floor(edge) - wide // 2 + 1
        laws, row = (edge_laws, j) if offset == 0.0 else (shifted, 0)
        if offset != 0.0 or not edge_made[j]:
            _edge_law(edge, start, noise, laws, row)
            edge_made[j] |= offset == 0.0
        # probability of all numbers below the Gaussian's reach, plus a part of those within it
        below = up_to[min(start - 1, high) - low] if start > low else 0.0
        for n in range(max(start, low), min(start + wide - 1, high) + 1):
            below += share[n - low] * laws[row, n - start]
        thresholds[j] = np.uint64(min(below, 1.0) * 9223372036854775808.0)
        if j > 0 and thresholds[j] < thresholds[j - 1]:  # by the last bits of a sum near 1
            thresholds[j] = thresholds[j - 1]
    thresholds[edges.size] = np.uint64(9223372036854775808)


@bare_step
def _edge_law(edge: float, start: int, noise: float, laws: Array, row: int) -> None:
    """Fill a row of ``laws`` with P(n + noise < edge) for n = start, start + 1, ..."""
    for i in range(laws.shape[1]):
        laws[row, i] = 0.5 * math.erfc((start + i - edge) / (noise * 1.4142135623730951))


@kernel
def _guide(thresholds: Array, first: int, bits: int, guide: Array) -> None:
    """Fill the lowest counts that a number's leading bits allow, with SEARCH added where they allow several."""
    j = 0
    for cell in range(guide.size):
        start = np.uint64(cell) << np.uint64(63 - bits)
        end = start + (np.uint64(1) << np.uint64(63 - bits)) - np.uint64(1)
        while thresholds[j] <= start:
            j += 1
        guide[cell] = first + j + (0 if thresholds[j] > end else SEARCH)
