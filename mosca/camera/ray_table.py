"""Pixels to rays with their errors, compiled: one call for all cameras of a frame set."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate

import numpy as np

from mosca.camera.eccentricity import ball_field
from mosca.camera.lens_models.arrays import direction_of, ray_row
from mosca.camera.lens_models.row import RAY_ROW
from mosca.camera.projection import image_grid, lens_directions
from mosca.data.arrays import Array
from mosca.data.detections import MERGED, PARTIAL, UNREFINED, Detections
from mosca.data.rays import (
    ANGLE,
    AREA_RADIUS,
    BONUS,
    COLUMNS,
    DENSITY,
    DIRECTION,
    ELLIPTIC,
    ELLIPTIC_SIGMA,
    FLAGS,
    NORMAL,
    RADIUS,
    ROOT,
    ROTATION,
    SHARE_SIGMA,
    SIGMA,
    SPREAD,
    VIEW,
    WHITE,
    RayTable,
)
from mosca.data.rig import Camera, Lens, Pose, Rig
from mosca.numba_support.decorators import inlined_step, kernel

WIDTH, HEIGHT, CAMERA_ROW = RAY_ROW, RAY_ROW + 1, RAY_ROW + 2
"""Columns of ``RigTable.cameras`` after those of a lens row: the image's size [px]."""
EDGE_STEP_PX = 64.0
"""Step of the grid by which a camera's field of view is found: coarse, since only its outermost points count."""
TWO_LONG = 1.6
"""Ratio of a box's sides from which an image is taken for two targets (a small disc's box reaches 3 : 2)."""
LEAST_DIAMETER_PX = 0.5
"""Diameter that is assumed for a target of one pixel, which has no measurable size."""
REGION_MARGIN_PX = 1.1
"""Length by which a region exceeds the disc that has its light: about a pixel."""
LONG = 16
"""Bit of a ray's FLAGS besides those of its detection: the region is longer than whole pixels make that of a disc."""
ROUNDED_PX = 1.5
"""Difference of a region's sides from which it is long: the sides of a disc's region differ by one at most."""

IMAGE_NOISE = 0.035
"""Relative standard deviation of an image's area and of its ellipticity, in addition to its noise: for the effects of
blur and brightness over the target."""
FIRST_AREA_NOISE = 0.0175
"""Relative standard deviation of an image's area besides its own until ``mosca.correspondence.typical_size`` has
learned it. Half or twice of it gives the same."""
ROUND_SIGMAS = 3.0
"""Standard deviations up to which an image's ellipticity is that of a ball."""


@dataclass(frozen=True, eq=False)
class RigTable:
    """A rig as the kernels read it."""

    cameras: Array
    """(c, CAMERA_ROW): lens row (``mosca.camera.lens_models.row``) and image size."""
    views: Array
    """(c, DENSITY): ``RayTable.views`` without the density of detections."""
    pairs: Array
    """(p, 2) pairs of cameras, those first whose base is most nearly perpendicular to both optical axes."""
    bases: Array
    """(p, 2, 3) two unit vectors perpendicular to each pair's base and to each other, the first towards the mean
    optical axis (infinite for a base of length zero)."""


