"""Pixels to rays with their errors, compiled: one call for all cameras of a frame set.

The lens formulas are those of ``mosca.camera.lens_models`` (one file a model; the sources stand there), for one
pixel at a time and with the one derivative that matching needs: of the pixel by the ray's direction.
"""

from collections.abc import Mapping
from dataclasses import astuple, dataclass
from functools import lru_cache
from itertools import accumulate

import numpy as np

from mosca.camera.eccentricity import ball_field
from mosca.camera.lens_models import fisheye as fisheye_model
from mosca.camera.lens_models import mosca as mosca_model
from mosca.camera.lens_models import opencv as opencv_model
from mosca.camera.projection import image_grid, lens_directions
from mosca.data.arrays import Array
from mosca.data.detections import MERGED, UNREFINED, Detections
from mosca.data.rays import (
    ANGLE,
    BONUS,
    COLUMNS,
    DENSITY,
    DIRECTION,
    FLAGS,
    NORMAL,
    RADIUS,
    SIGMA,
    SPREAD,
    VIEW,
    WHITE,
    RayTable,
)
from mosca.data.rig import Camera, FisheyeLens, Lens, MoscaLens, OpenCVLens, Rig
from mosca.numba_support.decorators import bare_step, kernel

MOSCA, OPENCV, FISHEYE = 0, 1, 2
FOLD, TILTED, TILT, UNTILT, WIDTH = 20, 21, 22, 31, 40
"""Places in a camera's row of lens parameters: the first 18 are the lens's fields in their order."""
NEWTON_STEPS = 30
EDGE_STEP_PX = 64.0
TWO_LONG = 1.6
"""Ratio of a box's sides from which an image is taken for two targets (a small disc's box reaches 3 : 2)."""
LEAST_DIAMETER_PX = 0.5
"""A target of one pixel has no measurable size; taken for this one."""
BLUR_PX = 0.45
"""Blur of lens and pixel (standard deviation) that makes images larger than what they show; of small targets the area
by a third, by more where they are far, so that whole targets far off would hide what is missing of near ones."""
SHARPEST = 0.1
"""Share of its area that an image keeps at least when its blur is taken off."""
LONG = 16
"""Bit of a ray's FLAGS beside those of its detection: the region is longer than pixels make that of a disc."""
ROUNDED_PX = 1.5
"""Difference of a region's sides from which it is: those of a disc's differ by one at most."""


@dataclass(frozen=True, eq=False)
class RigTable:
    """A rig as the kernels read it.

    ``kind`` (c,) lens model; ``lens`` (c, WIDTH) its parameters; ``size`` (c, 2) of the image [px]; ``rotation``
    (c, 3, 3) and ``origin`` (c, 3) of world_from_camera [m]; ``views`` (c, 16) both, origin
    first, and what ``_edges`` gives; ``pairs`` (p, 2) of cameras, those first whose base lies most across both views;
    ``bases`` (p, 2, 3) two unit vectors across each pair's base, the first towards where both look (infinite where
    both stand at one place).
    """

    kind: Array
    lens: Array
    size: Array
    rotation: Array
    origin: Array
    views: Array
    pairs: Array
    bases: Array


def make_ray_table(
    rig: Rig, detections: Mapping[str, Detections], camera_sigma_px: float | Array, target: str = "point"
) -> RayTable:
    """Return the rays of all detections of a frame set.

    ``camera_sigma_px``: what besides the detection's own error moves an image point at random (camera body,
    trigger, lens model), standard deviation an axis, of all cameras or of each (c,); added to each detection's
    covariance. ``target``: "ball"
    frees each image of a ball's eccentricity, by its own size (``mosca.camera.eccentricity``); "point" takes the
    image as it is.
    """
    table = rig_table(rig)
    found = [detections.get(c.name) for c in rig.cameras]
    there = [f for f in found if f is not None] or [Detections.none("")]
    start = np.array([0, *accumulate(0 if f is None else len(f) for f in found)])
    covariance = np.concatenate([f.covariance_px2 for f in there])
    extra = np.zeros(len(found))
    extra[:] = np.square(camera_sigma_px)
    rays, views = np.empty((int(start[-1]), COLUMNS)), np.empty((len(found), VIEW))
    odd = fill_rays(
        table.kind, table.lens, table.size, table.rotation, table.views, start,
        ball_fields(rig) if target == "ball" else NO_FIELDS,
        np.concatenate([f.xy_px for f in there]), covariance, extra,
        np.concatenate([f.diameter_px for f in there]), np.concatenate([f.elongation for f in there]),
        np.concatenate([f.flags for f in there]), rays, views,
    )  # fmt: skip
    return RayTable(rays, views, table.pairs, table.bases, start, covariance, extra, odd)


