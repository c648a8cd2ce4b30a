"""Trajectories: predict, gate, assign, update; identities survive occlusion and absence.

Each target is a Kalman filter (``mosca.tracking.motion_models``: constant velocity or Singer's acceleration).
Points and predictions are paired by the assignment of greatest likelihood (``mosca.tracking.assignment``). A new
target is tentative until its sightings weigh enough: a sighting by n cameras weighs n - 1, since two cameras can
agree by chance (images of odd size count for less than one); its samples are handed out when it is confirmed, the
earlier ones with them. A hidden target is expected where its own motion brings it, or, longer, where its limb does
(``mosca.tracking.rigid_neighbours``); one that was lost and fits into its limb again gets its identity back. What
is handed out is the measured point, not the filter's: no smoothing hides errors.
"""

import numpy as np

from mosca.correspondence.match import Predicted
from mosca.data.arrays import Array
from mosca.data.settings import TrackSettings as TrackSettings
from mosca.data.tracks import Points, Samples
from mosca.tracking.motion_models import motion
from mosca.tracking.rigid_neighbours import found_instead, learn, recall, take_over
from mosca.tracking.state import CONFIRMED, FREE, IDENTITY, TOP, grown, new_bank, new_limbs
from mosca.tracking.step import Rules, follow, foresee

FIRST_SLOTS = 64
CALMEST, WILDEST, OUTBURST = 0.2, 4.0, 6.0
"""Limits of a target's learned acceleration and what it may do beyond that, in those that the settings expect."""
SURE = 1.5
"""Cameras that must count in full for a sighting that teaches distances."""
FASTEST = 4.0
"""Speed at which a lost target may come back, in those that the settings expect."""
TWIN_SHARE = 0.25
"""A nameless target and a lost one found again so near to it (in largest gates) are the same."""
CONVINCING = 6.0
"""Log-likelihood ratio of distances by which a lost target is known again."""


class Tracker:
    """Follows targets from frame set to frame set. The state is its own; hand it points in order of time."""

    def __init__(self, settings: TrackSettings) -> None:
        self.settings = settings
        self._rules = _rules(settings)
        self._bank, self._limbs = new_bank(FIRST_SLOTS), new_limbs(FIRST_SLOTS)
        self._time_s: float | None = None
        self._step_s = 0.0
        self._waiting: list[tuple[Samples, Array]] = []

    def predict(self, time_s: float) -> Predicted:
        """Carry all targets to ``time_s`` [s] and return where the confirmed ones are expected."""
        s = self.settings
        step = 0.0 if self._time_s is None else time_s - self._time_s
        if step < 0.0:
            raise ValueError(f"time {time_s} s lies before {self._time_s} s: points must come in order")
        self._time_s, self._step_s = float(time_s), float(step)
        step_of = motion(s.model, self._step_s, s.memory_s)
        return Predicted(*foresee(self._bank, self._limbs, step_of, self._time_s, self._step_s, self._rules))

    def update(self, points: Points, frame: int, time_ns: int, jitter_s: float = 0.0) -> Samples:
        """Give the points of the instant last predicted to the targets; return samples that are now certain.

        ``jitter_s``: of each camera's trigger, standard deviation; it spreads moving points along their paths.
        """
        self._make_room(len(points))
        bank, rules = self._bank, self._rules
        nameless, slot_of, serial, identity, covariance = follow(
            bank, self._limbs, points.xyz, points.covariance, points.n_cameras, points.trusted, float(jitter_s),
            self._time_s, self._step_s, rules,
        )  # fmt: skip
        named = {}
        if nameless:
            named = self._named(slot_of)
            identity = bank.identity[slot_of]
            if rules.limb_m > 0.0:
                learn(bank, self._limbs, self._step_s, rules.limb_m)
        n = len(points)
        now = Samples(
            np.full(n, frame), np.full(n, time_ns), identity, points.xyz, covariance,
            points.n_cameras, points.residual_px, np.zeros(n, np.int8),
        )  # fmt: skip
        return self._certain(now, serial, named)

    @property
    def waiting(self) -> int:
        """How many samples are held back because their target has no name yet; at a run's end they are left out."""
        return sum(len(samples) for samples, _ in self._waiting)

    def _make_room(self, points: int) -> None:
        need = int(self._bank.numbers[TOP]) + points
        if need > len(self._bank.state):
            self._bank, self._limbs = grown(self._bank, self._limbs, 2 * need)

    def _named(self, slot_of: Array) -> dict[int, int]:
        """Give each target confirmed now the identity of a lost one whose limb it fits, or a new one.

        Returns serial -> identity; ``slot_of`` follows a target to the slot that it had.
        """
        bank, s = self._bank, self.settings
        top, named, now = int(bank.numbers[TOP]), {}, self._time_s
        for slot in np.flatnonzero((bank.state[:top] == CONFIRMED) & (bank.identity[:top] < 0)).tolist():
            serial, old, possible = int(bank.serial[slot]), -1, False
            if s.limb_m > 0.0 and bank.missed[slot] == 0:
                old, possible = recall(
                    bank, self._limbs, slot, now, CONVINCING, s.limb_m, FASTEST * s.speed_mps
                )
            elif s.limb_m > 0.0:
                old, possible = found_instead(bank, slot, now, TWIN_SHARE * s.gate_m), True
            if old >= 0 and bank.missed[slot] > 0:
                bank.state[slot], bank.serial[slot] = FREE, -1
            elif old >= 0:
                take_over(bank, old, slot)
                slot_of[slot_of == slot] = old
            elif possible and now - bank.born_s[slot] < s.name_wait_s:
                continue
            else:
                old = slot
                bank.identity[slot] = bank.numbers[IDENTITY]
                bank.numbers[IDENTITY] += 1
            named[serial] = int(bank.identity[old])
        return named

    def _certain(self, now: Samples, serial: Array, named: dict[int, int]) -> Samples:
        """Return the samples of known identity, now's and earlier ones; keep those of tentative targets."""
        if not self._waiting and (len(now) == 0 or now.track.min() >= 0):
            return now
        certain = []
        for samples, serials in self._waiting:
            samples.track[:] = [named.get(int(k), -1) for k in serials]
            certain.append(samples.select(samples.track >= 0))
        certain.append(now.select(now.track >= 0))
        bank = self._bank
        nameless = bank.serial[(bank.state != FREE) & (bank.identity < 0)]
        self._waiting.append((now, serial))
        kept = [(s, k, (s.track < 0) & np.isin(k, nameless)) for s, k in self._waiting]
        self._waiting = [(s.select(rows), k[rows]) for s, k, rows in kept if rows.any()]
        return Samples.joined(certain)


def _rules(settings: TrackSettings) -> Rules:
    """Return the settings as the kernels read them."""
    s = settings
    return Rules(
        gate_sigma=float(s.gate_sigma),
        gate_m=float(s.gate_m),
        wild_mps2=OUTBURST * s.acceleration_mps2,
        lowest=(CALMEST * s.acceleration_mps2) ** 2,
        highest=(WILDEST * s.acceleration_mps2) ** 2,
        order=3 if s.model == "acceleration" else 2,
        speed_mps=float(s.speed_mps),
        confirm_weight=float(s.confirm_weight),
        sure_from=SURE,
        coast_s=float(s.coast_s),
        memory_s=float(max(s.remember_s, s.coast_s)),
        limb_m=float(s.limb_m),
    )
