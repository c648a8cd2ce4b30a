"""Camera poses in the neural trajectory: known, one unknown pose each, or networks of time like the points.

Each kind provides the poses at given instants, their derivatives by the unknowns z, and the cameras after a step dz.
For networks, z are amplitudes of the patterns that a step of their weights can produce at the instants of the
exposures (eigenvectors of the tangent kernel), scaled so that |dz| is the length of the step.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.camera.projection import cross_matrices
from mosca.continuous.comparison_methods.moving_projection import rotated
from mosca.continuous.comparison_methods.neural_net import Nets, Tangent, fitted
from mosca.continuous.model.camera_paths import StillCameras
from mosca.continuous.model.observations import CameraPaths
from mosca.data.arrays import Array

MOST_PATTERNS, LEAST_SHARE = 40, 1e-7
"""Most patterns of a network that are kept, and the least eigenvalue as a share of the largest."""
STILL = 1e-6
"""Least spread of a component [rad, m]."""


class PoseModel(CameraPaths, Protocol):
    """Poses world_from_camera of c cameras over time; z (c, 6 r) are the unknowns."""

    def slopes(self, time_s: Array) -> Array:
        """Return derivatives (t, c, 6, u) of rotation about the camera's own axes and position by its u unknowns."""

    def moved(self, time_s: Array, z: Array) -> "PoseModel":
        """Return the cameras after a step z (c, u) of the unknowns of ``slopes(time_s)``; the first camera stays."""


class SteadyPoses(StillCameras):
    """Cameras that do not move."""

    def slopes(self, time_s: Array) -> Array:
        """As PoseModel: the six of the pose itself."""
        return np.tile(np.eye(6), (len(time_s), len(self.cameras), 1, 1))

    def moved(self, time_s: Array, z: Array) -> "SteadyPoses":
        """As PoseModel."""
        return replace(self, rotations=rotated(self.rotations, z[:, :3]), centres=self.centres + z[:, 3:])


@dataclass(frozen=True, eq=False)
class NetPoses:
    """Cameras as networks, one for each of the six components: rotation from ``middle`` (c, 3, 3), and position
    relative to ``origin`` (c, 3), in units of ``spread`` (c, 6) [rad, m]. ``spread`` is the component's variation in
    the initial state, so that a step of given length moves nearly stationary cameras little and body-worn ones far.
    """

    cameras: tuple[str, ...]
    nets: Nets  # 6 c of them
    middle: Array
    origin: Array
    spread: Array

    @classmethod
    def fit(cls, cameras: tuple[str, ...], nets: Nets, time_s: Array, rotations: Array, centres: Array) -> "NetPoses":
        """Return networks fitted to poses (t, c, 3, 3), (t, c, 3) at ``time_s`` (t,)."""
        c = len(cameras)
        middle = np.array([Rotation.from_matrix(rotations[:, k]).mean().as_matrix() for k in range(c)])
        origin = centres.mean(axis=0)
        turn = np.stack([Rotation.from_matrix(middle[k].T @ rotations[:, k]).as_rotvec() for k in range(c)], axis=1)
        values = np.concatenate([turn, centres - origin], axis=2)  # (t, c, 6)
        spread = np.maximum(values.std(axis=0), STILL)
        flat = np.moveaxis((values / spread).reshape(len(time_s), -1), 1, 0)[..., None]
        return cls(cameras, fitted(nets, time_s, flat, steps=3), middle, origin, spread)

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """As PoseModel."""
        turn, place = self._components(time_s)
        t, c = turn.shape[:2]
        middle = np.tile(self.middle, (t, 1, 1, 1)).reshape(-1, 3, 3)
        rotations = rotated(middle, turn.reshape(-1, 3)).reshape(t, c, 3, 3)
        return rotations, self.origin + place

    def slopes(self, time_s: Array) -> Array:
        """As PoseModel: the patterns of each component's network."""
        turn, _ = self._components(time_s)
        t, c = turn.shape[:2]
        patterns, strength, _ = self._patterns(time_s)
        rank = strength.shape[1]
        own = (patterns * np.sqrt(strength)[:, None]).reshape(c, 6, t, rank)
        local = np.tile(np.eye(6), (t, c, 1, 1))
        local[..., :3, :3] = right_jacobians(turn.reshape(-1, 3)).reshape(t, c, 3, 3)
        local = local * self.spread[:, None]
        spread = np.zeros((t, c, 6, 6, rank))
        for k in range(6):
            spread[:, :, k, k] = np.moveaxis(own[:, k], 0, 1)
        return np.asarray(local @ spread.reshape(t, c, 6, 6 * rank))

    def moved(self, time_s: Array, z: Array) -> "NetPoses":
        """As PoseModel."""
        patterns, strength, tangent = self._patterns(time_s)
        amplitude = z.reshape(strength.shape) / np.sqrt(np.maximum(strength, 1e-300))
        return replace(self, nets=tangent.moved(np.einsum("ptr,pr->pt", patterns, amplitude)))

    def _components(self, time_s: Array) -> tuple[Array, Array]:
        values = np.moveaxis(self.nets.at(time_s)[..., 0], 0, 1).reshape(len(time_s), len(self.cameras), 6)
        values = values * self.spread
        return values[..., :3], values[..., 3:]

    def _patterns(self, time_s: Array) -> tuple[Array, Array, Tangent]:
        p, t = len(self.nets.bias), len(time_s)
        tangent = Tangent.of(self.nets, np.tile(time_s, (p, 1)), np.ones((p, t, 1, 1)))
        strength, patterns = np.linalg.eigh(tangent.kernel())
        rank = min(MOST_PATTERNS, t)
        strength, patterns = strength[:, -rank:], patterns[:, :, -rank:]
        least = LEAST_SHARE * strength[:, -1:]
        return patterns, np.maximum(strength, least), tangent


def right_jacobians(turn: Array) -> Array:
    """Return J (n, 3, 3) with exp([w + dw]x) = exp([w]x) exp([J dw]x) to first order (Chirikjian 2012, 10.86)."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    k = cross_matrices(turn)
    return np.asarray(np.eye(3) - first * k + second * (k @ k))
