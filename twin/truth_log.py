"""The log of true states, pulse by pulse, and the Truth made from it."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.truth import NO_FRAME, FramesTruth, JointTruth, Truth
from twin.cameras.camera_session import CameraSession, TrueExposure
from twin.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class PulseLog:
    """The true state from one pulse until the next."""

    time_s: float
    """The pulse's nominal mid-exposure."""
    xyz: Array
    """(m, 3): the markers at that time, world frame [m]."""
    exposures: tuple[tuple[TrueExposure, ...], ...]
    """The frames taken by each camera of the rig."""

    def frame_of(self, camera: int) -> TrueExposure | None:
        """Return the frame of a camera that lies nearest to the pulse, if it took any."""
        return min(self.exposures[camera], key=lambda frame: abs(frame.exposure.middle_s - self.time_s), default=None)


def truth_of(logs: list[PulseLog], sessions: tuple[CameraSession, ...], scene: Scene) -> Truth:
    """Return the truth of the pulses logged."""
    names = scene.marker_names
    t, m, c = len(logs), len(names), len(sessions)
    visible, xy, diameter = np.zeros((t, m, c)), np.full((t, m, c, 2), np.nan), np.full((t, m, c), np.nan)
    middle = np.full((t, c), NO_FRAME, dtype=np.int64)
    rotation, position = np.full((t, c, 3, 3), np.nan), np.full((t, c, 3), np.nan)
    for k, log in enumerate(logs):
        for camera in range(c):
            frame = log.frame_of(camera)
            if frame is not None:
                visible[k, :, camera] = frame.seen.visible
                xy[k, :, camera] = frame.seen.xy_px
                diameter[k, :, camera] = frame.seen.diameter_px
                middle[k, camera] = round(frame.exposure.middle_s * 1e9)
                rotation[k, camera], position[k, camera] = frame.rotation, frame.position
    return Truth(
        time_ns=np.array([round(log.time_s * 1e9) for log in logs], dtype=np.int64),
        names=names,
        xyz=np.array([log.xyz for log in logs]).reshape(t, m, 3),
        visible=visible,
        cameras=tuple(s.virtual.camera.name for s in sessions),
        image_xy_px=xy,
        diameter_px=diameter,
        exposure_mid_ns=middle,
        camera_rotation=rotation,
        camera_position=position,
        frames=_frames(logs, sessions, m),
        joints=joints_at(scene, np.array([log.time_s for log in logs])),
    )


def joints_at(scene: Scene, time_s: Array) -> JointTruth | None:
    """Return the joints of the scene's person at instants (t,), session clock; None where there is no person."""
    if scene.joints is None:
        return None
    sampler, bodies = scene.sampler(), scene.model.nbody
    xyz, rotation = np.empty((len(time_s), bodies, 3)), np.empty((len(time_s), bodies, 3, 3))
    for k, time in enumerate(time_s):
        sampler.at(float(time))
        xyz[k], rotation[k] = sampler.data.xpos, sampler.data.xmat.reshape(-1, 3, 3)
    return scene.joints.truth(xyz, rotation)


def _frames(logs: list[PulseLog], sessions: tuple[CameraSession, ...], m: int) -> FramesTruth | None:
    """Return the frames of the free-running cameras, in the order of pulse periods; None where there are none."""
    free = [camera for camera, session in enumerate(sessions) if session.free]
    if not free:
        return None
    rows = [(camera, frame) for log in logs for camera in free for frame in log.exposures[camera]]
    exposures = [frame for _camera, frame in rows]
    return FramesTruth(
        camera=np.array([camera for camera, _frame in rows], dtype=np.int64),
        index=np.array([s.exposure.number for s in exposures], dtype=np.int64),
        stamp_ns=np.array([s.exposure.stamp_ns for s in exposures], dtype=np.int64),
        exposure_mid_ns=np.array([round(s.exposure.middle_s * 1e9) for s in exposures], dtype=np.int64),
        xyz=np.array([s.marker_xyz for s in exposures]).reshape(len(rows), m, 3),
        visible=np.array([s.seen.visible for s in exposures]).reshape(len(rows), m),
        image_xy_px=np.array([s.seen.xy_px for s in exposures]).reshape(len(rows), m, 2),
        diameter_px=np.array([s.seen.diameter_px for s in exposures]).reshape(len(rows), m),
        camera_rotation=np.array([s.rotation for s in exposures]).reshape(-1, 3, 3),
        camera_position=np.array([s.position for s in exposures]).reshape(-1, 3),
    )
