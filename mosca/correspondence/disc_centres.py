"""Points of flat round targets from images corrected for eccentricity: a compiled step of matching.

Each point's disc is estimated from all of its images (``mosca.correspondence.circle_fit``). Each image is then moved
from the ellipse's centroid to the image of the disc's centre (``mosca.camera.disc_rays``), and the point is solved
again. The uncertainty of the disc adds ``P (sum J' ds/dq) Q (sum J' ds/dq)' P`` to the point's covariance P. J is the
derivative of the whitened image by the point, s the image's whitened shift, q the logarithm of the radius and the
normal's two rotations, and Q their covariance.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.camera.disc_rays import free_of_eccentricity
from mosca.camera.ray_table import gram_of, normals, whiten
from mosca.correspondence.circle_fit import (
    CIRCLE_COVARIANCE,
    LN_RADIUS,
    across,
    distance_to,
    ellipses,
    is_elliptic,
    pixel_by_direction,
)
from mosca.correspondence.hypothesis import CHI2, COVARIANCE, DIAMETER, TWICE, judge_sizes, new_hypothesis, solve
from mosca.correspondence.selection import TAKEN
from mosca.data.detections import MERGED
from mosca.data.rays import FLAGS, ROOT, SIGMA, WHITE
from mosca.numba_support.copying import copy_row, copy_rows
from mosca.numba_support.decorators import bare_step, step
from mosca.numba_support.linalg3 import Symmetric3, quadratic_form3
from mosca.triangulation.triangulate import TRUST

BY_RADIUS, BY_TURN, BY_OTHER = 0, 1, 2
"""Rows of ``pulls``: logarithm of the radius, rotations of the normal."""


class Images(NamedTuple):
    """Pixels of the rays, and what is needed to turn them into rays."""

    freed: bool
    """Whether images of flat targets are corrected for eccentricity."""
    cameras: Any
    """``mosca.camera.ray_table.RigTable.cameras``."""
    xy: Any
    """(n, 2) [px]."""
    covariance: Any
    """(n, 2, 2) [px^2], of the detections alone."""
    whitened_by: Any
    """(n, 2, 2) [px^2]: with ``extra``, the covariance by which rays are whitened."""
    extra: Any
    """(c,) variance [px^2] that each camera adds to it."""
    gradient: float
    """Shift of a flat target's image by the gradient of its light, over its eccentricity."""
    gradient_variance: float


@step
def aim_at_centres(kept, state, data, images):
    """Solve the flat targets among the accepted hypotheses again, from rays aimed at their centres.

    Other targets with elliptic images, such as balls in motion, are solved from rays that err by their detections'
    noise alone. These rays are rewritten, always from their pixels, so that a second call changes nothing.
    """
    cameras = kept.members.shape[1]
    hypothesis, work, pulls = new_hypothesis(cameras), np.empty((8, 3)), np.empty((3, 3))
    members, ranks, values, circle = hypothesis
    for g in range(kept.members.shape[0]):
        if state[g] != TAKEN or ellipses(kept.members[g], data.rays) == 0:
            continue
        for c in range(cameras):
            members[c], ranks[c, TRUST] = kept.members[g, c], kept.trusts[g, c]
        copy_row(kept.values[g], values)
        _whiten_as_detected(members, data, images, work[2:4])
        values[DIAMETER], flat = judge_sizes(hypothesis, data)
        if flat:
            _aim(members, values, circle, ranks, data, images, pulls, work)
        error = solve(hypothesis, TWICE, data)
        if not error >= 0.0:
            continue
        if flat:
            _widen(values, circle, pulls, images.gradient_variance)
        values[CHI2] = error
        copy_row(values, kept.values[g])
        copy_row(ranks[:, TRUST], kept.trusts[g])