def make_ray_table(
    rig: Rig,
    detections: Mapping[str, Detections],
    camera_sigma_px: float | Array,
    target: str = "point",
    area_noise: float = FIRST_AREA_NOISE,
) -> RayTable:
    """Return the rays of all detections of a frame set.

    Parameters
    ----------
    rig
        Cameras with lenses and poses.
    detections
        By name of the camera; a camera without any may be missing.
    camera_sigma_px
        Standard deviation an axis of the random error of image points besides the detection's own (camera body,
        trigger, lens model), for all cameras or for each (c,); its square is added to each detection's covariance.
    target
        "ball" corrects each image for a ball's eccentricity, by its own size (``mosca.camera.eccentricity``). "point"
        takes the image as it is. "auto" corrects round images: a disc that faces the camera has the eccentricity of a
        ball; that of an oblique disc depends on its normal, which matching finds.
    area_noise
        Least relative standard deviation of an image's area: what lens and focus do to sizes.
    """
    table = rig_table(rig)
    found = [detections.get(c.name) for c in rig.cameras]
    there = [f for f in found if f is not None] or [Detections.none("")]
    start = np.array([0, *accumulate(0 if f is None else len(f) for f in found)])
    detected, xy = np.concatenate([f.covariance_px2 for f in there]), np.concatenate([f.xy_px for f in there])
    covariance = detected.copy()
    ellipticity = np.concatenate([f.ellipticity for f in there])
    extra = np.zeros(len(found))
    extra[:] = np.square(camera_sigma_px)
    rays, views, odd = fill_rays(
        table.cameras, table.views, start, (NO_FIELDS if target == "point" else ball_fields(rig), target == "ball"),
        xy, covariance, extra,
        (
            np.concatenate([f.diameter_px for f in there]),
            np.concatenate([f.diameter_sigma_px for f in there]), float(area_noise),
        ),
        (
            np.concatenate([f.elongation for f in there]), ellipticity,
            np.concatenate([f.ellipticity_sigma for f in there]),
        ),
        np.concatenate([f.flags for f in there]),
    )  # fmt: skip
    return RayTable(rays, views, table.pairs, table.bases, start, covariance, extra, xy, detected, table.cameras, odd)


@lru_cache(maxsize=32)
def rig_table(rig: Rig) -> RigTable:
    """Return the table of a rig (made once for each Rig object)."""
    rotation = np.array([c.world_from_camera.rotation for c in rig.cameras]).reshape(-1, 3, 3)
    origin = np.array([c.world_from_camera.translation for c in rig.cameras]).reshape(-1, 3)
    pairs = _ordered_pairs(rotation, origin)
    return RigTable(
        np.array([[*ray_row(c.lens), c.width, c.height] for c in rig.cameras]).reshape(-1, CAMERA_ROW),
        np.column_stack([origin, rotation.reshape(-1, 9), [_edges(c) for c in rig.cameras]]),
        pairs,
        np.array([_across(a, b, rotation, origin) for a, b in pairs]).reshape(-1, 2, 3),
    )


def _across(a: int, b: int, rotation: Array, origin: Array) -> Array:
    """Return two unit vectors (2, 3) perpendicular to the base of cameras a and b."""
    base = origin[b] - origin[a]
    if not base.any():
        return np.full((2, 3), np.inf)
    base = base / np.linalg.norm(base)
    # angles count from the mean optical axis, so that none is near 180 degrees
    tried = [rotation[a, :, 2] + rotation[b, :, 2], rotation[a, :, 1], rotation[a, :, 0]]
    flat = [one - base * (one @ base) for one in tried]
    up = next(one for one in flat if np.linalg.norm(one) > 1e-3)
    up = up / np.linalg.norm(up)
    return np.array([up, np.cross(base, up)])


@lru_cache(maxsize=32)
def ball_fields(rig: Rig) -> Array:
    """Return each camera's ``mosca.camera.eccentricity.ball_field``, (c, rows, columns, 2)."""
    return _fields(tuple((camera.lens, camera.width, camera.height) for camera in rig.cameras))


@lru_cache(maxsize=32)
def _fields(lenses: tuple[tuple[Lens, int, int], ...]) -> Array:
    """Return the fields for lenses and image sizes: a rig that moves keeps them."""
    still = Pose(np.eye(3), np.zeros(3))
    return np.array([ball_field(Camera("", width, height, lens, still)) for lens, width, height in lenses])


NO_FIELDS = np.zeros((0, 0, 0, 2))
"""Used instead of ``ball_fields`` where targets are points."""


def _edges(camera: Camera) -> Array:
    """Return the box (4,) left, top, right, bottom of a camera's field of view, stereographic as in ``RayTable``."""
    rays = lens_directions(camera.lens, image_grid(camera.width, camera.height, EDGE_STEP_PX))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if not len(rays):
        return np.zeros(4)
    place = rays[:, :2] / (1.0 + rays[:, 2:])
    return np.concatenate([place.min(axis=0), place.max(axis=0)])


