"""Tracks: predict, gate, assign, update; identities survive occlusion and absence.

Each track is a Kalman filter (``mosca.tracking.motion_models``: constant velocity or Singer's acceleration). Points
and predictions within the gates (``mosca.tracking.gating``) are paired by the assignment of greatest likelihood
(``mosca.tracking.assignment``). A new track is tentative until its points weigh enough: a point of n cameras has the
weight n - 1, since two cameras can agree by chance (images of odd size count for less than one). The samples of a
track are returned when it is confirmed, the earlier ones with them. An occluded track is predicted by its own motion
or, longer, by its rigid neighbours (``mosca.tracking.neighbour_model``). A new track that fits the distances of a
lost one gets its identity. The samples are the measured points, not the filter's estimates: no smoothing hides
errors.
"""

from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rays import Predicted
from mosca.data.settings import TrackSettings as TrackSettings
from mosca.data.tracks import Points, Samples
from mosca.tracking.motion_models import motion
from mosca.tracking.motion_scale import PERSON_SPACE_M, MotionScale, motion_scale
from mosca.tracking.neighbour_model import learn_distances, reacquired_nearby, reidentified, take_over
from mosca.tracking.state import (
    CONFIRMED,
    FREE,
    NEXT_IDENTITY,
    SLOTS_USED,
    Measurements,
    TrackRules,
    enlarged,
    new_bank,
    new_neighbours,
)
from mosca.tracking.step import predict_tracks, update_tracks

FIRST_SLOTS = 64
LEAST_ACCELERATION, LARGEST_ACCELERATION, MANOEUVRE_ACCELERATION = 0.2, 4.0, 6.0
"""Limits of a track's adapted acceleration, and that of a sudden manoeuvre, over the settings' acceleration."""
RELIABLE_CAMERAS = 1.5
"""Cameras that must count in full before distances are learned from a measurement."""
RETURN_SPEED = 4.0
"""Speed at which a lost target may have moved, in units of the settings' speed."""
SAME_TARGET_SHARE = 0.25
"""Distance, over the largest gate, up to which an unnamed track and a reacquired one are the same target."""
CONVINCING = 6.0
"""Log-likelihood ratio of distances from which a new track is taken for a lost one."""


