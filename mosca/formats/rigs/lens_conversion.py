"""Options, conversion of lenses and checks shared by readers and writers of other programs' calibrations."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from mosca.camera.projection import Conversion, convert_lens
from mosca.data.arrays import Array
from mosca.data.files.decimals import real
from mosca.data.files.rig_file import LARGEST_POSITION_M
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens
from mosca.data.rotations import nearest_rotation
from mosca.errors import InputError

Notes = tuple[str, ...]
"""What was assumed, fitted or left out, one line each, for the person who converts."""
CALIBRATION = "a file of a calibration"
"""The kind of file that is wanted, for errors where it is missing."""

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""Distortion coefficients in OpenCV's order."""
COUNTS = (4, 5, 8, 12, 14)
LARGEST_TILT_RAD = 1.5
"""Largest tilt of a sensor: the tilt's projection ends at 90 deg."""
LARGEST_MISFIT = 1e-3
"""Largest difference of a file's rotation, printed with few digits, from the nearest rotation matrix."""
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_ .-]*")


@dataclass(frozen=True)
class RigFileOptions:
    """What a calibration file does not contain, and the tolerance for fitted lens models.

    ``size_px``: (width, height) where the file has none; ``unit``: that of positions, None for the format's own;
    ``pixel_mm``: pixel pitch (width, height), which OpenPTV needs; ``max_residual_px``: a lens that the format can
    only approximate is refused where the best fit is farther off than this anywhere in the image.
    """

    size_px: tuple[int, int] | None = None
    unit: Literal["m", "mm"] | None = None
    pixel_mm: tuple[float, float] | None = None
    max_residual_px: float = 0.1

    def metres(self, default: Literal["m", "mm"]) -> float:
        """Return the length of one unit of the file [m]."""
        return 1.0 if (self.unit or default) == "m" else 1e-3


def as_opencv(camera: Camera, options: RigFileOptions, coefficients: int = 14) -> tuple[OpenCVLens, Notes]:
    """Return the camera's lens as OpenCV's pinhole model with the first ``coefficients`` of its 14.

    Such a lens is returned unchanged. Any other is fitted to its rays over the image (k1, k2, k3, p1, p2), and a note
    states the residual. InputError where it is above the options' limit, or rays are 90 deg or more off the axis.
    """
    lens = camera.lens
    if isinstance(lens, OpenCVLens) and not any(distortion(lens)[coefficients:]):
        return lens, ()
    with naming(camera):
        fit = convert_lens(lens, "opencv", camera.width, camera.height)
    assert isinstance(fit.lens, OpenCVLens)
    return fit.lens, (fit_note(camera, fit, "OpenCV's model", options),)


@contextmanager
def naming(camera: Camera) -> Iterator[None]:
    """Add the camera's name to InputErrors of a lens fit."""
    try:
        yield
    except InputError as error:
        raise InputError(f"camera '{camera.name}': {error}") from None


def fit_note(camera: Camera, fit: Conversion, model: str, options: RigFileOptions) -> str:
    """Return the line that states the residual of a lens fit; InputError where it is above the limit."""
    x, y = fit.worst_xy_px
    what = (
        f"camera '{camera.name}': {camera.lens.model} lens fitted by {model}: {fit.rms_px:.2g} px rms over the "
        f"image, {fit.max_px:.2g} px at most, at ({x:.0f}, {y:.0f})"
    )
    if not fit.max_px <= options.max_residual_px:
        raise InputError(
            f"{what}; {options.max_residual_px:g} px allowed; raise 'max_residual_px' or choose a format that holds "
            f"model '{camera.lens.model}'"
        )
    return what


def distortion(lens: OpenCVLens) -> tuple[float, ...]:
    """Return the 14 coefficients in OpenCV's order."""
    return tuple(float(getattr(lens, name)) for name in COEFFICIENTS)


def shortest(coefficients: Sequence[float], least: int = 5) -> list[float]:
    """Return the coefficients without trailing zeros, but as many as OpenCV accepts (one of ``COUNTS``)."""
    last = max((k + 1 for k, value in enumerate(coefficients) if value), default=0)
    count = next(n for n in COUNTS if n >= max(last, least))
    return list(coefficients[:count])


def matrix_of(lens: OpenCVLens | FisheyeLens) -> Array:
    """Return the camera matrix (3, 3) [px]."""
    return np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])


def opencv_parts(camera: Camera, options: RigFileOptions) -> tuple[Array, list[float], bool, Notes]:
    """Return a lens in OpenCV's terms: camera matrix, coefficients, whether they are a fisheye's, and notes."""
    lens = camera.lens
    if isinstance(lens, FisheyeLens):
        return matrix_of(lens), [lens.k1, lens.k2, lens.k3, lens.k4], True, ()
    pinhole, notes = as_opencv(camera, options)
    return matrix_of(pinhole), shortest(distortion(pinhole)), False, notes


