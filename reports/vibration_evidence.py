"""Data of the pictures of a vibration. Plain data, made by the analysis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class VibrationEvidence:
    """Data of the pictures of a vibration."""

    frequency_hz: Array
    """(k,)"""
    density: Array
    """(k,) mean of the channels' densities [m^2/Hz]."""
    largest: Array
    """(k, s) the largest singular values [m^2/Hz]."""
    interval95: tuple[float, float]
    """Factors on a density that give its 95 % interval."""
    floor_m2_per_hz: float
    expected_m2_per_hz: float
    modes_hz: Array
    """(n,)"""
    lines: Sequence[bool]
    """Whether each of these modes is a steady line."""
    place: Array
    """(m, 3) targets [m]."""
    shapes: Array
    """(n, m) deflection of each target in each mode; the largest of a mode has size 1."""
    rate_hz: float

    def __post_init__(self) -> None:
        k, n, m = len(np.asarray(self.frequency_hz)), len(np.asarray(self.modes_hz)), len(np.asarray(self.place))
        set_read_only(self, frequency_hz=(k,), density=(k,), largest=(k, None), modes_hz=(n,), place=(m, 3))
        set_read_only(self, shapes=(n, m))
