"""Rays of a flat round target's images, corrected for eccentricity: compiled steps.

The centroid of a small disc's image differs from the image of its centre by the formulas of
``mosca.camera.eccentricity``, here to first order in (r / R)^2 and in the plane across the ray d. The ellipse's
centre is off by ``(r / R)^2 (n . d) G n``, where G is the derivative of the pixel by the direction. Its centroid is
off from there by the lens's curvature over the ellipse's second moments M, ``H : M / 2 + J M grad log det J``. The
disc's axes across the ray are known, so H is needed along these two only: differences of G between neighbouring
pixels.

A lamp at the lens lights the nearer side of an oblique disc more, since its light falls with the squared distance.
This moves the centroid of the light by ``(r / R)^2 (n . d) G n / 2``, half of that ellipse's eccentricity. It moves
the fit of an even disc by a part of that, which is the smaller the larger the image is compared with its blur.
Distant lamps move neither.
"""

import math

from mosca.camera.lens_models.arrays import direction_of
from mosca.camera.ray_table import gram_of, normals, to_world, whiten, whiten_at_shifted
from mosca.data.rays import ROTATION
from mosca.numba_support.decorators import bare_step

STEP_PX = 1.0
"""Step of the differences of G: lenses change over hundreds of pixels."""


@bare_step
def free_of_eccentricity(n, c, xy, covariance, disc, cameras, views, rays, work):
    """Aim ray ``n`` of camera ``c`` at the centre of the disc whose image is at the pixel ``xy``.

    Parameters
    ----------
    n, c
        Row of ``rays``, and its camera.
    xy, covariance
        Pixel (x, y) and its covariance (xx, xy, yy) [px^2], with the variance that the camera adds.
    disc
        Unit normal of the disc, world frame; squared ratio of its radius and its distance; shift of the image by
        uneven light, over the eccentricity of the ellipse.
    cameras, views, rays
        ``RigTable.cameras``, ``RayTable.views``, and ``RayTable.rays``, of which row ``n`` is rewritten.
    work
        Scratch (8, 3).

    Returns G n (2) [px] and the cosine between ray and normal.
    """
    own, local, g, d, (normal, ratio2, gradient) = cameras[c], work[0:2], work[2:4], work[6], disc
    if not direction_of(own, xy[0], xy[1], d, local):
        return 0.0, 0.0, 0.0
    to_world(views, c, d, local, g, rays, n)
    gram = gram_of(g)
    v0 = g[0, 0] * normal[0] + g[0, 1] * normal[1] + g[0, 2] * normal[2]
    v1 = g[1, 0] * normal[0] + g[1, 1] * normal[1] + g[1, 2] * normal[2]
    cosine = rays[n, 0] * normal[0] + rays[n, 1] * normal[1] + rays[n, 2] * normal[2]
    bend_x, bend_y = _bend(own, xy, normal, cosine, (views, c), d, local, work)
    along = (1.0 + gradient) * cosine
    shift_x, shift_y = ratio2 * (along * v0 + bend_x), ratio2 * (along * v1 + bend_y)
    whiten(g, gram, covariance, shift_x, shift_y, rays, n)
    whiten_at_shifted(rays, n)
    normals(rays, n, views[c, 0], views[c, 1], views[c, 2])
    return v0, v1, cosine


@bare_step
def _bend(own, xy, normal, cosine, view, d, local, work):
    """Return H : M / 2 + J M grad log det J of a disc with r / R = 1 [px]."""
    views, c = view
    # the disc's axes across the ray in the camera's frame: m is foreshortened, e is not
    m0 = m1 = m2 = 0.0
    for k in range(3):
        m0 += views[c, ROTATION + 3 * k] * normal[k]
        m1 += views[c, ROTATION + 3 * k + 1] * normal[k]
        m2 += views[c, ROTATION + 3 * k + 2] * normal[k]
    m0, m1, m2 = m0 - cosine * d[0], m1 - cosine * d[1], m2 - cosine * d[2]
    length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    if length < 1e-6:
        # any direction across the ray: none is foreshortened
        m0, m1, m2 = (0.0, d[2], -d[1]) if abs(d[0]) < 0.8 else (d[2], 0.0, -d[0])
        length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / length, m1 / length, m2 / length
    e0, e1, e2 = d[1] * m2 - d[2] * m1, d[2] * m0 - d[0] * m2, d[0] * m1 - d[1] * m0
    a0, a1 = _image_of(local, m0, m1, m2)
    b0, b1 = _image_of(local, e0, e1, e2)
    of_m, of_e = 0.25 * cosine * cosine, 0.25
    x = y = 0.0
    for axis in range(2):
        slope = ax = ay = bx = by = 0.0
        for side in range(2):
            step_px = STEP_PX if side else -STEP_PX
            u, v = xy[0] + (step_px if axis == 0 else 0.0), xy[1] + (step_px if axis == 1 else 0.0)
            if not direction_of(own, u, v, work[7], work[4:6]):
                return 0.0, 0.0
            scale = 0.5 / step_px
            p0, p1 = _image_of(work[4:6], m0, m1, m2)
            q0, q1 = _image_of(work[4:6], e0, e1, e2)
            ax, ay, bx, by = ax + scale * p0, ay + scale * p1, bx + scale * q0, by + scale * q1
            there = gram_of(work[4:6])
            slope += scale * 0.5 * math.log(there[0] * there[2] - there[1] * there[1])
        along_m, along_e = (a0, b0) if axis == 0 else (a1, b1)
        x += of_m * along_m * (0.5 * ax + a0 * slope) + of_e * along_e * (0.5 * bx + b0 * slope)
        y += of_m * along_m * (0.5 * ay + a1 * slope) + of_e * along_e * (0.5 * by + b1 * slope)
    return x, y


@bare_step
def _image_of(g, x, y, z):
    """Return G (2, 3) times a direction."""
    return g[0, 0] * x + g[0, 1] * y + g[0, 2] * z, g[1, 0] * x + g[1, 1] * y + g[1, 2] * z
