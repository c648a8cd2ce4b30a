"""Cyclic codes, read from an unknown start: sectors on a ring, blinks of a lamp.

A word represents all its cyclic shifts. Two words differ in at least ``distance`` bits under any cyclic shift. A word
differs from its own shifts in at least ``own_distance`` bits, so that the start is determined as well. The search
goes through all necklaces in rising order and keeps each that is far enough from those kept so far (a greedy
lexicode; Conway & Sloane 1986). It finds the same words on every machine.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TypeVar

import numpy as np

from mosca.data.arrays import Array

Words = TypeVar("Words", int, Array)


@dataclass(frozen=True, eq=False)
class CyclicCode:
    """``words`` of ``length`` bits by number; bit k of a word is read k positions after its start."""

    length: int
    words: tuple[int, ...]

    def bits(self, number: int) -> tuple[bool, ...]:
        """Return the bits of word ``number``, from its start on; IndexError where there is no such word."""
        if not 0 <= number < len(self.words):
            raise IndexError(f"number = {number} given; 0 to {len(self.words) - 1} is allowed")
        return tuple(bool(self.words[number] >> k & 1) for k in range(self.length))

    def find(self, bits: tuple[bool, ...]) -> tuple[int, int] | None:
        """Return which word is read in ``bits`` and at which position it starts, or None.

        None unless ``bits`` is exactly a shifted word: no error correction.
        """
        if len(bits) != self.length:
            return None
        return self._starts.get(sum(1 << k for k, bit in enumerate(bits) if bit))

    @cached_property
    def _starts(self) -> dict[int, tuple[int, int]]:
        return {
            turned(word, start, self.length): (number, start)
            for number, word in enumerate(self.words)
            for start in range(self.length)
        }


def turned(word: Words, places: int, length: int) -> Words:
    """Return ``word`` (or an array of words) of ``length`` bits, cyclically shifted to be read ``places`` later.

    ``places`` from 0 to ``length`` - 1.
    """
    return ((word << places) | (word >> (length - places))) & ((1 << length) - 1)


def longest_runs(word: int, length: int) -> tuple[int, int]:
    """Return the lengths of the longest runs of zeros and of ones in ``word``, read cyclically."""
    text = f"{word:0{length}b}" * 2  # twice: a run may pass the start
    zeros, ones = (max(len(run) for run in text.split(end)) for end in "10")
    return min(zeros, length), min(ones, length)


def cyclic_code(length: int, distance: int, own_distance: int, most_zeros: int, most_ones: int) -> CyclicCode:
    """Return the code of ``length`` bits (at most 20) with the distances above and bounded runs.

    ``most_zeros``, ``most_ones``: longest allowed runs of equal bits, read cyclically; below ``length`` they exclude
    the words of all zeros and of all ones.
    """
    every = np.arange(1 << length, dtype=np.int32)
    first = np.ones(len(every), dtype=bool)
    for places in range(1, length):
        first &= every <= turned(every, places, length)
    words = every[first]
    own = np.bitwise_count(_rotations(words, length)[1:] ^ words).min(axis=0)
    flips = np.array([sum(1 << k for k in some) for some in _places(length, distance - 1)], dtype=np.int32)
    taken = np.zeros(1 << length, dtype=bool)
    kept = []
    for word in words[own >= own_distance].tolist():
        zeros, ones = longest_runs(word, length)
        if taken[word] or zeros > most_zeros or ones > most_ones:
            continue
        kept.append(word)
        # a word too near to a rotation of this one is a rotation of a word that is too near to this one
        taken[_rotations(word ^ flips, length)] = True
    return CyclicCode(length, tuple(kept))


def _rotations(words: Array, length: int) -> Array:
    return np.stack([turned(words, places, length) for places in range(length)])


def _places(length: int, most: int) -> list[tuple[int, ...]]:
    """Return all choices of up to ``most`` of ``length`` positions."""
    return [some for count in range(most + 1) for some in combinations(range(length), count)]
