"""Test of whether a hypothesis's images show one flat round target, and its normal and radius: compiled steps.

A circle of radius r with the unit normal n, seen from the distance D, has the image ellipse with the matrix

    W = (r / D)^2 (G G' - v v'),  v = G n,

to first order in r / D. Its eigenvalues are the squared semi-axes [px^2], G is the derivative of the pixel by the
direction, and ``(r / D)^2 (I - n n')`` is the disc as it appears to the camera across its ray. A ball has v = 0. Two
circles have the same image, with normals mirrored at the ray; a second image distinguishes them. The circles of each
image are tried. The best one is refined by weighted least squares, and accepted as a disc if it explains one image
more than the best ball does.
"""

import math

from mosca.camera.ray_table import IMAGE_NOISE
from mosca.data.detections import MERGED, PARTIAL, UNREFINED
from mosca.data.rays import AREA_RADIUS, ELLIPTIC, ELLIPTIC_SIGMA, FLAGS, ROOT, SHARE_SIGMA, SIGMA, WHITE
from mosca.numba_support.decorators import bare_step, inlined_step
from mosca.numba_support.linalg3 import Symmetric3, inverse3, scaled3, times3

FACING, LN_RADIUS, CIRCLE_COVARIANCE, CIRCLE = 0, 3, 4, 10
"""Columns of a circle: unit normal (3), logarithm of the radius [m], and the covariance (6, upper triangle) of that
logarithm and of the normal's rotations towards its two ``across`` vectors [rad]."""
ODD_CHI2 = 16.0
"""Chi-square of an image's three residuals beyond which it is no image of the circle (4 standard deviations)."""
FEWEST_ELLIPSES = 2
"""Fewest images that must be ellipses: a single ellipse among round images shows two targets, or a partly hidden
ball. Most images of an oblique disc are ellipses."""
STEPS = 4
"""Steps of the refinement: the first circle has the errors of one image."""
STEP = 1e-4
"""Step of the derivatives by the normal's rotations."""
EDGE_ON = 1e-9
"""Least squared cosine between ray and normal."""


@inlined_step
def is_elliptic(k, rays):
    """Whether a ray's image is known to be an ellipse."""
    return rays[k, ELLIPTIC] != 0.0 or rays[k, ELLIPTIC + 1] != 0.0


@inlined_step
def shows_shape(k, rays):
    """Whether a ray's image shows its target's shape: it is of a single target, and a disc fits it."""
    return rays[k, ELLIPTIC_SIGMA] > 0.0 and not int(rays[k, FLAGS]) & (MERGED | PARTIAL | UNREFINED)


@bare_step
def ellipses(members, rays):
    """Return how many of the rays (c,), -1 for none, have an image that is an ellipse."""
    n = 0
    for c in range(members.shape[0]):
        n += members[c] >= 0 and is_elliptic(members[c], rays) and shows_shape(members[c], rays)
    return n


@inlined_step
def pixel_by_direction(k, rays):
    """Return G (2 x 3) of a ray, row by row: its whitened form times the covariance's Cholesky factor."""
    l00, l10 = rays[k, ROOT], rays[k, ROOT + 1]
    l11 = rays[k, SIGMA] * rays[k, SIGMA] / l00
    a0, a1, a2 = rays[k, WHITE], rays[k, WHITE + 1], rays[k, WHITE + 2]
    b0, b1, b2 = rays[k, WHITE + 3], rays[k, WHITE + 4], rays[k, WHITE + 5]
    return l00 * a0, l00 * a1, l00 * a2, l10 * a0 + l11 * b0, l10 * a1 + l11 * b1, l10 * a2 + l11 * b2


@inlined_step
def distance_to(point, c, views):
    """Return the distance of a point from camera c."""
    x, y, z = point[0] - views[c, 0], point[1] - views[c, 1], point[2] - views[c, 2]
    return math.sqrt(x * x + y * y + z * z)


@bare_step
def across(x, y, z):
    """Return two unit vectors perpendicular to a unit vector and to each other."""
    if abs(x) < 0.8:
        s = 1.0 / math.sqrt(y * y + z * z)
        p, q, r = 0.0, -z * s, y * s
    else:
        s = 1.0 / math.sqrt(x * x + z * z)
        p, q, r = z * s, 0.0, -x * s
    return p, q, r, y * r - z * q, z * p - x * r, x * q - y * p


