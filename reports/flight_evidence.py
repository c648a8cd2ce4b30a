"""Data of the picture of a flight in closed loop. Plain data, made by the scorer."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class FlightEvidence:
    """A flight, control step by control step (n)."""

    time_s: Array
    wanted: Array
    """(n, 3) [m]"""
    position: Array
    """(n, 3) true [m]."""
    estimated: Array
    """(n, 3) predicted for each instant [m]; NaN before the first pose."""
    pose_age_s: Array
    """(n,) age of the newest pose that was used; infinite before the first pose."""
    scored_from_s: float
    crash: str
    """The crash in words; "" where there was none."""
    crashed_s: float
    believed_delay_s: float
    delay_words: str
    """The delay estimated from the flight's log, or the reason why there is no estimate."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.time_s))
        set_read_only(self, time_s=(n,), wanted=(n, 3), position=(n, 3), estimated=(n, 3), pose_age_s=(n,))
