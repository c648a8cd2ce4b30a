"""Starting values of object points: intersection of the rays that see them."""

import numpy as np

from mosca.calibration.bundle.layout import NormalsLayout
from mosca.camera.projection import lens_directions
from mosca.data.arrays import Array
from mosca.data.rig import Camera
from mosca.errors import CalibrationError

# least eigenvalue of the normal matrix of unit rays: below it (angles of about 0.2 deg) rays count as parallel
LEAST_CROSSING = 1e-5


def intersected(
    cameras: tuple[Camera, ...], layout: NormalsLayout, points: Array, fallback: Array | None = None
) -> Array:
    """Return points (p, 3) in which eliminated points that are NaN are replaced by the point nearest to their rays.

    Where rays hardly cross, or meet behind a camera (possible with poor starting poses), the point is the mean of its
    rays at the typical distance of the other points. An undetermined point is taken from ``fallback`` (p, 3);
    CalibrationError without it.
    """
    missing = layout.members[~np.isfinite(points.take(layout.members, axis=0)).all(axis=1)]
    if len(missing) == 0:
        return points
    camera, point, placement, xy_px = layout.observations[:4]
    rank = np.full(len(points), -1, dtype=np.int64)
    rank[missing] = np.arange(len(missing))
    chosen = np.flatnonzero((rank[point] >= 0) & (placement < 0))
    origin, direction = np.empty((len(chosen), 3)), np.empty((len(chosen), 3))
    for c in np.unique(camera[chosen]):
        mine = camera[chosen] == c
        pose = cameras[c].world_from_camera
        origin[mine] = pose.translation
        direction[mine] = lens_directions(cameras[c].lens, xy_px[chosen[mine]]) @ pose.rotation.T
    good = np.isfinite(direction).all(axis=1)
    origin, direction, target = origin[good], direction[good], rank[point[chosen[good]]]
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    normal = _sums(target, across, len(missing))
    right = _sums(target, np.einsum("nij,nj->ni", across, origin), len(missing))
    crossing = np.linalg.eigvalsh(normal)[:, 0] > LEAST_CROSSING
    found = np.full((len(missing), 3), np.nan)
    found[crossing] = np.linalg.solve(normal[crossing], right[crossing][:, :, None])[:, :, 0]
    depth = np.einsum("ni,ni->n", found[target] - origin, direction)
    behind = np.zeros(len(missing), dtype=bool)
    behind[target[~(depth > 0)]] = True
    if behind.any():
        typical = float(np.median(depth[~behind[target]])) if not behind.all() else 1.0
        along = _sums(target, origin + typical * direction, len(missing))
        counts = np.bincount(target, minlength=len(missing))
        with np.errstate(invalid="ignore"):
            found[behind] = (along / counts[:, None])[behind]
    lost = ~np.isfinite(found).all(axis=1)
    if fallback is not None:
        found[lost] = fallback[missing[lost]]
    elif lost.any():
        raise CalibrationError(
            f"point {missing[np.argmax(lost)]}: no ray places it and it has no starting coordinates; give some or "
            "leave it out"
        )
    points = points.copy()
    points[missing] = found
    return points


def _sums(target: Array, values: Array, length: int) -> Array:
    """Return the sums (length, ...) of the ``values`` (n, ...) with the same index in ``target`` (n,)."""
    flat = values.reshape(len(values), -1)
    sums = [np.bincount(target, column, length) for column in flat.T]
    return np.stack(sums, axis=1).reshape(length, *values.shape[1:])
