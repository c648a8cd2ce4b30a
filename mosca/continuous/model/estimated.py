"""Settings and result of the continuous-time estimate."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.continuous.model.bspline import Knots, values
from mosca.continuous.model.camera_paths import PosedCameras, StillCameras
from mosca.data.arrays import Array


@dataclass(frozen=True)
class ContinuousSettings:
    """Settings of the continuous-time estimate."""

    clocks: Literal["known", "offset", "drift", "rolling"] = "known"
    """"known": time stamps are right. Otherwise the unknowns of each camera's clock that are estimated: "offset";
    "drift", offset and drift; "rolling", also the rolling shutter's row time."""
    cameras: Literal["known", "fixed", "moving"] = "known"
    """"known" poses, "fixed" unknown poses (the rig's are the start), or "moving" cameras."""
    limbs: bool = True
    """Find constant distances and use them."""
    knot_s: float | None = None
    """Knot spacing [s]; None: from the data's rate."""
    most_together: int = 60
    """Most points with a joint acceleration covariance; more are split into groups."""
    rounds: int = 8
    """Iterations of the variance estimation with constant distances."""
    reach_s: float = 0.0
    """Time before and after the observations over which curves are predicted [s]."""


@dataclass(frozen=True)
class Clock:
    """A camera's clock: time of an image point = offset_s + (1 + drift) * time_s + row_time_s * y_px.

    The sigmas are standard deviations, 0 for values that were not estimated; ``held``: names of values that the data
    did not determine and that were not changed.
    """

    camera: str
    offset_s: float = 0.0
    drift: float = 0.0
    row_time_s: float = 0.0
    offset_sigma_s: float = 0.0
    drift_sigma: float = 0.0
    row_time_sigma_s: float = 0.0
    held: tuple[str, ...] = ()


@dataclass(frozen=True)
class ConstantDistance:
    """Two points a constant distance apart [m]; ``slack_m``: standard deviation of its true variation [m]."""

    one: str
    other: str
    distance_m: float
    slack_m: float


@dataclass(frozen=True, eq=False)
class SplineCurves:
    """Curves of points as B-splines: ``coefficients`` (count, points, 3) [m].

    ``blocks`` (degree + 1, count, points, 3, 3): covariances between coefficients k + o and k of one point;
    ``carried`` (count, points, 3, b) and ``shared`` (b, b): the part from unknowns that do not depend on time;
    ``beyond`` (points, 3, 3): covariance of motion above the knot frequency, to be multiplied by ``pace``
    (pieces + 1,) at the knots; ``unheld`` (pieces + 1, points, 3, 3): errors at the knots missing from the curves'
    covariance (``residual_covariance``) [m^2]. ``from_s``, ``to_s`` (points,): between these the point is known [s].
    """

    points: tuple[str, ...]
    knots: Knots
    coefficients: Array
    blocks: Array
    carried: Array
    shared: Array
    beyond: Array
    pace: Array
    unheld: Array
    from_s: Array
    to_s: Array

    def at(self, time_s: Array) -> Array:
        """Return the positions (t, points, 3) [m] at the instants ``time_s`` (t,); NaN where a point was not seen."""
        return self._known(values(self.knots, self.coefficients, time_s), time_s)

    def covariance_at(self, time_s: Array) -> Array:
        """Return the covariances (t, points, 3, 3) [m^2] at the instants ``time_s`` (t,)."""
        first, weight = self.knots.weights(time_s)
        pace = np.interp(time_s, self.knots.breaks_s, self.pace)
        linear = replace(self.knots, degree=1)
        total = pace[:, None, None, None] * self.beyond + values(linear, self.unheld, time_s)
        for a in range(weight.shape[1]):
            for b in range(a + 1):
                part = (weight[:, a] * weight[:, b])[:, None, None, None] * self.blocks[a - b, first + b]
                total += part if a == b else part + np.swapaxes(part, 2, 3)
        if len(self.shared):
            by_shared = values(self.knots, self.carried, time_s)
            total += np.einsum("tpib,bc,tpjc->tpij", by_shared, self.shared, by_shared)
        return self._known(total, time_s)

    def reaching(self, farther_s: float) -> "SplineCurves":
        """Return the curves extended by predictions for ``farther_s`` before and after each point was seen."""
        begin, end = self.knots.start_s, self.knots.end_s
        return replace(
            self, from_s=np.maximum(self.from_s - farther_s, begin), to_s=np.minimum(self.to_s + farther_s, end)
        )

    def _known(self, of_points: Array, time_s: Array) -> Array:
        t = np.asarray(time_s)[:, None]
        slack = 1e-9 + 1e-9 * self.knots.step_s
        of_points = np.array(of_points)
        of_points[(t < self.from_s - slack) | (t > self.to_s + slack)] = np.nan
        return of_points


@dataclass(frozen=True, eq=False)
class SplinePaths:
    """World_from_camera as functions of time: a start path rotated by curves, and centres that are curves.

    R(t) = R_start(t) exp([w(t)]x); ``coefficients`` (count, cameras, 6) of w [rad] and of the centre [m];
    ``frame`` (count, cameras, 6): initial coefficients, near which the frame is held.
    """

    cameras: tuple[str, ...]
    start: PosedCameras
    knots: Knots
    coefficients: Array
    frame: Array

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return rotations (t, cameras, 3, 3) and centres (t, cameras, 3) [m], world_from_camera."""
        rotation, _ = self.start.at(time_s)
        change = values(self.knots, self.coefficients, time_s)
        turn = Rotation.from_rotvec(change[..., :3].reshape(-1, 3)).as_matrix().reshape(rotation.shape)
        return rotation @ turn, change[..., 3:]


@dataclass(frozen=True, eq=False)
class ContinuousEstimate:
    """Curves, cameras' paths and clocks, the constant distances found, and findings about them.

    ``sigma0``: image residuals in units of their stated standard deviations (1 where these are right); ``of_camera``
    (c,): the same for each camera; ``seconds``: computing time of the estimate.
    """

    curves: SplineCurves
    paths: SplinePaths | StillCameras
    clocks: tuple[Clock, ...]
    distances: tuple[ConstantDistance, ...]
    findings: tuple[str, ...]
    sigma0: float
    of_camera: Array
    seconds: float
