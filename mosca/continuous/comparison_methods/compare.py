"""The second paper's own trajectory models on the image points of a reconstruction, for comparison with its curves.

Every method gets the same named image points on the same clock, and the rig's poses. The methods differ only in the
trajectory model.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from mosca.continuous.comparison_methods.interpolated import interpolated
from mosca.continuous.comparison_methods.neural import neural
from mosca.continuous.model.observations import Curves
from mosca.continuous.reconstruct import Reconstructed
from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.errors import InputError

Method = Literal["linear", "cubic", "neural"]
METHODS: tuple[Method, ...] = get_args(Method)


def reconstruct_by(method: Method, found: Reconstructed, time_ns: Array) -> Tracks:
    """Return the tracks that one of the METHODS computes from a reconstruction's image points.

    "linear", "cubic": image tracks interpolated to common instants (``interpolated``); "neural": networks of time
    (``neural``), started at the cubic result; their cost grows with the cube of the number of exposures. ``time_ns``
    (t,): stamps of the first camera's clock. Tracks are numbered and named as those of ``found``; their covariances
    are NaN, since these methods state none. InputError for an unknown method, for cameras that move, and where the
    cameras share no time.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown; allowed: {', '.join(METHODS)}")
    if found.cameras is not None:
        raise InputError(
            f"method '{method}': cameras that move (moving = true) are not compared; it takes the rig's poses"
        )
    curves: Curves
    if method == "neural":
        curves = neural(found.observations, found.rig, interpolated(found.observations, found.rig, "cubic"))
    else:
        curves = interpolated(found.observations, found.rig, method)
    return found.tracks(time_ns, _WithoutCovariance(curves))


@dataclass(frozen=True, eq=False)
class _WithoutCovariance:
    """Curves of a method that states no uncertainty."""

    curves: Curves

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the points."""
        return self.curves.points

    def at(self, time_s: Array) -> Array:
        """Return the positions (t, points, 3) [m]."""
        return self.curves.at(time_s)

    def covariance_at(self, time_s: Array) -> Array:
        """Return NaN (t, points, 3, 3)."""
        return np.full((len(time_s), len(self.points), 3, 3), np.nan)