@lru_cache(maxsize=32)
def rig_table(rig: Rig) -> RigTable:
    """Return the table of a rig (made once for each Rig object)."""
    rows = [_lens_row(camera.lens) for camera in rig.cameras]
    rotation = np.array([c.world_from_camera.rotation for c in rig.cameras]).reshape(-1, 3, 3)
    origin = np.array([c.world_from_camera.translation for c in rig.cameras]).reshape(-1, 3)
    pairs = _ordered_pairs(rotation, origin)
    return RigTable(
        np.array([kind for kind, _ in rows], dtype=np.int64),
        np.array([row for _, row in rows]).reshape(-1, WIDTH),
        np.array([(c.width, c.height) for c in rig.cameras], dtype=float).reshape(-1, 2),
        np.ascontiguousarray(rotation),
        np.ascontiguousarray(origin),
        np.column_stack([origin, rotation.reshape(-1, 9), [_edges(c) for c in rig.cameras]]),
        pairs,
        np.array([_across(a, b, rotation, origin) for a, b in pairs]).reshape(-1, 2, 3),
    )


def _across(a: int, b: int, rotation: Array, origin: Array) -> Array:
    """Return two unit vectors (2, 3) across the base of cameras a and b."""
    base = origin[b] - origin[a]
    if not base.any():
        return np.full((2, 3), np.inf)
    base = base / np.linalg.norm(base)
    # angles count from where both cameras look, so that none is near half a turn
    tried = [rotation[a, :, 2] + rotation[b, :, 2], rotation[a, :, 1], rotation[a, :, 0]]
    flat = [one - base * (one @ base) for one in tried]
    up = next(one for one in flat if np.linalg.norm(one) > 1e-3)
    up = up / np.linalg.norm(up)
    return np.array([up, np.cross(base, up)])


@lru_cache(maxsize=32)
def ball_fields(rig: Rig) -> Array:
    """Return each camera's ``mosca.camera.eccentricity.ball_field``, (c, rows, columns, 2)."""
    return np.array([ball_field(camera) for camera in rig.cameras])


NO_FIELDS = np.zeros((0, 0, 0, 2))
"""In place of ``ball_fields``: targets are points."""


def _lens_row(lens: Lens) -> tuple[int, Array]:
    row = np.zeros(WIDTH)
    values = astuple(lens)
    row[: len(values)] = values
    if isinstance(lens, MoscaLens):
        row[FOLD] = mosca_model.fold_mm2(lens)
        return MOSCA, row
    if isinstance(lens, FisheyeLens):
        row[FOLD] = min(np.pi, np.sqrt(fisheye_model.fold_rad2(lens)))
        return FISHEYE, row
    assert isinstance(lens, OpenCVLens)
    row[FOLD] = opencv_model.fold_r2(lens)
    row[TILTED] = float(lens.tauX != 0 or lens.tauY != 0)
    tilt = _tilt(lens.tauX, lens.tauY)
    row[TILT:UNTILT], row[UNTILT:WIDTH] = tilt.ravel(), np.linalg.inv(tilt).ravel()
    return OPENCV, row


