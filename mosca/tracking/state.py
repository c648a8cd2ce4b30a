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
    sighting can be learned from; ``seen_s``, ``born_s`` (n,); ``back_s``, ``gone_s`` (n,) when last found again and
    when lost before that; ``weight`` (n,); ``variance`` (n,) of the acceleration, an axis;
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
    back_s: Array
    gone_s: Array
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
    distance [m, m^2]; ``shown_s`` (n, k) how long it was observed [s]; ``photo`` (n, k, 3) the mates' places when
    the target was last seen and ``taken`` (n, k) which were seen then; ``own`` (n, 3) its own place then; ``turn``
    (n, 3, 3) how the limb has turned since.
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


def new_bank(slots: int) -> Bank:
    """Return an empty bank."""
    n, none = slots, np.full(slots, -1, np.int64)
    return Bank(
        numbers=np.zeros(4, np.int64), state=np.zeros(n, np.int64), serial=none, identity=none.copy(),
        missed=np.zeros(n, np.int64), sure=np.zeros(n, np.bool_), seen_s=np.zeros(n), born_s=np.zeros(n),
        back_s=np.full(n, -1.0), gone_s=np.zeros(n), weight=np.zeros(n), variance=np.zeros(n),
        mean=np.zeros((n, 9)), covariance=np.zeros((n, 9, 9)), place=np.zeros((n, 3)),
        place_covariance=np.zeros((n, 3, 3)), source=np.zeros(n, np.int64),
    )  # fmt: skip


def new_limbs(slots: int) -> Limbs:
    """Return an empty memory of limbs."""
    each = (slots, MATES)
    return Limbs(
        mate=np.full(each, -1, np.int64), mate_serial=np.full(each, -1, np.int64), length=np.zeros(each),
        variance=np.zeros(each), shown_s=np.zeros(each), photo=np.zeros((*each, 3)), taken=np.zeros(each, np.bool_),
        own=np.zeros((slots, 3)), turn=np.zeros((slots, 3, 3)),
    )  # fmt: skip


def grown(bank: Bank, limbs: Limbs, slots: int) -> tuple[Bank, Limbs]:
    """Return both with room for ``slots`` targets, what they hold kept."""
    more = slots - len(bank.state)
    wider = [np.concatenate([a, b[:more]]) for a, b in zip(bank[1:], new_bank(slots)[1:], strict=True)]
    longer = [np.concatenate([a, b[:more]]) for a, b in zip(limbs, new_limbs(slots), strict=True)]
    return Bank(bank.numbers, *wider), Limbs(*longer)
