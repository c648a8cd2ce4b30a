"""What the picture of virtual objects shows. Plain data, made by who scores."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class VirtualEvidence:
    """Objects as they were shown, one row an object and display (n)."""

    time_s: Array
    """(n,) of the display [s from session start]."""
    age_s: Array
    """(n,) from the newest exposure to the display [s]."""
    error_m: Array
    """(n,) distance of the object from where its body really was; NaN where that is not known."""
    unpredicted_m: Array
    """(n,) the same for the newest pose as it was measured."""
    stated_m: Array
    """(n,) root of the trace of the stated covariance."""
    unknown: Array
    """(n,) whether its motion up to the display was not known: starting or stale."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.time_s))
        set_read_only(self, time_s=(n,), age_s=(n,), error_m=(n,), unpredicted_m=(n,), stated_m=(n,))
        set_read_only(self, np.bool_, unknown=(n,))
