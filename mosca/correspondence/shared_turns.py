"""Errors that the images of one camera in one frame set have in common: estimated, and removed from the points.

A body that shakes turns its camera, which moves all images of an exposure. For a single point such a shift is an
error like any other; the images of many points show most of it. With unknown points p and turns d of the cameras
(about their x and y axes) the residuals are r + J p + B d + e, where e is an image's own error with covariance R, and
d has the variance by which cameras are known to turn (mixed linear model; Henderson, Biometrics 31, 1975). The points
are eliminated first, each with its own normal matrix N = sum J' R^-1 J. Two equations for each camera are left. What
lens models do not fit is alike in neighbouring images, and must not be taken for independent errors
(``mosca.correspondence.lens_field``).

``without_turns`` moves matched points, ``share_likelihoods`` shows how much images have in common.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.correspondence.circle_fit import pixel_by_direction
from mosca.correspondence.lens_field import (
    MODES,
    add_field,
    field_as_noise,
    field_covariance,
    fill_answers,
    fill_modes,
    product,
)
from mosca.data.arrays import Array
from mosca.data.rays import ROOT, ROTATION, SIGMA, RayTable
from mosca.data.tracks import Points
from mosca.numba_support.cholesky import solve
from mosca.numba_support.decorators import bare_step, kernel, step
from mosca.numba_support.linalg3 import cofactors3, determinant3, divided3, store3, symmetric3

SINGULAR = 1e-12
"""Determinant of a point's normal matrix over the product of its diagonal, below which it is left as it is: parallel
rays. Half or twice of it gives the same."""
LEAST_PX2 = 1e-12
"""Least variance of a field's amplitude [px^2]: none that any image shows. Half or twice of it gives the same."""
LEAST_RAD2 = 1e-18
"""Least variance of a camera's turns [rad^2]: none that any image shows. Half or twice of it gives the same."""


class Shared(NamedTuple):
    """What the images of a camera in a frame set have in common: its body shakes."""

    sigma_px: Array
    """(c,) standard deviation on each axis: a part of the camera's errors by which rays are whitened."""
    field_px: Array
    """(c,) standard deviation on each axis of the smooth field of errors that the lens model leaves, another part."""
    steady: Array
    """(c, 2) mean turns of the cameras in earlier frame sets [rad] that are not removed."""


class PointEquations(NamedTuple):
    """Equations of n points in c cameras with w unknowns each: working memory.

    The unknowns are the turns about the camera's x and y axes and, where they are estimated, the amplitudes [px] of
    the modes of its lens's field on x, then on y. Units are those of turns.
    """

    slope: Any
    """(n, c, 2, 3) J, derivative of the images by the point [px/m]."""
    turn: Any
    """(n, c, 2, w) B, the same by their cameras' unknowns [px/rad]."""
    weight: Any
    """(n, c, 2, 2) R^-1 of the images [px^-2]."""
    rest: Any
    """(n, c, 2) residuals r of the images [px]."""
    modes: Any
    """(n, c, MODES) modes of the lens's field at the images."""
    answer: Any
    """(n, c, 2, 3) N^-1 J' R^-1: how the point goes with an error of each image on each axis [m/px]
    (``mosca.correspondence.lens_field``)."""
    right: Any
    """(n, 3) sum J' R^-1 r [1/m]."""
    square: Any
    """(n, c, w, w) B' R^-1 B [rad^-2]; as all further ones 0 for a camera without an image."""
    push: Any
    """(n, c, w) B' R^-1 r [1/rad]."""
    toward: Any
    """(n, c, 3, w) J' R^-1 B [1/(m rad)]."""
    held: Any
    """(n, c, 3, w) N^-1 J' R^-1 B: how the point goes against a turn [m/rad]."""
    inverse: Any
    """(n, 3, 3) N^-1 [m^2]."""
    whole: Any
    """(n, 3, 3) covariance of the point if the errors of all images were independent [m^2]."""
    pull: Any
    """(n, 3) N^-1 sum J' R^-1 r [m]."""
    whole_weight: Any
    """(2, 2) inverse of the whole covariance of one image [px^-2]."""
    normal: Any
    """(3, 3) N of one point [m^-2]."""
    usual: Any
    """(3, 3) the same with the images' whole covariances [m^-2]."""
    crossed: Any
    """(2, 3, w c) products of turns and places of one point."""
    added: Any
    """(3, 3) covariance that the field adds to one point [m^2]."""