def opencv_lens(matrix: Array, coefficients: Sequence[float], fisheye: bool, where: str) -> OpenCVLens | FisheyeLens:
    """Return the lens of a camera matrix (3, 3) [px] and coefficients in OpenCV's order; ``where`` begins errors."""
    (fx, skew, cx), (low, fy, cy), last = np.asarray(matrix, dtype=float).tolist()
    whole = np.allclose([low, *last], [0, 0, 0, 1], atol=1e-9)
    if not whole or not (fx > 0 and fy > 0) or abs(skew) > 1e-6 * fx:
        raise InputError(
            f"{where}: camera matrix {[fx, skew, cx, low, fy, cy, *last]} given; "
            "[fx, 0, cx, 0, fy, cy, 0, 0, 1] with fx, fy above 0 and no skew is allowed"
        )
    d = [float(value) for value in coefficients]
    if fisheye:
        if len(d) != 4:
            raise InputError(f"{where}: {len(d)} distortion coefficients given; a fisheye has 4 (k1 k2 k3 k4)")
        return FisheyeLens(fx, fy, cx, cy, *d)
    if len(d) not in (0, *COUNTS):
        raise InputError(
            f"{where}: {len(d)} distortion coefficients given; 4, 5, 8, 12 or 14 are allowed, in OpenCV's order "
            f"({' '.join(COEFFICIENTS)})"
        )
    if any(abs(tau) > LARGEST_TILT_RAD for tau in d[12:]):
        raise InputError(f"{where}: tauX, tauY = {d[12:]} given; at most {LARGEST_TILT_RAD:g} rad are allowed")
    return OpenCVLens(fx, fy, cx, cy, *d)


def rotation_of(given: Array, where: str) -> Array:
    """Return the rotation matrix (3, 3) nearest to what a file gives; InputError where it is not a rotation."""
    matrix = np.asarray(given, dtype=float).reshape(3, 3)
    rotation, misfit = nearest_rotation(matrix) if np.isfinite(matrix).all() else (matrix, np.inf)
    if not misfit <= LARGEST_MISFIT:
        raise InputError(
            f"{where}: rotation is {misfit:.3g} off the nearest rotation matrix; {LARGEST_MISFIT:g} is allowed"
        )
    return rotation


def checked_camera(camera: Camera, where: str) -> Camera:
    """Return ``camera``; InputError where its numbers cannot be those of a camera in metres and pixels."""
    lens, position = camera.lens, camera.world_from_camera.translation
    if isinstance(lens, MoscaLens):
        focal, centre = (lens.c_mm, lens.mx_mm_per_px, lens.my_mm_per_px), (lens.xp_px, lens.yp_px)
    else:
        focal, centre = (lens.fx_px, lens.fy_px, 1.0), (lens.cx_px, lens.cy_px)
    if not (0 < camera.width <= 65535 and 0 < camera.height <= 65535):
        raise InputError(f"{where}: image of {camera.width} x {camera.height} px given; 1 to 65535 px are allowed")
    if not np.isfinite(astuple(lens)).all() or not min(focal) > 0:
        raise InputError(f"{where}: lens {lens} given; finite numbers and a focal length above 0 are wanted")
    if not np.abs(position).max() <= LARGEST_POSITION_M:
        raise InputError(
            f"{where}: position {position.tolist()} given; metres are wanted, at most {LARGEST_POSITION_M:g} from "
            "the origin; where the file is in millimetres, say so (unit = mm)"
        )
    for value, size in zip(centre, (camera.width, camera.height), strict=True):
        if not -0.5 * size <= value <= 1.5 * size:
            raise InputError(
                f"{where}: principal point ({centre[0]:g}, {centre[1]:g}) px is far outside the image of "
                f"{camera.width} x {camera.height} px; check the image size and its unit"
            )
    return camera


def named(cameras: Sequence[Camera], path: Path) -> tuple[tuple[Camera, ...], Notes]:
    """Return the cameras with names that a rig file can hold, and what was renamed; InputError for a name twice."""
    renamed, notes = [], []
    for camera in cameras:
        name = re.sub(r"[^A-Za-z0-9_ .-]", "_", camera.name)
        name = name if NAME.fullmatch(name) else f"cam_{name}"
        if name != camera.name:
            notes.append(f"camera '{camera.name}' is called '{name}' (letters, digits, _ . - are allowed)")
        renamed.append(replace(camera, name=name))
    names = [camera.name for camera in renamed]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: camera name '{name}' stands twice; give each camera its own name")
    return tuple(renamed), tuple(notes)


def numbers(text: str, path: Path) -> list[float]:
    """Return the numbers of a text separated by white space; InputError names what is not a number."""
    found = []
    for word in text.split():
        try:
            found.append(real(word))
        except ValueError:
            raise InputError(f"{path}: '{word[:40]}' stands where a number is wanted") from None
        if not np.isfinite(found[-1]):
            raise InputError(f"{path}: '{word[:40]}' stands where a finite number is wanted")
    return found


Reader = Callable[[Path, RigFileOptions], tuple[tuple[Camera, ...], Notes]]
Writer = Callable[[tuple[Camera, ...], Path, RigFileOptions], Notes]
