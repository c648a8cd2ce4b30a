"""OpenPTV's camera model without refraction, and its exchange with ours.

Camera frame x right, y up, looking along -z. With (x, y) = c (X, Y) / -Z + (xh, yh) [mm] and r^2 = x^2 + y^2:

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 x^2) + 2 p2 x y      u = (scx x' - sin(she) y') / pix + w / 2
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p2 (r^2 + 2 y^2) + 2 p1 x y      v = h / 2 - cos(she) y' / pix

The distortion is about the middle of the sensor, not the principal point. The middle of the top-left pixel is at
(0.5, 0.5), as OpenPTV's target recognition gives it. Source: liboptv, ``imgcoord.c``, ``trafo.c``.
"""

from dataclasses import astuple, dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from mosca.camera import Conversion, convert_lens, fit_lens, image_grid, lens_directions
from mosca.data.arrays import Array
from mosca.data.rig import Lens, OpenCVLens

STEPS = 100
CONVERGED_MM = 1e-13


@dataclass(frozen=True)
class OpenPTVInterior:
    """Interior orientation: principal distance and point [mm], distortion [1/mm^2 ...], affinity; sensor."""

    pixel_mm: tuple[float, float]
    size_px: tuple[int, int]
    c_mm: float
    xh_mm: float
    yh_mm: float
    k1: float
    k2: float
    k3: float
    p1: float
    p2: float
    scx: float
    she: float


def openptv_pixels(interior: OpenPTVInterior, directions: Array) -> Array:
    """Direction (n, 3) in our camera frame -> pixel (n, 2), centre of the top-left pixel (0, 0)."""
    v = np.asarray(directions, dtype=float)
    flat = interior.c_mm * np.column_stack([v[:, 0], -v[:, 1]]) / v[:, 2:]
    measured = _distorted(interior, flat + (interior.xh_mm, interior.yh_mm))
    affine = np.array([[interior.scx, -np.sin(interior.she)], [0.0, np.cos(interior.she)]])
    right, up = (measured @ affine.T / interior.pixel_mm).T
    width, height = interior.size_px
    return np.column_stack([width / 2 + right, height / 2 - up]) - 0.5


def openptv_directions(interior: OpenPTVInterior, xy_px: Array) -> Array:
    """Pixel (n, 2) -> direction (n, 3) with z = 1 in our camera frame; NaN where the distortion has no inverse."""
    width, height = interior.size_px
    u, v = (np.asarray(xy_px, dtype=float) + 0.5).T
    metric = np.column_stack([u - width / 2, height / 2 - v]) * interior.pixel_mm
    affine = np.array([[interior.scx, -np.sin(interior.she)], [0.0, np.cos(interior.she)]])
    measured = np.linalg.solve(affine, metric.T).T
    flat = measured.copy()
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            step = measured - _distorted(interior, flat)
            flat = flat + step
            if not np.any(np.abs(step) > CONVERGED_MM):
                break
        found = np.abs(measured - _distorted(interior, flat)).max(axis=1) < 1e-9
    x, y = ((flat - (interior.xh_mm, interior.yh_mm)) / interior.c_mm).T
    return np.where(found[:, None], np.column_stack([x, -y, np.ones(len(x))]), np.nan)


def to_opencv(interior: OpenPTVInterior) -> tuple[Lens, Conversion | None]:
    """Return OpenCV's lens: exact without shear where distortion and principal point agree, else the best fit."""
    one, (width, height) = interior, interior.size_px
    distorted = any((one.k1, one.k2, one.k3, one.p1, one.p2))
    c = one.c_mm
    exact = OpenCVLens(
        fx_px=one.scx * c / one.pixel_mm[0],
        fy_px=c / one.pixel_mm[1],
        cx_px=width / 2 + one.scx * one.xh_mm / one.pixel_mm[0] - 0.5,
        cy_px=height / 2 - one.yh_mm / one.pixel_mm[1] - 0.5,
        k1=one.k1 * c**2,
        k2=one.k2 * c**4,
        k3=one.k3 * c**6,
        p1=-one.p2 * c,
        p2=one.p1 * c,
    )
    if one.she == 0 and (not distorted or (one.xh_mm == 0 and one.yh_mm == 0)):
        return exact, None
    grid = image_grid(width, height)
    fit = fit_lens("opencv", grid, openptv_directions(interior, grid), exact)
    return fit.lens, fit


def from_lens(
    lens: Lens, size_px: tuple[int, int], pitch_mm: float
) -> tuple[OpenPTVInterior, Conversion | None]:
    """Return OpenPTV's interior orientation for square pixels of ``pitch_mm``: exact where it can be, else fitted."""
    width, height = size_px
    plain = lens if isinstance(lens, OpenCVLens) else convert_lens(lens, "opencv", width, height).lens
    assert isinstance(plain, OpenCVLens)
    c = plain.fy_px * pitch_mm
    scx = plain.fx_px / plain.fy_px
    start = OpenPTVInterior(
        c_mm=c,
        xh_mm=(plain.cx_px + 0.5 - width / 2) * pitch_mm / scx,
        yh_mm=(height / 2 - plain.cy_px - 0.5) * pitch_mm,
        k1=plain.k1 / c**2,
        k2=plain.k2 / c**4,
        k3=plain.k3 / c**6,
        p1=plain.p2 / c,
        p2=-plain.p1 / c,
        scx=scx,
        she=0.0,
        pixel_mm=(pitch_mm, pitch_mm),
        size_px=size_px,
    )
    simple = replace(plain, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    pinhole = simple == OpenCVLens(plain.fx_px, plain.fy_px, plain.cx_px, plain.cy_px)
    undistorted = pinhole and plain == simple
    if lens is plain and (undistorted or (pinhole and start.xh_mm == 0 and start.yh_mm == 0)):
        return start, None
    grid = image_grid(width, height)
    directions = lens_directions(lens, grid)
    usable = np.isfinite(directions).all(axis=1) & (directions[:, 2] > 0)
    grid, directions = grid[usable], directions[usable]
    values = np.array(astuple(start)[2:], dtype=float)
    scale = np.array([c, c, c, c**-2, c**-4, c**-6, 1 / c, 1 / c, 1.0, 1.0])

    def interior(x: Array) -> OpenPTVInterior:
        return OpenPTVInterior(start.pixel_mm, size_px, *(x * scale).tolist())

    def residuals(x: Array) -> Array:
        return (openptv_pixels(interior(x), directions) - grid).ravel()

    fit = least_squares(
        residuals, values / scale, method="lm", x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14
    )
    distance = np.linalg.norm(fit.fun.reshape(-1, 2), axis=1)
    worst = grid[int(np.argmax(distance))]
    rms = float(np.sqrt(np.mean(distance**2)))
    return interior(fit.x), Conversion(plain, rms, float(distance.max()), (float(worst[0]), float(worst[1])))


def _distorted(interior: OpenPTVInterior, flat: Array) -> Array:
    x, y = flat.T
    r2 = x * x + y * y
    radial = 1 + r2 * (interior.k1 + r2 * (interior.k2 + r2 * interior.k3))
    return np.column_stack(
        [
            x * radial + interior.p1 * (r2 + 2 * x * x) + 2 * interior.p2 * x * y,
            y * radial + interior.p2 * (r2 + 2 * y * y) + 2 * interior.p1 * x * y,
        ]
    )
