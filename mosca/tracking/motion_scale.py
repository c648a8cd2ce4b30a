"""Speeds and distances of targets, scaled with the size of the measured space.

A tank of 7 cm, a room and a hall are measured by the same rules. Lengths and speeds that the settings leave open are
those of a person in a space of 2.5 m, times the size of the space over 2.5 m. This size is the longest edge of a
volume where one is given. Else it is the width of the cameras' fields of view at the first points, which is 1.0 to
1.6 of the edge for rigs that are aimed at a working space. Times are not scaled: a target crosses its space in the
same time, whatever the space's size.
"""

from typing import NamedTuple

import numpy as np

from mosca.camera.projection import lens_directions
from mosca.data.arrays import Array, middle
from mosca.data.rig import Camera, Rig
from mosca.data.settings import TrackSettings
from mosca.data.tracks import Points

PERSON_SPACE_M = 2.5
"""Longest edge [m] of the space for which the lengths and speeds of ``PERSON`` are meant. The benchmark's actor: no
identity is exchanged with 1.25, one with 2.5, three with 5, where completeness falls from 0.997 to 0.973."""
LEARNED_FROM = 100
"""Frame sets with points from which the field's width is learned."""


class MotionScale(NamedTuple):
    """Lengths and speeds of ``TrackSettings``, all of them set."""

    acceleration_mps2: float = 20.0
    speed_mps: float = 1.5
    gate_m: float = 0.08
    limb_m: float = 0.6


def motion_scale(settings: TrackSettings, edge_m: float = PERSON_SPACE_M) -> MotionScale:
    """Return the settings' lengths and speeds; those left open are scaled to a space of ``edge_m`` [m]."""
    scale = edge_m / PERSON_SPACE_M
    given = (getattr(settings, name) for name in MotionScale._fields)
    return MotionScale(*(scale * usual if own is None else own for usual, own in zip(PERSON, given, strict=True)))


class FieldWidth:
    """Width of the cameras' fields of view at the points: mean of the medians of the first sets."""

    def __init__(self, rig: Rig) -> None:
        self._centre = np.array([camera.world_from_camera.translation for camera in rig.cameras])
        self._width = np.array([relative_width(camera) for camera in rig.cameras])
        self._sum, self._sets = 0.0, 0

    def learn(self, points: Points) -> float | None:
        """Take a frame set's points; return the width [m], None where it has not changed."""
        if len(points) == 0 or self._sets >= LEARNED_FROM:
            return None
        distance = np.linalg.norm(points.xyz[:, None] - self._centre, axis=2)
        self._sum += middle(np.sort((distance * self._width)[points.rays >= 0]))
        self._sets += 1
        return self._sum / self._sets


def relative_width(camera: Camera) -> float:
    """Return the width of a camera's field of view over the distance: geometric mean of both chords' lengths."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    middle = np.array([right - 0.5, bottom - 0.5]) / 2
    edges: Array = np.array([[-0.5, middle[1]], [right, middle[1]], [middle[0], -0.5], [middle[0], bottom]])
    left, right_, top, bottom_ = lens_directions(camera.lens, edges)
    return float(np.sqrt(np.linalg.norm(right_ - left) * np.linalg.norm(bottom_ - top)))


PERSON = MotionScale()
"""Values of a person in a space of PERSON_SPACE_M."""
