"""Moving cameras: the rig at each instant, and images at each camera's pose."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mosca.camera.projection import lens_pixels
from mosca.continuous.model.observations import CameraPaths, Curves
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.tracks import Points


@dataclass(frozen=True, eq=False)
class MovingRig:
    """A rig whose cameras move. ``paths``: their poses; ``known_s``: instants at which each camera's pose was
    estimated; ``valid_s``: largest distance from such an instant at which the pose is valid [s].
    """

    rig: Rig
    paths: CameraPaths
    known_s: tuple[Array, ...]
    valid_s: float

    def rigs(self, time_s: Array) -> list[Rig]:
        """Return the rig at each of ``time_s`` (t,); cameras without a pose at an instant keep that of the rig."""
        rotations, centres = self.paths.at(time_s)
        known = np.asarray(np.isfinite(centres).all(axis=2))
        return [
            Rig(
                tuple(
                    replace(camera, world_from_camera=Pose(rotations[i, c], centres[i, c])) if known[i, c] else camera
                    for c, camera in enumerate(self.rig.cameras)
                )
            )
            for i in range(len(time_s))
        ]

    def there(self, time_s: Array) -> Array:
        """Return whether (t, c) each camera's pose is known at each of ``time_s`` (t,)."""
        away = [cKDTree(known[:, None]).query(time_s[:, None])[0] for known in self.known_s]
        return np.column_stack(away) <= self.valid_s


class RigAtEach:
    """Supplies the pipeline with the rig of the next frame set (``mosca.pipeline.Keeper``)."""

    def __init__(self, rigs: list[Rig]) -> None:
        self._rigs = rigs
        self.rig = rigs[0]

    def attend(self, frame: int, detections: Mapping[str, Detections], points: Points) -> None:
        """Advance to the rig of the next frame set after ``frame``."""
        self.rig = self._rigs[min(frame + 1, len(self._rigs) - 1)]


def images_at(camera: Camera, c: int, paths: CameraPaths | None, time_s: Array, xyz: Array) -> Array:
    """Return the images (t, m, 2) [px] of positions (t, m, 3) [m] in camera number ``c`` at ``time_s`` (t,).

    ``paths`` None: the camera is stationary at its own pose.
    """
    if paths is None:
        pose = camera.world_from_camera
        rotation, centre = pose.rotation[None], pose.translation[None]
    else:
        rotations, centres = paths.at(time_s)
        rotation, centre = rotations[:, c], centres[:, c]
    inside = np.einsum("tji,tmj->tmi", np.broadcast_to(rotation, (len(xyz), 3, 3)), xyz - centre[:, None])
    return np.asarray(lens_pixels(camera.lens, inside.reshape(-1, 3)).reshape(*xyz.shape[:2], 2))


def centres_at(camera: Camera, c: int, paths: CameraPaths | None, time_s: Array) -> Array:
    """Return the centres (t, 3) [m] of camera number ``c`` at ``time_s`` (t,)."""
    if paths is None:
        return np.tile(camera.world_from_camera.translation, (len(time_s), 1))
    return np.asarray(paths.at(time_s)[1][:, c])


def lamp_positions_at(lamp_m: Array, paths: CameraPaths, time_s: Array) -> Array:
    """Return the positions (t, c, 3) [m] at ``time_s`` of the cameras' lamps, ``lamp_m`` (c, 3) in their frames."""
    rotations, centres = paths.at(time_s)
    return np.asarray(centres + np.einsum("tcij,cj->tci", rotations, lamp_m))


def images_of(curves: Curves, camera: Camera, c: int, paths: CameraPaths | None, time_s: Array) -> Array:
    """Return the images (t, points, 2) [px] of curves in camera number ``c`` at ``time_s`` (t,)."""
    return images_at(camera, c, paths, time_s, curves.at(time_s))
