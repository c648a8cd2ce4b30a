"""Space resection of one calibrated camera, frame by frame, from coded targets at known positions.

The adjustment uses the collinearity equations with the camera's own lens model (Mosca paper, section 2.2; Luhmann
2014, section 4.2.3). There are six unknowns; residuals x - x(pose) are weighted by the covariance of the image plus
that of the targets' positions projected into it. The start comes from ``target_pose``. Errors of lens and targets are
the same in every frame and are kept separate (``camera_path``): pose error = -(J^T W J)^-1 J^T W (dx/dp) dp.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from mosca.calibration.initial.target_pose import poses_of
from mosca.calibration.quality.jacobian import sensitivity
from mosca.camera.eccentricity import eccentricity_px
from mosca.camera.projection import lens_directions, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses
from mosca.data.calibration import Calibration
from mosca.data.distributions import chi2
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.rotations import quaternion_from_rotation, rotation_from_vector
from mosca.data.targets import CodedTarget, TestField
from mosca.errors import InputError
from mosca.machines.self_orientation.camera_path import CameraPath, SharedErrors
from mosca.machines.self_orientation.shutter import TargetImages, at_central_row

FEWEST_TARGETS = 4
STEPS = 20
SETTLED = 1e-10
"""Largest change of position [m] or rotation [rad] at convergence."""
MEDIAN_CHI2 = 2 * float(np.log(2))
"""Median of chi squared with two degrees of freedom."""
LEAST_SIGMA_PX = 0.003
"""Least standard deviation of a centre (as in ``mosca.calibration.rigid_target``)."""


@dataclass(frozen=True)
class ResectionSettings:
    """Conditions under which a frame gives a pose."""

    fewest: int = 6
    """Least number of targets; four determine a pose, more reveal a wrong target."""
    reject: float = 0.001
    """Chance that a good image is rejected."""
    row_time_s: float = 0.0
    """Delay from row to row of a rolling shutter [s]; 0: all rows are exposed at once."""

    def __post_init__(self) -> None:
        if self.fewest < FEWEST_TARGETS:
            raise InputError(
                f"fewest = {self.fewest} given; {FEWEST_TARGETS} or more targets determine a pose: raise it"
            )


@dataclass(frozen=True, eq=False)
class Resected:
    """The camera's poses, and the fit of the images."""

    path: CameraPath
    frame: Array
    """(n,) the camera's frame numbers."""
    targets: Array
    """(n,) number of target images used."""
    residual_px: Array
    """(n,) rms residual of an image coordinate."""
    sigma0: float
    """Standard deviation of unit weight over all frames: 1 where the stated errors are right."""
    withheld: int
    """Number of frames with targets, of which too few agree."""
    rejected: int = 0
    """Number of target images left out as blunders."""
    used: tuple[Array, ...] = field(default=())
    """For each pose, the numbers of the targets that it is based on."""

    def poses(self, name: str) -> BodyPoses:
        """Return the poses as those of a body ``name``, for files; the covariance includes shared errors."""
        n = len(self.path)
        return BodyPoses(
            self.frame,
            self.path.time_ns,
            np.full(n, name),
            np.array([quaternion_from_rotation(r) for r in self.path.rotation]).reshape(n, 4),
            self.path.position,
            self.path.total_covariance(),
            self.targets,
            np.full(n, np.nan),
            np.full(n, "measured"),
        )


@dataclass(frozen=True, eq=False)
class LensErrors:
    """Covariance (k, k) of the lens parameters ``names`` (k) of a calibrated camera."""

    names: tuple[str, ...]
    covariance: Array

    @classmethod
    def of(cls, calibration: Calibration, camera: str) -> "LensErrors":
        """Return the lens errors of a calibration's camera, without those of its pose."""
        lens = vars(calibration.rig.camera(camera).lens)
        rows = [k for k, name in enumerate(calibration.parameters) if _lens_name(name, camera, lens)]
        names = tuple(calibration.parameters[k].rpartition(".")[2] for k in rows)
        return cls(names, calibration.covariance[np.ix_(rows, rows)])


def _lens_name(name: str, camera: str, lens: dict[str, float]) -> bool:
    whose, _, what = name.rpartition(".")
    return whose == camera and (what in lens or what == "f_px")


@dataclass(frozen=True, eq=False)
class _Fit:
    pose: Pose
    covariance: Array
    """(6, 6) from the images alone."""
    by_parameter: Array
    """(6, 3 m + k)"""
    chi2: float
    used: Array
    residual_px: float


