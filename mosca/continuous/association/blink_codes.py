"""Identification of lamps among a camera's image points by their blink codes.

A lamp shows its number's 16 bits over and over (``mosca.data.lamp_codes``), and a free-running camera exposes at any
time. So neither the code's start nor a frame's phase in a bit is known. A tracklet that bridges the dark bits is lit
in some frames and dark in others. The likelihood of this is computed for each number and each start; a number is
accepted where it is far likelier than any other and than chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.association.tracklets_2d import tracklets
from mosca.data.arrays import Array
from mosca.data.lamp_codes import LAMP_BITS, lamp_bits
from mosca.errors import InputError

NO_LAMP = -1
DARKEST = 3
"""Most successive bits in which a lamp is dark."""
SHIFTS = 4
"""Number of phases of the first frame in a bit that are tried."""


@dataclass(frozen=True)
class LampSettings:
    """``bit_s``: duration of a bit [s]. ``missed``: probability that a lit lamp is not seen; ``stray``: that a dark
    one is seen. ``odds``: least likelihood ratio of a number to any other. ``least_bits``: bits that a tracklet must
    span.
    """

    bit_s: float
    missed: float = 0.05
    stray: float = 0.02
    odds: float = 1e4
    least_bits: int = LAMP_BITS

    def __post_init__(self) -> None:
        if not self.bit_s > 0.0:
            raise InputError(f"lamps: bit_s = {self.bit_s:g} given; a time above 0 s is wanted")


def blinking(seen: CameraDetections, numbers: Sequence[int], settings: LampSettings) -> Array:
    """Return the lamp (n,) of each image point of a camera: one of ``numbers``, or NO_LAMP.

    InputError where the camera's frames are too far apart to see every bit.
    """
    if seen.period_s > 1.1 * settings.bit_s:
        raise InputError(
            f"camera '{seen.info.name}': a frame each {1e3 * seen.period_s:.3g} ms, but lamps show a bit for "
            f"{1e3 * settings.bit_s:.3g} ms; each bit must be seen: blink more slowly or film faster"
        )
    longest = (DARKEST + 1) * settings.bit_s / seen.period_s + 1.6
    tracklet = tracklets(seen, longest)
    frame = seen.frame
    number = np.full(len(tracklet), NO_LAMP, dtype=np.int64)
    sure = np.zeros(len(tracklet))
    order = np.argsort(tracklet, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(tracklet[order])) + 1) if len(order) else []:
        found, odds = _number_of(seen, frame[rows], numbers, settings)
        number[rows], sure[rows] = found, odds
    return _one_each(frame, number, sure)


def _number_of(
    seen: CameraDetections, lit: Array, numbers: Sequence[int], settings: LampSettings
) -> tuple[int, float]:
    """Return the number of a tracklet that is lit in the frames ``lit``, and its log odds against the next best."""
    during = np.arange(lit[0], lit[-1] + 1)
    own_s = (seen.frame_ns[during] - seen.frame_ns[lit[0]]) * 1e-9
    if own_s[-1] < (settings.least_bits - 1) * settings.bit_s:
        return NO_LAMP, 0.0
    on = np.isin(during, lit)
    best = np.full(len(numbers), -np.inf)
    if_lit = np.asarray(np.where(on, np.log(1 - settings.missed), np.log(settings.missed)))
    if_dark = np.asarray(np.where(on, np.log(settings.stray), np.log(1 - settings.stray)))
    gain = if_lit - if_dark
    for shift in range(SHIFTS):
        bit = np.floor(own_s / settings.bit_s + (shift + 0.5) / SHIFTS).astype(int) % LAMP_BITS
        by_bit = np.bincount(bit, gain, minlength=LAMP_BITS)
        for k, number in enumerate(numbers):
            code = np.array(lamp_bits(number), dtype=float)
            starts = [float(by_bit @ np.roll(code, s)) for s in range(LAMP_BITS)]
            best[k] = max(best[k], max(starts) + float(if_dark.sum()))
    share = float(on.mean())
    # a marker is never dark: the chance hypothesis uses the observed share of lit frames
    chance = len(on) * sum(p * np.log(p) for p in (share, 1 - share) if p > 0)
    ranked = np.sort(np.append(best, chance))
    first = int(np.argmax(best))
    odds = float(best[first] - ranked[-2]) if best[first] == ranked[-1] else 0.0
    return (int(numbers[first]), odds) if odds > np.log(settings.odds) else (NO_LAMP, 0.0)


def _one_each(frame: Array, number: Array, sure: Array) -> Array:
    """Return the numbers with each lamp at most once per frame: that of the more certain tracklet."""
    lamps = np.flatnonzero(number != NO_LAMP)
    lamps = lamps[np.lexsort((-sure[lamps], number[lamps], frame[lamps]))]
    again = np.zeros(len(lamps), dtype=bool)
    again[1:] = (np.diff(frame[lamps]) == 0) & (np.diff(number[lamps]) == 0)
    result = number.copy()
    result[lamps[again]] = NO_LAMP
    return result
