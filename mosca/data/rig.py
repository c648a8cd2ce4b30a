"""Lens, Camera, Rig: parameters and poses, no projection (that is ``mosca.camera.projection`` and
``twin.cameras.optics.lens``).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Literal

import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.errors import InputError


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion ``a_from_b``: ``x_a = rotation @ x_b + translation``.

    ``rotation`` (3, 3) is orthonormal with determinant +1 (checked to 1e-6), ``translation`` (3,) in m.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", read_only(self.rotation, (3, 3), "rotation"))
        object.__setattr__(self, "translation", read_only(self.translation, (3,), "translation"))
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(self.rotation) < 0:
            raise ValueError("rotation: not a rotation matrix (orthonormal, determinant +1)")

    def inverse(self) -> "Pose":
        """Return ``b_from_a``."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: "Pose") -> "Pose":
        """Return ``a_from_c`` of ``a_from_b @ b_from_c``."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def transform(self, points: Array) -> Array:
        """Return points (n, 3) of frame b in frame a [m]."""
        return np.asarray(points) @ self.rotation.T + self.translation


@dataclass(frozen=True)
class MoscaLens:
    """Interior orientation of the Mosca paper, section 2.2: collinearity with affinity, K1-K3, P1, P2.

    Image coordinates in mm from the principal point: ``xb = mx (x - xp)`` to the right,
    ``yb = -my (y - yp)`` up. The correction is a function of the *measured* point and is added to it,
    so pixel -> ray is closed form. ``mx``, ``my`` are the pixel pitches; c, mx and my together have only two
    degrees of freedom, so adjustments hold mx.
    """

    model: ClassVar[Literal["mosca"]] = "mosca"
    c_mm: float
    xp_px: float
    yp_px: float
    mx_mm_per_px: float
    my_mm_per_px: float
    a: float = 0.0
    K1_per_mm2: float = 0.0
    K2_per_mm4: float = 0.0
    K3_per_mm6: float = 0.0
    P1_per_mm: float = 0.0
    P2_per_mm: float = 0.0


@dataclass(frozen=True)
class OpenCVLens:
    """OpenCV's pinhole model: ideal -> distorted with radial k1, k2, k3, rational k4, k5, k6, tangential p1, p2,
    thin prism s1-s4 and a sensor tilted by tauX, tauY [rad, below 90 deg] about its x and y axes.

    The distortion's fields are in OpenCV's order of 14 coefficients. Pixel (0, 0) is the centre of the top-left
    pixel, as in OpenCV.
    """

    model: ClassVar[Literal["opencv"]] = "opencv"
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    tauX: float = 0.0
    tauY: float = 0.0


@dataclass(frozen=True)
class FisheyeLens:
    """Equidistant (Kannala-Brandt) fisheye: image radius theta (1 + k1 theta^2 + ... + k4 theta^8).

    The same model as OpenCV's ``cv2.fisheye`` with zero skew, but valid beyond 90 degrees from the axis, too: up to
    the angle where the radius stops rising, 180 degrees at most.
    """

    model: ClassVar[Literal["fisheye"]] = "fisheye"
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


Lens = MoscaLens | OpenCVLens | FisheyeLens
LENS_MODELS: dict[str, type[MoscaLens] | type[OpenCVLens] | type[FisheyeLens]] = {
    "mosca": MoscaLens,
    "opencv": OpenCVLens,
    "fisheye": FisheyeLens,
}


def principal_distances_px(lens: Lens) -> tuple[float, float]:
    """Return the principal distance in pixel widths and in pixel heights: fx, fy."""
    if isinstance(lens, MoscaLens):
        return lens.c_mm / lens.mx_mm_per_px, lens.c_mm / lens.my_mm_per_px
    return lens.fx_px, lens.fy_px


def principal_point_px(lens: Lens) -> tuple[float, float]:
    """Return the principal point (x, y) [px]."""
    return (lens.xp_px, lens.yp_px) if isinstance(lens, MoscaLens) else (lens.cx_px, lens.cy_px)


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: size in px, interior orientation (lens) and exterior orientation (pose).

    ``residual_px``: image errors left by the lens model, rms an axis [px], as found by the calibration. They are
    systematic and do not average out over time. ``shake_px``: shift of whole images, independent in each exposure,
    rms an axis [px]; it is common to all targets of an image. Either is 0 where it is not known.
    """

    name: str
    width: int
    height: int
    lens: Lens
    world_from_camera: Pose
    residual_px: float = 0.0
    shake_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras with distinct names, in a fixed order."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        names = self.names
        if len(set(names)) != len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise InputError(f"rig: camera name '{twice}' stands twice; give each camera its own name")

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names in the rig's order."""
        return tuple(camera.name for camera in self.cameras)

    def camera(self, name: str) -> Camera:
        """Return the camera called ``name``; InputError lists what there is."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise InputError(f"rig: no camera '{name}'; it has {', '.join(self.names)}")


@lru_cache(maxsize=32)
def focal_px(rig: Rig) -> Array:
    """Return the principal distances (c,) [px], the longer of both of each camera."""
    return np.array([max(principal_distances_px(camera.lens)) for camera in rig.cameras])