@step
def point_equations(points, cameras, unknowns):
    """Return working memory for ``points`` in ``cameras`` with so many ``unknowns`` each."""
    n, c, w = points, cameras, unknowns
    return PointEquations(
        np.zeros((n, c, 2, 3)), np.zeros((n, c, 2, w)), np.zeros((n, c, 2, 2)), np.zeros((n, c, 2)),
        np.zeros((n, c, MODES)), np.zeros((n, c, 2, 3)), np.zeros((n, 3)), np.zeros((n, c, w, w)),
        np.zeros((n, c, w)), np.zeros((n, c, 3, w)), np.zeros((n, c, 3, w)), np.zeros((n, 3, 3)),
        np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((2, 2)), np.zeros((3, 3)), np.zeros((3, 3)),
        np.zeros((2, 3, w * c)), np.zeros((3, 3)),
    )  # fmt: skip


@bare_step
def turn_of(k, c, rays, views, turn):
    """Fill ``turn`` (2, 2): derivative of the image of ray k by the turns of its camera about x and y [px/rad]."""
    g00, g01, g02, g10, g11, g12 = pixel_by_direction(k, rays)
    for i in range(2):
        # the direction times axis i of the camera, world frame: the scene turns against the camera
        m = ROTATION + i
        x, y, z = views[c, m], views[c, m + 3], views[c, m + 6]
        u, v, w = z * rays[k, 1] - y * rays[k, 2], x * rays[k, 2] - z * rays[k, 0], y * rays[k, 0] - x * rays[k, 1]
        turn[0, i], turn[1, i] = g00 * u + g01 * v + g02 * w, g10 * u + g11 * v + g12 * w


@bare_step
def _fill_image(n, c, k, trust, point, rays, views, shared_px2, out):
    """Fill slope, turn, modes, both weights and rest of point n with those of ray k, of camera c."""
    slope, weight, rest, turn = out.slope[n, c], out.weight[n, c], out.rest[n, c], out.turn[n, c]
    depth = 0.0
    for p in range(3):
        depth += rays[k, p] * (point[p] - views[c, p])
    (slope[0, 0], slope[0, 1], slope[0, 2], slope[1, 0], slope[1, 1], slope[1, 2]) = pixel_by_direction(k, rays)
    for i in range(2):
        rest[i] = 0.0
        for p in range(3):
            slope[i, p] /= depth
            rest[i] += slope[i, p] * (point[p] - views[c, p])
    turn_of(k, c, rays, views, turn)
    fill_modes(k, c, rays, views, out.modes[n, c])
    if turn.shape[1] > 2:
        for m in range(MODES):
            turn[0, 2 + m] = turn[1, 2 + MODES + m] = out.modes[n, c, m]
    l00, l10, t2 = rays[k, ROOT], rays[k, ROOT + 1], trust * trust
    l11 = rays[k, SIGMA] * rays[k, SIGMA] / l00
    s00, s01, s11 = l00 * l00 / t2, l00 * l10 / t2, (l10 * l10 + l11 * l11) / t2
    _invert(s00, s01, s11, out.whole_weight)
    _invert(s00 - shared_px2[c], s01, s11 - shared_px2[c], weight)


@bare_step
def _invert(xx, xy, yy, out):
    """Fill ``out`` (2, 2) with the inverse of a symmetric matrix."""
    det = xx * yy - xy * xy
    out[0, 0], out[1, 1] = yy / det, xx / det
    out[0, 1] = out[1, 0] = -xy / det


@bare_step
def _add_image(n, c, out):
    """Add the image of camera c to the equations of its point n."""
    slope, turn, weight, rest = out.slope[n, c], out.turn[n, c], out.weight[n, c], out.rest[n, c]
    push, square, toward, right = out.push[n, c], out.square[n, c], out.toward[n, c], out.right[n]
    unknowns, usual_weight, normal, usual = turn.shape[1], out.whole_weight, out.normal, out.usual
    for i in range(2):
        pushed = weight[i, 0] * rest[0] + weight[i, 1] * rest[1]
        for p in range(3):
            right[p] += slope[i, p] * pushed
            heavy = weight[i, 0] * slope[0, p] + weight[i, 1] * slope[1, p]
            light = usual_weight[i, 0] * slope[0, p] + usual_weight[i, 1] * slope[1, p]
            for q in range(3):
                normal[q, p] += slope[i, q] * heavy
                usual[q, p] += slope[i, q] * light
            for j in range(unknowns):
                toward[p, j] += heavy * turn[i, j]
        for j in range(unknowns):
            push[j] += turn[i, j] * pushed
            heavy = weight[i, 0] * turn[0, j] + weight[i, 1] * turn[1, j]
            for k in range(unknowns):
                square[j, k] += turn[i, k] * heavy


