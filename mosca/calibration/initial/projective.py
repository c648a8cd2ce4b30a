"""Projective geometry of uncalibrated views: fundamental matrices and homographies.

The estimates are robust: random samples are scored by the median (Rousseeuw 1984), each followed by concentration
steps (Rousseeuw and Van Driessen 1999). No threshold has to be known; up to about a third of the pairs may be wrong.
Image coordinates are plain ones (``PointViews.plain``), of size one; formulas after Hartley and Zisserman 2004.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_1D
from mosca.data.arrays import Array

FOCAL_RANGE = (0.45, 16.0)
"""Focal lengths that are tried, in half diagonals of the image: 0.28 to 10 image widths at 4 : 3."""
SAMPLES, KEPT, CONCENTRATIONS, MOST_SCORED = 300, 8, 3, 300
# distances of good pairs beyond so many robust standard deviations are improbable
INLIER_SIGMAS = 4.0
SMALL = 1e-300
"""Guards divisions by zero."""


@dataclass(frozen=True, eq=False)
class Robust:
    """A robustly estimated ``matrix``, its ``inliers`` (n,) bool, and the ``median`` of all distances."""

    matrix: Array
    inliers: Array
    median: float


def fundamental(first: Array, second: Array, rng: np.random.Generator, samples: int = SAMPLES) -> Robust:
    """Return the fundamental matrix F (3, 3), second^T F first = 0, of image points (n, 2) each, n >= 8.

    The eight-point algorithm (Hartley 1997) is used on samples, with Sampson's distance in units of the coordinates.
    """
    x, back_x = _normalised(first)
    y, back_y = _normalised(second)
    flat_x, flat_y = _h(first), _h(second)

    def distances(matrices: Array, which: Array) -> Array:
        return _sampson(back_y.T @ matrices @ back_x, flat_x[which], flat_y[which])

    def fit(chosen: Array) -> Array:
        return _eight_point(x[chosen], y[chosen])

    found = _robust(len(x), 8, samples, fit, distances, rng)
    matrix = back_y.T @ found.matrix @ back_x
    return Robust(matrix / np.linalg.norm(matrix), found.inliers, found.median)


def plane_misfit(first: Array, second: Array, rng: np.random.Generator) -> float:
    """Return the median residual of the best homography of image points (n, 2) [units of the coordinates].

    It is small where the points lie in a plane or the baseline is short: then they determine a pair poorly.
    """
    x = _h(first)

    def fit(chosen: Array) -> Array:
        return _least(_camera_rows(x[chosen], second[chosen])).reshape(-1, 3, 3)

    return _robust(len(x), 4, SAMPLES // 4, fit, lambda m, k: _transfer(m, x[k], second[k]), rng).median


def epipolar_distance(matrix: Array, first: Array, second: Array) -> Array:
    """Return Sampson's distances (n,) of image points (n, 2) from F (3, 3)."""
    result: Array = _sampson(matrix[None], _h(first), _h(second))[0]
    return result


