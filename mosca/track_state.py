"""What a tracker remembers, as columns: one row a target, so that compiled kernels can work on all at once.

A row (*slot*) belongs to one target from its birth until it is forgotten; ``serial`` tells two owners apart.
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array

FREE, TENTATIVE, CONFIRMED = range(3)
NOWHERE, BY_MOTION, BY_LIMB = range(3)
"""Where a target's expected place comes from: none, its own motion, its limb mates."""
MATES = 10
"""Neighbours that a target keeps an eye on."""
TOP, SERIAL, IDENTITY, TICK = range(4)


class Bank(NamedTuple):
    """Filters and history of n slots; world frame, SI.

    ``numbers`` (4,): slots in use, next serial, next identity, instants so far. ``state`` (n,); ``serial`` (n,);
    ``identity`` (n,) or -1; ``missed`` (n,) instants not seen since last seen; ``sure`` (n,) whether the last
    sighting can be learned from; ``seen_s``, ``born_s``, ``weight`` (n,); ``variance`` (n,) of the acceleration, an axis;
    ``mean`` (n, 9) position, velocity, acceleration; ``covariance`` (n, 9, 9); ``place`` (n, 3) and
    ``place_covariance`` (n, 3, 3): where it is expected now, by ``source`` (n,).
    """

    numbers: Array
    state: Array
    serial: Array
    identity: Array
    missed: Array
    sure: Array
    seen_s: Array
    born_s: Array
    weight: Array
    variance: Array
    mean: Array
    covariance: Array
    place: Array
    place_covariance: Array
    source: Array


class Limbs(NamedTuple):
    """How n targets sit among their neighbours, k of them each.

    ``mate``, ``mate_serial`` (n, k): slot and its owner, -1 where none; ``length``, ``variance`` (n, k) of the
    distance [m, m^2]; ``shown_s`` (n, k) how long it was observed [s]; ``photo`` (n, k, 3) the mates' places when the target
    was last seen and ``taken`` (n, k) which were seen then; ``own`` (n, 3) its own place then; ``turn`` (n, 3, 3) how
    the limb has turned since; ``strain`` (n,) instants in a row at which most distances were violated.
    """

    mate: Array
    mate_serial: Array
    length: Array
    variance: Array
    shown_s: Array
    photo: Array
    taken: Array
    own: Array
    turn: Array
    strain: Array


def new_bank(slots: int) -> Bank:
    """Return an empty bank."""
    i, f = np.int64, np.float64
    return Bank(
        np.zeros(4, i), np.zeros(slots, i), np.full(slots, -1, i), np.full(slots, -1, i), np.zeros(slots, i),
        np.zeros(slots, np.bool_), np.zeros(slots, f), np.zeros(slots, f), np.zeros(slots, f), np.zeros(slots, f),
        np.zeros((slots, 9), f),
        np.zeros((slots, 9, 9), f), np.zeros((slots, 3), f), np.zeros((slots, 3, 3), f), np.zeros(slots, i),
    )  # fmt: skip


def new_limbs(slots: int) -> Limbs:
    """Return an empty memory of limbs."""
    i, f = np.int64, np.float64
    return Limbs(
        np.full((slots, MATES), -1, i), np.full((slots, MATES), -1, i), np.zeros((slots, MATES), f),
        np.zeros((slots, MATES), f), np.zeros((slots, MATES), f), np.zeros((slots, MATES, 3), f),
        np.zeros((slots, MATES), np.bool_), np.zeros((slots, 3), f), np.zeros((slots, 3, 3), f), np.zeros(slots, i),
    )  # fmt: skip


def grown(bank: Bank, limbs: Limbs, slots: int) -> tuple[Bank, Limbs]:
    """Return both with room for ``slots`` targets, what they hold kept."""
    more = slots - len(bank.state)
    wider = [np.concatenate([a, b[:more]]) for a, b in zip(bank[1:], new_bank(slots)[1:], strict=True)]
    longer = [np.concatenate([a, b[:more]]) for a, b in zip(limbs, new_limbs(slots), strict=True)]
    return Bank(bank.numbers, *wider), Limbs(*longer)
