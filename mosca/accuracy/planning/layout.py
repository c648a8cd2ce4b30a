"""Places and cameras that a plan may choose from, and a choice of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.accuracy.planning.image_noise import PIXEL_VARIANCE_PX2
from mosca.accuracy.planning.views import (
    BLUR,
    COLUMNS,
    DEFOCUS,
    EXTRA,
    HALF_HEIGHT,
    HALF_WIDTH,
    PAN,
    SCALE,
    TABLE,
    TILT,
)
from mosca.data.arrays import Array, read_only
from mosca.data.rig import Camera, MoscaLens, Pose, Rig

STEEPEST_RAD = np.deg2rad(85.0)
"""Largest tilt: cameras are kept level about their axis, which has no meaning straight up or down."""


@dataclass(frozen=True, eq=False)
class MountingPlace:
    """A rail or a rectangle of a wall: cameras may stand at start + a along + b up, with a and b from 0 to 1."""

    start: Array
    """(3,) [m]"""
    along: Array
    """(3,) [m]"""
    up: Array
    """(3,) [m]; zero for a rail."""

    def __post_init__(self) -> None:
        for name in ("start", "along", "up"):
            object.__setattr__(self, name, read_only(getattr(self, name), (3,), name))


@dataclass(frozen=True)
class CameraOption:
    """A camera with one of its lenses."""

    model: str
    width: int
    height: int
    pitch_mm: float
    focal_mm: float
    price: float
    f_number: float | None
    """None: sharp everywhere."""
    blur_px: float
    """Standard deviation of the blur in focus."""
    extra_px: float
    """Standard deviation of image coordinates besides pixel noise, an axis: shake, misfit of the lens model."""
    table: int
    """Index of its information table in the ``MarkerRoom``."""

    @property
    def row(self) -> Array:
        """The camera's row (COLUMNS,) for ``mosca.accuracy.planning.views``, at the origin."""
        row = np.zeros(COLUMNS)
        row[SCALE] = self.focal_mm / self.pitch_mm
        row[HALF_WIDTH], row[HALF_HEIGHT] = self.width / 2, self.height / 2
        if self.f_number is not None:
            row[DEFOCUS] = self.focal_mm**2 * 1e-3 / (self.f_number * self.pitch_mm)
        row[BLUR] = self.blur_px**2 + PIXEL_VARIANCE_PX2
        row[TABLE], row[EXTRA] = self.table, self.extra_px**2
        return row


@dataclass(frozen=True, eq=False)
class Layout:
    """Places, directions and camera options of n cameras."""

    mount: Array
    """(n,) index of the mount."""
    share: Array
    """(n, 2) along the mount and up, 0 to 1."""
    angles: Array
    """(n, 2) pan from the x axis and tilt above the horizon [rad]."""
    option: Array
    """(n,) index of the camera option."""

    def __len__(self) -> int:
        return len(self.mount)

    def places(self, mounts: Sequence[MountingPlace]) -> Array:
        """Return where the cameras stand (n, 3) [m]."""
        start, along, up = (np.array([getattr(one, name) for one in mounts]) for name in ("start", "along", "up"))
        a, b = self.share[:, :1], self.share[:, 1:]
        return np.asarray(start[self.mount] + a * along[self.mount] + b * up[self.mount])

    def rows(self, mounts: Sequence[MountingPlace], option_rows: Array) -> Array:
        """Return the cameras' rows (n, COLUMNS); ``option_rows`` (o, COLUMNS) of the options."""
        rows = np.array(option_rows[self.option])
        rows[:, :3] = self.places(mounts)
        rows[:, PAN : TILT + 1] = self.angles
        return rows

    def price(self, options: Sequence[CameraOption]) -> float:
        """Return the total price of the cameras."""
        return float(sum(options[k].price for k in self.option))

    def moved(self, share: Array, angles: Array) -> "Layout":
        """Return the same cameras at other places on their mounts and with other angles."""
        return replace(self, share=share, angles=angles)


def angles_towards(places: Array, target: Array) -> Array:
    """Return pan and tilt (n, 2) [rad] of cameras at ``places`` (n, 3) that look at ``target`` (3,)."""
    away = target - places
    pan = np.arctan2(away[:, 1], away[:, 0])
    tilt = np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1]))
    return np.column_stack([pan, np.clip(tilt, -STEEPEST_RAD, STEEPEST_RAD)])


def direction(angles: Array) -> Array:
    """Return unit vectors (n, 3) of pan and tilt (n, 2) [rad]."""
    pan, tilt = angles[:, 0], angles[:, 1]
    return np.column_stack([np.cos(tilt) * np.cos(pan), np.cos(tilt) * np.sin(pan), np.sin(tilt)])


def planned_rig(layout: Layout, mounts: Sequence[MountingPlace], options: Sequence[CameraOption]) -> Rig:
    """Return the rig: cameras cam1, cam2 ... without distortion, the principal point in the image's middle."""
    cameras = []
    for k, (place, angles) in enumerate(zip(layout.places(mounts), layout.angles, strict=True)):
        one = options[layout.option[k]]
        ahead = direction(angles[None])[0]
        right = np.array([np.sin(angles[0]), -np.cos(angles[0]), 0.0])
        pose = Pose(np.column_stack([right, np.cross(ahead, right), ahead]), place)
        lens = MoscaLens(one.focal_mm, (one.width - 1) / 2, (one.height - 1) / 2, one.pitch_mm, one.pitch_mm)
        cameras.append(Camera(f"cam{k + 1}", one.width, one.height, lens, pose))
    return Rig(tuple(cameras))
