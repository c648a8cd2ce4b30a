"""Projection of points, rays of pixels, and the Jacobians of both; conversion between lens models.

A point's way into the image: world -> camera frame (x right, y down, z forward) -> direction -> lens -> pixel.
"""

from dataclasses import astuple, dataclass, fields
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from mosca.camera.lens_models.arrays import directions as directions_of
from mosca.camera.lens_models.arrays import pixels
from mosca.data.arrays import Array
from mosca.data.rig import LENS_MODELS, Camera, FisheyeLens, Lens, MoscaLens, OpenCVLens
from mosca.errors import InputError

HELD: dict[str, frozenset[str]] = {
    "mosca": frozenset({"mx_mm_per_px"}),
    "opencv": frozenset({"k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"}),
    "fisheye": frozenset(),
}
"""Lens parameters that ``fit_lens`` holds fixed: redundant, or rarely determined by images."""


def lens_directions(lens: Lens, xy_px: Array) -> Array:
    """Return the unit directions (n, 3) of pixels (n, 2), camera frame; NaN where the lens has none."""
    return directions_of(lens, xy_px)[0]


def lens_pixels(lens: Lens, directions: Array) -> Array:
    """Return the pixels (n, 2) of directions (n, 3) of any length, camera frame; NaN where they are not imaged."""
    return pixels(lens, directions)[0]


def project(camera: Camera, points: Array) -> Array:
    """Return the pixels (n, 2) of world points (n, 3) [m]; NaN where the lens does not image them.

    Pixels beyond the image's edge are returned as they are.
    """
    return lens_pixels(camera.lens, camera.world_from_camera.inverse().transform(points))


@dataclass(frozen=True, eq=False)
class Projection:
    """Pixels of world points with analytic Jacobians.

    ``xy_px`` (n, 2); ``by_point`` (n, 2, 3) [px/m]; ``by_pose`` (n, 2, 6): rotation of the camera about
    its own axes (rad; ``R -> R exp([w]x)``), then its position in the world [px/m]; ``by_lens`` (n, 2, p)
    in the order of the lens's fields.
    """

    xy_px: Array
    by_point: Array
    by_pose: Array
    by_lens: Array


def project_with_jacobians(camera: Camera, points: Array) -> Projection:
    """Return the pixels of world points (n, 3) [m] and their Jacobians; NaN where the lens does not image them."""
    world_from_camera = camera.world_from_camera
    v = world_from_camera.inverse().transform(np.asarray(points, dtype=float).reshape(-1, 3))
    xy, by_direction, by_lens = pixels(camera.lens, v)
    by_point = by_direction @ world_from_camera.rotation.T
    # v' = exp(-[w]x) v: dv/dw = [v]x
    by_rotation = by_direction @ cross_matrices(v)
    return Projection(xy, by_point, np.concatenate([by_rotation, -by_point], axis=2), by_lens)


@dataclass(frozen=True, eq=False)
class Rays:
    """Observed pixels as rays in the world.

    ``origin`` (3,) centre of projection [m]; ``direction`` (n, 3) unit; ``pixel_by_direction`` (n, 2, 3): a point X
    near the ray has the reprojection error ``pixel_by_direction @ (X - origin) / (direction . (X - origin))`` [px] to
    first order in the error. This holds for every lens model, so matching and triangulation are independent of the
    lens.
    """

    origin: Array
    direction: Array
    pixel_by_direction: Array


def rays(camera: Camera, xy_px: Array) -> Rays:
    """Return the rays of pixels (n, 2); NaN where the lens has none."""
    rotation = camera.world_from_camera.rotation
    v, by_direction = directions_of(camera.lens, xy_px)
    return Rays(camera.world_from_camera.translation, v @ rotation.T, by_direction @ rotation.T)


@dataclass(frozen=True)
class Conversion:
    """A lens fitted to another's rays: rms and largest distance [px] over the image, and the pixel of the largest."""

    lens: Lens
    rms_px: float
    max_px: float
    worst_xy_px: tuple[float, float]

    @classmethod
    def of(cls, lens: Lens, residuals: Array, xy_px: Array) -> "Conversion":
        """Return the conversion to a lens with residuals (2 n,) [px] at pixels (n, 2)."""
        distance = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
        worst = xy_px[int(np.argmax(distance))]
        rms = float(np.sqrt(np.mean(distance**2)))
        return cls(lens, rms, float(distance.max()), (float(worst[0]), float(worst[1])))