@bare_step
def fill_equations(n, point, members, trusts, rays, views, shared_px2, out):
    """Fill the equations of point n, at ``point`` (3,); return whether they determine it.

    ``members`` (c,): its rays, -1 for none; ``trusts`` (c,): how much each image counts; ``shared_px2`` (c,): part of
    the images' variances that is not their own.
    """
    cameras, unknowns = out.push.shape[1], out.push.shape[2]
    inverse, pull, right = out.inverse[n], out.pull[n], out.right[n]
    for p in range(3):
        right[p] = 0.0
        for q in range(3):
            out.normal[p, q] = out.usual[p, q] = 0.0
    for c in range(cameras):
        for i in range(unknowns):
            out.push[n, c, i] = 0.0
            for j in range(unknowns):
                out.square[n, c, i, j] = 0.0
            for p in range(3):
                out.toward[n, c, p, i] = out.held[n, c, p, i] = 0.0
        if members[c] >= 0:
            _fill_image(n, c, members[c], trusts[c], point, rays, views, shared_px2, out)
            _add_image(n, c, out)
    one, other = symmetric3(out.normal), symmetric3(out.usual)
    one_cofactors, other_cofactors = cofactors3(one), cofactors3(other)
    det, other_det = determinant3(one, one_cofactors), determinant3(other, other_cofactors)
    if not (det > SINGULAR * one.xx * one.yy * one.zz and other_det > SINGULAR * other.xx * other.yy * other.zz):
        return False
    store3(divided3(one_cofactors, det), inverse)
    store3(divided3(other_cofactors, other_det), out.whole[n])
    for p in range(3):
        pull[p] = 0.0
        for q in range(3):
            pull[p] += inverse[p, q] * right[q]
    for c in range(cameras):
        for p in range(3 if members[c] >= 0 else 0):
            for q in range(3):
                for i in range(unknowns):
                    out.held[n, c, p, i] += inverse[p, q] * out.toward[n, c, q, i]
    return True


@bare_step
def deviance_of(n, members, equations):
    """Return minus twice the log-likelihood of the images of point n if no camera turns, up to a constant.

    The point is integrated out. ``equations``: filled by ``fill_equations``; ``members``: as there.
    """
    inverse = symmetric3(equations.inverse[n])
    total = -np.log(determinant3(inverse, cofactors3(inverse)))
    for p in range(3):
        total -= equations.pull[n, p] * equations.right[n, p]
    for c in range(members.shape[0]):
        if members[c] >= 0:
            weight, (x, y) = equations.weight[n, c], (equations.rest[n, c, 0], equations.rest[n, c, 1])
            total += weight[0, 0] * x * x + 2.0 * weight[0, 1] * x * y + weight[1, 1] * y * y
            total -= np.log(weight[0, 0] * weight[1, 1] - weight[0, 1] * weight[1, 0])
    return total


@bare_step
def add_equations(n, points, normal, right):
    """Add the equations of point n to those of the unknowns, ``normal`` (w c, w c), lower triangle, and ``right``."""
    cameras, unknowns = points.push.shape[1], points.push.shape[2]
    for c in range(cameras):
        push, square, toward, pull = points.push[n, c], points.square[n, c], points.toward[n, c], points.pull[n]
        for i in range(unknowns if square[0, 0] > 0.0 else 0):
            row = unknowns * c + i
            right[row] += push[i]
            for j in range(unknowns):
                normal[row, unknowns * c + j] += square[i, j]
            for p in range(3):
                right[row] -= toward[p, i] * pull[p]
            x, y, z = toward[0, i], toward[1, i], toward[2, i]
            for d in range(c + 1):
                held, first = points.held[n, d], unknowns * d
                for j in range(unknowns if points.square[n, d, 0, 0] > 0.0 else 0):
                    normal[row, first + j] -= x * held[0, j] + y * held[1, j] + z * held[2, j]


