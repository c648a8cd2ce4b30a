"""Camera poses and fields of view: a ring of cameras, image windows (ROI), checks for unusable rigs."""

from dataclasses import replace

import numpy as np

from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Lens, MoscaLens, Pose, Rig
from mosca.errors import InputError
from scenarios.spec.cameras import Cameras
from scenarios.spec.scenario import WorkingSpace

VIEW_GRID = 7


def ring(spec: Cameras, space: WorkingSpace) -> Rig:
    """Return cameras on a ring around the working space, all looking at one point."""
    centre = np.array(space.center_m)
    target = centre if spec.look_at_m is None else np.array(spec.look_at_m)
    azimuth = spec.azimuth_deg or tuple(45.0 + 360.0 * k / spec.count for k in range(spec.count))
    height = spec.height_m if isinstance(spec.height_m, tuple) else (spec.height_m,) * spec.count
    width, rows = spec.size_px
    cameras = []
    for k in range(spec.count):
        turn = np.deg2rad(azimuth[k])
        place = centre + spec.radius_m * np.array([np.cos(turn), np.sin(turn), 0.0])
        place[2] = height[k]
        # no two lenses are equal: principal point and distortion differ a little from camera to camera
        lens = MoscaLens(
            spec.c_mm * (1 + 0.004 * k),
            (width - 1) / 2 + 3.0 - 2.0 * k,
            (rows - 1) / 2 - 2.0 + 1.5 * k,
            spec.pixel_pitch_mm,
            spec.pixel_pitch_mm * 1.001,
            spec.a,
            spec.K1_per_mm2 * (1 + 0.1 * k),
            spec.K2_per_mm4,
            0.0,
            spec.P1_per_mm,
            spec.P2_per_mm,
        )
        cameras.append(Camera(f"cam{k + 1}", width, rows, lens, looking_at(place, target, f"cam{k + 1}")))
    return Rig(tuple(cameras))


def check_rig(rig: Rig, space: WorkingSpace) -> None:
    """Raise InputError, with the reason, for a rig that cannot measure the working space."""
    centre, size = np.array(space.center_m), np.array(space.size_m)
    places = np.array([c.world_from_camera.translation for c in rig.cameras])
    for k, camera in enumerate(rig.cameras):
        if np.all(np.abs(places[k] - centre) < size / 2):
            raise InputError(
                f"camera '{camera.name}' stands inside the working space at {_text(places[k])} m; "
                "move it out (cameras.radius_m, cameras.height_m) or make working_space.size_m smaller"
            )
        for other in range(k):
            if np.linalg.norm(places[k] - places[other]) < 1e-3 * size.max():
                raise InputError(
                    f"cameras '{rig.cameras[other].name}' and '{camera.name}' stand at the same place "
                    f"{_text(places[k])} m and see no depth; give them different cameras.azimuth_deg"
                )
    grid = centre + size * (np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, VIEW_GRID)] * 3), -1).reshape(-1, 3))
    views = np.array([sees(camera, grid) for camera in rig.cameras])
    blind = [camera.name for camera, seen in zip(rig.cameras, views, strict=True) if not seen.any()]
    if not (views.sum(axis=0) >= 2).any():
        who = f"{', '.join(blind)} see nothing of it" if blind else "their views do not overlap"
        raise InputError(
            f"no point of the working space is seen by two cameras: {who}; "
            "check poses, principal distance c_mm and look_at_m"
        )


def windowed(camera: Camera, window_px: tuple[int, int, int, int]) -> Camera:
    """Return the camera that reads out only a window (left, top, width, height) of its image."""
    left, top, width, height = window_px
    if left < 0 or top < 0 or min(width, height) < 1 or left + width > camera.width or top + height > camera.height:
        raise InputError(
            f"camera '{camera.name}': window_px = {list(window_px)} does not lie in its image of "
            f"{camera.width} x {camera.height}"
        )
    lens = camera.lens
    if isinstance(lens, MoscaLens):
        moved: Lens = replace(lens, xp_px=lens.xp_px - left, yp_px=lens.yp_px - top)
    else:
        moved = replace(lens, cx_px=lens.cx_px - left, cy_px=lens.cy_px - top)
    return replace(camera, width=width, height=height, lens=moved)


def sees(camera: Camera, points: Array) -> Array:
    """Return whether points (n, 3) of the world are in a camera's image (n,) bool."""
    xy = project(camera, points)
    inside = np.asarray(np.isfinite(xy).all(axis=1))
    xy = np.where(inside[:, None], xy, -1.0)
    return inside & (xy >= -0.5).all(axis=1) & (xy[:, 0] <= camera.width - 0.5) & (xy[:, 1] <= camera.height - 0.5)


def looking_at(place: Array, target: Array, name: str) -> Pose:
    """Return the pose of a camera at ``place`` that points at ``target`` with its x axis level."""
    forward = target - place
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise InputError(f"camera '{name}' stands at the point that it looks at; change look_at_m or height_m")
    forward = forward / distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return Pose(np.column_stack([right, np.cross(forward, right), forward]), place)


def _text(point: Array) -> str:
    return "(" + ", ".join(f"{x:g}" for x in point) + ")"
