"""Cameras' exterior orientations over time: stationary cameras, and poses interpolated between given instants."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from mosca.data.arrays import Array
from mosca.data.rig import Rig


@dataclass(frozen=True, eq=False)
class StillCameras:
    """Cameras that do not move; ``rotations`` (c, 3, 3) world_from_camera, ``centres`` (c, 3) [m]."""

    cameras: tuple[str, ...]
    rotations: Array
    centres: Array

    @classmethod
    def of(cls, rig: Rig, names: tuple[str, ...] | None = None) -> "StillCameras":
        """Return the cameras ``names`` of a rig (None: all), stationary."""
        names = rig.names if names is None else names
        poses = [rig.camera(name).world_from_camera for name in names]
        return cls(names, np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]))

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return world_from_camera: rotations (t, c, 3, 3) and centres (t, c, 3) [m]."""
        t = len(time_s)
        return np.tile(self.rotations, (t, 1, 1, 1)), np.tile(self.centres, (t, 1, 1))


@dataclass(frozen=True)
class _Between:
    """One camera's interpolated rotation and centre, from ``from_s`` to ``to_s``."""

    from_s: float
    to_s: float
    rotations_at: Slerp | RotationSpline
    centres_at: BSpline | CubicSpline


@dataclass(frozen=True, eq=False)
class PosedCameras:
    """Poses known at ``time_s`` (t,) and interpolated in between (``kind``); NaN outside and where none is known.

    "linear": straight lines and great arcs (slerp); "cubic": splines with continuous acceleration, of rotations too.
    """

    cameras: tuple[str, ...]
    time_s: Array
    rotations: Array
    centres: Array
    kind: Literal["linear", "cubic"] = "cubic"

    @cached_property
    def _between(self) -> list[_Between | None]:
        """Each camera's interpolation, fitted once; None where fewer than two of its poses are known."""
        return [self._fitted(k) for k in range(len(self.cameras))]

    def _fitted(self, k: int) -> _Between | None:
        known = np.isfinite(self.centres[:, k]).all(axis=1) & np.isfinite(self.rotations[:, k]).all(axis=(1, 2))
        if known.sum() < 2:
            return None
        t, centres = self.time_s[known], self.centres[known, k]
        poses = Rotation.from_matrix(self.rotations[known, k])
        if self.kind == "linear" or len(t) < 3:
            return _Between(t[0], t[-1], Slerp(t, poses), make_interp_spline(t, centres, k=1))
        return _Between(t[0], t[-1], RotationSpline(t, poses), CubicSpline(t, centres))

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return world_from_camera: rotations (t, c, 3, 3) and centres (t, c, 3) [m]."""
        time_s = np.asarray(time_s, dtype=float)
        c = len(self.cameras)
        rotations, centres = np.full((len(time_s), c, 3, 3), np.nan), np.full((len(time_s), c, 3), np.nan)
        for k, between in enumerate(self._between):
            if between is None:
                continue
            inside = (time_s >= between.from_s) & (time_s <= between.to_s)
            if inside.any():
                rotations[inside, k] = between.rotations_at(time_s[inside]).as_matrix()
                centres[inside, k] = between.centres_at(time_s[inside])
        return rotations, centres
