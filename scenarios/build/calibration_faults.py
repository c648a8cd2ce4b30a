"""What is wrong with the calibration that the pipeline gets: the faults of scenarios."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.files.toml import Table
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from scenarios.spec.faults import LensFault, MovedFault, ScaleFault, SwapFault, TurnFault
from twin.cameras.exposure.mount import pixels_per_radian
from twin.cameras.optics.lens import TwinLens


def with_fault(rig: Rig, fault: Table | None) -> Rig:
    """Return the rig that the pipeline believes in, with the scenario's fault."""
    if isinstance(fault, SwapFault):
        one, two = (rig.camera(name) for name in fault.cameras)
        swapped = {one.name: two, two.name: one}
        return Rig(tuple(replace(swapped.get(c.name, c), name=c.name) for c in rig.cameras))
    if isinstance(fault, LensFault):
        return Rig(tuple(_undistorted(camera) for camera in rig.cameras))
    if isinstance(fault, ScaleFault):
        return Rig(tuple(_scaled(camera, fault.factor) for camera in rig.cameras))
    if isinstance(fault, MovedFault):
        for name in fault.cameras:
            rig.camera(name)
        return Rig(tuple(_moved(c, fault.shift_m) if c.name in fault.cameras else c for c in rig.cameras))
    if isinstance(fault, TurnFault):
        rig.camera(fault.camera)
        return Rig(tuple(_turned(c, fault.turn_px) if c.name == fault.camera else c for c in rig.cameras))
    return rig


def _undistorted(camera: Camera) -> Camera:
    """Return the camera with its lens's distortion forgotten (principal distance and point kept)."""
    lens = camera.lens
    if isinstance(lens, MoscaLens):
        plain = MoscaLens(lens.c_mm, lens.xp_px, lens.yp_px, lens.mx_mm_per_px, lens.my_mm_per_px)
        return replace(camera, lens=plain)
    return replace(camera, lens=type(lens)(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px))


def _scaled(camera: Camera, factor: float) -> Camera:
    """Return the camera with its position scaled about the world's origin."""
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation, factor * pose.translation))


def _moved(camera: Camera, shift_m: tuple[float, float, float]) -> Camera:
    """Return the camera with a wrong position."""
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation, pose.translation + np.array(shift_m)))


def _turned(camera: Camera, turn_px: float) -> Camera:
    lens = TwinLens.of(camera.lens, camera.width, camera.height).vector
    turn = Rotation.from_rotvec([0.0, turn_px / pixels_per_radian(lens), 0.0]).as_matrix()
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn, pose.translation))