def _tilt(tau_x: float, tau_y: float) -> Array:
    """Return the homography (3, 3) of a sensor turned by R = R_y(tauY) R_x(tauX) (OpenCV, calib3d)."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1.0]]) @ turn


def _edges(camera: Camera) -> Array:
    """Return the box (4,) left, top, right, bottom of what a camera sees, in ``match_index``'s places."""
    rays = lens_directions(camera.lens, image_grid(camera.width, camera.height, EDGE_STEP_PX))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if not len(rays):
        return np.zeros(4)
    place = rays[:, :2] / (1.0 + rays[:, 2:])
    return np.concatenate([place.min(axis=0), place.max(axis=0)])


def _ordered_pairs(rotation: Array, origin: Array) -> Array:
    """Return the pairs of cameras, those first whose optical axes both stand across the base."""
    a, b = np.triu_indices(len(origin), 1)
    base = origin[b] - origin[a]
    across = np.linalg.norm(np.cross(base, rotation[a, :, 2]), axis=1)
    across *= np.linalg.norm(np.cross(base, rotation[b, :, 2]), axis=1)
    length2 = np.maximum((base**2).sum(axis=1), 1e-300)
    order = np.argsort(-np.round(across / length2, 6), kind="stable")
    return np.ascontiguousarray(np.column_stack([a, b])[order]).astype(np.int64)


@bare_step
def mosca_ray(p, u, v, d, g):  # type: ignore[no-untyped-def]
    """Pixel -> unit direction ``d`` (3,) and d pixel / d direction ``g`` (2, 3), camera frame; False without one."""
    c, mx, my, a, k1, k2, k3, p1, p2 = p[0], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10]
    x, y = mx * (u - p[1]), -my * (v - p[2])
    r2 = x * x + y * y
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    rise = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    ix = x + a * y + x * radial + (r2 + 2.0 * x * x) * p1 + 2.0 * x * y * p2
    iy = y + a * x + y * radial + 2.0 * x * y * p1 + (r2 + 2.0 * y * y) * p2
    s00 = 1.0 + radial + x * x * rise + 6.0 * x * p1 + 2.0 * y * p2
    s01 = a + x * y * rise + 2.0 * y * p1 + 2.0 * x * p2
    s11 = 1.0 + radial + y * y * rise + 2.0 * x * p1 + 6.0 * y * p2
    det = s00 * s11 - s01 * s01
    if not (det > 0.0 and s00 + s11 > 0.0 and r2 < p[FOLD]):
        return False
    tx, ty = ix / c, -iy / c
    # pixel by tangent: scale (1/mx, -1/my), inverse slope, c (1, -1)
    across, down = c / (mx * det), c / (my * det)
    j00, j01 = across * s11, across * s01
    j10, j11 = down * s01, down * s00
    _by_direction(tx, ty, j00, j01, j10, j11, d, g)
    return True


@bare_step
def opencv_ray(p, u, v, d, g):  # type: ignore[no-untyped-def]
    """As ``mosca_ray``; Newton's method for the ideal point."""
    fx, fy, k1, k2, p1, p2, k3 = p[0], p[1], p[4], p[5], p[6], p[7], p[8]
    wx, wy = (u - p[2]) / fx, (v - p[3]) / fy
    if p[TILTED] > 0.0:
        depth = p[UNTILT + 6] * wx + p[UNTILT + 7] * wy + p[UNTILT + 8]
        if not depth > 0.0:
            return False
        wx, wy = (
            (p[UNTILT] * wx + p[UNTILT + 1] * wy + p[UNTILT + 2]) / depth,
            (p[UNTILT + 3] * wx + p[UNTILT + 4] * wy + p[UNTILT + 5]) / depth,
        )
    x, y = wx, wy
    for turn in range(NEWTON_STEPS + 1):
        r2 = x * x + y * y
        above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1.0 + r2 * (p[9] + r2 * (p[10] + r2 * p[11]))
        q = above / below
        rise = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - q * (p[9] + r2 * (2.0 * p[10] + r2 * 3.0 * p[11]))
        rise /= below
        ex = wx - (x * q + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (p[12] + r2 * p[13]))
        ey = wy - (y * q + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (p[14] + r2 * p[15]))
        prism_x, prism_y = 2.0 * (p[12] + 2.0 * r2 * p[13]), 2.0 * (p[14] + 2.0 * r2 * p[15])
        across = 2.0 * x * y * rise + 2.0 * p1 * x + 2.0 * p2 * y
        s00 = q + 2.0 * x * x * rise + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x
        s01, s10 = across + prism_x * y, across + prism_y * x
        s11 = q + 2.0 * y * y * rise + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y
        det = s00 * s11 - s01 * s10
        near = abs(ex) < 1e-14 and abs(ey) < 1e-14
        if near or turn == NEWTON_STEPS or not np.isfinite(det):
            break
        x, y = x + (s11 * ex - s01 * ey) / det, y + (s00 * ey - s10 * ex) / det
    if not (abs(ex) < 1e-10 and abs(ey) < 1e-10 and det > 0.0 and s00 + s11 > 0.0 and r2 < p[FOLD]):
        return False
    if p[TILTED] > 0.0:
        s00, s01, s10, s11 = _tilted(p, wx, wy, s00, s01, s10, s11)
    _by_direction(x, y, fx * s00, fx * s01, fy * s10, fy * s11, d, g)
    return True


