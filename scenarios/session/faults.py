"""Faults of a calibration session: swapped cameras, a camera that was moved."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.frames import Frame, FrameSource, WrappedSource
from mosca.data.rig import Pose, principal_distances_px
from mosca.errors import InputError
from twin.cameras.virtual_camera import VirtualCamera


def turned(cameras: tuple[VirtualCamera, ...], name: str, turn_px: float) -> tuple[VirtualCamera, ...]:
    """Return the cameras, with one rotated about its y axis so that its image moves by ``turn_px``."""
    names = [one.camera.name for one in cameras]
    if name not in names:
        raise InputError(f"calibration.fault.camera = '{name}' given; the rig has {', '.join(names)}")
    return tuple(_turned(one, turn_px) if one.camera.name == name else one for one in cameras)


def _turned(virtual: VirtualCamera, turn_px: float) -> VirtualCamera:
    camera = virtual.camera
    pose, f_px = camera.world_from_camera, principal_distances_px(camera.lens)[0]
    turn = Rotation.from_rotvec([0.0, np.arctan(turn_px / f_px), 0.0]).as_matrix()
    moved = Pose(pose.rotation @ turn, pose.translation)
    return replace(virtual, camera=replace(camera, world_from_camera=moved))


class _Swapped(WrappedSource):
    """A source in which the names of two cameras are exchanged."""

    def __init__(self, source: FrameSource, names: tuple[str, str]) -> None:
        super().__init__(source)
        self._name = {names[0]: names[1], names[1]: names[0]}
        self.cameras = tuple(replace(info, name=self._new(info.name)) for info in source.cameras)

    def _new(self, name: str) -> str:
        return self._name.get(name, name)

    def __iter__(self) -> Iterator[Frame]:
        return (replace(frame, camera=self._new(frame.camera)) for frame in self._source)


def swapped(source: FrameSource, names: tuple[str, str]) -> FrameSource:
    """Return the source with the names of two cameras exchanged in their frames."""
    given = [info.name for info in source.cameras]
    for name in names:
        if name not in given:
            raise InputError(f"calibration.fault.cameras: '{name}' given; the rig has {', '.join(given)}")
    return _Swapped(source, names)
