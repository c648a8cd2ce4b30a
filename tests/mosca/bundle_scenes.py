"""Scenes for the tests of the bundle adjustment; the pixels come from OpenCV's projectPoints."""

from dataclasses import replace

import cv2
import numpy as np
from rigs import looking_at
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.solver import CameraUnknowns, Distances, ObjectPoints, Problem
from mosca.data.rig import Camera, OpenCVLens, Pose

WIDTH, HEIGHT = 1280, 1024


def ring(n=4, radius=3.0, seed=0, **lens) -> list[Camera]:
    """Return n cameras around the z axis, aimed at (0, 0, 1)."""
    rng = np.random.default_rng(seed)
    cameras = []
    for k in range(n):
        a = 2 * np.pi * k / n + rng.normal(0, 0.1)
        centre = [radius * np.cos(a), radius * np.sin(a), 1.8 + rng.normal(0, 0.3)]
        values = {"fx_px": 1000.0 + 5 * k, "fy_px": 1003.0 + 5 * k, "cx_px": 640.0 + k, "cy_px": 510.0 - k, **lens}
        pose = looking_at(centre, rng.normal(0, 0.1, 3) + [0, 0, 1])
        cameras.append(Camera(f"c{k}", WIDTH, HEIGHT, OpenCVLens(**values), pose))
    return cameras


def cv2_pixels(camera: Camera, points) -> np.ndarray:
    lens, pose = camera.lens, camera.world_from_camera
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    d = np.array([getattr(lens, n) for n in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    turn = cv2.Rodrigues(pose.rotation.T)[0]
    shift = -pose.rotation.T @ pose.translation
    return cv2.projectPoints(np.asarray(points, dtype=float), turn, shift, matrix, d)[0].reshape(-1, 2)


def views(cameras, points, noise_px=0.0, seen=1.0, seed=1):
    """Return camera, point and pixel of what the cameras see of points (n, 3)."""
    rng = np.random.default_rng(seed)
    camera, point, xy = [], [], []
    for k, one in enumerate(cameras):
        pixel = cv2_pixels(one, points)
        inside = ((pixel > 0) & (pixel < (WIDTH - 1, HEIGHT - 1))).all(axis=1) & (rng.random(len(points)) < seen)
        there = np.flatnonzero(inside)
        camera.append(np.full(len(there), k))
        point.append(there)
        xy.append(pixel[there] + rng.normal(0, noise_px, (len(there), 2)) if noise_px else pixel[there])
    return np.concatenate(camera), np.concatenate(point), np.concatenate(xy)


def wand_points(frames, length=0.5, seed=2) -> np.ndarray:
    """Return both ends (2 frames, 3) of a wand waved about (0, 0, 1)."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-0.6, 0.6, (frames, 3)) + [0, 0, 1]
    along = rng.normal(size=(frames, 3))
    along *= length / 2 / np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([middle - along, middle + along], axis=1).reshape(-1, 3)


def moved(camera: Camera, rng, turn_rad=0.0, shift_m=0.0, **lens) -> Camera:
    """Return the camera with a disturbed pose and the named lens parameters."""
    pose = camera.world_from_camera
    turn = Rotation.from_rotvec(rng.normal(0, 1, 3) * turn_rad / np.sqrt(3)).as_matrix()
    new = Pose(pose.rotation @ turn, pose.translation + rng.normal(0, 1, 3) * shift_m / np.sqrt(3))
    return replace(camera, world_from_camera=new, lens=replace(camera.lens, **lens))


def wand_problem(starts, see, points, *, rod_sigma_m, free=("f_px", "k1"), datum="given", hold_first=True) -> Problem:
    """Return the problem of a wand of 0.5 m whose ends are points 2k and 2k + 1 (array, or their number)."""
    points = ObjectPoints.free(points)
    unknowns = tuple(CameraUnknowns(c, free, held=hold_first and k == 0) for k, c in enumerate(starts))
    ends = np.arange(0, len(points), 2)
    rods = Distances(ends, ends + 1, np.full(len(ends), 0.5), np.full(len(ends), rod_sigma_m))
    return Problem(unknowns, see, points, distances=rods, datum=datum)
