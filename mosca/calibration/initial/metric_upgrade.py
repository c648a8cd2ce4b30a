"""From a projective to a metric reconstruction with nothing known of the cameras but square pixels.

Gherardi and Fusiello 2010 ("Practical autocalibration", ECCV): given two cameras' focal lengths, the plane at
infinity follows in closed form; so all pairs of focal lengths within reason are tried, and those are kept that make
the other cameras most like cameras: no skew, square pixels, principal point near the image's middle. That finds
the solution wherever it is, unlike linear methods, which break down near their many critical motions.
"""

from dataclasses import dataclass

import numpy as np

from mosca.calibration.initial.projective import FOCAL_RANGE, Robust, intersect, minima, projection, transfer
from mosca.data.arrays import Array
from mosca.data.rotations import nearest_rotation

GRID = 28
# how far real cameras lie from skew 0, aspect 1 and the middle of the image, relative to the focal length and to
# half the diagonal; the first two allow for noise
SKEW, ASPECT, MIDDLE = 0.02, 0.05, 0.1
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class ProjectiveReconstruction:
    """Projection matrices (k, 3, 4) of ``cameras`` (k indices), homogeneous ``points`` (p, 4), NaN where
    unknown, and which image points (k, p) of them agree.
    """

    cameras: tuple[int, ...]
    matrices: Array
    points: Array
    good: Array


@dataclass(frozen=True, eq=False)
class MetricGuess:
    """A metric guess: ``focal`` (k,) in half diagonals, camera_from_world ``rotation`` (k, 3, 3), ``centre`` (k, 3);
    ``cost``: how unlike real cameras they were.
    """

    focal: Array
    rotation: Array
    centre: Array
    cost: float


def pair_matrices(fundamental: Array, focal: tuple[float, float]) -> Array:
    """Return two projection matrices (2, 3, 4) with this fundamental matrix that are nearly metric for cameras of
    these focal lengths (half diagonals).
    """
    epipole = np.linalg.svd(fundamental.T)[2][-1]
    cross = np.array([[0, -epipole[2], epipole[1]], [epipole[2], 0, -epipole[0]], [-epipole[1], epipole[0], 0]])
    first = np.hstack([np.eye(3), np.zeros((3, 1))])
    second = np.hstack([cross @ fundamental, epipole[:, None]])
    second *= np.sqrt(3) / np.linalg.norm(second[:, :3])
    both = np.stack([first, second])
    upgrade = _upgrades(both, np.array([focal[0]]), np.array([focal[1]]))[0]
    return np.asarray(both @ upgrade)


def grown(
    start: ProjectiveReconstruction, xy: Array, fewest: int, most: int, rng: np.random.Generator
) -> ProjectiveReconstruction:
    """Add cameras to a projective reconstruction as long as they see ``fewest`` of its points, ``most`` in all.

    ``xy`` (c, p, 2): plain image points of all cameras, NaN where unseen. Projection matrices and points are
    then estimated again alternately.
    """
    one, tried = start, set(start.cameras)
    while len(one.cameras) < most:
        known = np.isfinite(one.points).all(axis=1)
        links = (np.isfinite(xy).all(axis=2) & known).sum(axis=1)
        links[list(tried)] = 0
        camera = int(np.argmax(links))
        if links[camera] < fewest:
            break
        tried.add(camera)
        there = known & np.isfinite(xy[camera]).all(axis=1)
        found = projection(one.points[there], xy[camera, there], rng)
        if found.inliers.sum() < fewest:
            continue
        one = _with(one, camera, found, there, xy)
    for _ in range(ROUNDS):
        one = _again(one, xy, rng)
    return one


def _with(
    one: ProjectiveReconstruction, camera: int, found: Robust, there: Array, xy: Array
) -> ProjectiveReconstruction:
    # points that the new camera contradicts may be wrong themselves, those it alone joins to another are new
    good = np.isfinite(xy[camera]).all(axis=1)
    good[np.flatnonzero(there)[~found.inliers]] = False
    cameras = (*one.cameras, camera)
    matrices = np.concatenate([one.matrices, found.matrix[None]])
    return _intersected(ProjectiveReconstruction(cameras, matrices, one.points, np.vstack([one.good, good])), xy)


def _intersected(one: ProjectiveReconstruction, xy: Array) -> ProjectiveReconstruction:
    trusted = np.where(one.good[:, :, None], xy[list(one.cameras)], np.nan)
    return ProjectiveReconstruction(one.cameras, one.matrices, intersect(one.matrices, trusted), one.good)


def _again(one: ProjectiveReconstruction, xy: Array, rng: np.random.Generator) -> ProjectiveReconstruction:
    matrices, good = one.matrices.copy(), one.good.copy()
    for k, camera in enumerate(one.cameras):
        there = np.flatnonzero(np.isfinite(one.points).all(axis=1) & np.isfinite(xy[camera]).all(axis=1))
        found = projection(one.points[there], xy[camera, there], rng, samples=60)
        if np.median(transfer(matrices[k], one.points[there], xy[camera, there])) > found.median:
            matrices[k] = found.matrix
        good[k, there] = found.inliers
    return _intersected(ProjectiveReconstruction(one.cameras, matrices, one.points, good), xy)