def resect_frames(
    seen: Sequence[TargetImages],
    camera: Camera,
    targets: TestField,
    lens_errors: LensErrors | None = None,
    settings: ResectionSettings | None = None,
) -> Resected:
    """Return the camera's pose in the test field's frame, for each of the frames ``seen`` that gives one.

    ``camera``: only its lens is used; ``lens_errors``: None, for unknown, leaves them out of the covariance. With a
    rolling shutter the images are corrected to the instant of the central row (``shutter``). InputError where no
    frame gives a pose.
    """
    settings = settings or ResectionSettings()
    solver = _Solver(camera, targets, lens_errors or LensErrors((), np.zeros((0, 0))), settings)
    frames = list(seen)
    for one in range(2 if settings.row_time_s else 1):
        fits = solver.fits(frames)
        if not any(fits):
            most = max((len(images.number) for images in seen), default=0)
            raise InputError(
                f"camera '{camera.name}': none of {len(seen)} frames gives a pose: {settings.fewest} targets of the "
                f"field that agree are wanted, the most seen were {most}; is it this field, and this camera's lens?"
            )
        if settings.row_time_s and one == 0:
            poses = [None if fit is None else fit.pose for fit in fits]
            frames = at_central_row(seen, poses, camera, solver.place_of, settings.row_time_s)
    return solver.resected(frames, fits)


