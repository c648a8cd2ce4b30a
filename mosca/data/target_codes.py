"""The numbers of coded targets: bits on a ring around a centre dot.

The ring is cut into 20 sectors, white for a one. Sector k runs from k to k + 1 twentieths of a turn,
counter-clockwise from the plate's x axis, seen from the front. Reading starts at an unknown sector. So any two
numbers differ in at least 4 sectors under any rotation: up to 3 misread sectors never make another number. A number
differs from its own rotations in at least 4 sectors, so that its roll is determined as well. Runs have at most 5
equal sectors: at most a quarter of the ring has no edge.

Alternatives, and how many numbers each has (greedy, own distance 4, runs of at most 5)::

    sectors        14     15     16     17     18     19     20
    distance 2    288    487   1519   2832   4751   9001  13188   one error is detected
    distance 3     36     62    102    187    313    559    956   two are detected, or one corrected
    distance 4     21     33     56     99    166    298    507   three are detected, or one corrected

500 numbers at distance 3 take 19 sectors: 5 % wider sectors at the cost of distance 4.
"""

from functools import cache

from mosca.data.cyclic_codes import CyclicCode, cyclic_code
from mosca.errors import InputError

SECTORS = 20
NUMBERS = 507
"""There are numbers 0 to 506."""


@cache
def ring_code() -> CyclicCode:
    """Return the code of all numbers (computed at the first call)."""
    return cyclic_code(SECTORS, distance=4, own_distance=4, most_zeros=5, most_ones=5)


def code_bits(number: int) -> tuple[bool, ...]:
    """Return the sectors (20) of a number, counter-clockwise from the plate's x axis; True is white."""
    if not 0 <= number < NUMBERS:
        raise InputError(f"number = {number} given; coded targets have numbers 0 to {NUMBERS - 1}")
    return ring_code().bits(number)