def metric_guesses(one: ProjectiveReconstruction, most: int) -> list[MetricGuess]:
    """Return up to ``most`` metric guesses of a projective reconstruction, the likeliest first."""
    # distances from the other camera's focal length distinguish what lies on one valley
    focal = np.geomspace(*FOCAL_RANGE, GRID)
    first, second = (side.ravel() for side in np.meshgrid(focal, focal, indexing="ij"))
    # the first camera's matrix becomes (I | 0)
    to_first = np.vstack([one.matrices[0], np.linalg.svd(one.matrices[0])[2][-1]])
    canonical = one.matrices @ np.linalg.inv(to_first)
    points = one.points[np.isfinite(one.points).all(axis=1)] @ to_first.T
    signs = [_costs(canonical, points, sign, first, second) for sign in (1.0, -1.0)]
    found: list[tuple[float, MetricGuess]] = []
    for cost, upgrades in signs:
        grid = cost.reshape(GRID, GRID)
        for i, j in minima(grid)[:most]:
            found.append((float(grid[i, j]), _metric(canonical @ upgrades[i * GRID + j], float(grid[i, j]))))
    found.sort(key=lambda pair: pair[0])
    return [metric for _, metric in found[:most]]


def _upgrades(matrices: Array, first: Array, second: Array, sign: float = 1.0) -> Array:
    """Return homographies (g, 4, 4) that make the first two matrices, the first (I | 0), cameras of focal
    lengths ``first``, ``second`` (g,).
    """
    p, e = sign * matrices[1, :, :3], sign * matrices[1, :, 3]
    k1 = np.stack([first, first, np.ones_like(first)], axis=1)
    k2 = np.stack([second, second, np.ones_like(second)], axis=1)
    m = p[None] * k1[:, None, :] / k2[:, :, None]
    t = e[None] / k2
    length = np.linalg.norm(t, axis=1)
    w = _rotation_to_x(t / length[:, None]) @ m
    size = np.sqrt(np.linalg.norm(w[:, 1], axis=1) * np.linalg.norm(w[:, 2], axis=1))
    row = (np.cross(w[:, 1], w[:, 2]) / size[:, None] - w[:, 0]) / length[:, None]
    out = np.zeros((len(first), 4, 4))
    out[:, [0, 1, 2], [0, 1, 2]] = k1
    out[:, 3, :3], out[:, 3, 3] = row, 1.0
    return out


def _rotation_to_x(unit: Array) -> Array:
    """Return rotations (g, 3, 3) that rotate unit vectors (g, 3) into the x axis."""
    other = np.where(np.abs(unit[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    y = np.cross(unit, other)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([unit, y, np.cross(unit, y)], axis=1)


def _costs(matrices: Array, points: Array, sign: float, first: Array, second: Array) -> tuple[Array, Array]:
    """Return the cost (g,) and the upgrade (g, 4, 4) of each pair of focal lengths."""
    upgrades = _upgrades(matrices, first, second, sign)
    cost = np.zeros(len(first))
    for matrix in matrices[1:]:
        m = matrix[:, :3] @ upgrades[:, :3, :3] + matrix[:, 3:] @ upgrades[:, 3:, :3]
        fx, fy, skew, cx, cy = _interior(m)
        f = np.sqrt(fx * fy)
        low, high = FOCAL_RANGE
        cost += np.abs(skew) / f / SKEW + np.abs(np.log(fx / fy)) / ASPECT + np.hypot(cx, cy) / MIDDLE
        cost += 10 * (np.maximum(np.log(low / f), 0) + np.maximum(np.log(f / high), 0))
    cost /= len(matrices) - 1
    sample = points[:: max(1, len(points) // 60)]
    share = _front_share(matrices, sample, upgrades)
    cost = cost + 20 * (1 - np.maximum(share, 1 - share))
    # cameras whose points lie behind them: the point reflection of the upgrade
    mirrored = upgrades.copy()
    mirrored[:, :, 3] *= np.where(share < 0.5, -1.0, 1.0)[:, None]
    return np.where(np.isfinite(cost), cost, np.inf), mirrored


def _interior(m: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return fx, fy, skew, cx, cy (g,) of the left parts (g, 3, 3) of projection matrices (from K K^T = M M^T)."""
    dual = m @ np.swapaxes(m, 1, 2)
    dual = dual / np.maximum(dual[:, 2:, 2:], 1e-300)
    cx, cy = dual[:, 0, 2], dual[:, 1, 2]
    fy = np.sqrt(np.maximum(dual[:, 1, 1] - cy**2, 1e-12))
    skew = (dual[:, 0, 1] - cx * cy) / fy
    fx = np.sqrt(np.maximum(dual[:, 0, 0] - cx**2 - skew**2, 1e-12))
    return fx, fy, skew, cx, cy


def _front_share(matrices: Array, points: Array, upgrades: Array) -> Array:
    """Return the share (g,) of the points (n, 4) in front of all cameras, of each upgrade."""
    metric = points @ np.swapaxes(np.linalg.inv(upgrades), 1, 2)
    front = np.zeros(len(upgrades))
    for matrix in matrices:
        handed = np.linalg.det(matrix[:, :3] @ upgrades[:, :3, :3] + matrix[:, 3:] @ upgrades[:, 3:, :3])
        depth = (points @ matrix[2])[None] * metric[:, :, 3] * handed[:, None]
        front += (depth > 0).mean(axis=1)
    return np.asarray(front / len(matrices))


def _metric(matrices: Array, cost: float) -> MetricGuess:
    """Return metric cameras nearest to upgraded matrices (k, 3, 4)."""
    fx, fy, *_ = _interior(matrices[:, :, :3])
    focal = np.clip(np.sqrt(fx * fy), *FOCAL_RANGE)
    rotation, centre = [], []
    for f, matrix in zip(focal, matrices, strict=True):
        turn = matrix[:, :3] / np.array([f, f, 1.0])[:, None]
        turn = turn * np.sign(np.linalg.det(turn)) / np.linalg.norm(turn[2])
        rotation.append(nearest_rotation(turn)[0])
        centre.append(-np.linalg.solve(matrix[:, :3], matrix[:, 3]))
    return MetricGuess(focal, np.array(rotation), np.array(centre), cost)
