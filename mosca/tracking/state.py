"""The tracker's state as columns, one row (*slot*) a track, so that compiled kernels work on all tracks at once.

A slot belongs to one track from its first point until it is deleted; ``serial`` distinguishes successive owners.
All positions in the world frame, SI units.
"""

from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array

FREE, TENTATIVE, CONFIRMED = range(3)
UNPREDICTED, BY_MOTION, BY_NEIGHBOURS = range(3)
"""Source of a track's predicted position: none, its own motion, its rigid neighbours."""
NEIGHBOURS = 10
"""Number of neighbouring tracks in a track's distance model."""
SLOTS_USED, NEXT_SERIAL, NEXT_IDENTITY, INSTANT = range(4)
"""Entries of ``Bank.counters``."""


class TrackRules(NamedTuple):
    """``mosca.tracking.tracker.TrackSettings`` as the kernels read them."""

    gate_sigma: float
    gate_m: float
    manoeuvre_mps2: float
    """Acceleration of a sudden manoeuvre, beyond what a track has shown so far."""
    least_variance: float
    """Lower limit of a track's variance of acceleration."""
    largest_variance: float
    order: int
    """Order of the motion: 2 (position, velocity) or 3 (and acceleration)."""
    speed_mps: float
    confirm_weight: float
    reliable_from: float
    """Cameras that must count in full before distances are learned from a measurement."""
    coast_s: float
    remember_s: float
    limb_m: float
    """Largest distance of a neighbour; 0 where no distances are learned."""


class Measurements(NamedTuple):
    """The m points of one instant, as the kernels read them."""

    xyz: Array
    """(m, 3) [m]"""
    covariance: Array
    """(m, 3, 3) [m^2]"""
    cameras: Array
    """(m,) number of cameras."""
    trusted: Array
    """(m,) how many of the cameras count in full."""


class Scratch(NamedTuple):
    """Working memory of one Kalman update."""

    gain: Array
    """(9, 3)"""
    rows: Array
    """(3, 9) first rows of the covariance before the update."""


class Bank(NamedTuple):
    """Filters and history of n slots."""

    counters: Array
    """(4,) slots in use, next serial, next identity, instants so far."""
    state: Array
    """(n,) FREE, TENTATIVE or CONFIRMED."""
    serial: Array
    """(n,) number of the slot's owner, -1 where free."""
    identity: Array
    """(n,) or -1."""
    missed: Array
    """(n,) instants since the last measurement."""
    reliable: Array
    """(n,) whether distances can be learned from the last measurement."""
    seen_s: Array
    """(n,) time of the last measurement."""
    born_s: Array
    """(n,) time of the first."""
    reacquired_s: Array
    """(n,) when last measured again after a pause, -1 for never; set when a slot is taken."""
    lost_s: Array
    """(n,) last measurement before that pause."""
    weight: Array
    """(n,) total weight of the measurements so far, which confirms a track."""
    variance: Array
    """(n,) variance of the acceleration, an axis."""
    mean: Array
    """(n, 9) position, velocity, acceleration."""
    covariance: Array
    """(n, 9, 9)"""
    predicted: Array
    """(n, 3) position predicted for the current instant."""
    predicted_covariance: Array
    """(n, 3, 3)"""
    source: Array
    """(n,) source of the prediction."""


class Neighbours(NamedTuple):
    """Distances of n tracks to k neighbouring tracks each."""

    slot: Array
    """(n, k) slot of the neighbour, -1 where none."""
    serial: Array
    """(n, k) ``serial`` of that slot's owner, where there is one."""
    distance: Array
    """(n, k) mean [m]."""
    variance: Array
    """(n, k) of the distance [m^2]."""
    rate2: Array
    """(n, k) mean square of its change in time [m^2/s^2]."""
    observed_s: Array
    """(n, k) how long the distance was observed [s]."""
    xyz_last_seen: Array
    """(n, k, 3) the neighbours' positions when the track itself was last seen."""
    valid: Array
    """(n, k) which neighbours were seen then."""
    own_xyz_last_seen: Array
    """(n, 3) the track's own position then."""
    rotation: Array
    """(n, 3, 3) rotation of the neighbours as one rigid body since then."""


def new_bank(slots: int) -> Bank:
    """Return an empty bank."""
    n, none = slots, np.full(slots, -1, np.int64)
    return Bank(
        counters=np.zeros(4, np.int64), state=np.zeros(n, np.int64), serial=none, identity=none.copy(),
        missed=np.zeros(n, np.int64), reliable=np.zeros(n, np.bool_), seen_s=np.zeros(n), born_s=np.zeros(n),
        reacquired_s=np.zeros(n), lost_s=np.zeros(n), weight=np.zeros(n), variance=np.zeros(n),
        mean=np.zeros((n, 9)), covariance=np.zeros((n, 9, 9)), predicted=np.zeros((n, 3)),
        predicted_covariance=np.zeros((n, 3, 3)), source=np.zeros(n, np.int64),
    )  # fmt: skip


def new_neighbours(slots: int) -> Neighbours:
    """Return a distance model without any neighbours."""
    each = (slots, NEIGHBOURS)
    return Neighbours(
        slot=np.full(each, -1, np.int64), serial=np.zeros(each, np.int64), distance=np.zeros(each),
        variance=np.zeros(each), rate2=np.zeros(each), observed_s=np.zeros(each), xyz_last_seen=np.zeros((*each, 3)),
        valid=np.zeros(each, np.bool_), own_xyz_last_seen=np.zeros((slots, 3)), rotation=np.zeros((slots, 3, 3)),
    )  # fmt: skip


def enlarged(bank: Bank, neighbours: Neighbours, slots: int) -> tuple[Bank, Neighbours]:
    """Return both with ``slots`` slots, their contents kept."""
    more = slots - len(bank.state)
    wider = [np.concatenate([a, b[:more]]) for a, b in zip(bank[1:], new_bank(slots)[1:], strict=True)]
    longer = [np.concatenate([a, b[:more]]) for a, b in zip(neighbours, new_neighbours(slots), strict=True)]
    return Bank(bank.counters, *wider), Neighbours(*longer)
