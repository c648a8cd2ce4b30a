"""Cameras' exterior orientations over time: cameras that stand still, and poses between those of some instants."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
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
    def of(cls, rig: Rig) -> "StillCameras":
        """Return the cameras of a rig where they stand."""
        poses = [camera.world_from_camera for camera in rig.cameras]
        return cls(rig.names, np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]))

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return world_from_camera: rotations (t, c, 3, 3) and centres (t, c, 3) [m]."""
        t = len(time_s)
        return np.tile(self.rotations, (t, 1, 1, 1)), np.tile(self.centres, (t, 1, 1))


@dataclass(frozen=True, eq=False)
class PosedCameras:
    """Poses known at ``time_s`` (t,), between them interpolated (``kind``); NaN outside and where none is known.

    "linear": straight lines and great arcs (slerp); "cubic": splines with continuous acceleration, of turns too.
    """

    cameras: tuple[str, ...]
    time_s: Array
    rotations: Array
    centres: Array
    kind: Literal["linear", "cubic"] = "cubic"

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return world_from_camera: rotations (t, c, 3, 3) and centres (t, c, 3) [m]."""
        time_s = np.asarray(time_s, dtype=float)
        c = len(self.cameras)
        rotations, centres = np.full((len(time_s), c, 3, 3), np.nan), np.full((len(time_s), c, 3), np.nan)
        for k in range(c):
            good = np.isfinite(self.centres[:, k]).all(axis=1) & np.isfinite(self.rotations[:, k]).all(
                axis=(1, 2)
            )
            if good.sum() < 2:
                continue
            t, poses = self.time_s[good], Rotation.from_matrix(self.rotations[good, k])
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            if not inside.any():
                continue
            if self.kind == "linear" or len(t) < 3:
                turns, places = Slerp(t, poses), make_interp_spline(t, self.centres[good, k], k=1)
            else:
                turns, places = RotationSpline(t, poses), CubicSpline(t, self.centres[good, k])
            rotations[inside, k] = turns(time_s[inside]).as_matrix()
            centres[inside, k] = places(time_s[inside])
        return rotations, centres
