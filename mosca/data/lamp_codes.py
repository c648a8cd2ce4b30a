"""Blink codes of lamps: numbers that identify them, and a sequence that encodes the time.

A bit lasts a whole number of frame periods; a camera sees the lamp on or off and so reads one bit per frame. A number
is a word of 16 bits, repeated, which can be read from any start. Any two differ in at least 3 bits under any shift. A
lamp is dark for at most 3 bits in a row, so that it can be tracked meanwhile::

    bits              14    15    16    17    18
    distance 3        27    45    75   126   207   (dark for at most 3 bits, lit for at most 5)
    distance 4        14    25    43    69   117
"""

from functools import cache

from mosca.data.cyclic_codes import CyclicCode, cyclic_code
from mosca.errors import InputError

LAMP_BITS = 16
LAMP_NUMBERS = 75
"""There are lamps 0 to 74."""

# x^n = sum of x^(n - tap): primitive polynomials over GF(2) (Zierler & Brillhart 1968; 8 and 12: Golomb 1967)
_TAPS = {
    3: (2, 3),
    4: (3, 4),
    5: (3, 5),
    6: (5, 6),
    7: (6, 7),
    8: (4, 5, 6, 8),
    9: (5, 9),
    10: (7, 10),
    11: (9, 11),
    12: (1, 4, 6, 12),
}


@cache
def lamp_code() -> CyclicCode:
    """Return the code of all lamps (computed at the first call)."""
    return cyclic_code(LAMP_BITS, distance=3, own_distance=4, most_zeros=3, most_ones=5)


def lamp_bits(number: int) -> tuple[bool, ...]:
    """Return the bits (16) that lamp ``number`` shows over and over; True is lit."""
    if not 0 <= number < LAMP_NUMBERS:
        raise InputError(f"number = {number} given; lamps have numbers 0 to {LAMP_NUMBERS - 1}")
    return lamp_code().bits(number)


def m_sequence(order: int) -> tuple[bool, ...]:
    """Return the 2^order - 1 bits of a maximum length sequence, ``order`` from 3 to 12.

    Any ``order`` consecutive bits occur in it only once, so that they determine the position in the sequence. It
    agrees with any shift of itself in one bit less than half (Golomb 1967), so that a correlation has one peak.
    """
    if order not in _TAPS:
        raise InputError(f"order = {order} given; a sequence has an order from {min(_TAPS)} to {max(_TAPS)}")
    bits = [True] * order
    while len(bits) < 2**order - 1:
        bits.append(sum(bits[-tap] for tap in _TAPS[order]) % 2 == 1)
    return tuple(bits)