def _ordered_pairs(rotation: Array, origin: Array) -> Array:
    """Return the pairs of cameras, those first whose optical axes are most nearly perpendicular to the baseline."""
    a, b = np.triu_indices(len(origin), 1)
    base = origin[b] - origin[a]
    across = np.linalg.norm(np.cross(base, rotation[a, :, 2]), axis=1)
    across *= np.linalg.norm(np.cross(base, rotation[b, :, 2]), axis=1)
    length2 = np.maximum((base**2).sum(axis=1), 1e-300)
    order = np.argsort(-np.round(across / length2, 6), kind="stable")
    return np.ascontiguousarray(np.column_stack([a, b])[order]).astype(np.int64)


@kernel
def fill_rays(cameras, seen, start, balls, xy, covariance, extra, size, shape, flags):
    """Return the rays (n, COLUMNS) of detections, the views (c, VIEW), and how many images are odd (``RayTable``).

    Adds to ``covariance`` the eccentricity that images may have.

    ``cameras``, ``seen``: ``RigTable.cameras`` and ``.views``. ``balls``: the eccentricity of balls (c, rows,
    columns, 2), or no rows (a ball's image of the angular diameter A is shifted by (A/2)^2 times this field); and
    whether long images are of balls, too. ``size``: diameter, its standard deviation, and the least relative one of
    areas; ``shape``: elongation, ellipticity and its standard deviation.
    """
    (fields, all_balls), (elongation, ellipticity, ellipticity_sigma) = balls, shape
    diameter, diameter_sigma, area_noise = size
    rays, views = np.empty((xy.shape[0], COLUMNS)), np.empty((cameras.shape[0], VIEW))
    d, local, g = np.empty(3), np.empty((2, 3)), np.empty((2, 3))
    odd = 0
    for c in range(cameras.shape[0]):
        own = cameras[c]
        density = (start[c + 1] - start[c]) / (own[WIDTH] * own[HEIGHT])
        for k in range(DENSITY):
            views[c, k] = seen[c, k]
        views[c, DENSITY] = density
        for n in range(start[c], start[c + 1]):
            good = direction_of(own, xy[n, 0], xy[n, 1], d, local)
            # the same in every frame; where the lens stretches its cone, a ball's image is long
            gram = gram_of(local) if good else (1.0, 0.0, 1.0)
            ratio = np.sqrt(gram[0] / gram[2])
            across, long = _longer_axis(diameter[n], max(1.0, elongation[n] / max(ratio, 1.0 / ratio)))
            odd += long or flags[n] & (UNREFINED | MERGED) == UNREFINED
            s00, s01, s11 = (covariance[n, 0, 0] + extra[c], covariance[n, 0, 1], covariance[n, 1, 1] + extra[c])
            area = s00 * s11 - s01 * s01
            if not (good and s00 > 0.0 and area > 0.0):
                rays[n] = np.nan
                continue
            to_world(views, c, d, local, g, rays, n)
            elliptic = ellipticity[n, 0] != 0.0 and flags[n] & (MERGED | PARTIAL) == 0
            if elliptic and fields.shape[0] > 0 and not all_balls:
                more = _possible_eccentricity(diameter[n], ellipticity[n], ellipticity_sigma[n], gram)
                covariance[n, 0, 0] += more[0]
                covariance[n, 0, 1] += more[1]
                covariance[n, 1, 0] += more[1]
                covariance[n, 1, 1] += more[2]
                s00, s01, s11 = s00 + more[0], s01 + more[1], s11 + more[2]
                area = s00 * s11 - s01 * s01
            sigma2 = np.sqrt(area)
            rays[n, SIGMA], rays[n, FLAGS] = np.sqrt(sigma2), flags[n] + (LONG if long else 0)
            # the image's part in a hypothesis's log-likelihood ratio: target against clutter anywhere
            rays[n, BONUS] = -np.log(2.0 * np.pi * sigma2 * density)
            rays[n, ELLIPTIC], rays[n, ELLIPTIC + 1] = ellipticity[n, 0], ellipticity[n, 1]
            rays[n, ELLIPTIC_SIGMA] = ellipticity_sigma[n]
            rays[n, AREA_RADIUS] = 0.5 * max(diameter[n], LEAST_DIAMETER_PX)
            rays[n, ROOT] = np.sqrt(s00)
            rays[n, ROOT + 1] = s01 / rays[n, ROOT]
            # px per radian across the ray: the geometric mean of both axes
            angle = across / np.sqrt(np.sqrt(gram[0] * gram[2] - gram[1] * gram[1]))
            rays[n, RADIUS], rays[n, ANGLE] = 0.5 * across, angle
            rays[n, SHARE_SIGMA] = max(2.0 * diameter_sigma[n] / across, area_noise)
            shift_x = shift_y = 0.0
            freed = fields.shape[0] > 0 and (all_balls or not long)
            if fields.shape[0] > 0 and not freed and ellipticity_sigma[n] > 0.0:
                freed = _beyond_ball(ellipticity[n], ellipticity_sigma[n], gram)[2] == 0.0
            if freed:
                ratio = 0.25 * angle * angle
                shift_x, shift_y = _field(fields[c], own, xy[n, 0], xy[n, 1])
                shift_x, shift_y = shift_x * ratio, shift_y * ratio
            whiten(g, gram, (s00, s01, s11), shift_x, shift_y, rays, n)
            if freed:
                whiten_at_shifted(rays, n)
            normals(rays, n, seen[c, 0], seen[c, 1], seen[c, 2])
    return rays, views, odd


