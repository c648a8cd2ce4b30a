"""Predicted accuracy of a planned rig's calibration by a test field, before any image is taken.

It follows from the normal equations of the bundle adjustment of predicted images. The unknowns are the cameras' poses
and lenses; the field's pose at each stand but the first, which defines the world; the field's marks; and the shake of
each whole image. Marks and shakes have a-priori standard deviations. The inverse is the covariance C of the
parameters; that of a measured point is G C G' with G = -N^-1 sum J' dx/dp
(``mosca.calibration.quality.accuracy_map``).
"""

from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mosca.camera.projection import Projection, inside_image, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import MoscaLens, Pose, Rig

FREE = ("c_mm", "xp_px", "yp_px", "my_mm_per_px", "a", "K1_per_mm2", "K2_per_mm4", "P1_per_mm", "P2_per_mm")
"""Parameters of a ``MoscaLens`` that a session estimates; mx is held."""
LENS_COLUMNS = [k for k, one in enumerate(fields(MoscaLens)) if one.name in FREE]
OWN = 6 + len(FREE)
"""Number of unknowns of a camera."""


@dataclass(frozen=True, eq=False)
class FieldSession:
    """A session: the marks of a field and the poses in which it is shown."""

    marks: Array
    """(m, 3) in the field's frame [m]."""
    stands: tuple[Pose, ...]
    """world_from_field; the first one defines the world."""
    frames: tuple[int, ...]
    """Number of exposures at each stand."""
    seen: Array
    """(c, s, m) bool: which camera sees which mark (the image borders are checked in addition)."""
    sigma_px: float
    """Standard deviation of a mark's image, an axis."""
    lasting_px: float
    """Standard deviation of errors that are the same in all exposures at a stand, an axis."""
    body_px: float
    """Shake of a whole image, rms an axis."""
    known_m: float
    """Standard deviation of the marks' coordinates."""


def parameter_covariance(rig: Rig, session: FieldSession) -> Array:
    """Return the covariance (c OWN, c OWN) of the cameras' poses (``mosca.camera.projection.Projection``) and lenses.

    All lenses are ``MoscaLens``. Cameras that see too few marks keep a prior of a radian, a metre and a tenth of each
    lens parameter's usual size, so that the result is finite.
    """
    cameras, stands, marks = len(rig.cameras), len(session.stands), len(session.marks)
    first_stand = cameras * OWN
    first_mark = first_stand + 6 * (stands - 1)
    size = first_mark + 3 * marks
    normal = np.zeros((size, size))
    for s, pose in enumerate(session.stands):
        world = pose.transform(session.marks)
        for c, camera in enumerate(rig.cameras):
            one = project_with_jacobians(camera, world)
            rows = np.flatnonzero(inside_image(camera, one.xy_px) & session.seen[c, s])
            if not len(rows):
                continue
            columns, jacobian = _design(one, rows, c, s, pose, world, first_stand, first_mark)
            variance = session.sigma_px**2 / session.frames[s] + session.lasting_px**2
            shake = session.body_px**2 / session.frames[s]
            for axis in (0, 1):
                of_axis = jacobian[axis::2]
                # noise plus a common shake: by the Sherman-Morrison formula
                total = of_axis.sum(axis=0)
                less = shake / (variance * (variance + shake * len(rows)))
                normal[np.ix_(columns, columns)] += of_axis.T @ of_axis / variance - less * np.outer(total, total)
    normal[np.arange(size), np.arange(size)] += np.concatenate(
        [np.tile(_prior(), cameras), np.full(6 * (stands - 1), 1e-6), np.full(3 * marks, session.known_m**-2)]
    )
    own = np.eye(size, first_stand)
    scale = np.sqrt(np.diag(normal))
    solved = cho_solve(cho_factor(normal / np.outer(scale, scale)), own / scale[:, None]) / scale[:, None]
    covariance = solved[:first_stand]
    return np.asarray((covariance + covariance.T) / 2)


def _design(
    one: Projection, rows: Array, c: int, s: int, pose: Pose, world: Array, first_stand: int, first_mark: int
) -> tuple[Array, Array]:
    """Return the indices of the unknowns and the Jacobian (2 n, u) of the images ``rows`` (n,)."""
    by_point = one.by_point[rows]
    parts = [one.by_pose[rows], one.by_lens[rows][:, :, LENS_COLUMNS]]
    columns = [np.arange(c * OWN, (c + 1) * OWN)]
    if s > 0:
        arm = world[rows] - pose.translation
        cross = np.zeros((len(rows), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = arm[:, 2], -arm[:, 1], arm[:, 0]
        cross -= np.swapaxes(cross, 1, 2)
        parts += [by_point @ cross, by_point]
        columns.append(np.arange(first_stand + 6 * (s - 1), first_stand + 6 * s))
    dense = np.concatenate(parts, axis=2)
    of_marks = np.zeros((len(rows), 2, 3 * len(rows)))
    turned = by_point @ pose.rotation
    for k in range(len(rows)):
        of_marks[k, :, 3 * k : 3 * k + 3] = turned[k]
    columns.append((first_mark + 3 * rows[:, None] + np.arange(3)).ravel())
    jacobian = np.concatenate([dense, of_marks], axis=2).reshape(2 * len(rows), -1)
    return np.concatenate(columns), jacobian


def _prior() -> Array:
    """Return the a-priori inverse variances (OWN,) of a camera's unknowns."""
    usual = {"c_mm": 1.0, "xp_px": 100.0, "yp_px": 100.0, "my_mm_per_px": 1e-3, "a": 0.01}
    return np.array([1.0] * 6 + [usual.get(name, 1e-3) ** -2 for name in FREE])


def common_covariance(rig: Rig, covariance: Array, points: Array, weights: Array) -> Array:
    """Return the covariance (n, 3, 3) [m^2] of points (n, 3) [m] due to the calibration's error.

    ``weights`` (c, n): 1 / sigma^2 [1/px^2] with which each camera measures each point, 0 where it does not see it.
    NaN where fewer than two cameras see the point.
    """
    total = np.zeros((len(points), 3, 3))
    pull = np.zeros((len(points), 3, covariance.shape[0]))
    for c, camera in enumerate(rig.cameras):
        rows = np.flatnonzero(weights[c] > 0)
        one = project_with_jacobians(camera, points[rows])
        weighted = np.swapaxes(one.by_point, 1, 2) * weights[c, rows, None, None]
        total[rows] += weighted @ one.by_point
        by_own = np.concatenate([one.by_pose, one.by_lens[:, :, LENS_COLUMNS]], axis=2)
        pull[rows, :, c * OWN : (c + 1) * OWN] += weighted @ by_own
    good = (weights > 0).sum(axis=0) >= 2
    shift = np.full(pull.shape, np.nan)
    shift[good] = np.linalg.solve(total[good], pull[good])
    return np.asarray(shift @ covariance @ np.swapaxes(shift, 1, 2))