class _Solver:
    def __init__(self, camera: Camera, targets: TestField, lens: LensErrors, settings: ResectionSettings) -> None:
        coded = [(k, one.target) for k, one in enumerate(targets.targets) if isinstance(one.target, CodedTarget)]
        self.row_of = {one.number: k for k, one in coded}
        self.xyz = targets.positions
        self.normals = np.array([one.normal for one in targets.targets])
        self.radii = np.array([getattr(one.target, "dot_radius_m", np.nan) for one in targets.targets])
        self.camera, self.sigma_m, self.lens, self.settings = camera, targets.sigma_m, lens, settings
        self.place_of = {number: self.xyz[k] for number, k in self.row_of.items()}
        self._rejected = 0

    def fits(self, frames: Sequence[TargetImages]) -> list[_Fit | None]:
        self._rejected = 0
        found: list[_Fit | None] = []
        last: Pose | None = None
        for images in frames:
            fit = self._fit(images, last)
            last = None if fit is None else fit.pose
            found.append(fit)
        return found

    def resected(self, frames: Sequence[TargetImages], fits: Sequence[_Fit | None]) -> Resected:
        kept = [(images, fit) for images, fit in zip(frames, fits, strict=True) if fit is not None]
        freedom = sum(2 * len(fit.used) - 6 for _, fit in kept)
        sigma0 = float(np.sqrt(sum(fit.chi2 for _, fit in kept) / freedom)) if freedom else 1.0
        m = 3 * len(self.xyz)
        names = (
            *(f"target {k} {axis}" for k in self.row_of for axis in "xyz"),
            *(f"lens {n}" for n in self.lens.names),
        )
        shared = SharedErrors(names, block_diag(self.sigma_m**2 * np.eye(m), self.lens.covariance))
        path = CameraPath(
            np.array([images.time_ns for images, _ in kept]),
            np.array([fit.pose.rotation for _, fit in kept]),
            np.array([fit.pose.translation for _, fit in kept]),
            max(1.0, sigma0) ** 2 * np.array([fit.covariance for _, fit in kept]),
            shared,
            np.array([fit.by_parameter for _, fit in kept]),
        )
        return Resected(
            path,
            np.array([images.frame for images, _ in kept]),
            np.array([len(fit.used) for _, fit in kept]),
            np.array([fit.residual_px for _, fit in kept]),
            sigma0,
            sum(fit is None and len(images.number) > 0 for images, fit in zip(frames, fits, strict=True)),
            self._rejected,
            tuple(fit.used for _, fit in kept),
        )

    def _fit(self, images: TargetImages, last: Pose | None) -> _Fit | None:
        known = np.array([number in self.row_of for number in images.number.tolist()], dtype=bool)
        number, xy = images.number[known], images.xy_px[known]
        rows = np.array([self.row_of[k] for k in number.tolist()], dtype=np.int64)
        noise = images.covariance_px2[known] + (self.camera.residual_px**2 + LEAST_SIGMA_PX**2) * np.eye(2)
        pose = self._start(xy, rows, last)
        limit = float(chi2.ppf(1 - self.settings.reject, 2))
        while pose is not None and len(rows) >= self.settings.fewest:
            found = self._adjusted(pose, xy, rows, noise)
            if found is None:
                return None
            pose, jacobian, weight, rest, by_point = found
            # an image affects the pose and so its own residual, whose covariance is W^-1 - J N^-1 J^T
            inverse = np.linalg.inv(np.einsum("nki,nkl,nlj->ij", jacobian, weight, jacobian))
            left = np.linalg.inv(weight) - jacobian @ inverse @ np.swapaxes(jacobian, 1, 2)
            size = np.einsum("ni,nij,nj->n", rest, np.linalg.pinv(left), rest)
            worst = int(np.argmax(size))
            # where all images fit worse than stated (a shutter that is not corrected yet), none of them is a blunder
            if size[worst] <= limit * max(1.0, float(np.median(size)) / MEDIAN_CHI2) or len(rows) == FEWEST_TARGETS:
                return self._kept(pose, inverse, jacobian, weight, rest, by_point, rows, number, noise)
            keep = np.arange(len(rows)) != worst
            self._rejected += 1
            xy, rows, noise, number = xy[keep], rows[keep], noise[keep], number[keep]
        return None

    def _start(self, xy: Array, rows: Array, last: Pose | None) -> Pose | None:
        if len(rows) < self.settings.fewest:
            return None
        fits = poses_of(lens_directions(self.camera.lens, xy), self.xyz[rows])
        if not fits:
            return last
        best = fits[0]
        if last is not None and len(fits) > 1 and fits[1].rms_rad < 2 * fits[0].rms_rad:
            # of two poses of a plane that fit about equally, take the one nearer to the last frame's
            best = min(fits, key=lambda f: float(np.linalg.norm(f.camera_from_target.rotation.T - last.rotation)))
        return best.camera_from_target.inverse()

    def _adjusted(
        self, pose: Pose, xy: Array, rows: Array, noise: Array
    ) -> tuple[Pose, Array, Array, Array, Array] | None:
        """Return the pose, Jacobians (n, 2, 6) by position and rotation about the frame's axes, weights (n, 2, 2),
        residuals (n, 2) and Jacobians by the points (n, 2, 3); None where the points do not determine the pose.
        """
        points = self.xyz[rows]
        for _ in range(STEPS):
            at = replace(self.camera, world_from_camera=pose)
            projected = project_with_jacobians(at, points)
            offset = eccentricity_px(at, points, self.normals[rows], self.radii[rows])
            rest = xy - np.nan_to_num(offset) - projected.xy_px
            if not np.isfinite(rest).all():
                return None
            # R exp([w]x) = exp([R w]x) R: rotation about the frame's axes
            jacobian = np.concatenate(
                [projected.by_pose[:, :, 3:], projected.by_pose[:, :, :3] @ pose.rotation.T], axis=2
            )
            carried = self.sigma_m**2 * projected.by_point @ np.swapaxes(projected.by_point, 1, 2)
            weight = np.linalg.inv(noise + carried)
            normal = np.einsum("nki,nkl,nlj->ij", jacobian, weight, jacobian)
            if np.linalg.cond(normal) > 1e14:
                return None
            step = np.linalg.solve(normal, np.einsum("nki,nkl,nl->i", jacobian, weight, rest))
            pose = Pose(rotation_from_vector(step[3:]) @ pose.rotation, pose.translation + step[:3])
            if np.abs(step).max() < SETTLED:
                break
        return pose, jacobian, weight, rest, projected.by_point

    def _kept(
        self,
        pose: Pose,
        inverse: Array,
        jacobian: Array,
        weight: Array,
        rest: Array,
        by_point: Array,
        rows: Array,
        number: Array,
        noise: Array,
    ) -> _Fit:
        pull = np.einsum("ij,nkj,nkl->nil", inverse, jacobian, weight)  # (n, 6, 2): derivative of pose by image
        own = np.einsum("nik,nkl,njl->ij", pull, noise, pull)
        by_targets = np.zeros((6, len(self.xyz), 3))
        by_targets[:, rows] = np.swapaxes(pull @ by_point, 0, 1)
        camera = replace(self.camera, world_from_camera=pose)
        wanted = tuple(f"{camera.name}.{name}" for name in self.lens.names)
        by_lens = sensitivity(Rig((camera,)), 0, wanted, self.xyz[rows]).by_parameter
        # the error is true minus measured: if a target or lens is stated too large by d, the pose moves by -pull d,
        # so that the true pose lies pull d from it
        shared = np.hstack([by_targets.reshape(6, -1), np.einsum("nik,nkp->ip", pull, by_lens)])
        size = float(np.einsum("ni,nij,nj->", rest, weight, rest))
        return _Fit(pose, own, shared, size, number, float(np.sqrt(np.mean(rest**2))))
