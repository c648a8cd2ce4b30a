"""The logbook: what really was, pulse by pulse, and the truth that it makes."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.truth import NO_FRAME, FramesTruth, Truth
from twin.cameras.camera_session import Shot, Station


@dataclass(frozen=True, eq=False)
class PulseLog:
    """What was from one pulse until the next.

    ``time_s``: the pulse's nominal mid-exposure; ``xyz`` (m, 3) the markers then; ``shots``: for each camera of the
    rig the frames that it took.
    """

    time_s: float
    xyz: Array
    shots: tuple[tuple[Shot, ...], ...]

    def shot_of(self, camera: int) -> Shot | None:
        """Return the frame of a camera that lies nearest to the pulse, if it took any."""
        return min(
            self.shots[camera], key=lambda shot: abs(shot.exposure.middle_s - self.time_s), default=None
        )


def truth_of(logs: list[PulseLog], stations: tuple[Station, ...], names: tuple[str, ...]) -> Truth:
    """Return the truth of the pulses logged; ``names`` (m) of the markers."""
    t, m, c = len(logs), len(names), len(stations)
    visible, xy, diameter = np.zeros((t, m, c)), np.full((t, m, c, 2), np.nan), np.full((t, m, c), np.nan)
    middle = np.full((t, c), NO_FRAME, dtype=np.int64)
    rotation, position = np.full((t, c, 3, 3), np.nan), np.full((t, c, 3), np.nan)
    for k, log in enumerate(logs):
        for camera in range(c):
            shot = log.shot_of(camera)
            if shot is not None:
                visible[k, :, camera] = shot.seen.visible
                xy[k, :, camera] = shot.seen.xy_px
                diameter[k, :, camera] = shot.seen.diameter_px
                middle[k, camera] = round(shot.exposure.middle_s * 1e9)
                rotation[k, camera], position[k, camera] = shot.rotation, shot.position
    return Truth(
        time_ns=np.array([round(log.time_s * 1e9) for log in logs], dtype=np.int64),
        names=names,
        xyz=np.array([log.xyz for log in logs]).reshape(t, m, 3),
        visible=visible,
        cameras=tuple(s.virtual.camera.name for s in stations),
        image_xy_px=xy,
        diameter_px=diameter,
        exposure_mid_ns=middle,
        camera_rotation=rotation,
        camera_position=position,
        frames=_frames(logs, stations, m),
    )


def _frames(logs: list[PulseLog], stations: tuple[Station, ...], m: int) -> FramesTruth | None:
    """Return the frames of the cameras that run free, in the order of pulse periods; None where there are none."""
    free = [camera for camera, station in enumerate(stations) if station.free]
    if not free:
        return None
    rows = [(camera, shot) for log in logs for camera in free for shot in log.shots[camera]]
    shots = [shot for _camera, shot in rows]
    return FramesTruth(
        camera=np.array([camera for camera, _shot in rows], dtype=np.int64),
        index=np.array([s.exposure.number for s in shots], dtype=np.int64),
        stamp_ns=np.array([s.exposure.stamp_ns for s in shots], dtype=np.int64),
        exposure_mid_ns=np.array([round(s.exposure.middle_s * 1e9) for s in shots], dtype=np.int64),
        xyz=np.array([s.marker_xyz for s in shots]).reshape(-1, m, 3),
        visible=np.array([s.seen.visible for s in shots]).reshape(-1, m),
        image_xy_px=np.array([s.seen.xy_px for s in shots]).reshape(-1, m, 2),
        diameter_px=np.array([s.seen.diameter_px for s in shots]).reshape(-1, m),
        camera_rotation=np.array([s.rotation for s in shots]).reshape(-1, 3, 3),
        camera_position=np.array([s.position for s in shots]).reshape(-1, 3),
    )
