"""Data of the picture of virtual objects. Plain data, made by the scorer."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class VirtualEvidence:
    """Objects as they were shown, one row (n) for each object and display."""

    time_s: Array
    """(n,) time of the display [s from session start]."""
    age_s: Array
    """(n,) time from the newest exposure to the display [s]."""
    error_m: Array
    """(n,) distance of the object from the true position of its body; NaN where that is unknown."""
    unpredicted_m: Array
    """(n,) the same distance for the newest measured pose."""
    stated_m: Array
    """(n,) root of the trace of the stated covariance."""
    unknown: Array
    """(n,) whether the motion up to the display was unknown: starting or stale."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.time_s))
        set_read_only(self, time_s=(n,), age_s=(n,), error_m=(n,), unpredicted_m=(n,), stated_m=(n,))
        set_read_only(self, np.bool_, unknown=(n,))
