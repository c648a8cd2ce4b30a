"""Moving targets in calibrated cameras: displacements of the images from their points, as sums over each frame set.

A camera that exposes late by d shifts a target's image by u d, with u the velocity of the image. A shake by s shifts
all images by s. A rolling shutter of row time t shifts a target v rows below the image's middle by u v t. So the
residual of an image is ``u d + s + u v t + noise``, minus the part that the point's own position takes up: the points
are eliminated, as in a bundle adjustment (Schur complement). Each frame set leaves sums M (4c, 4c) and z (4c,) over c
cameras, in the order d of all cameras, s along x, s along y, t.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mosca.camera.projection import project, project_with_jacobians, rays
from mosca.data.arrays import Array
from mosca.data.frames import mid_exposure_ns
from mosca.data.rig import Camera, Rig
from mosca.pipeline import Step

FARTHEST_M = 0.1
"""Largest distance that a target moves from one frame set to the next."""
ASTRAY_M = 0.02
"""Largest distance of the third of three consecutive positions from the straight line through the others."""
STEP_M = 1e-4
"""Step of the numerical derivative of an image."""
ODD = 4.0
"""Ratio of a residual to the usual one from which it belongs to another target, or to two that hide each other."""
ROUNDS = 5
"""Rounds in which such residuals are left out."""
SCALES = (1e-4, 1e-2, 1e-2, 1e-6)
"""Units of d [s], s [px] and t [s/row], so that all sums are of one size."""


@dataclass(frozen=True, eq=False)
class MovingTargets:
    """Images of points in all cameras, n points of all frame sets together."""

    names: tuple[str, ...]
    set_of: Array
    """(n,) number of the frame set, ascending from 0."""
    residual_px: Array
    """(n, c, 2) image minus projected point; 0 where the camera does not see it."""
    weight: Array
    """(n, c, 2, 2) W with ``W^T W`` the inverse covariance of the image; 0 where the camera does not see it."""
    slope: Array
    """(n, c, 2, 3) derivative of the image by the point [px/m]."""
    speed: Array
    """(n, c, 2) velocity of the image [px/s]."""
    turned: Array
    """(n, c, 2, 2) motion of the image, in columns, when the camera's body rotates so that the middle of its image
    moves by 1 px along x, and along y."""
    xy_px: Array
    """(n, c, 2) the images."""
    rows: Array
    """(n, c) rows below the image's middle."""
    stated_s: Array
    """(c,) mean delay of each camera's exposures against their frame sets, as the camera states it."""
    stated_row_s: Array
    """(c,) time from row to row, as each camera states it."""


@dataclass(frozen=True, eq=False)
class TimingSums:
    """Sums of f frame sets, in units of SCALES, divided by the variance of the residuals."""

    normal: Array
    """(f, 4c, 4c) M."""
    right: Array
    """(f, 4c) z."""
    variance: float
    """Variance of the whitened residuals within frame sets: 1 where the detections' covariances are right."""


def observe(steps: Iterable[Step], rig: Rig) -> MovingTargets | None:
    """Return the images of all points that have a velocity; None where there is none."""
    kept = []
    stated: list[list[float]] = [[] for _ in rig.names]
    row_s = np.zeros(len(rig.names))
    for step in steps:
        places = step.points
        found = [step.detections.get(name) for name in rig.names]
        n = len(places)
        xy, covariance = np.full((n, len(found), 2), np.nan), np.zeros((n, len(found), 2, 2))
        for k, one in enumerate(found):
            seen = places.rays[:, k] >= 0
            if one is not None and seen.any():
                seen[seen] = one.flags[places.rays[seen, k]] == 0  # only whole, single targets
                xy[seen, k] = one.xy_px[places.rays[seen, k]]
                covariance[seen, k] = one.covariance_px2[places.rays[seen, k]]
        for k, name in enumerate(rig.names):
            frame = step.frame_set.frames.get(name)
            if frame is not None:
                stated[k].append(1e-9 * (mid_exposure_ns(frame) - step.frame_set.time_ns))
                row_s[k] = 1e-9 * frame.row_time_ns
        kept.append((step.frame_set.pulse, 1e-9 * step.frame_set.time_ns, np.asarray(places.xyz), xy, covariance))
    parts = [_moving(*three) for three in zip(kept, kept[1:], kept[2:], strict=False)]
    whole = [(k, *part) for k, part in enumerate(parts) if part is not None and len(part[0])]
    if not whole:
        return None
    set_of = np.concatenate([np.full(len(one[1]), k) for k, one in enumerate(whole)])
    columns = [np.concatenate([one[j] for one in whole]) for j in range(1, 5)]
    offsets = np.array([np.mean(one) if one else 0.0 for one in stated])
    return _images(rig, set_of, columns, offsets, row_s)


def _moving(before, here, after) -> tuple[Array, Array, Array, Array] | None:  # type: ignore[no-untyped-def]
    """Return position, velocity, images and covariances of the points that three consecutive frame sets share."""
    if after[0] - before[0] != 2 or not all(len(one[2]) for one in (before, here, after)):
        return None
    xyz = here[2]
    away, following = cKDTree(after[2]).query(xyz)
    ahead = after[2][following]
    astray, preceding = cKDTree(before[2]).query(2.0 * xyz - ahead)
    good = (away < FARTHEST_M) & (astray < ASTRAY_M) & (np.isfinite(here[3][:, :, 0]).sum(axis=1) >= 2)
    speed = (ahead - before[2][preceding]) / (after[1] - before[1])
    return xyz[good], speed[good], here[3][good], here[4][good]