@bare_step
def residuals(k, distance, flat, normal, ln_radius, rays):
    """Return an image's area and ellipticity (2) minus those of a disc, or of a ball (``flat`` 0), over sigma."""
    a0, a1, a2, b0, b1, b2 = pixel_by_direction(k, rays)
    nx, ny, nz = normal
    va, vb = flat * (a0 * nx + a1 * ny + a2 * nz), flat * (b0 * nx + b1 * ny + b2 * nz)
    qaa, qab, qbb = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
    waa, wab, wbb = qaa - va * va, qab - va * vb, qbb - vb * vb
    root = math.sqrt(max(waa * wbb - wab * wab, EDGE_ON * (qaa * qbb - qab * qab)))
    p, q = 0.5 * (waa - wbb) / root, wab / root
    sine = math.sqrt(p * p + q * q)
    scale = math.log(sine + math.sqrt(1.0 + sine * sine)) / sine if sine > 1e-9 else 1.0
    area = 2.0 * (math.log(rays[k, AREA_RADIUS]) - ln_radius + math.log(distance)) - math.log(root)
    of_area = 1.0 / math.sqrt(rays[k, SHARE_SIGMA] ** 2 + IMAGE_NOISE**2)
    of_shape = 1.0 / math.sqrt(rays[k, ELLIPTIC_SIGMA] ** 2 + IMAGE_NOISE**2)
    return (
        area * of_area, (rays[k, ELLIPTIC] - scale * p) * of_shape, (rays[k, ELLIPTIC + 1] - scale * q) * of_shape,
    )  # fmt: skip


@bare_step
def misfit(flat, normal, ln_radius, members, point, data):
    """Return the sum of the images' chi-squares, each limited to ``ODD_CHI2``, and how many reach that limit."""
    total, odd = 0.0, 0
    for c in range(members.shape[0]):
        k = members[c]
        if k >= 0 and shows_shape(k, data.rays):
            distance = distance_to(point, c, data.views)
            e0, e1, e2 = residuals(k, distance, flat, normal, ln_radius, data.rays)
            chi2 = e0 * e0 + e1 * e1 + e2 * e2
            total += min(chi2, ODD_CHI2)
            odd += not chi2 < ODD_CHI2
    return total, odd


@bare_step
def circles_of_image(k, distance, rays):
    """Return the two circles that fit an image: the normal's part across the ray (3), its part along it, ln radius.

    The last value is the logarithm of the radius of the ball whose image has the same area. With G G' = C C', the
    ellipse across the ray has the matrix C^-1 W C'^-1 = (r / D)^2 (I - w w').
    """
    a0, a1, a2, b0, b1, b2 = pixel_by_direction(k, rays)
    qaa, qab, qbb = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
    c00 = math.sqrt(qaa)
    c10 = qab / c00
    c11 = math.sqrt(qbb - c10 * c10)
    p, q = rays[k, ELLIPTIC], rays[k, ELLIPTIC + 1]
    size = math.sqrt(p * p + q * q)
    even, odd = math.cosh(size), math.sinh(size) / size if size > 1e-9 else 1.0
    waa, wab, wbb = even + odd * p, odd * q, even - odd * p
    # C^-1 W C'^-1 for a radius of one pixel
    xaa = waa / qaa
    xab = (wab - c10 * waa / c00) / (c00 * c11)
    xbb = (wbb - 2.0 * c10 * wab / c00 + c10 * c10 * waa / qaa) / (c11 * c11)
    middle, half = 0.5 * (xaa + xbb), math.sqrt(0.25 * (xaa - xbb) ** 2 + xab * xab)
    larger, smaller = middle + half, max(middle - half, EDGE_ON * middle)
    turn = 0.5 * math.atan2(2.0 * xab, xaa - xbb)
    length = math.sqrt(max(1.0 - smaller / larger, 0.0))
    w0, w1 = -length * math.sin(turn), length * math.cos(turn)
    z1 = w1 / c11
    z0 = (w0 - c10 * z1) / c00
    return (
        a0 * z0 + b0 * z1, a1 * z0 + b1 * z1, a2 * z0 + b2 * z1, math.sqrt(smaller / larger),
        math.log(rays[k, AREA_RADIUS] * distance) + 0.5 * math.log(larger),
        math.log(rays[k, AREA_RADIUS] * distance) - 0.5 * math.log(c00 * c11),
    )  # fmt: skip