@inlined_step
def _longer_axis(diameter, elongation):
    """Return the diameter [px] by which an image's size is judged, and whether its region is long."""
    root = np.sqrt(elongation)
    # a disc of a pixel lights one or two
    shorter = (diameter + REGION_MARGIN_PX) / root
    long = (elongation - 1.0) * (shorter if shorter >= 2.0 else 1.0) > ROUNDED_PX
    # two merged targets are long; their longer axis gives a diameter, their flux and peak do not
    across = max(diameter * (root if long and elongation > TWO_LONG else 1.0), LEAST_DIAMETER_PX)
    return across, long


@inlined_step
def _beyond_ball(ellipticity, sigma, gram):
    """Return an image's ellipticity (2) minus that of a ball there, and its length, 0 where it may be a ball's."""
    f2 = np.sqrt(gram[0] * gram[2] - gram[1] * gram[1])
    p, q = ellipticity[0] - 0.5 * (gram[0] - gram[2]) / f2, ellipticity[1] - gram[1] / f2
    size2 = p * p + q * q
    return p, q, np.sqrt(size2) if size2 > ROUND_SIGMAS**2 * (sigma * sigma + IMAGE_NOISE**2) else 0.0


@inlined_step
def _possible_eccentricity(diameter, ellipticity, sigma, gram):
    """Return the covariance (xx, xy, yy) [px^2] of an ellipse's centroid if it may be an oblique disc, else zeros.

    The disc's centre is off by b sqrt(a^2 - b^2) / f along the minor axis, to either side, with the semi-axes a and b
    and the scale f [px/rad] (``mosca.camera.eccentricity``: (r / R)^2 f times sine and cosine of the slant). The
    ellipticity of a ball at this pixel is no slant.
    """
    p, q, size = _beyond_ball(ellipticity, sigma, gram)
    if size == 0.0:
        return 0.0, 0.0, 0.0
    f2 = np.sqrt(gram[0] * gram[2] - gram[1] * gram[1])
    b2 = 0.25 * diameter * diameter * np.exp(-size)
    half = 0.5 * b2 * b2 * (np.exp(2.0 * size) - 1.0) / f2
    return half * (1.0 - p / size), -half * q / size, half * (1.0 + p / size)


@inlined_step
def to_world(views, c, d, local, g, rays, n):
    """Rotate a direction and the pixel's derivative by it from the camera's frame into the world's."""
    for row in range(2):
        for k in range(3):
            m = ROTATION + 3 * k
            g[row, k] = (
                local[row, 0] * views[c, m] + local[row, 1] * views[c, m + 1] + local[row, 2] * views[c, m + 2]
            )
    for k in range(3):
        m = ROTATION + 3 * k
        rays[n, DIRECTION + k] = views[c, m] * d[0] + views[c, m + 1] * d[1] + views[c, m + 2] * d[2]