def _images(rig: Rig, set_of: Array, columns: list[Array], stated_s: Array, row_s: Array) -> MovingTargets:
    xyz, velocity, xy, covariance = columns
    n, c = xy.shape[:2]
    residual, slope = np.zeros((n, c, 2)), np.zeros((n, c, 2, 3))
    weight, rows, turned = np.zeros((n, c, 2, 2)), np.zeros((n, c)), np.zeros((n, c, 2, 2))
    for k, camera in enumerate(rig.cameras):
        seen = np.isfinite(xy[:, k, 0])
        residual[seen, k] = (xy[:, k] - project(camera, xyz))[seen]
        for axis in range(3):
            away = STEP_M * np.eye(3)[axis]
            slope[seen, k, :, axis] = ((project(camera, xyz + away) - project(camera, xyz - away)) / (2 * STEP_M))[
                seen
            ]
        turned[:, k] = np.einsum("nij,njk->nik", slope[:, k], turns(camera, xyz))
        weight[seen, k] = np.linalg.inv(np.linalg.cholesky(covariance[seen, k]))
        rows[seen, k] = xy[seen, k, 1] - 0.5 * (camera.height - 1)
    speed = np.einsum("ncij,nj->nci", slope, velocity)
    return MovingTargets(
        rig.names, set_of, residual, weight, slope, speed, turned, np.nan_to_num(xy), rows, stated_s, row_s
    )  # fmt: skip


def turned_images(camera: Camera, xy_px: Array) -> Array:
    """Return the motions (n, 2, 2) of images (n, 2), in columns, as the camera's body rotates so that the middle of
    its image moves by 1 px along x, and along y.
    """
    ray = rays(camera, xy_px)
    points = ray.origin + ray.direction
    return np.asarray(project_with_jacobians(camera, points).by_point @ turns(camera, points))


def turns(camera: Camera, xyz: Array) -> Array:
    """Return the motions (n, 3, 2) of points (n, 3) as the camera's body rotates by 1 px at its image's middle."""
    rotation, place = camera.world_from_camera.rotation, camera.world_from_camera.translation
    near = place + (np.array([0.0, 0.0, 1.0]) + STEP_M * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])) @ (
        rotation.T
    )
    image = project(camera, near)
    px_per_radian = np.linalg.norm(np.concatenate([image[0] - image[1], image[2] - image[3]])) / STEP_M / 8.0**0.5
    own = (xyz - place) @ rotation
    x, y, z = own.T
    zero = np.zeros_like(x)
    # the image moves right where points rotate about the camera's y axis, and down where about its x axis
    moved = np.stack([np.stack([z, zero, -x], axis=-1), np.stack([zero, z, -y], axis=-1)], axis=-1)
    result: Array = np.einsum("ij,njk->nik", rotation, moved) / px_per_radian
    return result


def frame_sums(seen: MovingTargets) -> TimingSums:
    """Return the sums of each frame set; points with residuals from another target are left out."""
    n, c = seen.rows.shape
    whole = np.einsum("ncij,ncj->nci", seen.weight, seen.residual_px).reshape(n, 2 * c)
    places = np.einsum("ncij,ncjk->ncik", seen.weight, seen.slope).reshape(n, 2 * c, 3)
    columns = np.zeros((n, c, 2, 4 * c))
    for k in range(c):
        columns[:, k, :, k] = SCALES[0] * seen.speed[:, k]
        columns[:, k, :, c + k] = SCALES[1] * seen.turned[:, k, :, 0]
        columns[:, k, :, 2 * c + k] = SCALES[1] * seen.turned[:, k, :, 1]
        columns[:, k, :, 3 * c + k] = SCALES[3] * seen.speed[:, k] * seen.rows[:, k, None]
    design = np.einsum("ncij,ncjk->ncik", seen.weight, columns).reshape(n, 2 * c, 4 * c)
    inverse = np.linalg.inv(np.einsum("nij,nik->njk", places, places))
    whole = whole - np.einsum("nij,njk,nlk,nl->ni", places, inverse, places, whole)
    design = design - np.einsum("nij,njk,nlk,nlm->nim", places, inverse, places, design)
    freedom = 2.0 * (seen.weight[:, :, 0, 0] > 0.0).sum(axis=1) - 3.0
    sets = int(seen.set_of[-1]) + 1
    left = (whole**2).sum(axis=1) / freedom
    good = left < ODD**2 * np.median(left)
    for _ in range(ROUNDS):
        normal, right = np.zeros((sets, 4 * c, 4 * c)), np.zeros((sets, 4 * c))
        of = seen.set_of[good]
        np.add.at(normal, of, np.einsum("nij,nik->njk", design[good], design[good]))
        np.add.at(right, of, np.einsum("nij,ni->nj", design[good], whole[good]))
        effect = np.einsum("fij,fj->fi", np.linalg.pinv(normal, rcond=1e-9, hermitian=True), right)
        left = ((whole - np.einsum("nij,nj->ni", design, effect[seen.set_of])) ** 2).sum(axis=1) / freedom
        good = left < ODD**2 * np.median(left)
    free = float(freedom[good].sum()) - float(np.linalg.matrix_rank(normal, hermitian=True).sum())
    variance = float((left * freedom)[good].sum()) / max(free, 1.0)
    return TimingSums(normal / variance, right / variance, variance)
