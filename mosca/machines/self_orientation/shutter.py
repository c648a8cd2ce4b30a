"""Correction of a rolling shutter: images of targets are shifted to the instant of the image's central row.

The motion between frames is modelled by cubic splines through the poses at the central rows' instants (positions;
rotations by SciPy's RotationSpline). The poses are adjusted together (Gauss-Newton): every point is projected at its
own row's instant, and each pose affects the points of neighbouring frames by the spline's weights. Correcting the
poses of single frames in turn would fail: with a readout of a whole period, errors that alternate from frame to frame
grow from round to round.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_2D
from mosca.camera.lens_models.arrays import pixels
from mosca.camera.projection import cross_matrices, lens_pixels
from mosca.data.arrays import Array, set_read_only
from mosca.data.rig import Camera, Lens, Pose

AT_ENDS = 2
"""Frames at both ends of a stretch that give no pose: the motion before and after it is not known."""
FEWEST_IN_A_ROW = 2 * AT_ENDS + 1
"""Least number of poses of a stretch."""
STEPS = 8
SETTLED = 1e-7
"""Largest change of a position [m] or rotation [rad] at convergence: a ten-thousandth of a pixel."""
DAMPING = 1e-9
"""Share of its diagonal that is added to the normal matrix: a frame that no point determines keeps its pose."""
LEAST_WEIGHT = 1e-4
"""Weights of a spline's knots below this are left out: they fall by a factor of 3.7 from knot to knot."""
LONGEST_GAP = 1.5
"""Gap between poses, in median periods, above which a stretch ends."""


@dataclass(frozen=True, eq=False)
class TargetImages:
    """The targets in one frame: numbers (n,) of coded targets, their centres (n, 2) [px] and covariance (n, 2, 2)."""

    frame: int
    time_ns: int
    """Mid-exposure of the central row."""
    number: Array
    xy_px: Array
    covariance_px2: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.number))
        set_read_only(self, np.int64, number=(n,))
        set_read_only(self, xy_px=(n, 2), covariance_px2=(n, 2, 2))


def at_central_row(
    seen: Sequence[TargetImages],
    poses: Sequence[Pose | None],
    camera: Camera,
    place_of: Mapping[int, Array],
    row_time_s: float,
) -> list[TargetImages]:
    """Return the images as if all rows had been exposed together with the central one.

    Frames of unknown motion get no images: the first two and the last two of a stretch with poses. ``poses``
    (world_from_camera) of the frames, None where there is none; ``place_of``: number of a target -> its place (3,)
    [m].
    """
    nothing = np.zeros(0)
    out = [TargetImages(one.frame, one.time_ns, nothing, np.zeros((0, 2)), np.zeros((0, 2, 2))) for one in seen]
    for stretch in _stretches(seen, poses):
        there = [pose for pose in (poses[k] for k in stretch) if pose is not None]
        time_s = np.array([seen[k].time_ns - seen[stretch[0]].time_ns for k in stretch]) * 1e-9
        points = _points(seen, stretch, time_s, camera, place_of, row_time_s)
        motion = _adjusted(_Motion.through(time_s, there), points, camera.lens)
        shift = motion.images(points.time_s, points.xyz, camera.lens)
        shift -= motion.images(time_s[points.frame], points.xyz, camera.lens)
        for number, k in list(enumerate(stretch))[AT_ENDS:-AT_ENDS]:
            mine = points.frame == number
            xy = seen[k].xy_px.copy()
            xy[points.row[mine]] -= np.nan_to_num(shift[mine])
            out[k] = replace(seen[k], xy_px=xy)
    return out


@dataclass(frozen=True, eq=False)
class _Points:
    """Image points of a stretch: index of the frame in it, index in the frame, own instant [s], image, place."""

    frame: Array
    row: Array
    time_s: Array
    xy_px: Array
    xyz: Array