@inlined_step
def gram_of(g):
    """Return G G' (xx, xy, yy) of the pixel's derivative G (2, 3)."""
    return (
        g[0, 0] * g[0, 0] + g[0, 1] * g[0, 1] + g[0, 2] * g[0, 2],
        g[0, 0] * g[1, 0] + g[0, 1] * g[1, 1] + g[0, 2] * g[1, 2],
        g[1, 0] * g[1, 0] + g[1, 1] * g[1, 1] + g[1, 2] * g[1, 2],
    )


@inlined_step
def whiten(g, gram, covariance, shift_x, shift_y, rays, n):
    """Fill WHITE and SPREAD of a ray and move its direction by an image shift [px].

    ``covariance``: of the pixel (xx, xy, yy) = L L'. WHITE = L^-1 G, SPREAD = G' (G G')^-1 L.
    """
    q00, q01, q11 = gram
    s00, s01, s11 = covariance
    l00 = np.sqrt(s00)
    l10 = s01 / l00
    l11 = np.sqrt(s11 - l10 * l10)
    i00, i11, inverse = 1.0 / l00, 1.0 / l11, 1.0 / (q00 * q11 - q01 * q01)
    for k in range(3):
        first = g[0, k] * i00
        rays[n, WHITE + k], rays[n, WHITE + 3 + k] = first, (g[1, k] - l10 * first) * i11
        # direction by pixel: the pseudo-inverse G' (G G')^-1
        tx = (g[0, k] * q11 - g[1, k] * q01) * inverse
        ty = (g[1, k] * q00 - g[0, k] * q01) * inverse
        rays[n, SPREAD + 2 * k] = tx * l00 + ty * l10
        rays[n, SPREAD + 2 * k + 1] = ty * l11
        rays[n, DIRECTION + k] -= tx * shift_x + ty * shift_y


@inlined_step
def normals(rays, n, x, y, z):
    """Fill a ray's share in the normal equations: A'A (xx, xy, xz, yy, yz, zz), A'A times the origin (x, y, z)."""
    k = NORMAL
    for p in range(3):
        for q in range(p, 3):
            rays[n, k] = rays[n, WHITE + p] * rays[n, WHITE + q] + rays[n, WHITE + 3 + p] * rays[n, WHITE + 3 + q]
            k += 1
    rays[n, k] = rays[n, NORMAL] * x + rays[n, NORMAL + 1] * y + rays[n, NORMAL + 2] * z
    rays[n, k + 1] = rays[n, NORMAL + 1] * x + rays[n, NORMAL + 3] * y + rays[n, NORMAL + 4] * z
    rays[n, k + 2] = rays[n, NORMAL + 2] * x + rays[n, NORMAL + 4] * y + rays[n, NORMAL + 5] * z


@inlined_step
def whiten_at_shifted(rays, n):
    """Remove from a ray's whitened errors the part along its shifted direction, where the error is zero."""
    norm2 = rays[n, 0] ** 2 + rays[n, 1] ** 2 + rays[n, 2] ** 2
    for row in (WHITE, WHITE + 3):
        along = (rays[n, row] * rays[n, 0] + rays[n, row + 1] * rays[n, 1] + rays[n, row + 2] * rays[n, 2]) / norm2
        for k in range(3):
            rays[n, row + k] -= along * rays[n, k]


@inlined_step
def _field(field, camera, u, v):
    """Interpolate a field (rows, columns, 2) over an image, linearly."""
    rows, columns = field.shape[0], field.shape[1]
    x = min(max((u + 0.5) / camera[WIDTH] * (columns - 1), 0.0), columns - 1.0)
    y = min(max((v + 0.5) / camera[HEIGHT] * (rows - 1), 0.0), rows - 1.0)
    i, j = min(int(y), rows - 2), min(int(x), columns - 2)
    p, q = x - j, y - i
    out_x = out_y = 0.0
    for di in range(2):
        for dj in range(2):
            share = (p if dj else 1.0 - p) * (q if di else 1.0 - q)
            out_x += share * field[i + di, j + dj, 0]
            out_y += share * field[i + di, j + dj, 1]
    return out_x, out_y
