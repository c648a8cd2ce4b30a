"""The scene's geometry about one pulse, evaluated once for all cameras with similar exposure windows.

Forward kinematics at each instant of each camera is expensive, and over the few milliseconds of an exposure
everything moves along a polynomial. So an *interval* of time is sampled at Chebyshev's nodes and interpolated by
Lagrange's formula (Trefethen, Approximation Theory and Approximation Practice, chapters 4 to 6). With n nodes over a
length T, the error of a coordinate is at most ``2 (T / 4)^n / n!`` times its n-th derivative. The number of nodes is
even, so that the error is largest in the middle of the interval. It is measured there, and an interval that misses
TOLERANCE (a kink, a rotor) is evaluated instant by instant. Measured over 2 ms: 0.03 nm for a walking actor; up to
0.4 um where a kink lies beside the middle, in a robot's contacts or in noisy motion capture.

The samples that a camera gets depend on its own timing alone, not on which other cameras there are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, kernel
from twin.scenes.scene import SceneSampler

TOLERANCE = 1e-8
"""Largest error of an interpolated position, measured in the middle of an interval [m]."""
ROTATION_TOLERANCE = 1e-7
"""Largest error of an element of an interpolated rotation, measured in the middle of an interval."""
LADDER = ((0.00125, 4), (0.0025, 6), (0.005, 6), (0.010, 8), (0.025, 10))
"""Lengths of intervals [s] and their numbers of nodes."""
MARGIN_JITTERS = 6.0
"""Margin of an interval at both ends, in rms trigger jitters."""


@dataclass(frozen=True, eq=False)
class GeomPoses:
    """Poses of geoms and bodies at k instants, world frame [m]."""

    geom_xyz: Array
    """(k, g, 3)."""
    geom_rotation: Array
    """(k, g, 3, 3): geom -> world."""
    body_xyz: Array
    """(k, b, 3)."""
    body_rotation: Array
    """(k, b, 3, 3): body -> world."""


@dataclass(frozen=True)
class SampledInterval:
    """An interval of time that is sampled at ``nodes`` instants."""

    middle_s: float
    """Its middle, session clock."""
    length_s: float
    """Its length."""
    nodes: int
    """Number of Chebyshev nodes."""

    def holds(self, from_s: float, to_s: float) -> bool:
        """Whether it contains the time from ``from_s`` to ``to_s``."""
        half = 0.5 * self.length_s
        return self.middle_s - half <= from_s and to_s <= self.middle_s + half


def interval_about(middle_s: float, span_s: float, jitter_s: float) -> SampledInterval | None:
    """Return the interval for exposures of ``span_s`` about ``middle_s``; None for spans too long for LADDER."""
    wanted = span_s + 2.0 * MARGIN_JITTERS * jitter_s
    for length, nodes in LADDER:
        if wanted <= length:
            return SampledInterval(middle_s, length, nodes)
    return None


class SceneSamples:
    """The poses of a scene during one pulse period, for one worker; remembers what it has evaluated.

    ``geoms`` (g,) and ``bodies`` (b,): the ids to be sampled.
    """

    def __init__(self, sampler: SceneSampler, geoms: Array, bodies: Array) -> None:
        self._sampler, self._geoms, self._bodies = sampler, geoms, bodies
        self._known: dict[float, Array] = {}
        self._intervals: dict[SampledInterval, tuple[Array, Array] | None] = {}
        g, b = len(geoms), len(bodies)
        self._tolerance = np.repeat([TOLERANCE, ROTATION_TOLERANCE] * 2, [3 * g, 9 * g, 3 * b, 9 * b])

    def at(self, times_s: Array, interval: SampledInterval | None = None) -> GeomPoses:
        """Return the poses at instants (k,); ``interval``: the one in which they should lie."""
        rows = None
        if interval is not None and interval.holds(float(times_s.min()), float(times_s.max())):
            nodes = self._sampled(interval)
            if nodes is not None:
                rows = interpolated(*nodes, times_s)
        if rows is None:
            rows = np.stack([self._exact(float(t)) for t in times_s])
        k, g, b = len(times_s), len(self._geoms), len(self._bodies)
        rotations, bodies, body_rotations = 3 * g, 12 * g, 12 * g + 3 * b
        return GeomPoses(
            rows[:, :rotations].reshape(k, g, 3),
            rows[:, rotations:bodies].reshape(k, g, 3, 3),
            rows[:, bodies:body_rotations].reshape(k, b, 3),
            rows[:, body_rotations:].reshape(k, b, 3, 3),
        )

    def hold(self, time_s: float) -> SceneSampler:
        """Return the sampler with its data at ``time_s``, for calls of MuJoCo itself."""
        self._sampler.at(time_s)
        return self._sampler

    def _exact(self, time_s: float) -> Array:
        """Return all coordinates at an instant as one row."""
        row = self._known.get(time_s)
        if row is None:
            state = self._sampler.at(time_s)
            data = self._sampler.data
            row = self._known[time_s] = np.concatenate(
                [
                    state.geom_xyz.take(self._geoms, axis=0).ravel(),
                    state.geom_rotation.take(self._geoms, axis=0).ravel(),
                    data.xpos.take(self._bodies, axis=0).ravel(),
                    data.xmat.take(self._bodies, axis=0).ravel(),
                ]
            )
        return row

    def _sampled(self, interval: SampledInterval) -> tuple[Array, Array] | None:
        """Return an interval's nodes (n,) and rows (n, d); None where interpolation would miss the tolerance."""
        if interval not in self._intervals:
            times = chebyshev_nodes(interval.middle_s, interval.length_s, interval.nodes)
            rows = np.stack([self._exact(float(t)) for t in times])
            middle = interpolated(times, rows, np.array([interval.middle_s]))
            off = np.abs(middle[0] - self._exact(interval.middle_s))
            self._intervals[interval] = (times, rows) if (off <= self._tolerance).all() else None
        return self._intervals[interval]


