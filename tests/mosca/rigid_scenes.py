"""Sightings of rigid targets by a known rig, for tests: closed-form projections with stated noise, no images."""

from dataclasses import fields, replace

import numpy as np
from rigs import looking_at
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.layout import POSE_NAMES
from mosca.camera.projection import image_grid, project, rays
from mosca.data.rig import Camera, Lens, MoscaLens, OpenCVLens, Pose, Rig, principal_distances_px
from mosca.data.sightings import Part, Sightings


def some_rig(rng, n=4, model="mosca", radius=4.0, height=1.2, size=(656, 491)) -> Rig:
    cameras = []
    for k in range(n):
        turn = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / n
        place = np.array([radius * np.cos(turn), radius * np.sin(turn), height + rng.uniform(-0.3, 0.6)])
        centre = (np.array(size) - 1) / 2 + rng.uniform(-5, 5, 2)
        lens: Lens
        if model == "mosca":
            lens = MoscaLens(
                7.5 * rng.uniform(0.9, 1.1), *centre, 0.0099, 0.00991, -0.004,
                1e-3 * rng.uniform(0.5, 1.5), -1.5e-5, 0.0, 1e-4, 5e-5
            )  # fmt: skip
        else:
            f = 757 * rng.uniform(0.9, 1.1)
            lens = OpenCVLens(f, f * 1.001, *centre, -0.1, 0.05, 1e-4, -2e-4)
        cameras.append(Camera(f"cam{k + 1}", *size, lens, looking_at(place, rng.uniform(-0.1, 0.1, 3))))
    return Rig(tuple(cameras))


def seen(rig: Rig, marks, poses, rng, *, noise=0.02, shake=0.0, facing=None) -> Sightings:
    """Return what the cameras see of marks (m, 3) at each of ``poses`` (world_from_target), one a frame set.

    ``shake``: rotation of the camera's body about its x and y axes at each exposure [px at the image's middle].
    """
    parts = []
    for frame, pose in enumerate(poses):
        world = pose.transform(marks)
        for k, camera in enumerate(rig.cameras):
            xy = project(camera, world)
            there = np.isfinite(xy).all(axis=1)
            there &= (np.nan_to_num(xy) > 3).all(axis=1)
            there &= (np.nan_to_num(xy) < np.array([camera.width, camera.height]) - 4).all(axis=1)
            if facing is not None:
                normals = np.asarray(facing) @ pose.rotation.T
                to_camera = camera.world_from_camera.translation - world
                cosine = np.einsum("ni,ni->n", normals, to_camera) / np.linalg.norm(to_camera, axis=1)
                there &= cosine > 0.3
            noisy = rng.normal(0, noise, (int(there.sum()), 2))
            xy = project(turned(camera, rng.normal(0, shake, 2)), world[there]) + noisy
            n = len(xy)
            parts.append(
                Part(k, frame, np.flatnonzero(there), xy, np.tile(noise**2 * np.eye(2), (n, 1, 1)), np.full(n, 8.0))
            )
    sizes = np.array([(c.width, c.height) for c in rig.cameras])
    return Sightings.joined(rig.names, sizes, len(poses), parts)


def turned(camera: Camera, shake_px) -> Camera:
    """Return a camera rotated about its x and y axes such that its image's middle moves by ``shake_px`` (2,)."""
    fx, fy = principal_distances_px(camera.lens)
    turn = Rotation.from_rotvec([shake_px[1] / fy, -shake_px[0] / fx, 0.0]).as_matrix()
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn, pose.translation))


def ray_rms_px(camera: Camera, other: Camera, distance=4.0) -> float:
    """Return the rms difference of what two cameras see at a distance, over the image [px], poses included."""
    grid = image_grid(camera.width, camera.height)
    seen_by = rays(camera, grid)
    back = project(other, seen_by.origin + distance * seen_by.direction)
    return float(np.sqrt(np.mean(((back - grid) ** 2).sum(axis=1))))


def field_marks(rng, n=120) -> np.ndarray:
    return rng.uniform(-1, 1, (n, 3)) * [1.2, 1.2, 0.8]


def board_marks(columns=8, rows=6, step=0.12) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    flat = np.column_stack([x.ravel() - (columns - 1) / 2, y.ravel() - (rows - 1) / 2])
    return np.column_stack([step * flat, np.zeros(len(flat))])


def still(frames: int) -> list[Pose]:
    return [Pose(np.eye(3), np.zeros(3))] * frames


def stood(rng, stands: int, frames: int, turn=0.3, shift=0.3) -> list[Pose]:
    """Return poses of a target put up ``stands`` times for ``frames`` frame sets each."""
    poses = [
        Pose(Rotation.from_rotvec(rng.normal(0, turn, 3)).as_matrix(), rng.uniform(-shift, shift, 3))
        for _ in range(stands)
    ]
    return [pose for pose in poses for _ in range(frames)]


def carried(rng, frames: int) -> list[Pose]:
    """Return poses of an upright board carried round, facing all sides, tilted by some 25 degrees."""
    upright = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    poses = []
    for k in range(frames):
        side = Rotation.from_euler("z", 2 * np.pi * (k * 0.381966 + rng.uniform(-0.05, 0.05)))
        tilt = Rotation.from_rotvec(rng.normal(0, 0.45, 3))
        place = rng.uniform(-1, 1, 3) * [0.8, 0.8, 0.6]
        poses.append(Pose((tilt * side * upright).as_matrix(), place))
    return poses


def errors_of(calibration, rig: Rig, poses) -> dict[str, tuple[float, float]]:
    """Return error and stated standard deviation of each estimable parameter of cameras and lenses, by name.

    The world of the estimate is the target's reference pose: the truth is transformed into it. Rotations are about
    the camera's own axes. Weakly determined and held parameters are left out: no interval is claimed for them.
    """
    reference = poses[calibration.sightings.frame[calibration.placement < 0][0]]
    sigma = calibration.standard_deviations
    left_out = {*calibration.weak, *calibration.held}
    found = {}
    for true, one in zip(rig.cameras, calibration.rig.cameras, strict=True):
        pose = reference.inverse() @ true.world_from_camera
        turn = Rotation.from_matrix(pose.rotation.T @ one.world_from_camera.rotation).as_rotvec()
        shift = one.world_from_camera.translation - pose.translation
        off = dict(zip(POSE_NAMES, [*turn, *shift], strict=True))
        off |= {f.name: getattr(one.lens, f.name) - getattr(true.lens, f.name) for f in fields(true.lens)}
        for name, error in off.items():
            full = f"{true.name}.{name}"
            if full in sigma and full not in left_out:
                found[full] = (float(error), sigma[full])
    return found
