"""The tracker's work on a frame set as two compiled kernels: predict all tracks, and update them with the points.

Called by ``mosca.tracking.tracker``. Few kernels, because each return to Python waits for the GIL, which the
detection threads hold, and each call unpacks the many columns of the bank.
"""

import numpy as np

from mosca.numba_support.decorators import kernel, step
from mosca.tracking.assignment import best_pairs
from mosca.tracking.gating import gated_pairs
from mosca.tracking.kalman import predict, predictions, update
from mosca.tracking.neighbour_model import learn_distances, predict_hidden
from mosca.tracking.state import CONFIRMED, SLOTS_USED, TENTATIVE, Measurements, Scratch


@kernel
def predict_tracks(bank, neighbours, motion, time_s, step_s, rules):
    """Predict all tracks ``step_s`` ahead, to ``time_s``.

    Returns positions (k, 3) and covariances (k, 3, 3) of the confirmed tracks that have a prediction.
    """
    predict(bank, motion, time_s, rules.coast_s, rules.remember_s)
    if rules.limb_m > 0.0:
        predict_hidden(bank, neighbours, time_s, step_s, 0.5 * rules.gate_m)
    return predictions(bank)


@kernel
def update_tracks(bank, neighbours, points, jitter_s, time_s, step_s, rules):
    """Assign the points to the tracks, update these and begin new ones; learn distances unless identities are open.

    ``points``: ``Measurements`` (m) with the covariances of points at rest; ``jitter_s``: standard deviation of each
    camera's trigger. Returns how many confirmed tracks have no identity yet; slot, serial and identity (m,) of each
    point's track; and covariance (m, 3, 3) of each point.
    """
    slot_of = _assigned(bank, neighbours, points, time_s, rules)
    covariance = points.covariance.copy()
    moving = Measurements(points.xyz, covariance, points.cameras, points.trusted)
    scratch = Scratch(np.empty((9, 3)), np.empty((3, 9)))
    nameless = update(bank, slot_of, moving, jitter_s, time_s, rules, scratch)
    if nameless == 0 and rules.limb_m > 0.0:
        learn_distances(bank, neighbours, step_s, rules.limb_m)
    serial, identity = np.empty_like(slot_of), np.empty_like(slot_of)
    serials, identities = bank.serial, bank.identity
    for r in range(slot_of.shape[0]):
        serial[r], identity[r] = serials[slot_of[r]], identities[slot_of[r]]
    return nameless, slot_of, serial, identity, covariance


@step
def _assigned(bank, neighbours, points, time_s, rules):
    """Return the slot of each point's track (m,), or -1; confirmed tracks are assigned first."""
    left = points.xyz.shape[0]
    slot_of = np.full(left, -1, np.int64)
    for state in (CONFIRMED, TENTATIVE):
        if left == 0:
            break
        slots, rows, score = gated_pairs(bank, neighbours, points, slot_of, state, rules, time_s)
        if slots.shape[0] > 0:
            chosen = best_pairs(slots, rows, score, bank.counters[SLOTS_USED], points.xyz.shape[0])
            for r in range(slot_of.shape[0]):
                if chosen[r] >= 0:
                    slot_of[r] = chosen[r]
                    left -= 1
    return slot_of
