"""Eccentricity of round targets: offset of the centroid of a disc's or ball's image from the image of its centre.

A circle of radius r about C with unit normal n, before a camera at the origin, has the image ellipse with the
dual conic ``E = C C^T - r^2 (I - n n^T)`` in the plane z = 1 (the homography ``H = [r u, r v, C]`` carries the
unit circle's dual conic diag(-1, -1, 1) there; Hartley and Zisserman 2004, section 2.2.3). Its centre is
``(E_13, E_23) / E_33``, so that

    centre - image of C = r^2 [nx nz Cz + Cx (1 - nz^2)] / {Cz [Cz^2 - r^2 (1 - nz^2)]}, likewise in y

(Mattsson and Dold derive the same; Luhmann 2014 shows its size). A ball's outline is the cone that touches it, with
``E = C C^T - r^2 I``: centre - image of C = (Cx / Cz) r^2 / (Cz^2 - r^2), likewise in y. Lens distortion maps the
ellipse into the image by a function g with the Jacobian J and the second derivatives H. With the ellipse's second
moments ``M = (c c^T - E_(12,12) / E_33) / 4``, its centroid is, to second order in its size, ``g(c) + H : M / 2 + J M
grad log det J``. The two terms are the curvature of g and the varying magnification. Without distortion both are zero
and the result is exact. For a fisheye (field beyond the plane z = 1) the plane perpendicular to the ray to C is used
instead.

The image of a ball at the distance R is shifted by ``(r / R)^2`` times a field over the image that depends on the
lens alone (``ball_field``; neglected terms are smaller by another (r / R)^2). The correction needs only the ball's
angular size.
"""

import numpy as np

from mosca.camera.projection import lens_directions, lens_pixels
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Lens
from mosca.errors import InputError

STEP = 1e-3
"""Step of the second differences in the image plane [tangent of an angle]."""
FIELD_STEP_PX = 16.0
"""Grid step of ``ball_field``: linear interpolation is good to some 1e-3 of a shift that is itself below a pixel."""
SMALL = 3e-3
"""Radius over distance at which ``ball_field`` is taken."""


def eccentricity_px(camera: Camera, centres: Array, normals: Array, radii_m: Array | float) -> Array:
    """Return centroid of the disc's image minus image of its centre (n, 2) [px]; subtract it from a measurement.

    ``centres`` (n, 3) [m] and ``normals`` (n, 3), of any length and of either face, world frame; ``radii_m`` (n,) or
    one for all. NaN where the lens does not image the disc or the camera lies in its plane. Raises InputError for
    radii that are not above zero and normals without a direction.
    """
    centres = np.asarray(centres, dtype=float).reshape(-1, 3)
    normals = np.asarray(normals, dtype=float).reshape(-1, 3)
    radius = np.broadcast_to(np.asarray(radii_m, dtype=float), len(centres))
    if not (radius > 0).all():
        raise InputError(f"eccentricity: radii_m = {radii_m} given; give radii above zero")
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError("eccentricity: a normal of length zero given; give the direction that the disc faces")
    to_camera = camera.world_from_camera.inverse()
    c, n = to_camera.transform(centres), (normals / length) @ to_camera.rotation.T
    axes = _planes(camera.lens, c)
    circle, normal = np.einsum("nij,ni->nj", axes, c), np.einsum("nij,ni->nj", axes, n)
    edge_on = np.einsum("ni,ni->n", circle, normal) == 0
    flat = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    return _offsets(camera.lens, axes, circle, radius[:, None, None] ** 2 * flat, ~edge_on)


def ball_eccentricity_px(camera: Camera, centres: Array, radii_m: Array | float) -> Array:
    """Return centroid of the ball's image minus image of its centre (n, 2) [px]; subtract it from a measurement.

    ``centres`` (n, 3) [m], world frame; ``radii_m`` (n,) or one for all. NaN where the lens does not image the
    ball as a whole. Raises InputError for radii that are not above zero.
    """
    centres = np.asarray(centres, dtype=float).reshape(-1, 3)
    radius = np.broadcast_to(np.asarray(radii_m, dtype=float), len(centres))
    if not (radius > 0).all():
        raise InputError(f"eccentricity: radii_m = {radii_m} given; give radii above zero")
    return _of_balls(camera.lens, camera.world_from_camera.inverse().transform(centres), radius)


