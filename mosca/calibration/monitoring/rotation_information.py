"""Normal equations of each camera's rotation from one frame set's points, correlations between cameras included."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.data.tracks import Points

FARTHEST_SIGMAS = 6.0
"""Images farther from their point than this are wrong matches and left out."""


@dataclass(frozen=True, eq=False)
class FrameSums:
    """Normal equations of c cameras' rotations from one frame's residuals.

    Let r be the residuals of all images of a point, W their weights, J and A their derivatives by the point and by
    the rotations. P = W - W J N^-1 J^T W leaves the part that the point cannot take up. ``pull`` (3c,): sum A^T P r;
    ``information`` (3c, 3c): sum A^T P A = M; ``spread`` (3c, 3c): covariance of the pull, M + M B M with B the
    body's shake. ``image_square`` (c, 3, 3), sum of A^T A [px^2/rad^2], and ``count`` (c,) of images give a
    rotation's effect in px.
    """

    frame: int
    pull: Array
    information: Array
    spread: Array
    image_square: Array
    count: Array


def frame_sums(
    rig: Rig, frame: int, detections: Mapping[str, Detections], points: Points, sigma_px: float, body_px: float
) -> FrameSums:
    """Return the sums of a frame's points that at least two cameras see.

    ``sigma_px``: random error of an image point besides its detection's; ``body_px``: shake of whole images.
    """
    n, c = len(points), len(rig.cameras)
    slope, turn = np.zeros((n, c, 2, 3)), np.zeros((n, c, 2, 3))
    weight, rest = np.zeros((n, c, 2, 2)), np.zeros((n, c, 2))
    seen = np.zeros((n, c), dtype=bool)
    for k, camera in enumerate(rig.cameras):
        found = detections.get(camera.name)
        rows = np.flatnonzero(points.rays[:, k] >= 0) if found is not None else np.empty(0, dtype=np.int64)
        if found is None or len(rows) == 0:
            continue
        which = points.rays[rows, k]
        p = project_with_jacobians(camera, points.xyz[rows])
        covariance = found.covariance_px2[which] + sigma_px**2 * np.eye(2)
        slope[rows, k], turn[rows, k] = np.nan_to_num(p.by_point), np.nan_to_num(p.by_pose[:, :, :3])
        rest[rows, k] = np.nan_to_num(found.xy_px[which] - p.xy_px)
        weight[rows, k] = np.linalg.inv(covariance)
        seen[rows, k] = np.isfinite(p.xy_px).all(axis=1)
    weight[~seen] = 0.0
    weight, rest, used = _fitted(slope, weight, rest, seen)
    return _sums(rig, frame, slope[used], turn[used], weight[used], rest[used], seen[used], body_px)


def _fitted(slope: Array, weight: Array, rest: Array, seen: Array) -> tuple[Array, Array, Array]:
    """Return weights, residuals at each point's best position, and which points (n,) are used.

    Used are points that two cameras and more determine and of which no image is far off.
    """
    weighted = np.swapaxes(slope, 2, 3) @ weight
    total = (weighted @ slope).sum(axis=1)
    values = np.linalg.eigvalsh(total)
    used = (seen.sum(axis=1) >= 2) & (values[:, 0] > 1e-9 * values[:, 2])
    move = np.zeros((len(slope), 3))
    right = (weighted @ rest[..., None]).sum(axis=1)[..., 0]
    move[used] = np.linalg.solve(total[used], right[used][..., None])[..., 0]
    rest = rest - np.where(seen[..., None], (slope @ move[:, None, :, None])[..., 0], 0.0)
    squared = np.einsum("nci,ncij,ncj->nc", rest, weight, rest)
    used &= (squared <= 2 * FARTHEST_SIGMAS**2).all(axis=1)
    return weight, rest, used


def _sums(
    rig: Rig, frame: int, slope: Array, turn: Array, weight: Array, rest: Array, seen: Array, body_px: float
) -> FrameSums:
    c = len(rig.cameras)
    weighted = np.swapaxes(slope, 2, 3) @ weight  # J^T W (n, c, 3, 2)
    inverse = np.linalg.inv((weighted @ slope).sum(axis=1))
    along = weighted @ turn  # J^T W A (n, c, 3, 3)
    own = np.swapaxes(turn, 2, 3) @ weight @ turn
    between = np.einsum("ncai,nab,ndbj->cidj", along, inverse, along, optimize=True)
    information = -between.reshape(3 * c, 3 * c)
    for k in range(c):
        information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own[:, k].sum(axis=0)
    # at the point's best position sum J^T W r = 0, so that P r = W r
    pull = np.einsum("ncij,ncik,nck->cj", turn, weight, rest).reshape(-1)
    shake = np.concatenate([body_px**2 * _rotation_variances(turn[:, k], seen[:, k]) for k in range(c)])
    spread = information + information @ (shake[:, None] * information)
    square = np.einsum("ncij,ncik->cjk", turn, turn)
    return FrameSums(frame, pull, information, spread, square, seen.sum(axis=0).astype(float))


def _rotation_variances(turn: Array, seen: Array) -> Array:
    """Return the variances (3,) [rad^2/px^2] of rotations, about x and y, that shift the image by 1 px an axis."""
    if not seen.any():
        return np.zeros(3)
    square = np.mean(np.sum(turn[seen] ** 2, axis=1), axis=0)
    return np.array([1.0 / square[0], 1.0 / square[1], 0.0])
