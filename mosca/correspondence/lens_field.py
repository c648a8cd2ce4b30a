"""The smooth field of image errors that a lens model leaves, as a source of error of the cameras' turns.

The misfit of a lens model does not change from set to set, and is alike in neighbouring images: hundreds of images
show a turn no better than a few do. On each axis of each camera it is modelled as a polynomial of degree 2 over the
field of view. Its constant part is a turn; the other MODES have one variance each. Amplitudes b of the modes of all
cameras add G b to the right side g of the turns' equations A d = g (``mosca.correspondence.shared_turns``). The best
linear prediction of turns with the variance D from g, whose covariance given d is A + G Cov(b) G', is

    d = (D^-1 + A M^-1 A)^-1 A M^-1 g,   M = A + G Cov(b) G',

with the covariance (D^-1 + A M^-1 A)^-1 (Henderson, Biometrics 31, 1975). Compiled steps of ``shared_turns``.
"""

import math

import numpy as np

from mosca.data.rays import DIRECTION, EDGES, ROTATION
from mosca.numba_support.cholesky import solve
from mosca.numba_support.decorators import bare_step, step

MODES = 5
"""Modes of the field on an axis: x, y, x y, x^2, y^2. Of degree 3 as well (9), fields of the library's calibrated
lenses are no likelier; of degree 1 (2), they are clearly less likely, and points' errors are stated half as large."""
RIDGE = 1e-6
"""Least information about a turn, over that of its prior: keeps equations of unseen cameras solvable. Half or twice
of it gives the same."""


@bare_step
def fill_modes(k, c, rays, views, out):
    """Fill ``out`` (MODES,) with the modes at ray k of camera c; their squares add to 1 on average over the image."""
    x = y = z = 0.0
    for p in range(3):
        x += rays[k, DIRECTION + p] * views[c, ROTATION + 3 * p]
        y += rays[k, DIRECTION + p] * views[c, ROTATION + 3 * p + 1]
        z += rays[k, DIRECTION + p] * views[c, ROTATION + 3 * p + 2]
    # stereographic, as the edges of the field of view are, which become -1 and 1
    left, top, right, bottom = views[c, EDGES], views[c, EDGES + 1], views[c, EDGES + 2], views[c, EDGES + 3]
    u = (2.0 * x / (1.0 + z) - left - right) / (right - left)
    v = (2.0 * y / (1.0 + z) - top - bottom) / (bottom - top)
    # each has the mean square 1 / MODES over the field of view
    slope, square = math.sqrt(3.0 / MODES), math.sqrt(11.25 / MODES)
    out[0], out[1], out[2] = slope * u, slope * v, 3.0 / math.sqrt(MODES) * u * v
    out[3], out[4] = square * (u * u - 1.0 / 3.0), square * (v * v - 1.0 / 3.0)


@bare_step
def fill_answers(n, members, points):
    """Fill ``points.answer`` of point n: how the point goes with an error of each image.

    ``points``: filled by ``mosca.correspondence.shared_turns.fill_equations``; ``members`` (c,): its rays, -1: none.
    """
    inverse = points.inverse[n]
    for c in range(members.shape[0]):
        if members[c] < 0:
            continue
        slope, weight, answer = points.slope[n, c], points.weight[n, c], points.answer[n, c]
        for i in range(2):
            for p in range(3):
                answer[i, p] = 0.0
                for q in range(3):
                    pushed = slope[0, q] * weight[0, i] + slope[1, q] * weight[1, i]
                    answer[i, p] += inverse[p, q] * pushed


