"""Data of the pictures of a self-orientation. Plain data, made by the scorer."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class SelfOrientationEvidence:
    """Errors of a camera's own poses and of its poses by a rig, against the truth, and the error budget."""

    time_s: Array
    """(n,)"""
    own_errors: Array
    """(n, 6) measured minus true: X, Y, Z [m], omega, alpha, kappa [rad]."""
    own_sigma: Array
    """(n, 6) stated standard deviations."""
    rig_errors: Array
    """(n, 6)"""
    rig_sigma: Array
    """(n, 6)"""
    shares: Mapping[str, float]
    """Source of error -> its share of the squared difference in position."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.time_s))
        set_read_only(self, time_s=(n,), own_errors=(n, 6), own_sigma=(n, 6), rig_errors=(n, 6), rig_sigma=(n, 6))