def minima(grid: Array) -> list[tuple[int, int]]:
    """Return the positions of the local minima of a grid (n, m), the deepest first."""
    padded = np.pad(grid, 1, constant_values=np.inf)
    rows, columns = grid.shape
    around = [padded[1 + a : 1 + a + rows, 1 + b : 1 + b + columns] for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
    least = np.isfinite(grid) & (grid <= np.min(around, axis=0))
    places = np.argwhere(least)
    return [(int(i), int(j)) for i, j in places[np.argsort(grid[least])]]


def _robust(
    n: int,
    size: int,
    samples: int,
    fit: Callable[[Array], Array],
    distances: Callable[[Array, Array], Array],
    rng: np.random.Generator,
) -> Robust:
    """Return the best matrix. ``fit`` maps indices (s, k) to matrices (s, ...); ``distances`` maps matrices (s, ...)
    and indices (n,) to distances (s, n).
    """
    every = np.arange(n)
    looked_at = rng.permutation(n)[: max(MOST_SCORED, 2 * size)]
    matrices = fit(rng.choice(looked_at, (samples, size)) if n > size else every[None])
    half = max(size, (len(looked_at) + 1) // 2)
    for _ in range(CONCENTRATIONS):
        far = distances(matrices, looked_at)
        best = np.argsort(np.median(far, axis=1))[:KEPT]
        near = looked_at[np.argpartition(far[best], half - 1, axis=1)[:, :half]]
        matrices = np.concatenate([matrices[best], fit(near)])
    first = int(np.argmin(np.median(distances(matrices, looked_at), axis=1)))
    matrix = matrices[first]
    own = distances(matrix[None], every)[0]
    inliers = np.ones(n, dtype=bool)
    for _ in range(5):
        inliers = own <= max(INLIER_SIGMAS * SIGMA_BY_MEDIAN_1D * float(np.median(own)), 1e-12)
        if inliers.sum() < size:
            break
        trial = fit(np.flatnonzero(inliers)[None])[0]
        again = distances(trial[None], every)[0]
        if np.median(again) > 1.5 * np.median(own):
            break
        matrix, own = trial, again
    return Robust(matrix, inliers, float(np.median(own)))


def _h(xy: Array) -> Array:
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


def _normalised(xy: Array) -> tuple[Array, Array]:
    """Return homogeneous points (n, 3) of mean 0 and mean length sqrt 2, and the matrix that makes them."""
    middle = np.median(xy, axis=0)
    size = np.sqrt(2) / max(float(np.mean(np.linalg.norm(xy - middle, axis=1))), 1e-12)
    matrix = np.array([[size, 0, -size * middle[0]], [0, size, -size * middle[1]], [0, 0, 1.0]])
    return _h(xy) @ matrix.T, matrix


def _eight_point(x: Array, y: Array) -> Array:
    """Return matrices (s, 3, 3) of rank two of s sets of homogeneous points (s, n, 3)."""
    rows = (y[..., :, None] * x[..., None, :]).reshape(*x.shape[:-1], 9)
    left, sizes, right = np.linalg.svd(_least(rows).reshape(-1, 3, 3))
    sizes[:, 2] = 0
    return np.asarray((left * sizes[:, None, :]) @ right)


def _least(rows: Array) -> Array:
    """Return the unit vectors (s, k) for which the products of ``rows`` (s, n, k) with them are least."""
    return np.asarray(np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)[1][:, :, 0])


def _camera_rows(points: Array, xy: Array) -> Array:
    """Return the equations (s, 2 n, 3 k) of ``xy x (P point) = 0`` of points (s, n, k) and pixels (s, n, 2)."""
    none = np.zeros_like(points)
    u, v = xy[..., 0, None] * points, xy[..., 1, None] * points
    return np.concatenate(
        [np.concatenate([points, none, -u], axis=-1), np.concatenate([none, points, -v], axis=-1)], axis=1
    )


def _sampson(matrices: Array, x: Array, y: Array) -> Array:
    """Return Sampson's distances (s, n) of homogeneous points (n, 3) from matrices (s, 3, 3)."""
    line, other = matrices @ x.T, np.swapaxes(matrices, 1, 2) @ y.T
    slope = line[:, 0] ** 2 + line[:, 1] ** 2 + other[:, 0] ** 2 + other[:, 1] ** 2
    away = line[:, 0] * y[:, 0] + line[:, 1] * y[:, 1] + line[:, 2] * y[:, 2]
    return np.asarray(np.abs(away) / np.sqrt(np.maximum(slope, SMALL)))


def _transfer(matrices: Array, points: Array, xy: Array) -> Array:
    """Return the distances (s, n) of the images of points (n, k) under matrices (s, 3, k) from ``xy`` (n, 2)."""
    image = points @ np.swapaxes(matrices, 1, 2)
    depth = np.where(np.abs(image[..., 2:]) > SMALL, image[..., 2:], SMALL)
    # large distances are clipped, so that squares do not overflow
    return np.asarray(np.linalg.norm(np.clip(image[..., :2] / depth - xy, -1e6, 1e6), axis=2))
