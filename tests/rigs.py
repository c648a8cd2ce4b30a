"""Rigs for tests: cameras on a ring, aimed at a point. Geometry written out here, shared with no product code."""

from collections.abc import Sequence

import numpy as np

from mosca.data.rig import Camera, Lens, OpenCVLens, Pose, Rig

SIZE = (656, 491)
"""Width and height of an image [px], where a test needs no other."""
PINHOLE = OpenCVLens(800.0, 800.0, 327.5, 245.0)
"""A lens without distortion, its principal point in the middle of an image of ``SIZE``."""


def looking_at(centre, target=(0.0, 0.0, 0.0)) -> Pose:
    """Return world_from_camera at ``centre`` (3,), optical axis through ``target`` (3,) [m], image x horizontal."""
    centre = np.asarray(centre, dtype=float)
    z = np.asarray(target, dtype=float) - centre
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Pose(np.column_stack([x, np.cross(z, x), z]), centre)


def ring(
    count: int = 4,
    lens: Lens | Sequence[Lens] = PINHOLE,
    *,
    radius_m: float = 3.0,
    height_m: float | Sequence[float] = 1.0,
    target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    first_rad: float = 0.3,
    step_rad: float | None = None,
    size: tuple[int, int] = SIZE,
    names: str | Sequence[str] = "c{}",
) -> Rig:
    """Return cameras on a circle about the z axis, all aimed at a point.

    Parameters
    ----------
    lens, height_m : of all cameras, or one for each.
    target : (3,) or (count, 3), the point each camera is aimed at [m].
    first_rad, step_rad : azimuth of the first camera and from camera to camera; default step: evenly all round.
    names : a format for the camera's index, or one name for each.
    """
    step = 2 * np.pi / count if step_rad is None else step_rad
    azimuth = first_rad + step * np.arange(count)
    heights = np.broadcast_to(np.asarray(height_m, dtype=float), count)
    centres = np.column_stack([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), heights])
    targets = np.broadcast_to(np.asarray(target, dtype=float), (count, 3))
    lenses = list(lens) if isinstance(lens, Sequence) else [lens] * count
    labels = [names.format(k) for k in range(count)] if isinstance(names, str) else names
    return Rig(tuple(Camera(labels[k], *size, lenses[k], looking_at(centres[k], targets[k])) for k in range(count)))
