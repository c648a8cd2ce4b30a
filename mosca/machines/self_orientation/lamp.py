"""Images of a lamp at a known place of the test field in the frames of a moving camera."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.frames import Frame
from mosca.data.rig import Camera, Pose
from mosca.data.rotations import rotation_from_vector
from mosca.machines.self_orientation.resection import Resected

ROW_ROUNDS = 2
"""Rounds of computing a lamp's exposure from its image row, and its image from that: the second moves it < 0.1 px."""


def lamp_in_flight(
    own: Resected, camera: Camera, frames: Iterable[Frame], xyz: Array, diameter_m: float, row_time_s: float
) -> Iterator[tuple[Frame, Array, float, float]]:
    """Yield the frames that have a pose, with the lamp's image (2,), its radius [px] and its distance [m].

    ``xyz`` (3,): its centre in the field's frame [m]. Motion of the camera until the lamp's rows are exposed is
    included.
    """
    row_of = {int(frame): k for k, frame in enumerate(own.frame)}
    rates = own.path.rates()
    for frame in frames:
        k = row_of.get(frame.index)
        if k is None:
            continue
        pose, late = own.path.pose(k), 0.0
        for _ in range(ROW_ROUNDS):
            moved = Pose(
                rotation_from_vector(late * rates[k, 3:]) @ pose.rotation, pose.translation + late * rates[k, :3]
            )
            xy, radius, away = lamp_image(replace(camera, world_from_camera=moved), xyz, diameter_m)
            late = float(xy[1] - (camera.height - 1) / 2) * row_time_s if np.isfinite(xy).all() else 0.0
        yield frame, xy, radius, away


def lamp_image(camera: Camera, xyz: Array, diameter_m: float) -> tuple[Array, float, float]:
    """Return the image (2,) [px] of a lamp at ``xyz`` (3,) [m] in a camera, its radius [px] and its distance [m]."""
    away = float(np.linalg.norm(camera.world_from_camera.translation - xyz))
    aside = camera.world_from_camera.rotation[:, 0] * diameter_m / 2
    centre, rim = project(camera, np.stack([xyz, xyz + aside]))
    return centre, float(np.linalg.norm(rim - centre)), away
