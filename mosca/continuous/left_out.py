"""How honest stated covariances are: whole exposures left out, foretold from all others, and compared.

For a linear estimate leaving equations out needs no second run: with H = J P J^T of an exposure (all its image
points, in standard deviations) the error of what the others foretell is (1 - H)^-1 r, and (1 - H)^-1 its stated
covariance (Cook and Weisberg 1982, 2.2). Where errors are larger than stated, motion has something quicker than
exposures can show: what is too much is taken for a variance of every point in all directions, alike for points,
changing in time.
"""

import numpy as np
from scipy.sparse import csr_array

from mosca.continuous.banded import Factor, Rows
from mosca.continuous.image_rows import ImagePoints
from mosca.continuous.solve import Solved, of_group
from mosca.continuous.state import Layout
from mosca.data.arrays import Array

MOST_EXPOSURES = 600
"""So many are left out, evenly spread: enough to tell how rough motion is, and time does not grow without end."""
FARTHEST = 5.0
"""Errors count up to so many standard deviations: one blunder is no roughness."""
ROUGH_S = 0.1
"""How fast roughness changes."""


def roughness(image: ImagePoints, solved: Solved, places: Layout) -> Array:
    """Return the variance (pieces + 1,) [m^2] an axis, at the knots, of motion that curves and prior do not hold."""
    o, knots = image.observations, solved.state.knots
    number = np.unique(np.column_stack([o.camera, o.exposure]), axis=0, return_inverse=True)[1].ravel()
    count = int(number.max()) + 1
    when = np.bincount(number, image.times(solved.state)) / np.bincount(number)
    order = np.argsort(when)
    chosen = np.zeros(count, dtype=bool)
    chosen[order[np.linspace(0, count - 1, min(count, MOST_EXPOSURES)).round().astype(int)]] = True
    excess, lever = np.zeros(count), np.zeros(count)
    for g, (factor, rows) in enumerate(zip(solved.factors, solved.rows, strict=True)):
        own = np.flatnonzero(of_group(image, places, g) & (solved.weight > 0))
        free = image.carrier[own] < 0
        for e, pairs, error, stated in foretold(
            factor, rows, number[own], chosen, solved.carried[g], solved.covariance
        ):
            here = free[pairs]
            expected = np.trace(stated, axis1=1, axis2=2)
            more = np.minimum((error**2).sum(axis=1), FARTHEST**2 * expected) - expected
            row = (2 * pairs[:, None] + np.arange(2))[here]
            excess[e] += more[here].sum()
            lever[e] += (rows.values[row, :3] ** 2).sum()
    told = lever > 0
    if not told.any():
        return np.zeros(knots.pieces + 1)
    near = np.exp(-0.5 * ((knots.breaks_s[:, None] - when[told]) / ROUGH_S) ** 2) + 1e-9
    return np.asarray(np.maximum(near @ excess[told], 0.0) / (near @ lever[told]))


def foretold(
    factor: Factor, rows: Rows, exposure: Array, chosen: Array, carried: Array, covariance: Array
) -> list[tuple[int, Array, Array, Array]]:
    """Return of exposures: their number, their pairs of equations (m,), what the other exposures foretell minus what
    was seen (m, 2), and its stated covariances (m, 2, 2), all in standard deviations of images.

    ``exposure`` (n / 2,) of each pair of equations; ``chosen``: which exposures are left out, one at a time;
    ``carried`` T^-1 B and ``covariance`` of the unknowns without time. Exposures so long (rolling shutters) that they
    reach over two blocks are passed over.
    """
    w, found = factor.width, []
    order = np.argsort(exposure, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(exposure[order])) + 1) if len(order) else []
    parts = [part for part in parts if chosen[exposure[part[0]]]]
    begin = np.array([rows.first[2 * part].min() for part in parts])
    for start, window in factor.windows():
        for k in np.flatnonzero((begin >= start) & (begin < start + factor.step)):
            pairs = parts[k]
            row = (2 * pairs[:, None] + np.arange(2)).ravel()
            if (rows.first[row].max() + factor.reach - start) * w > len(window):
                continue
            by = _sparse(rows, row, start, factor.reach, w, len(window))
            fitted = by @ (by @ window).T
            if len(covariance):
                free = rows.shared[row] - by @ carried[start * w : start * w + len(window)]
                fitted += free @ covariance @ free.T
            inverse = np.linalg.inv(np.eye(len(row)) - fitted)
            at = np.arange(len(row)).reshape(-1, 2)
            error = (inverse @ rows.rest[row]).reshape(-1, 2)
            found.append((int(exposure[pairs[0]]), pairs, error, inverse[at[:, :, None], at[:, None, :]]))
    return found


def _sparse(rows: Rows, row: Array, start: int, reach: int, width: int, unknowns: int) -> csr_array:
    """Return J (rows, unknowns) of equations ``row``, of unknowns from coefficient ``start`` on."""
    column = ((rows.first[row] - start)[:, None] + np.arange(reach))[:, :, None] * width
    column = column + rows.columns[row][:, None, :]
    value = rows.weights[row][:, :, None] * rows.values[row][:, None, :]
    used = np.broadcast_to((rows.columns[row] >= 0)[:, None, :], column.shape)
    each = np.broadcast_to(np.arange(len(row))[:, None, None], column.shape)
    return csr_array((value[used], (each[used], column[used])), shape=(len(row), unknowns))