@bare_step
def _aim(members, point, circle, ranks, data, images, pulls, work):
    """Aim the rays of a disc at its centre; fill ``pulls`` (3, 3): sums of J' ds/dq, one row for each value of q."""
    rays, views, _ = data
    nx, ny, nz = circle[0], circle[1], circle[2]
    p0, p1, p2, q0, q1, q2 = across(nx, ny, nz)
    pulls[:] = 0.0
    for c in range(members.shape[0]):
        k = members[c]
        if k < 0 or int(rays[k, FLAGS]) & MERGED:
            continue
        distance = distance_to(point, c, views)
        ratio2 = (np.exp(circle[LN_RADIUS]) / distance) ** 2
        covariance = _detected(k, c, rays, images)
        xy = images.xy[k, 0], images.xy[k, 1]
        v0, v1, cosine = free_of_eccentricity(
            k, c, xy, covariance, ((nx, ny, nz), ratio2, images.gradient), images.cameras, views, rays, work
        )
        l00, l10 = rays[k, ROOT], rays[k, ROOT + 1]
        l11 = rays[k, SIGMA] ** 2 / l00
        g, weight = work[2:4], ranks[c, TRUST] ** 2 / distance
        for row in range(3):
            if row == BY_RADIUS:
                s0, s1 = 2.0 * cosine * v0, 2.0 * cosine * v1
            else:
                t0, t1, t2 = (p0, p1, p2) if row == BY_TURN else (q0, q1, q2)
                along = rays[k, 0] * t0 + rays[k, 1] * t1 + rays[k, 2] * t2
                s0 = along * v0 + cosine * (g[0, 0] * t0 + g[0, 1] * t1 + g[0, 2] * t2)
                s1 = along * v1 + cosine * (g[1, 0] * t0 + g[1, 1] * t1 + g[1, 2] * t2)
            a = ratio2 * s0 / l00
            b = (ratio2 * s1 - l10 * a) / l11
            for m in range(3):
                pulls[row, m] += weight * (rays[k, WHITE + m] * a + rays[k, WHITE + 3 + m] * b)


@bare_step
def _whiten_as_detected(members, data, images, g):
    """Whiten rays by their detections' covariance alone; ``g``: scratch (2, 3)."""
    rays, views, _ = data
    for c in range(members.shape[0]):
        k = members[c]
        if k >= 0 and is_elliptic(k, rays):
            g[0, 0], g[0, 1], g[0, 2], g[1, 0], g[1, 1], g[1, 2] = pixel_by_direction(k, rays)
            covariance = _detected(k, c, rays, images)
            whiten(g, gram_of(g), covariance, 0.0, 0.0, rays, k)
            normals(rays, k, views[c, 0], views[c, 1], views[c, 2])


@bare_step
def _detected(k, c, rays, images):
    """Return the covariance (xx, xy, yy) of a detection, and store it as the one that whitens its ray."""
    s = images.covariance[k]
    copy_rows(s, images.whitened_by[k])
    xx, xy, yy = s[0, 0] + images.extra[c], s[0, 1], s[1, 1] + images.extra[c]
    rays[k, ROOT] = np.sqrt(xx)
    rays[k, ROOT + 1] = xy / rays[k, ROOT]
    rays[k, SIGMA] = np.sqrt(np.sqrt(xx * yy - xy * xy))
    return xx, xy, yy


@step
def _widen(values, circle, pulls, gradient_variance):
    """Add the uncertainties of a point's disc and of its light to the point's covariance."""
    shifts = np.zeros((3, 3))  # one row for each element of q
    for row in range(3):
        for i in range(3):
            for j in range(3):
                shifts[row, i] += values[COVARIANCE + 3 * i + j] * pulls[row, j]
    c = circle[CIRCLE_COVARIANCE:]
    # uncertain light shifts images as an error of the radius does, which counts twice
    of_q = Symmetric3(c[0] + 0.25 * gradient_variance, c[1], c[2], c[3], c[4], c[5])
    for i in range(3):
        for j in range(i, 3):
            plus, minus = shifts[:, i] + shifts[:, j], shifts[:, i] - shifts[:, j]
            more = 0.25 * (
                quadratic_form3(of_q, plus[0], plus[1], plus[2]) - quadratic_form3(of_q, minus[0], minus[1], minus[2])
            )
            values[COVARIANCE + 3 * i + j] += more
            if i != j:
                values[COVARIANCE + 3 * j + i] += more
