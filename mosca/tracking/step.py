"""What the tracker does with each frame set, compiled as two kernels: foresee, and follow what was seen.

Called by ``mosca.tracking.tracker``. Few kernels, since each return to Python has to win the GIL back from the
threads that look at frames, and each call unpacks the bank's many columns.
"""

from typing import NamedTuple

import numpy as np

from mosca.numba_support.decorators import kernel, step
from mosca.tracking.assignment import best_pairs
from mosca.tracking.kalman import carry, correct, expected
from mosca.tracking.rigid_neighbours import expect, learn, pairs
from mosca.tracking.state import CONFIRMED, TENTATIVE, TOP


class Rules(NamedTuple):
    """How targets are followed: ``mosca.tracking.tracker.TrackSettings`` as the kernels read them.

    ``wild_mps2``: acceleration beyond what a target has shown; ``lowest``, ``highest``: limits of the variance of
    acceleration; ``order`` of the motion; ``sure_from``: cameras that must count in full for a lesson; ``limb_m``: 0
    where no limbs are learned.
    """

    gate_sigma: float
    gate_m: float
    wild_mps2: float
    lowest: float
    highest: float
    order: int
    speed_mps: float
    confirm_weight: float
    sure_from: float
    coast_s: float
    memory_s: float
    limb_m: float


@kernel
def foresee(bank, limbs, motion, time_s, step_s, rules):  # type: ignore[no-untyped-def]
    """Carry all targets on by ``step_s`` to ``time_s``; return places (k, 3) and covariances (k, 3, 3) of those
    confirmed that are expected somewhere.
    """
    carry(bank, motion, time_s, rules.coast_s, rules.memory_s)
    if rules.limb_m > 0.0:
        expect(bank, limbs, time_s, step_s, 0.5 * rules.gate_m)
    return expected(bank)


@kernel
def follow(  # type: ignore[no-untyped-def]
    bank, limbs, xyz, own, cameras, trusted, jitter_s, time_s, step_s, rules
):
    """Give the points (m,) to the targets, and begin new ones; learn their limbs unless someone is to be named first.

    The points: as ``correct`` takes them, ``own`` (m, 3, 3) their covariance where they stand still. Returns how many
    confirmed targets have no identity yet, each point's slot, serial and identity (m,), and covariance (m, 3, 3).
    """
    slot_of = _assigned(bank, limbs, xyz, own, trusted, time_s, rules)
    covariance = own.copy()
    nameless = correct(
        bank, slot_of, xyz, covariance, cameras, trusted, jitter_s, time_s, rules.order, rules.lowest, rules.highest,
        rules.speed_mps, rules.confirm_weight, rules.sure_from, np.empty((9, 3)), np.empty((3, 9)),
    )  # fmt: skip
    if nameless == 0 and rules.limb_m > 0.0:
        learn(bank, limbs, step_s, rules.limb_m)
    serial, identity, serials, identities = (
        np.empty_like(slot_of),
        np.empty_like(slot_of),
        bank.serial,
        bank.identity,
    )
    for r in range(slot_of.shape[0]):
        serial[r], identity[r] = serials[slot_of[r]], identities[slot_of[r]]
    return nameless, slot_of, serial, identity, covariance


@step
def _assigned(bank, limbs, xyz, covariance, trusted, time_s, rules):  # type: ignore[no-untyped-def]
    """Return which target (slot) each point goes to, or -1; confirmed targets choose first."""
    left = xyz.shape[0]
    slot_of = np.full(left, -1, np.int64)
    for state in (CONFIRMED, TENTATIVE):
        if left == 0:
            break
        slots, rows, worth = pairs(
            bank, limbs, xyz, covariance, trusted, slot_of, state, rules.gate_sigma, rules.gate_m, rules.wild_mps2,
            rules.sure_from, time_s,
        )  # fmt: skip
        if slots.shape[0] > 0:
            chosen = best_pairs(slots, rows, worth, bank.numbers[TOP], xyz.shape[0])
            for r in range(slot_of.shape[0]):
                if chosen[r] >= 0:
                    slot_of[r] = chosen[r]
                    left -= 1
    return slot_of