def ball_field(camera: Camera) -> Array:
    """Return the eccentricity of small balls over (radius / distance)^2 (rows, columns, 2) [px].

    On a regular grid from one edge of the image to the other, FIELD_STEP_PX wide or less; zero where the lens has
    no ray.
    """
    columns, rows = (int(np.ceil(n / FIELD_STEP_PX)) + 1 for n in (camera.width, camera.height))
    x, y = (np.linspace(-0.5, n - 0.5, k) for n, k in ((camera.width, columns), (camera.height, rows)))
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    ray = lens_directions(camera.lens, xy)
    seen = np.isfinite(ray).all(axis=1)
    field = np.zeros((len(xy), 2))
    field[seen] = _of_balls(camera.lens, ray[seen], np.full(seen.sum(), SMALL)) / SMALL**2
    return np.nan_to_num(field).reshape(rows, columns, 2)


def _of_balls(lens: Lens, centres: Array, radius: Array) -> Array:
    """Return the offsets (n, 2) [px] of balls with centres (n, 3) in the camera frame."""
    axes = _planes(lens, centres)
    # the whole ball must lie before the plane through the camera: else its outline is no ellipse
    circle = np.einsum("nij,ni->nj", axes, centres)
    inertia = radius[:, None, None] ** 2 * np.eye(3)
    return _offsets(lens, axes, circle, inertia, circle[:, 2] > radius)


def _planes(lens: Lens, centres: Array) -> Array:
    """Return rotations (n, 3, 3); their columns are the axes of the plane in which each ellipse is taken."""
    axes = np.broadcast_to(np.eye(3), (len(centres), 3, 3))
    if lens.model != "fisheye":
        return axes
    z = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    side = np.where(np.abs(z[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    y = np.cross(z, side)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=2)


def _offsets(lens: Lens, axes: Array, circle: Array, inertia: Array, shown: Array) -> Array:
    """Return the offsets (n, 2) [px] of round targets given in the axes of their planes.

    ``circle`` (n, 3) centres; ``inertia`` (n, 3, 3): the dual conic of the outline is C C^T less this; ``shown``
    (n,): whether the target has an image with an area.
    """
    dual = circle[:, :, None] * circle[:, None, :] - inertia
    with np.errstate(divide="ignore", invalid="ignore"):
        # in front of the camera as a whole
        whole = shown & (circle[:, 2] > 0) & (dual[:, 2, 2] > 0)
        dual = np.where(whole[:, None, None], dual / dual[:, 2:, 2:], np.nan)
        true = np.where(whole[:, None], circle[:, :2] / circle[:, 2:], np.nan)
    centre = dual[:, :2, 2]
    moments = (centre[:, :, None] * centre[:, None, :] - dual[:, :2, :2]) / 4

    def pixels(plane: Array) -> Array:
        directions = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        return lens_pixels(lens, np.einsum("nij,nj->ni", axes, directions))

    here = pixels(centre)
    x, y = np.array([STEP, 0.0]), np.array([0.0, STEP])
    right, left, down, up = (pixels(centre + by) for by in (x, -x, y, -y))
    jacobian = np.stack([right - left, down - up], axis=2) / (2 * STEP)
    both = (pixels(centre + x + y) - pixels(centre + x - y) - pixels(centre - x + y) + pixels(centre - x - y)) / 4
    # second[:, i, j, k]: of pixel coordinate i, by plane coordinates j and k
    second = np.stack([right - 2 * here + left, both, both, down - 2 * here + up], axis=2).reshape(-1, 2, 2, 2)
    second /= STEP**2
    bend = np.einsum("nijk,njk->ni", second, moments) / 2
    (a, b), (c, d) = jacobian[:, 0].T, jacobian[:, 1].T
    of_det = (
        second[:, 0, 0] * d[:, None]
        + second[:, 1, 1] * a[:, None]
        - second[:, 0, 1] * c[:, None]
        - second[:, 1, 0] * b[:, None]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = of_det / (a * d - b * c)[:, None]  # gradient of log det J
    result: Array = here - pixels(true) + bend + np.einsum("nij,njk,nk->ni", jacobian, moments, stretch)
    return result