@bare_step
def add_field(n, members, points, by_field):
    """Add the part of point n to G': ``by_field`` (c, 2, MODES, 2 c), of each camera, on each axis, of each mode.

    ``points``, ``members``: as for ``fill_answers``, which is called.
    """
    cameras, changes = members.shape[0], points.crossed[0, 0]
    fill_answers(n, members, points)
    for c in range(cameras):
        for i in range(2 if members[c] >= 0 else 0):
            answer, turn, weight = points.answer[n, c], points.turn[n, c], points.weight[n, c]
            for d in range(cameras):
                toward = points.toward[n, d]
                for j in range(2):
                    change = -toward[0, j] * answer[i, 0] - toward[1, j] * answer[i, 1] - toward[2, j] * answer[i, 2]
                    if d == c:
                        change += turn[0, j] * weight[0, i] + turn[1, j] * weight[1, i]
                    changes[2 * d + j] = change
            for m in range(MODES):
                mode, row = points.modes[n, c, m], by_field[c, i, m]
                for k in range(2 * cameras):
                    row[k] += changes[k] * mode


@step
def field_as_noise(normal, right, by_field, field_px2, variance):
    """Replace A and g by A M^-1 A and A M^-1 g; return A M^-1 (2 c, 2 c).

    ``normal`` (2 c, 2 c): A, lower triangle; ``right`` (2 c,): g; ``by_field``: of ``add_field``; ``field_px2`` (c,):
    variance of the field, of all modes together; ``variance`` (c,): of the turns.
    """
    n = len(right)
    given, whole, sides = np.empty((n, n)), np.empty((n, n)), np.empty((n, n + 1))
    for i in range(n):
        for j in range(i + 1):
            given[i, j] = given[j, i] = whole[i, j] = normal[i, j]
            for c in range(len(field_px2)):
                total = 0.0
                for k in range(2):
                    for m in range(MODES):
                        total += by_field[c, k, m, i] * by_field[c, k, m, j]
                whole[i, j] += field_px2[c] * total
        whole[i, i] += RIDGE / variance[i // 2]
        sides[i, n] = right[i]
    sides[:, :n] = given
    solve(whole, sides, n)
    normal[:] = product(given, sides[:, :n])
    right[:] = product(given, sides[:, n:])[:, 0]
    return sides[:, :n].T.copy()


@step
def product(one, other):
    """Return the product of two matrices."""
    out = np.zeros((one.shape[0], other.shape[1]))
    for i in range(one.shape[0]):
        for p in range(one.shape[1]):
            for j in range(other.shape[1]):
                out[i, j] += one[i, p] * other[p, j]
    return out


@bare_step
def field_covariance(n, members, points, by_field, field_px2, counted_px2, gain):
    """Fill ``points.added`` (3, 3): the covariance that the field adds to point n beside that of the turns.

    A field shifts the point's own images and, through all points, the turns. Where they go together, the turns undo
    it. ``counted_px2`` (c,): variance of turns and field that the weights of the point's images count as their own,
    which is taken off; ``gain`` (2 c, 2 c): M^-1 A (D^-1 + A M^-1 A)^-1; others as for ``add_field``,
    after ``fill_answers``.
    """
    cameras, (by_images, by_turns), added = members.shape[0], points.crossed, points.added
    added[:] = 0.0
    points.crossed[:] = 0.0
    for c in range(cameras):
        if members[c] < 0:
            continue
        modes, own_px2 = points.modes[n, c], -counted_px2[c]
        for m in range(MODES):
            own_px2 += field_px2[c] * modes[m] ** 2
        for i in range(2):
            answer = points.answer[n, c, i]
            for p in range(3):
                for q in range(3):
                    added[p, q] += own_px2 * answer[p] * answer[q]
            for m in range(MODES):
                mode_px2, row = field_px2[c] * modes[m], by_field[c, i, m]
                for p in range(3):
                    for k in range(2 * cameras):
                        by_images[p, k] += mode_px2 * answer[p] * row[k]
    for p in range(3):
        for j in range(2 * cameras):
            for k in range(2 * cameras):
                by_turns[p, k] += by_images[p, j] * gain[j, k]
    for d in range(cameras):
        for j in range(2 if members[d] >= 0 else 0):
            for p in range(3):
                for q in range(3):
                    both = by_turns[p, 2 * d + j] * points.held[n, d, q, j]
                    both += by_turns[q, 2 * d + j] * points.held[n, d, p, j]
                    added[p, q] -= both