def fit_lens(model: str, xy_px: Array, directions: Array, start: Lens | None = None) -> Conversion:
    """Fit a lens of ``model`` to pixels (n, 2) and their directions (n, 3), least squares in the image.

    ``start``: initial lens (its principal point and scale; default from the data). A Mosca lens keeps the start's
    pixel pitch mx, since c, mx and my have only two degrees of freedom. OpenCV's model keeps its rational part, thin
    prism and tilt (k4-k6, s1-s4, tauX, tauY). InputError for an unknown model, fewer than 10 usable points, or rays
    that the model cannot image at all.
    """
    if model not in LENS_MODELS:
        raise InputError(f"lens model '{model}' is unknown; there are {', '.join(LENS_MODELS)}")
    xy, v = np.asarray(xy_px, dtype=float), np.asarray(directions, dtype=float)
    usable = np.isfinite(v).all(axis=1) & np.isfinite(xy).all(axis=1)
    xy, v = xy[usable], v[usable]
    if len(xy) < 10:
        raise InputError(f"lens fit: {len(xy)} points with a ray given, at least 10 are needed")
    beside = int(np.sum(v[:, 2] <= 0))
    if model != "fisheye" and beside:
        raise InputError(
            f"lens fit: {beside} of {len(v)} rays stand 90 deg or more off the axis, which model '{model}' cannot "
            "image; use 'fisheye', or a smaller part of the image"
        )
    first = start if start is not None and start.model == model else _plain_lens(model, xy, v, start)
    names = [f.name for f in fields(first)]
    free = [k for k, name in enumerate(names) if name not in HELD[model]]
    values = np.array(astuple(first), dtype=float)

    def lens_of(x: Array) -> Any:
        full = values.copy()
        full[free] = x
        return type(first)(*full)

    def residuals(x: Array) -> Array:
        rest = pixels(lens_of(x), v)[0] - xy
        # a point that the trial lens cannot image must not count as a perfect fit
        result: Array = np.nan_to_num(rest, nan=1e3).ravel()
        return result

    def jacobian(x: Array) -> Array:
        by_lens = pixels(lens_of(x), v)[2]
        return np.nan_to_num(by_lens).reshape(-1, len(names))[:, free]

    fit = least_squares(
        residuals, values[free], jac=jacobian, method="lm", x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14
    )
    return Conversion.of(lens_of(fit.x), fit.fun, xy)


def convert_lens(lens: Lens, model: str, width: int, height: int, step_px: float = 16.0) -> Conversion:
    """Return the lens of ``model`` that agrees best with ``lens`` over an image (least squares on a grid)."""
    grid = image_grid(width, height, step_px)
    start = lens if isinstance(lens, MoscaLens) else None
    return fit_lens(model, grid, lens_directions(lens, grid), start)


def image_grid(width: int, height: int, step_px: float = 16.0) -> Array:
    """Return pixels (n, 2) on a regular grid over an image, its borders included."""
    x = np.linspace(-0.5, width - 0.5, max(2, round(width / step_px) + 1))
    y = np.linspace(-0.5, height - 0.5, max(2, round(height / step_px) + 1))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _plain_lens(model: str, xy: Array, v: Array, pitch_from: Lens | None) -> Lens:
    """Return a distortion-free lens of ``model`` from a straight line of pixel over tangent (fisheye: angle)."""
    across = np.hypot(v[:, 0], v[:, 1])
    angle = np.arctan2(across, v[:, 2])
    near = angle <= max(np.quantile(angle, 0.3), 1e-6)
    if model == "fisheye":
        ideal = v[near, :2] * (angle[near] / np.maximum(across[near], 1e-300))[:, None]
    else:
        ideal = v[near, :2] / v[near, 2:3]
    scales = []
    for axis in (0, 1):
        design = np.column_stack([ideal[:, axis], np.ones(near.sum())])
        scales.append(np.linalg.lstsq(design, xy[near, axis], rcond=None)[0])
    (fx, cx), (fy, cy) = scales
    if model == "mosca":
        mx = pitch_from.mx_mm_per_px if isinstance(pitch_from, MoscaLens) else 0.01
        return MoscaLens(fx * mx, cx, cy, mx, mx * fx / fy)
    if model == "opencv":
        return OpenCVLens(fx, fy, cx, cy)
    return FisheyeLens(fx, fy, cx, cy)


def inside_image(camera: Camera, xy_px: Array) -> Array:
    """Return which of pixels (n, 2) lie within the camera's image (n,); NaN does not."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((xy_px > -0.5) & (xy_px < (camera.width - 0.5, camera.height - 0.5))).all(axis=1))


def cross_matrices(v: Array) -> Array:
    """Return the matrices (n, 3, 3) [v]x of vectors (n, 3): [v]x w = v x w."""
    matrices = np.zeros((len(v), 3, 3))
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return matrices