def _points(
    seen: Sequence[TargetImages],
    stretch: Sequence[int],
    time_s: Array,
    camera: Camera,
    place_of: Mapping[int, Array],
    row_time_s: float,
) -> _Points:
    frame, row, xyz = [], [], []
    for number, k in enumerate(stretch):
        for at, target in enumerate(seen[k].number.tolist()):
            if target in place_of:
                frame.append(number)
                row.append(at)
                xyz.append(place_of[target])
    frames, rows = np.array(frame, dtype=np.int64), np.array(row, dtype=np.int64)
    xy = np.array([seen[stretch[f]].xy_px[r] for f, r in zip(frame, row, strict=True)]).reshape(-1, 2)
    late = (xy[:, 1] - (camera.height - 1) / 2) * row_time_s
    return _Points(frames, rows, time_s[frames] + late, xy, np.array(xyz).reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class _Motion:
    """Splines through poses at n instants."""

    time_s: Array
    rotation: Array
    position: Array

    @classmethod
    def through(cls, time_s: Array, poses: Sequence[Pose]) -> "_Motion":
        return cls(time_s, np.array([one.rotation for one in poses]), np.array([one.translation for one in poses]))

    def seen_from(self, at_s: Array, xyz: Array) -> tuple[Array, Array]:
        """Return points (m, 3) in the camera's frame at instants (m,), and world_from_camera (m, 3, 3)."""
        turn = RotationSpline(self.time_s, Rotation.from_matrix(self.rotation))(at_s).as_matrix()
        away = xyz - CubicSpline(self.time_s, self.position, bc_type="natural")(at_s)
        return np.einsum("nji,nj->ni", turn, away), turn

    def images(self, at_s: Array, xyz: Array, lens: Lens) -> Array:
        """Return the images (m, 2) of points (m, 3) at instants (m,)."""
        return lens_pixels(lens, self.seen_from(at_s, xyz)[0])

    def moved(self, by: Array) -> "_Motion":
        """Return the motion with its poses changed by (n, 6): positions, rotation vectors about the world's axes."""
        turn = Rotation.from_rotvec(by[:, 3:]).as_matrix()
        return _Motion(self.time_s, turn @ self.rotation, self.position + by[:, :3])


def _adjusted(motion: _Motion, points: _Points, lens: Lens) -> _Motion:
    """Return the motion that fits the image points best, each at its own instant."""
    n = len(motion.time_s)
    between = (points.time_s >= motion.time_s[0]) & (points.time_s <= motion.time_s[-1])
    weights = CubicSpline(motion.time_s, np.eye(n), bc_type="natural")(points.time_s)
    point, knot = np.nonzero(np.abs(weights) > LEAST_WEIGHT)
    rows = (2 * point[:, None, None] + np.arange(2)[:, None]).repeat(6, axis=2)
    columns = (6 * knot[:, None, None] + np.arange(6)).repeat(2, axis=1)
    for _ in range(STEPS):
        there, turn = motion.seen_from(points.time_s, points.xyz)
        xy, by_direction, _ = pixels(lens, there)
        # if a camera moves by d and turns by exp([r]), R^T (X - p) changes by R^T ([X - p]x r - d)
        by_position = -by_direction @ np.swapaxes(turn, 1, 2)
        by_rotation = -by_position @ cross_matrices(np.einsum("nij,nj->ni", turn, there))
        jacobian = np.concatenate([by_position, by_rotation], axis=2)
        rest = points.xy_px - xy
        good = between & np.isfinite(rest).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
        jacobian, rest = np.where(good[:, None, None], jacobian, 0.0), np.where(good[:, None], rest, 0.0)
        # blunders are down-weighted by Huber's function beyond three robust standard deviations
        size = np.linalg.norm(rest, axis=1)
        limit = 3 * SIGMA_BY_MEDIAN_2D * float(np.median(size[good]))
        root = np.sqrt(np.minimum(1.0, limit / np.maximum(size, 1e-12)))[:, None]
        values = weights[point, knot][:, None, None] * (root[:, None] * jacobian)[point]
        design = sparse.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), (2 * len(rest), 6 * n))
        normal = (design.T @ design).toarray()
        normal[np.diag_indices(6 * n)] *= 1 + DAMPING
        step = np.linalg.solve(normal, design.T @ (root * rest).ravel()).reshape(n, 6)
        motion = motion.moved(step)
        if np.abs(step).max() < SETTLED:
            break
    return motion


def _stretches(seen: Sequence[TargetImages], poses: Sequence[Pose | None]) -> list[list[int]]:
    """Return the runs of frames that have poses, without gaps, long enough for a spline."""
    there = [k for k, pose in enumerate(poses) if pose is not None]
    if len(there) < FEWEST_IN_A_ROW:
        return []
    steps = np.diff([seen[k].time_ns for k in there])
    ends = np.flatnonzero(steps > LONGEST_GAP * np.median(steps)) + 1
    return [part.tolist() for part in np.split(np.array(there), ends) if len(part) >= FEWEST_IN_A_ROW]
