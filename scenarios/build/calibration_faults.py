"""Faults of scenarios in the calibration that the pipeline gets."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.files.toml import Table
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from scenarios.spec.faults import (
    LensFault,
    LittleDepthFault,
    MirroredFault,
    MovedFault,
    ResolutionFault,
    ScaleFault,
    SwapFault,
    TurnFault,
)
from twin.cameras.exposure.mount import pixels_per_radian
from twin.cameras.optics.lens import TwinLens


def with_fault(rig: Rig, fault: Table | None) -> Rig:
    """Return the rig that the pipeline gets, with the scenario's fault."""
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
    if isinstance(fault, MirroredFault):
        rig.camera(fault.camera)
        return Rig(tuple(_mirrored(c, fault) if c.name == fault.camera else c for c in rig.cameras))
    if isinstance(fault, ResolutionFault):
        return Rig(tuple(_resized(c, fault) for c in rig.cameras))
    if isinstance(fault, LittleDepthFault):
        return Rig(tuple(_farther(c, fault) for c in rig.cameras))
    return rig


def _mirrored(camera: Camera, fault: MirroredFault) -> Camera:
    """Return the camera for which the plane is mirrored across its line of sight: two reflections, one rotation."""
    pose, middle = camera.world_from_camera, np.array(fault.middle_m)
    sight = middle - pose.translation
    sight = sight / np.linalg.norm(sight)
    normal = np.array(fault.normal) / np.linalg.norm(fault.normal)
    turn = (np.eye(3) - 2 * np.outer(sight, sight)) @ (np.eye(3) - 2 * np.outer(normal, normal))
    centre = middle + turn.T @ (pose.translation - middle)
    return replace(camera, world_from_camera=Pose(turn.T @ pose.rotation, centre))


def _resized(camera: Camera, fault: ResolutionFault) -> Camera:
    lens, factor = camera.lens, fault.factor
    if not isinstance(lens, MoscaLens):
        return replace(camera, lens=replace(lens, fx_px=factor * lens.fx_px, fy_px=factor * lens.fy_px))
    # the image in millimetres is the same; the size of a pixel is not
    lens = replace(lens, mx_mm_per_px=lens.mx_mm_per_px / factor, my_mm_per_px=lens.my_mm_per_px / factor)
    if not fault.told:
        return replace(camera, lens=lens)
    lens = replace(lens, xp_px=factor * lens.xp_px, yp_px=factor * lens.yp_px)
    return replace(camera, lens=lens, width=round(factor * camera.width), height=round(factor * camera.height))


def _farther(camera: Camera, fault: LittleDepthFault) -> Camera:
    pose, middle, lens = camera.world_from_camera, np.array(fault.middle_m), camera.lens
    if isinstance(lens, MoscaLens):
        lens = replace(lens, c_mm=fault.factor * lens.c_mm)
    else:
        lens = replace(lens, fx_px=fault.factor * lens.fx_px, fy_px=fault.factor * lens.fy_px)
    place = middle + fault.factor * (pose.translation - middle)
    return replace(camera, lens=lens, world_from_camera=Pose(pose.rotation, place))


def _undistorted(camera: Camera) -> Camera:
    """Return the camera without its lens's distortion (principal distance and point are kept)."""
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
