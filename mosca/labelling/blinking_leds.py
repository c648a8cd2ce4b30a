"""Active markers by their blinks: the lamp of each track, from the frames in which it is lit.

A lamp shows its number's 16 bits over and over, one bit for ``frames_per_bit`` pulses, in step with them
(``mosca.data.lamp_codes``). A track that bridges the dark bits has a sample where its lamp is lit. The likelihood of
the observations is computed for each number, and each start where that is unknown, with a missed-detection and a
false-alarm probability. The most likely number is accepted where its likelihood ratio to the next is large enough.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.lamp_codes import LAMP_BITS, LAMP_NUMBERS, lamp_bits
from mosca.data.tracks import Tracks
from mosca.errors import InputError


@dataclass(frozen=True)
class BlinkSettings:
    """How lamps blink, and how certain a number must be."""

    frames_per_bit: int = 1
    """Pulses that a bit lasts."""
    in_step: bool = False
    """True: bit 0 begins at pulse 0 (a rig whose lamps count its trigger). False: at any pulse."""
    missed: float = 0.05
    """Probability that a lit lamp has no sample."""
    stray: float = 0.01
    """Probability that a dark lamp has a sample."""
    odds: float = 1e4
    """Least likelihood ratio of a number to any other."""
    least_bits: int = LAMP_BITS
    """Least number of bits that must be observed."""

    def __post_init__(self) -> None:
        if self.frames_per_bit < 1 or self.least_bits < 1:
            raise InputError(
                f"blink: frames_per_bit = {self.frames_per_bit}, least_bits = {self.least_bits} given; "
                "1 or more are allowed"
            )
        if not (0 < self.missed < 0.5 and 0 < self.stray < 0.5 and self.odds > 1):
            raise InputError(
                f"blink: missed = {self.missed:g}, stray = {self.stray:g}, odds = {self.odds:g} given; chances "
                "between 0 and 0.5 and odds above 1 are allowed"
            )


DEFAULTS = BlinkSettings()


def lamp_numbers(tracks: Tracks, settings: BlinkSettings = DEFAULTS, pulses: Array | None = None) -> dict[int, int]:
    """Return track -> number of its lamp, for the tracks that can be identified.

    ``pulses`` (p,): the pulses with a frame set; by default those with a measured sample of any track. A track counts
    from its first measured sample to its last, and as dark where it has no sample.
    """
    measured = tracks.select(tracks.status == "measured")
    known = np.unique(measured.frame if pulses is None else np.asarray(pulses, dtype=np.int64))
    found = {}
    for track in np.unique(measured.track).tolist():
        number = _number_of(np.unique(measured.frame[measured.track == track]), known, settings)
        if number is not None:
            found[track] = number
    return found


def label_lamps(
    tracks: Tracks,
    names: Mapping[int, str] | None = None,
    settings: BlinkSettings = DEFAULTS,
    pulses: Array | None = None,
) -> Tracks:
    """Return ``tracks`` with the names of their lamps as labels; tracks of no lamp keep theirs.

    ``names``: number -> label of the lamps that are present; by default ``lamp/00`` to ``lamp/74``.
    """
    names = {k: f"lamp/{k:02d}" for k in range(LAMP_NUMBERS)} if names is None else names
    found = lamp_numbers(tracks, settings, pulses)
    of_track = {track: names[number] for track, number in found.items() if number in names}
    label = [of_track.get(t, old) for t, old in zip(tracks.track.tolist(), tracks.label.tolist(), strict=True)]
    return replace(tracks, label=np.array(label, dtype=np.str_))


def _number_of(seen: Array, known: Array, settings: BlinkSettings) -> int | None:
    """Return the lamp lit at pulses ``seen``, a subset of ``known``, between the first and last of them; or None."""
    during = known[(known >= seen[0]) & (known <= seen[-1])]
    bit = during // settings.frames_per_bit
    if len(np.unique(bit)) < settings.least_bits:
        return None
    lit = np.isin(during, seen)
    on = np.bincount(bit[lit] % LAMP_BITS, minlength=LAMP_BITS)
    off = np.bincount(bit[~lit] % LAMP_BITS, minlength=LAMP_BITS)
    best = _likelihoods(on, off, settings)
    first, second = np.argsort(best, kind="stable")[[-1, -2]]
    # a lamp that is always on, or an intermittent reflection, is less likely under any number than under chance
    share = lit.mean()
    chance = sum(p * math.log(p) for p in (share, 1 - share) if p > 0) * len(lit)
    if best[first] - best[second] < math.log(settings.odds) or best[first] - chance < math.log(settings.odds):
        return None
    return int(first)


def _likelihoods(on: Array, off: Array, settings: BlinkSettings) -> Array:
    """Return the log likelihood (75,) of each number at its best start, given counts (16,) of lit and dark pulses."""
    bits = np.array([lamp_bits(k) for k in range(LAMP_NUMBERS)])
    if_lit = on * math.log(1 - settings.missed) + off * math.log(settings.missed)
    if_dark = on * math.log(settings.stray) + off * math.log(1 - settings.stray)
    starts = 1 if settings.in_step else LAMP_BITS
    each = [np.where(np.roll(bits, s, axis=1), if_lit, if_dark).sum(axis=1) for s in range(starts)]
    return np.asarray(np.max(each, axis=0))