class Tracker:
    """Follows targets from frame set to frame set. It keeps state: points must come in order of time."""

    def __init__(self, settings: TrackSettings, edge_m: float = PERSON_SPACE_M) -> None:
        self.settings = settings
        self.scale_to(edge_m)
        self._bank, self._neighbours = new_bank(FIRST_SLOTS), new_neighbours(FIRST_SLOTS)
        self._time_s: float | None = None
        self._step_s = 0.0
        self._waiting: list[tuple[Samples, Array]] = []

    def scale_to(self, edge_m: float) -> None:
        """Set lengths and speeds that the settings leave open to those of a space of ``edge_m`` [m]."""
        self._rules = _rules(self.settings, motion_scale(self.settings, edge_m))

    def predict(self, time_s: float) -> Predicted:
        """Predict all tracks at ``time_s`` [s]; return positions and covariances of the confirmed ones."""
        s = self.settings
        step = 0.0 if self._time_s is None else time_s - self._time_s
        if step < 0.0:
            raise ValueError(f"time {time_s} s lies before {self._time_s} s: points must come in order")
        self._time_s, self._step_s = float(time_s), float(step)
        move = motion(s.model, self._step_s, s.memory_s)
        return Predicted(*predict_tracks(self._bank, self._neighbours, move, self._time_s, self._step_s, self._rules))

    def update(self, points: Points, frame: int, time_ns: int, jitter_s: float = 0.0) -> Samples:
        """Assign the points of the instant last predicted to the tracks; return the samples of known identity.

        ``jitter_s``: standard deviation of each camera's trigger [s]; it spreads moving points along their paths.
        """
        n, used = len(points), int(self._bank.counters[SLOTS_USED])
        if used + n > len(self._bank.state):
            self._bank, self._neighbours = enlarged(self._bank, self._neighbours, 2 * (used + n))
        bank, rules = self._bank, self._rules
        measured = Measurements(points.xyz, points.covariance, points.n_cameras, points.trusted)
        nameless, slot_of, serial, identity, covariance = update_tracks(
            bank, self._neighbours, measured, float(jitter_s), self._time_s, self._step_s, rules
        )
        named = {}
        if nameless:
            named = self._identified(slot_of)
            identity = bank.identity[slot_of]
            if rules.limb_m > 0.0:
                learn_distances(bank, self._neighbours, self._step_s, rules.limb_m)
        now = Samples(
            np.full(n, frame), np.full(n, time_ns), identity, points.xyz, covariance,
            points.n_cameras, points.residual_px, np.zeros(n, np.int8),
        )  # fmt: skip
        return self._certain(now, serial, named)

    @property
    def waiting(self) -> int:
        """Number of samples that wait for their track's identity; those still waiting at a run's end are left out."""
        return sum(len(samples) for samples, _ in self._waiting)

    def _identified(self, slot_of: Array) -> dict[int, int]:
        """Give each unnamed confirmed track the identity of a lost one whose distances it fits, or a new one.

        Returns serial -> identity; ``slot_of`` (m,) is corrected for tracks that continue in their earlier slot.
        """
        bank, s, rules = self._bank, self.settings, self._rules
        top, named, now = int(bank.counters[SLOTS_USED]), {}, self._time_s
        for slot in np.flatnonzero((bank.state[:top] == CONFIRMED) & (bank.identity[:top] < 0)).tolist():
            serial, old, possible = int(bank.serial[slot]), -1, False
            if rules.limb_m > 0.0 and bank.missed[slot] == 0:
                speed = RETURN_SPEED * rules.speed_mps
                old, possible = reidentified(bank, self._neighbours, slot, now, CONVINCING, rules.limb_m, speed)
            elif rules.limb_m > 0.0:
                old, possible = reacquired_nearby(bank, slot, now, SAME_TARGET_SHARE * rules.gate_m), True
            if old >= 0 and bank.missed[slot] > 0:
                bank.state[slot], bank.serial[slot] = FREE, -1
            elif old >= 0:
                take_over(bank, old, slot)
                slot_of[slot_of == slot] = old
            elif possible and now - bank.born_s[slot] < s.name_wait_s:
                continue
            else:
                old = slot
                bank.identity[slot] = bank.counters[NEXT_IDENTITY]
                bank.counters[NEXT_IDENTITY] += 1
            named[serial] = int(bank.identity[old])
        return named

    def _certain(self, now: Samples, serial: Array, named: dict[int, int]) -> Samples:
        """Return the samples of known identity, present and earlier ones; keep those whose identity is open."""
        if not self._waiting and (len(now) == 0 or now.track.min() >= 0):
            return now
        waiting = [
            (replace(samples, track=np.array([named.get(int(k), -1) for k in serials])), serials)
            for samples, serials in self._waiting
        ]
        waiting.append((now, serial))
        bank = self._bank
        nameless = bank.serial[(bank.state != FREE) & (bank.identity < 0)]
        kept = [(s, k, (s.track < 0) & np.isin(k, nameless)) for s, k in waiting]
        self._waiting = [(s.select(rows), k[rows]) for s, k, rows in kept if rows.any()]
        return Samples.joined([samples.select(samples.track >= 0) for samples, _ in waiting])


def _rules(settings: TrackSettings, scale: MotionScale) -> TrackRules:
    """Return the settings as the kernels read them."""
    s = settings
    return TrackRules(
        gate_sigma=s.gate_sigma,
        gate_m=scale.gate_m,
        manoeuvre_mps2=MANOEUVRE_ACCELERATION * scale.acceleration_mps2,
        least_variance=(LEAST_ACCELERATION * scale.acceleration_mps2) ** 2,
        largest_variance=(LARGEST_ACCELERATION * scale.acceleration_mps2) ** 2,
        order=3 if s.model == "acceleration" else 2,
        speed_mps=scale.speed_mps,
        confirm_weight=s.confirm_weight,
        reliable_from=RELIABLE_CAMERAS,
        coast_s=s.coast_s,
        remember_s=max(s.remember_s, s.coast_s),
        limb_m=scale.limb_m,
    )