def chebyshev_nodes(middle: float, length: float, n: int) -> Array:
    """Return the n zeros of Chebyshev's polynomial over an interval, rising."""
    return middle - 0.5 * length * np.cos(np.pi * (np.arange(n) + 0.5) / n)


def lobatto_nodes(span: float, n: int) -> Array:
    """Return the n Chebyshev-Gauss-Lobatto nodes of 0..span, both ends among them, rising."""
    return 0.5 * span * (1.0 - np.cos(np.pi * np.arange(n) / (n - 1)))


def interpolated(nodes: Array, values: Array, times: Array) -> Array:
    """Return the polynomial through ``values`` (n, d) at ``nodes`` (n,), evaluated at ``times`` (k,): (k, d)."""
    return np.asarray(_interpolated(nodes, values, np.ascontiguousarray(times, dtype=float)))


@kernel
def _interpolated(nodes: Array, values: Array, times: Array) -> Any:
    out = np.zeros((times.shape[0], values.shape[1]))
    for k in range(times.shape[0]):
        for i in range(nodes.shape[0]):
            weight = 1.0
            for j in range(nodes.shape[0]):
                if i != j:
                    weight *= (times[k] - nodes[j]) / (nodes[i] - nodes[j])
            for d in range(values.shape[1]):
                out[k, d] += weight * values[i, d]
    return out


@dataclass(frozen=True, eq=False)
class View:
    """Targets and the solids that hide them, in the frame of a camera at K instants [m]."""

    path: Array
    """(m, K, 3): centres of the targets."""
    rotation: Array
    """(m, K, 3, 3): target's axes -> camera frame."""
    solid_xyz: Array
    """(K, s, 3): centres of the solids that hide."""
    solid_rotation: Array
    """(K, s, 3, 3): solid -> camera frame."""


def seen_from(rotation: Array, position: Array, poses: GeomPoses, targets: Array, solids: Array, count: int) -> View:
    """Return targets and solids in a camera's frame at the first ``count`` instants of ``poses``.

    ``rotation`` (k, 3, 3), ``position`` (k, 3): its ``world_from_camera``; ``targets`` (m,) and ``solids`` (s,):
    numbers of the geoms of ``poses``.
    """
    return View(*_seen_from(rotation, position, poses.geom_xyz, poses.geom_rotation, targets, solids, count))


@kernel
def _seen_from(
    rotation: Array, position: Array, xyz: Array, geom_rotation: Array, targets: Array, solids: Array, count: int
) -> Any:
    path, path_rotation = np.empty((targets.shape[0], count, 3)), np.empty((targets.shape[0], count, 3, 3))
    solid, solid_rotation = np.empty((count, solids.shape[0], 3)), np.empty((count, solids.shape[0], 3, 3))
    for k in range(count):
        r, p = rotation[k], position[k]
        for m in range(targets.shape[0]):
            _in_camera(r, p, xyz[k, targets[m]], geom_rotation[k, targets[m]], path[m, k], path_rotation[m, k])
        for s in range(solids.shape[0]):
            _in_camera(r, p, xyz[k, solids[s]], geom_rotation[k, solids[s]], solid[k, s], solid_rotation[k, s])
    return path, path_rotation, solid, solid_rotation


@bare_step
def _in_camera(
    rotation: Array, position: Array, xyz: Array, geom_rotation: Array, xyz_here: Array, rotation_here: Array
) -> None:
    """Write a position and its axes in the frame of a camera to ``xyz_here`` and ``rotation_here``."""
    x, y, z = xyz[0] - position[0], xyz[1] - position[1], xyz[2] - position[2]
    for i in range(3):
        a, b, c = rotation[0, i], rotation[1, i], rotation[2, i]
        xyz_here[i] = a * x + b * y + c * z
        for j in range(3):
            rotation_here[i, j] = a * geom_rotation[0, j] + b * geom_rotation[1, j] + c * geom_rotation[2, j]