@bare_step
def _tilted(p, wx, wy, s00, s01, s10, s11):  # type: ignore[no-untyped-def]
    """Carry a slope from before the sensor's tilt onto the sensor."""
    depth = p[TILT + 6] * wx + p[TILT + 7] * wy + p[TILT + 8]
    x = (p[TILT] * wx + p[TILT + 1] * wy + p[TILT + 2]) / depth
    y = (p[TILT + 3] * wx + p[TILT + 4] * wy + p[TILT + 5]) / depth
    c00, c01 = (p[TILT] - x * p[TILT + 6]) / depth, (p[TILT + 1] - x * p[TILT + 7]) / depth
    c10, c11 = (p[TILT + 3] - y * p[TILT + 6]) / depth, (p[TILT + 4] - y * p[TILT + 7]) / depth
    return c00 * s00 + c01 * s10, c00 * s01 + c01 * s11, c10 * s00 + c11 * s10, c10 * s01 + c11 * s11


@bare_step
def _by_direction(tx, ty, j00, j01, j10, j11, d, g):  # type: ignore[no-untyped-def]
    """Fill ``d`` and ``g`` from a tangent (x/z, y/z) and the pixel's derivatives by it."""
    length = np.sqrt(tx * tx + ty * ty + 1.0)
    inverse = 1.0 / length
    d[0], d[1], d[2] = tx * inverse, ty * inverse, inverse
    g[0, 0], g[0, 1], g[0, 2] = j00 * length, j01 * length, -(j00 * tx + j01 * ty) * length
    g[1, 0], g[1, 1], g[1, 2] = j10 * length, j11 * length, -(j10 * tx + j11 * ty) * length


@bare_step
def fisheye_ray(p, u, v, d, g):  # type: ignore[no-untyped-def]
    """As ``mosca_ray``; Newton's method between bounds for the angle."""
    fx, fy, k1, k2, k3, k4 = p[0], p[1], p[4], p[5], p[6], p[7]
    wx, wy = (u - p[2]) / fx, (v - p[3]) / fy
    rho = np.sqrt(wx * wx + wy * wy)
    low, high = 0.0, p[FOLD]
    theta = min(rho, high)
    value = slope = 0.0
    for _step in range(60):
        t2 = theta * theta
        value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        if value < rho:
            low = theta
        else:
            high = theta
        tried = theta + (rho - value) / slope
        moved = tried if low <= tried <= high else 0.5 * (low + high)
        done = abs(moved - theta) <= 1e-14
        theta = moved
        if done:
            break
    if not (abs(rho - value) < 1e-10 and theta < p[FOLD] and slope > 0.0):
        return False
    s, z = np.sin(theta), np.cos(theta)
    cx, cy = (wx / rho, wy / rho) if rho > 1e-9 else (1.0, 0.0)
    turn = rho / s if rho > 1e-9 else 1.0
    d[0], d[1], d[2] = s * cx, s * cy, z
    for k in range(3):
        along = (z * cx, z * cy, -s)[k] * slope
        beside = (-cy, cx, 0.0)[k] * turn
        g[0, k] = fx * (cx * along - cy * beside)
        g[1, k] = fy * (cy * along + cx * beside)
    return True