@bare_step
def refine(members, point, circle, data):
    """Improve a circle by weighted Gauss-Newton steps and write its covariance."""
    rays = data.rays
    for _step in range(STEPS):
        nx, ny, nz, ln_radius = circle[0], circle[1], circle[2], circle[LN_RADIUS]
        p0, p1, p2, q0, q1, q2 = across(nx, ny, nz)
        # a step along a tangent keeps the normal's unit length to second order
        to_p = nx + STEP * p0, ny + STEP * p1, nz + STEP * p2
        to_q = nx + STEP * q0, ny + STEP * q1, nz + STEP * q2
        rr = rp = rq = pp = pq = qq = r = p = q = 0.0
        total, freedom = 0.0, -3.0
        for c in range(members.shape[0]):
            k = members[c]
            if k < 0 or not shows_shape(k, rays):
                continue
            distance = distance_to(point, c, data.views)
            here = residuals(k, distance, 1.0, (nx, ny, nz), ln_radius, rays)
            of_p = residuals(k, distance, 1.0, to_p, ln_radius, rays)
            of_q = residuals(k, distance, 1.0, to_q, ln_radius, rays)
            chi2 = here[0] * here[0] + here[1] * here[1] + here[2] * here[2]
            weight = 1.0 / (1.0 + (chi2 / ODD_CHI2) ** 2)
            by_radius = 2.0 / math.sqrt(rays[k, SHARE_SIGMA] ** 2 + IMAGE_NOISE**2)
            for i in range(3):
                e = here[i]
                jr = by_radius if i == 0 else 0.0
                jp, jq = (e - of_p[i]) / STEP, (e - of_q[i]) / STEP
                rr += weight * jr * jr
                rp += weight * jr * jp
                rq += weight * jr * jq
                pp += weight * jp * jp
                pq += weight * jp * jq
                qq += weight * jq * jq
                r += weight * jr * e
                p += weight * jp * e
                q += weight * jq * e
            total += weight * chi2
            freedom += 3.0 * weight
        # prior of one radian for the normal's rotations: without an ellipse they are not determined
        covariance = inverse3(Symmetric3(rr, rp, rq, pp + 1.0, pq, qq + 1.0))
        dr, dp, dq = times3(covariance, r, p, q)
        hold = 1.0 / max(1.0, math.sqrt(dp * dp + dq * dq) / 0.5)
        nx += hold * (dp * p0 + dq * q0)
        ny += hold * (dp * p1 + dq * q1)
        nz += hold * (dp * p2 + dq * q2)
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        circle[0], circle[1], circle[2], circle[LN_RADIUS] = nx / length, ny / length, nz / length, ln_radius + dr
        scaled = scaled3(covariance, max(1.0, total / max(freedom, 1.0)))
        circle[CIRCLE_COVARIANCE], circle[CIRCLE_COVARIANCE + 1] = scaled.xx, scaled.xy
        circle[CIRCLE_COVARIANCE + 2], circle[CIRCLE_COVARIANCE + 3] = scaled.xz, scaled.yy
        circle[CIRCLE_COVARIANCE + 4], circle[CIRCLE_COVARIANCE + 5] = scaled.yz, scaled.zz


@bare_step
def fit_circle(members, point, circle, data):
    """Fit a circle to the images of the rays ``members`` (c,), -1 for none, of a target at ``point``.

    Fills ``circle`` (CIRCLE,). Returns whether the target is flat: the circle explains all images, or all but one of
    three or more, and at least ``Rules.discs``; ``FEWEST_ELLIPSES`` of them are ellipses; and its misfit is lower
    than a ball's by that of one image.
    """
    rays, best, ball, images = data.rays, math.inf, math.inf, 0
    if ellipses(members, rays) < FEWEST_ELLIPSES:
        return False
    for c in range(members.shape[0]):
        k = members[c]
        if k >= 0 and shows_shape(k, rays):
            of_ball = circles_of_image(k, distance_to(point, c, data.views), rays)[5]
            ball = min(ball, misfit(0.0, (0.0, 0.0, 0.0), of_ball, members, point, data)[0])
            images += 1
    if not ball > ODD_CHI2:
        return False
    for c in range(members.shape[0]):
        k = members[c]
        if k < 0 or not shows_shape(k, rays):
            continue
        x, y, z, along, ln_radius, _ = circles_of_image(k, distance_to(point, c, data.views), rays)
        for face in range(2 if is_elliptic(k, rays) else 0):
            s = along if face else -along
            normal = x + s * rays[k, 0], y + s * rays[k, 1], z + s * rays[k, 2]
            left = misfit(1.0, normal, ln_radius, members, point, data)[0]
            if left < best:
                best = left
                circle[0], circle[1], circle[2], circle[LN_RADIUS] = normal[0], normal[1], normal[2], ln_radius
    if images < 2 or not best < math.inf:
        return False
    length = math.sqrt(circle[0] ** 2 + circle[1] ** 2 + circle[2] ** 2)
    circle[0], circle[1], circle[2] = circle[0] / length, circle[1] / length, circle[2] / length
    refine(members, point, circle, data)
    normal = circle[0], circle[1], circle[2]
    left, odd = misfit(1.0, normal, circle[LN_RADIUS], members, point, data)
    return odd <= 1 and images - odd >= data.rules[0].discs and left + ODD_CHI2 < ball
