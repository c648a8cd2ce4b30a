"""OpenPTV's camera model without refraction, and its exchange with ours.

Camera frame x right, y up, looking along -z. With (x, y) = c (X, Y) / -Z + (xh, yh) [mm] and r^2 = x^2 + y^2:

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 x^2) + 2 p2 x y      u = w / 2 + x" / pix_x
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p2 (r^2 + 2 y^2) + 2 p1 x y      v = h / 2 - y" / pix_y
    x" = scx (x' - sin(she) y')      y" = scx cos(she) y'

The distortion is about the middle of the sensor, not the principal point. The middle of the top-left pixel is at
(0.5, 0.5), as OpenPTV's target recognition gives it. Source: liboptv 0.3, ``imgcoord.c``, ``trafo.c``.

scx scales both axes in liboptv 0.3's projection. Its inverse (``dist_to_flat``), and both directions of older
releases, scale x alone. At scx = 1 all agree, so 1 is written, and the ratio of fx to fy goes into the pixels' shape.

OpenPTV's shear rotates the y axis alone; the shear a of a Mosca lens rotates both axes by the same angle. So the two
differ by a roll about the optical axis. With tan(2 roll) = sin(she), a = tan(roll), and d the direction in each
camera frame: d_openptv = Rz(roll) d_mosca.
"""

from dataclasses import astuple, dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mosca.camera.projection import Conversion, convert_lens, fit_lens, image_grid, lens_directions
from mosca.data.arrays import Array
from mosca.data.rig import Lens, MoscaLens, OpenCVLens, principal_distances_px
from mosca.errors import InputError

STEPS = 100
CONVERGED_MM = 1e-13
"""Step of the inverse distortion [mm] that counts as rounding."""
SAME_SHAPE = 1e-12
"""Relative difference of two pixel shapes that counts as rounding."""


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


@dataclass(frozen=True)
class Exchanged:
    """A lens in our model and in OpenPTV's, the one converted to the other.

    ``roll_rad``: d_openptv = Rz(roll) d_ours; ``fit``: how well it fits, None where it is exact.
    """

    lens: Lens
    interior: OpenPTVInterior
    roll_rad: float
    fit: Conversion | None


def rolled(roll_rad: float) -> Array:
    """Return Rz(roll) (3, 3) in our camera frame: x right, y down, z ahead."""
    return np.asarray(Rotation.from_euler("z", roll_rad).as_matrix())


def openptv_pixels(interior: OpenPTVInterior, directions: Array) -> Array:
    """Return pixels (n, 2), top-left pixel's centre (0, 0), of directions (n, 3) in the camera frame, our axes."""
    v = np.asarray(directions, dtype=float)
    flat = interior.c_mm * np.column_stack([v[:, 0], -v[:, 1]]) / v[:, 2:]
    measured = _distorted(interior, flat + (interior.xh_mm, interior.yh_mm))
    right, up = (measured @ _affine(interior).T / interior.pixel_mm).T
    width, height = interior.size_px
    return np.column_stack([width / 2 + right, height / 2 - up]) - 0.5


def openptv_directions(interior: OpenPTVInterior, xy_px: Array) -> Array:
    """Return directions (n, 3), z = 1 in our axes, of pixels (n, 2); NaN where the distortion has no inverse."""
    width, height = interior.size_px
    u, v = (np.asarray(xy_px, dtype=float) + 0.5).T
    metric = np.column_stack([u - width / 2, height / 2 - v]) * interior.pixel_mm
    measured = np.linalg.solve(_affine(interior), metric.T).T
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


def to_lens(interior: OpenPTVInterior) -> Exchanged:
    """Return our lens: OpenCV's, exact where distortion and principal point agree; a Mosca lens for a shear.

    A Mosca lens is fitted where there is a shear alone; where it is not exact, the closer of both is taken.
    """
    one, c = interior, interior.c_mm
    fx, fy = (one.scx * c / pixel for pixel in one.pixel_mm)
    shift_x, shift_y = _affine(one) @ (one.xh_mm, one.yh_mm)
    cx = one.size_px[0] / 2 + shift_x / one.pixel_mm[0] - 0.5
    cy = one.size_px[1] / 2 - shift_y / one.pixel_mm[1] - 0.5
    distorted = any((one.k1, one.k2, one.k3, one.p1, one.p2))
    straight = OpenCVLens(
        fx, fy, cx, cy, k1=one.k1 * c**2, k2=one.k2 * c**4, k3=one.k3 * c**6, p1=-one.p2 * c, p2=one.p1 * c
    )
    if one.she == 0 and (not distorted or (one.xh_mm == 0 and one.yh_mm == 0)):
        return Exchanged(straight, one, 0.0, None)
    shear = np.sin(one.she)
    roll = float(np.arctan(shear) / 2)
    width_mm = np.cos(roll) * one.pixel_mm[0] / one.scx
    height_mm = np.cos(roll) * one.pixel_mm[1] / one.scx * np.sqrt(1 + shear**2) / np.cos(one.she)
    sheared = MoscaLens(c, cx, cy, float(width_mm), float(height_mm), float(np.tan(roll)))
    if not distorted:
        return Exchanged(sheared, one, roll, None)
    grid = image_grid(*one.size_px)
    directions = openptv_directions(one, grid) @ rolled(roll)
    sheared = replace(sheared, K1_per_mm2=-one.k1, P1_per_mm=-one.p1, P2_per_mm=-one.p2)
    fits = [fit_lens("opencv", grid, directions, straight)]
    if one.she:
        fits.append(fit_lens("mosca", grid, directions, sheared))
    best = min(fits, key=lambda fit: fit.max_px)
    return Exchanged(best.lens, one, roll, best)