@kernel
def fill_rays(  # type: ignore[no-untyped-def]
    kind, lens, size, rotation, seen, start, fields, xy, covariance, extra, diameter, elongation, flags, rays, views
):  # fmt: skip
    """Fill the table of rays (n, COLUMNS) from the detections, NaN where a pixel has no ray, and that of cameras.

    ``fields``: (c, rows, columns, 2) the eccentricity of balls, or none of them: a ball's image, which fills
    the angle A, is shifted by (A/2)^2 times the field. ``seen``: ``RigTable.views``, which ``views`` (c, VIEW)
    completes. Returns how many images are long, or stand alone without a fit.
    """
    d, local, g = np.empty(3), np.empty((2, 3)), np.empty((2, 3))
    odd = 0
    for c in range(kind.shape[0]):
        turn, own_lens = rotation[c], lens[c]
        density = (start[c + 1] - start[c]) / (size[c, 0] * size[c, 1])
        for k in range(DENSITY):
            views[c, k] = seen[c, k]
        views[c, DENSITY] = density
        for n in range(start[c], start[c + 1]):
            u, v = xy[n, 0], xy[n, 1]
            if kind[c] == MOSCA:
                good = mosca_ray(own_lens, u, v, d, local)
            elif kind[c] == OPENCV:
                good = opencv_ray(own_lens, u, v, d, local)
            else:
                good = fisheye_ray(own_lens, u, v, d, local)
            root = np.sqrt(elongation[n])
            # two targets grown together are long, and their flux and peak tell no diameter: the longer axis does
            across = max(diameter[n] * (root if elongation[n] > TWO_LONG else 1.0), LEAST_DIAMETER_PX)
            # a region reaches about a pixel past the disc that has its light
            long = (elongation[n] - 1.0) * (diameter[n] + 1.1) > ROUNDED_PX * root
            odd += long or flags[n] & (UNREFINED | MERGED) == UNREFINED
            s00, s01, s11 = (
                covariance[n, 0, 0] + extra[c],
                covariance[n, 0, 1],
                covariance[n, 1, 1] + extra[c],
            )
            area = s00 * s11 - s01 * s01
            if not (good and s00 > 0.0 and area > 0.0):
                rays[n] = np.nan
                continue
            sigma2 = np.sqrt(area)
            rays[n, SIGMA], rays[n, FLAGS] = np.sqrt(sigma2), flags[n] + (LONG if long else 0)
            # what a ray adds to the likelihood of a group: its image by the target against one by chance anywhere
            rays[n, BONUS] = -np.log(2.0 * np.pi * sigma2 * density)
            # the image of a direction of the world
            for row in range(2):
                for k in range(3):
                    g[row, k] = (
                        local[row, 0] * turn[k, 0] + local[row, 1] * turn[k, 1] + local[row, 2] * turn[k, 2]
                    )
            for k in range(3):
                rays[n, DIRECTION + k] = turn[k, 0] * d[0] + turn[k, 1] * d[1] + turn[k, 2] * d[2]
            q00 = g[0, 0] * g[0, 0] + g[0, 1] * g[0, 1] + g[0, 2] * g[0, 2]
            q01 = g[0, 0] * g[1, 0] + g[0, 1] * g[1, 1] + g[0, 2] * g[1, 2]
            q11 = g[1, 0] * g[1, 0] + g[1, 1] * g[1, 1] + g[1, 2] * g[1, 2]
            det = q00 * q11 - q01 * q01
            # px a radian across the ray: the geometric mean of both axes
            angle = across / np.sqrt(np.sqrt(det))
            sharp = np.sqrt(max(1.0 - (2.0 * BLUR_PX / diameter[n]) ** 2, SHARPEST))
            rays[n, RADIUS], rays[n, ANGLE] = 0.5 * across * sharp, angle * sharp
            l00 = np.sqrt(s00)
            l10 = s01 / l00
            l11 = np.sqrt(s11 - l10 * l10)
            i00, i11, inverse = 1.0 / l00, 1.0 / l11, 1.0 / det
            shift_x = shift_y = 0.0
            if fields.shape[0] > 0:
                ratio = 0.25 * angle * angle
                shift_x, shift_y = _field(fields[c], size[c], u, v)
                shift_x, shift_y = shift_x * ratio, shift_y * ratio
            for k in range(3):
                first = g[0, k] * i00
                rays[n, WHITE + k], rays[n, WHITE + 3 + k] = first, (g[1, k] - l10 * first) * i11
                # direction by pixel: the pseudo-inverse G' (G G')^-1
                tx = (g[0, k] * q11 - g[1, k] * q01) * inverse
                ty = (g[1, k] * q00 - g[0, k] * q01) * inverse
                rays[n, SPREAD + 2 * k] = tx * l00 + ty * l10
                rays[n, SPREAD + 2 * k + 1] = ty * l11
                rays[n, DIRECTION + k] -= tx * shift_x + ty * shift_y
            if fields.shape[0] > 0:
                _turn_with(rays, n)
            _normals(rays, n, seen[c, 0], seen[c, 1], seen[c, 2])
    return odd