@step
def turn_squares(rays, views, start):
    """Return the mean squared shifts (c,) of each camera's images by a turn of 1 rad, on each axis [px^2]."""
    turn, squares = np.zeros((2, 2)), np.zeros(len(views))
    for c in range(len(views)):
        many = 0
        for k in range(start[c], start[c + 1]):
            if np.isfinite(rays[k, SIGMA]):
                turn_of(k, c, rays, views, turn)
                squares[c] += 0.5 * (turn[0, 0] ** 2 + turn[0, 1] ** 2 + turn[1, 0] ** 2 + turn[1, 1] ** 2)
                many += 1
        squares[c] /= max(many, 1)
    return squares


@step
def turn_variances(shared_px2, squares):
    """Return the variances (c,) [rad^2] of turns that shift each camera's images by ``shared_px2`` on average.

    ``squares``: of ``turn_squares``.
    """
    variance = np.full(len(squares), LEAST_RAD2)
    for c in range(len(squares)):
        if squares[c] > 0.0:
            variance[c] = max(shared_px2[c] / squares[c], LEAST_RAD2)
    return variance


@step
def solved(normal, right, variance):
    """Return the turns (2 c,) [rad] and their covariance [rad^2]; ``normal`` is replaced."""
    n = len(right)
    sides = np.zeros((n, n + 1))
    for i in range(n):
        normal[i, i] += 1.0 / variance[i // 2]
        sides[i, i], sides[i, n] = 1.0, -right[i]
    solve(normal, sides, n)  # positive definite, by the prior
    return sides[:, n].copy(), sides[:, :n].copy()


def without_turns(points: Points, trusts: Array, table: RayTable, shared: Shared) -> tuple[Points, Array]:
    """Return points without the turns of the cameras, and these turns.

    Parameters
    ----------
    points
        The points of a frame set (n,).
    trusts
        (n, c) of ``mosca.correspondence.match.Matched``. Images that do not count in full (targets hidden in part)
        tell nothing of the turns, and a point with such an image keeps its images' weights.
    table
        The rays that the points were made from.
    shared
        What the images of a camera have in common.

    Returns
    -------
    The points, whose places and covariances are new (a point's correlation with others is not kept; what a flat
    target's uncertainty adds stays), and the turns (c, 2) about the cameras' x and y axes [rad].
    """
    if not (len(points) and np.any(shared.sigma_px)):
        return points, np.zeros((len(table.views), 2))
    xyz, covariance = points.xyz.copy(), points.covariance.copy()
    turns = remove_turns(
        xyz, covariance, points.rays, trusts, table.rays, table.views, table.start,
        (np.square(shared.sigma_px), np.square(shared.field_px), np.ravel(shared.steady)),
    )  # fmt: skip
    for column in (xyz, covariance):
        column.setflags(write=False)
    moved: Array = turns.reshape(-1, 2)
    return points.moved(xyz, covariance), moved


@kernel
def remove_turns(xyz, covariance, members, trusts, rays, views, start, shared):
    """Solve points again, together with the turns of the cameras (2 c,), which are returned.

    ``xyz`` (n, 3) and ``covariance`` (n, 3, 3) are replaced. ``members`` (n, c): of ``Points.rays``; ``shared``: the
    variances (c,) [px^2] of ``Shared`` and the steady turns (2 c,); others as for ``without_turns``.
    """
    shared_px2, field_px2, steady = shared
    n, cameras = members.shape
    points = point_equations(n, cameras, 2)
    variance = turn_variances(shared_px2, turn_squares(rays, views, start))
    normal, right = np.zeros((2 * cameras, 2 * cameras)), np.zeros(2 * cameras)
    by_field = np.zeros((cameras, 2, MODES, 2 * cameras))
    which, own_px2, nothing = np.empty(cameras, np.int64), shared_px2 + field_px2, np.zeros(cameras)
    for k in range(n):
        for c in range(cameras):
            certain = members[k, c] >= 0 and trusts[k, c] >= 1.0
            which[c] = start[c] + members[k, c] if certain else -1
        if fill_equations(k, xyz[k], which, trusts[k], rays, views, own_px2, points):
            add_equations(k, points, normal, right)
            add_field(k, which, points, by_field)
    gain = field_as_noise(normal, right, by_field, field_px2, variance)
    turns, turn_rad2 = solved(normal, right, variance)
    gain = product(turn_rad2, gain).T.copy()
    for k in range(n):
        certain = True
        for c in range(cameras):
            which[c] = start[c] + members[k, c] if members[k, c] >= 0 else -1
            certain &= which[c] < 0 or trusts[k, c] >= 1.0
        # the equations of certain points are those above: zero where images do not determine one
        known = points.whole[k, 0, 0] > 0.0
        if not certain:
            known = fill_equations(k, xyz[k], which, trusts[k], rays, views, nothing, points)
            fill_answers(k, which, points)
        if known:
            field_covariance(k, which, points, by_field, field_px2, nothing if certain else own_px2, gain)
            _move(k, xyz[k], covariance[k], points, turns, steady, turn_rad2)
    return turns


@bare_step
def _move(n, xyz, covariance, points, turns, steady, turn_rad2):
    """Give point n its place (3,) and covariance (3, 3) from images without the turns."""
    cameras, by_turns, held = points.push.shape[1], points.crossed[0], points.held[n]
    by_turns[:] = 0.0
    for d in range(cameras):
        for j in range(2):
            for q in range(3):
                for k in range(2 * cameras):
                    by_turns[q, k] += turn_rad2[2 * d + j, k] * held[d, q, j]
    for p in range(3):
        step_m = -points.pull[n, p]
        for c in range(cameras):
            for i in range(2):
                step_m -= held[c, p, i] * (turns[2 * c + i] - steady[2 * c + i])
        xyz[p] += step_m
        for q in range(3):
            change = points.inverse[n, p, q] - points.whole[n, p, q] + points.added[p, q]
            for c in range(cameras):
                for i in range(2):
                    change += held[c, p, i] * by_turns[q, 2 * c + i]
            covariance[p, q] += change


@kernel
def share_likelihoods(rays, views, start, members, xyz, whole, extra_px2, shares, chosen, sampling):
    """Return the log-likelihoods (m, f) of some of a frame set's points, up to a constant, for each pair of shares.

    Parameters
    ----------
    rays, views, start
        Of ``mosca.data.rays.RayTable``.
    members
        (n, c) of ``Points.rays``.
    xyz
        (n, 3) the points [m].
    whole
        (n,) points whose images count in full, which alone are used.
    extra_px2
        (c,) the part of the images' variance that is shared out.
    shares
        Shares (m,) of it that are each image's own, and shares (f,) of it that the lens's field has. What is left is
        common to a camera's images.
    chosen
        (k,) cameras whose images are used.
    sampling
        The first point and the step to the next.
    """
    own_shares, field_shares = shares
    cameras, unknowns = len(chosen), 2 + 2 * MODES
    split_px2, squares = extra_px2[chosen], turn_squares(rays, views, start)[chosen]
    seen, first, n = views[chosen], start[chosen], unknowns * cameras
    point, found = point_equations(1, cameras, unknowns), np.zeros((len(own_shares), len(field_shares)))
    trusts, which, side, factor = np.ones(cameras), np.empty(cameras, np.int64), np.empty((n, 1)), np.empty((n, n))
    for m in range(len(own_shares)):
        normal, right, total = np.zeros((n, n)), np.zeros(n), 0.0
        for k in range(sampling[0], len(xyz), sampling[1]):
            if not whole[k]:
                continue
            for c in range(cameras):
                member = members[k, chosen[c]]
                which[c] = first[c] + member if member >= 0 else -1
            if fill_equations(0, xyz[k], which, trusts, rays, seen, (1.0 - own_shares[m]) * split_px2, point):
                add_equations(0, point, normal, right)
                total += deviance_of(0, which, point)
        for f in range(len(field_shares)):
            common = max(1.0 - own_shares[m] - field_shares[f], 0.0)
            turn_rad2, error = turn_variances(common * split_px2, squares), total
            for i in range(n):
                c = i // unknowns
                field_px2 = max(field_shares[f] * split_px2[c], LEAST_PX2)
                variance = turn_rad2[c] if i - unknowns * c < 2 else field_px2
                side[i, 0] = right[i]
                for j in range(i):
                    factor[i, j] = normal[i, j]
                factor[i, i] = normal[i, i] + 1.0 / variance
                error += np.log(variance)
            solve(factor, side, n)  # positive definite, by the prior
            for i in range(n):
                error += 2.0 * np.log(factor[i, i]) - side[i, 0] * right[i]
            found[m, f] = -0.5 * error
    return found