def pixel_shape(lens: Lens) -> float:
    """Return the ratio of a pixel's height to its width with which OpenPTV represents the lens at scx = 1."""
    fx, fy = principal_distances_px(lens)
    she = _she(lens)
    return float(fx / fy * np.cos(she) / np.sqrt(1 + np.sin(she) ** 2))


def from_lens(lens: Lens, size_px: tuple[int, int], pixel_mm: tuple[float, float]) -> Exchanged:
    """Return OpenPTV's interior orientation on pixels of this size: exact where it can be, else fitted.

    InputError for a lens with rays 90 deg or more off the axis, or with a shear beyond OpenPTV's.
    """
    width, height = size_px
    plain = lens if isinstance(lens, OpenCVLens) else convert_lens(lens, "opencv", width, height).lens
    assert isinstance(plain, OpenCVLens)
    she, (fx, _) = _she(lens), principal_distances_px(lens)
    roll = float(np.arctan(np.sin(she)) / 2)
    c = float(fx * np.cos(roll) * pixel_mm[0])
    bare = OpenPTVInterior(pixel_mm, size_px, c, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, scx=1.0, she=she)
    from_middle = np.array([plain.cx_px + 0.5 - width / 2, height / 2 - plain.cy_px - 0.5]) * pixel_mm
    xh, yh = np.linalg.solve(_affine(bare), from_middle).tolist()
    start = replace(
        bare,
        xh_mm=xh,
        yh_mm=yh,
        k1=plain.k1 / c**2,
        k2=plain.k2 / c**4,
        k3=plain.k3 / c**6,
        p1=plain.p2 / c,
        p2=-plain.p1 / c,
    )
    simple = replace(plain, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    pinhole = simple == OpenCVLens(plain.fx_px, plain.fy_px, plain.cx_px, plain.cy_px)
    held = pinhole and (plain == simple or (xh == 0 and yh == 0))
    if lens is plain and held and abs(pixel_mm[1] / pixel_mm[0] / pixel_shape(lens) - 1) < SAME_SHAPE:
        return Exchanged(lens, start, roll, None)
    grid = image_grid(width, height)
    directions = lens_directions(lens, grid)
    usable = np.isfinite(directions).all(axis=1) & (directions[:, 2] > 0)
    grid, directions = grid[usable], directions[usable] @ rolled(roll).T
    # scx stays 1, and a lens without shear gets none
    free = np.array([True] * 8 + [False, she != 0])
    scale = np.array([c, c, c, c**-2, c**-4, c**-6, 1 / c, 1 / c, 1.0, 1.0])
    first = np.array(astuple(start)[2:], dtype=float)

    def interior(x: Array) -> OpenPTVInterior:
        values = first.copy()
        values[free] = x * scale[free]
        return OpenPTVInterior(pixel_mm, size_px, *values.tolist())

    def residuals(x: Array) -> Array:
        return (openptv_pixels(interior(x), directions) - grid).ravel()

    begin = (first / scale)[free]
    fit = least_squares(residuals, begin, method="lm", x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14)
    return Exchanged(lens, interior(fit.x), roll, Conversion.of(plain, fit.fun, grid))


def _she(lens: Lens) -> float:
    """Return OpenPTV's shear [rad] of a Mosca lens's a."""
    a = lens.a if isinstance(lens, MoscaLens) else 0.0
    if not abs(a) < np.sqrt(2) - 1:
        raise InputError(f"lens: a = {a:g} given; OpenPTV holds a shear of |a| < 0.41")
    return float(np.arcsin(2 * a / (1 - a * a)))


def _affine(interior: OpenPTVInterior) -> Array:
    return interior.scx * np.array([[1.0, -np.sin(interior.she)], [0.0, np.cos(interior.she)]])


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