@bare_step
def _normals(rays, n, x, y, z):  # type: ignore[no-untyped-def]
    """Fill a ray's share in the normal equations: A'A (xx, xy, xz, yy, yz, zz), A'A times the origin (x, y, z)."""
    k = NORMAL
    for p in range(3):
        for q in range(p, 3):
            rays[n, k] = (
                rays[n, WHITE + p] * rays[n, WHITE + q] + rays[n, WHITE + 3 + p] * rays[n, WHITE + 3 + q]
            )
            k += 1
    rays[n, k] = rays[n, NORMAL] * x + rays[n, NORMAL + 1] * y + rays[n, NORMAL + 2] * z
    rays[n, k + 1] = rays[n, NORMAL + 1] * x + rays[n, NORMAL + 3] * y + rays[n, NORMAL + 4] * z
    rays[n, k + 2] = rays[n, NORMAL + 2] * x + rays[n, NORMAL + 4] * y + rays[n, NORMAL + 5] * z


@bare_step
def _turn_with(rays, n):  # type: ignore[no-untyped-def]
    """Make the whitened errors of a ray count from its moved direction: their product with that is zero."""
    norm2 = rays[n, 0] ** 2 + rays[n, 1] ** 2 + rays[n, 2] ** 2
    for row in (WHITE, WHITE + 3):
        along = (
            rays[n, row] * rays[n, 0] + rays[n, row + 1] * rays[n, 1] + rays[n, row + 2] * rays[n, 2]
        ) / norm2
        for k in range(3):
            rays[n, row + k] -= along * rays[n, k]


@bare_step
def _field(field, size, u, v):  # type: ignore[no-untyped-def]
    """Interpolate a field (rows, columns, 2) over an image, linearly."""
    rows, columns = field.shape[0], field.shape[1]
    x = min(max((u + 0.5) / size[0] * (columns - 1), 0.0), columns - 1.0)
    y = min(max((v + 0.5) / size[1] * (rows - 1), 0.0), rows - 1.0)
    i, j = min(int(y), rows - 2), min(int(x), columns - 2)
    p, q = x - j, y - i
    out_x = out_y = 0.0
    for di in range(2):
        for dj in range(2):
            share = (p if dj else 1.0 - p) * (q if di else 1.0 - q)
            out_x += share * field[i + di, j + dj, 0]
            out_y += share * field[i + di, j + dj, 1]
    return out_x, out_y
