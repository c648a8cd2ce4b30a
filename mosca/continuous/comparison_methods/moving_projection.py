"""Projection into moving cameras, with derivatives by the point and by the camera's rotation and position."""

from dataclasses import dataclass, replace

import numpy as np

from mosca.camera.projection import cross_matrices, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Pose

AT_ORIGIN = Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """``xy_px`` (n, 2); ``by_point`` (n, 2, 3) [px/m], which is also minus the derivative by the camera's position;
    ``by_rotation`` (n, 2, 3) [px/rad], about the camera's own axes (``R -> R exp([w]x)``). NaN where not imaged.
    """

    xy_px: Array
    by_point: Array
    by_rotation: Array


def project_moving(camera: Camera, rotations: Array, centres: Array, points: Array) -> ProjectedPoints:
    """Project world points (n, 3) [m], each with its own world_from_camera: (n, 3, 3), (n, 3)."""
    v = np.einsum("nji,nj->ni", rotations, points - centres)
    own = project_with_jacobians(replace(camera, world_from_camera=AT_ORIGIN), v)
    return ProjectedPoints(own.xy_px, own.by_point @ np.swapaxes(rotations, 1, 2), own.by_point @ cross_matrices(v))


def rotated(rotations: Array, vectors: Array) -> Array:
    """Return rotations (n, 3, 3) rotated about their own axes by rotation vectors (n, 3): R exp([w]x) (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    k = cross_matrices(vectors)
    first, second = np.sinc(angle / np.pi), np.sinc(angle / 2 / np.pi) ** 2 / 2
    return np.asarray(rotations @ (np.eye(3) + first * k + second * (k @ k)))
