"""Fit of a skeleton to a take: joint places, marker places and all poses in one sparse least squares.

Poses are eliminated frame by frame (Schur complement, as camera poses in a bundle adjustment); the remaining system
has only the parameters as unknowns. How far each marker moves on the skin is estimated from its residuals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from mosca.data.arrays import Array, set_read_only
from mosca.errors import InputError
from mosca.skeleton.joints import SegmentAxes, fitted_axes
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import Kinematics, SkeletonModel
from mosca.skeleton.pose import TINY, PoseSolution, limited, linearised, pose_by_parameters, solve_pose
from mosca.skeleton.skin import common_m, common_modes
from mosca.skeleton.start import size_of, starting_pose

FRAMES = 150
"""Frames that a fit reads, evenly spread."""
LEAST_SEEN = 0.6
"""Least share of the markers that a frame must show to be fitted."""
FIRST_SKIN_M = 0.01
"""Movement on the skin assumed at first [m]."""
LEAST_SIGMA_M = 2e-5
"""Least standard deviation of a marker against its body [m]: below any rig's noise; it keeps weights finite."""
ROUNDS, ITERATIONS = 8, 12
"""Most estimates of the skin's movement, and most steps of the fit for each of them."""
LEAST_REDUNDANCY = 0.1
"""Least redundancy of a marker (share of its error that its residual shows): divided by less, it is noise alone."""
POOLED = 20.0
"""Degrees of freedom with which the median over all markers is weighted in each marker's movement on the skin."""
SIGNIFICANT = 3.0
"""Standard deviations by which residuals must exceed the measurement's covariance to be movement on the skin."""
POSTURES = 6.0
"""Independent postures of a take for a marker on moving skin: it slides with the neighbouring joint's three
rotations, to either side, and a repeated movement repeats the slide, so that frames in between add nothing."""
SETTLED = 0.3
"""Predicted decrease of chi squared by a step below which a fit has converged: a small part of one sigma."""


@dataclass(frozen=True, eq=False)
class FittedSubject:
    """A model fitted to one person.

    ``parameters`` (p,) as in ``model`` [m], with ``covariance`` (p, p) [m^2]; ``skin_m`` (m,) standard deviation of
    each marker against its body, per coordinate [m]; ``size`` relative to the given model; ``q`` (nq,) a pose of the
    take as a starting value for others; ``posture`` (nv,) the mean of the take's rotation vectors [rad]; ``axes`` of
    the segments; ``residual_rms_m`` of all markers.
    """

    model: SkeletonModel
    parameters: Array
    covariance: Array
    skin_m: Array
    size: float
    q: Array
    posture: Array
    axes: SegmentAxes
    residual_rms_m: float
    frames: int

    def __post_init__(self) -> None:
        p = len(self.model.parameters)
        set_read_only(self, parameters=(p,), covariance=(p, p), skin_m=(len(self.model.labels),))
        set_read_only(self, q=(None,), posture=(None,))


def fit_subject(
    model: SkeletonModel,
    frames: MarkerFrames,
    source: str = "tracks",
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> FittedSubject:
    """Return ``model`` fitted to the person in ``frames``, whose labels are the model's.

    The take must move every joint that is to be found: what it does not determine is taken from the model's
    proportions, and the covariance shows this. InputError, naming ``source``, where the markers are too few or of
    the wrong size.
    """
    full = np.flatnonzero(frames.seen.mean(axis=1) >= LEAST_SEEN)
    if len(full) < 2:
        raise InputError(
            f"{source}: {len(full)} frames show {LEAST_SEEN:.0%} of the markers; two or more are wanted: label more "
            "of the tracks"
        )
    chosen = frames.select(full[np.unique(np.linspace(0, len(full) - 1, FRAMES).round().astype(int))])
    size = size_of(model, chosen, source)
    scaled = replace(model, parameters=model.parameters * size, information=model.information / size**2)
    adjustment = SkeletonAdjustment(scaled, chosen)
    for done in range(ROUNDS):
        progress(done, ROUNDS)
        adjustment.converge()
        if not adjustment.update_skin():
            break
    progress(ROUNDS, ROUNDS)
    return adjustment.subject(size)


class SkeletonAdjustment:
    """Poses and parameters of a fit, improved in place."""

    def __init__(self, model: SkeletonModel, frames: MarkerFrames) -> None:
        self.model, self.frames = model, frames
        self.kinematics = Kinematics(model)
        self.parameters = np.array(model.parameters)
        self.skin = np.full(len(model.labels), FIRST_SKIN_M)
        self.correlated = 1.0
        self.last: Equations
        fullest = int(frames.seen.sum(axis=1).argmax())
        poses = {fullest: starting_pose(self.kinematics, frames.xyz[fullest]).q}
        order = [*range(fullest - 1, -1, -1), *range(fullest + 1, len(frames))]
        information = self._information(np.full(len(model.labels), 0.025))
        for k in order:
            near = k + 1 if k < fullest else k - 1
            poses[k] = self._started(k, poses[near], information[k])
        self.q = [poses[k] for k in range(len(frames))]

    def _started(self, k: int, near: Array, information: Array) -> Array:
        """Return a pose of frame ``k``, started from its neighbour's pose or without one, whichever fits better."""
        xyz = self.frames.xyz[k]
        first = solve_pose(self.kinematics, near, xyz, information)
        if first.converged and (first.weight[self.frames.seen[k]] < 0.3).sum() <= 2:
            return first.q
        second = starting_pose(self.kinematics, xyz)
        worst = [float(np.sum(s.residual[self.frames.seen[k]] ** 2)) for s in (first, second)]
        return first.q if worst[0] <= worst[1] else second.q

    def _information(self, skin: Array) -> Array:
        """Return the inverse covariances (n, m, 3, 3) of the markers against their bodies, 0 where not seen."""
        sigma = np.maximum(skin, LEAST_SIGMA_M)
        total = self.frames.covariance + sigma[:, None, None] ** 2 * np.eye(3)
        return np.where(self.frames.seen[:, :, None, None], np.linalg.inv(total), 0.0)

    def converge(self) -> None:
        """Improve poses and parameters until they settle: Levenberg-Marquardt over all of them."""
        information = self._information(self.skin)
        best, damping = self._linearise(information), 0.0
        for _ in range(ITERATIONS):
            before = np.array(self.parameters), list(self.q)
            promised = self._move(best, damping)
            trial = self._linearise(information)
            if trial.cost > best.cost + SETTLED:
                self.parameters, self.q = before
                damping = max(4 * damping, 1e-3)
                continue
            best, damping = trial, (damping / 3 if damping > 1e-5 else 0.0)
            if promised < SETTLED:
                break
        self.last = best
        self.kinematics.set_parameters(self.parameters)

    def _linearise(self, information: Array) -> "Equations":
        """Return the equations of all frames at the present poses and parameters."""
        self.kinematics.set_parameters(self.parameters)
        off = self.model.parameters - self.parameters
        normal, gradient = np.array(self.model.information), self.model.information @ off
        cost = float(off @ gradient)
        mean = np.mean([self.kinematics.rotation_vectors(q)[0] for q in self.q], axis=0)
        posture = np.concatenate([np.zeros(6), mean.ravel()])
        frames = []
        for k, q in enumerate(self.q):
            given = (q, self.frames.xyz[k], information[k])
            at = linearised(self.kinematics, *given, posture=posture, share=1 / len(self.q))
            part = reduced(self.kinematics, at)
            normal += part.normal / self.correlated
            gradient += part.gradient / self.correlated
            cost += at.cost / self.correlated
            frames.append(part)
        return Equations(normal, gradient, cost, posture, frames)

    def _move(self, at: "Equations", damping: float) -> float:
        """Take a step of poses and parameters; return the predicted decrease of the cost."""
        normal = at.normal + damping * np.diag(np.diag(at.normal))
        step = np.asarray(cho_solve(cho_factor(normal), at.gradient))
        self.parameters = self.parameters + step
        for k, part in enumerate(at.frames):
            # Undamped: poses that do not follow the parameters raise the cost, however small the step is.
            moved = limited(part.pose_step - part.follow(step))
            self.q[k] = self.kinematics.moved(self.q[k], moved)
        return float(at.gradient @ step) + sum(part.decrease for part in at.frames) / self.correlated

    def update_skin(self) -> bool:
        """Estimate each marker's movement on the skin from the residuals; return whether it has changed much."""
        seen = self.frames.seen
        count = np.maximum(seen.sum(axis=0), 1)
        residuals = np.stack([part.weighted_residual for part in self.last.frames])
        residuals[~seen] = np.nan
        share = np.where(seen, np.stack([part.redundancy for part in self.last.frames]), 0).sum(axis=0) / count
        share = np.clip(share, LEAST_REDUNDANCY, 1.0)
        square = np.nansum(residuals**2, axis=(0, 2)) / count / 3 / share
        # A marker has few independent residuals, as they are correlated: those of all markers stabilise the estimate.
        together = _correlation_length(residuals)
        own = 3 * share * count / together
        square = (own * square + POOLED * np.median(square)) / (own + POOLED)
        measured = np.trace(self.frames.covariance, axis1=2, axis2=3).mean(axis=0) / 3
        # Noise alone varies by this factor: a smaller excess is no sign of movement.
        chance = 1 + SIGNIFICANT * np.sqrt(2 / (own + POOLED))
        new = np.sqrt(np.where(square > chance * measured, square - measured, 0.0))
        changed = np.abs(np.log((new**2 + measured) / (self.skin**2 + measured))).max() > 0.1
        self.skin = new
        moving = float(np.mean(new**2 / (new**2 + measured + LEAST_SIGMA_M**2)))
        self.correlated = together + moving * max(len(self.q) / POSTURES - together, 0.0)
        return bool(changed)

    def subject(self, size: float) -> FittedSubject:
        """Return the fitted subject."""
        at, seen = self.last, self.frames.seen
        squares = np.stack([np.sum(part.at.residual**2, axis=1) for part in at.frames])[seen]
        inverse = np.asarray(cho_solve(cho_factor(at.normal), np.eye(len(at.normal))))
        covariance = inverse + inverse @ self._common_movement() @ inverse
        axes = fitted_axes(self.kinematics, self.q, [-part.pose_by_parameters for part in at.frames])
        return FittedSubject(
            self.model, self.parameters, covariance, self.skin, size, self.q[len(self.q) // 2], at.posture, axes,
            float(np.sqrt(squares.mean())), len(self.q),
        )  # fmt: skip

    def _common_movement(self) -> Array:
        """Return the covariance (p, p) of the gradient that comes from segments whose markers slide together.

        A take has POSTURES independent slides. Their sum over n frames has n / POSTURES times the variance of n
        independent slides.
        """
        kinematics, body = self.kinematics, self.kinematics.body_of_marker
        modes = common_modes(kinematics.local, body, common_m(self.skin, body))
        information = self._information(self.skin)
        total = np.zeros((len(self.parameters), len(self.parameters)))
        for k, (q, part) in enumerate(zip(self.q, self.last.frames, strict=True)):
            at = linearised(kinematics, q, self.frames.xyz[k], information[k])
            rotations = kinematics.rotations()[body]
            shaped = at.weighted @ rotations @ modes
            by_joints = kinematics.by_parameters(body)
            of_body = rotations.transpose(0, 2, 1) @ shaped
            direct = np.concatenate(
                [np.einsum("mip,mik->pk", by_joints, shaped, optimize=True), of_body.reshape(-1, shaped.shape[2])]
            )
            of_pose = np.einsum("miv,mik->vk", at.slopes, shaped, optimize=True)
            moved = direct - part.mixed.T @ solve_triangular(part.root, of_pose, trans=1)
            total += moved @ moved.T
        return total * max(len(self.q) / POSTURES, 1.0) / self.correlated**2


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of the parameters with all poses eliminated: ``normal`` (p, p), ``gradient`` (p,), the
    ``cost``, the mean ``posture`` (nv,) and the ``frames``' own.
    """

    normal: Array
    gradient: Array
    cost: float
    posture: Array
    frames: "list[Reduced]"


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations of the parameters from one frame, the pose of its equations ``at`` eliminated.

    ``normal`` (p, p), ``gradient`` (p,); ``pose_step`` (nv,) is the pose's best step for unchanged parameters.
    ``root`` (nv, nv) is upper triangular, root' root is the pose's normal matrix; ``mixed`` (nv, p) is root'^-1 times
    the block of the pose with the parameters.
    """

    at: PoseSolution
    normal: Array
    gradient: Array
    pose_step: Array
    root: Array
    mixed: Array

    def follow(self, change: Array) -> Array:
        """Return the step (nv, ...) to subtract from ``pose_step`` for a ``change`` (p, ...) of the parameters."""
        return np.asarray(solve_triangular(self.root, self.mixed @ change))

    @property
    def pose_by_parameters(self) -> Array:
        """(nv, p): ``follow`` of each parameter."""
        return np.asarray(solve_triangular(self.root, self.mixed))

    @property
    def decrease(self) -> float:
        """Predicted decrease of the cost by ``pose_step``."""
        return float(self.at.gradient @ self.pose_step)

    @property
    def redundancy(self) -> Array:
        """(m,): share of a marker's error that its residual shows."""
        m, _, nv = self.at.slopes.shape
        half = solve_triangular(self.root, self.at.slopes.reshape(3 * m, nv).T, trans=1).T.reshape(m, 3, nv)
        return np.asarray(1 - np.sum((half @ half.transpose(0, 2, 1)) * self.at.weighted, axis=(1, 2)) / 3)

    @property
    def weighted_residual(self) -> Array:
        """(m, 3) residual times the square root of its weight [m]."""
        return np.asarray(np.sqrt(self.at.weight)[:, None] * self.at.residual)


def reduced(kinematics: Kinematics, at: PoseSolution) -> Reduced:
    """Eliminate the pose from the equations ``at``, where ``kinematics`` stands."""
    m, nv = len(at.weight), len(at.gradient)
    by_joints = kinematics.by_parameters(kinematics.body_of_marker)
    of_body = kinematics.rotations()[kinematics.body_of_marker]
    split = by_joints.shape[2]
    shaped_joints = (at.weighted @ by_joints).reshape(3 * m, split)
    shaped_markers = at.weighted @ of_body
    normal = np.zeros((split + 3 * m, split + 3 * m))
    normal[:split, :split] = by_joints.reshape(3 * m, split).T @ shaped_joints
    across = (by_joints.transpose(0, 2, 1) @ shaped_markers).transpose(1, 0, 2).reshape(split, 3 * m)
    normal[:split, split:], normal[split:, :split] = across, across.T
    rows = split + np.arange(3 * m).reshape(m, 3)
    normal[rows[:, :, None], rows[:, None, :]] = of_body.transpose(0, 2, 1) @ shaped_markers
    own = np.einsum("mij,mi->mj", shaped_markers, at.residual).ravel()
    gradient = np.concatenate([shaped_joints.T @ at.residual.ravel(), own])
    root = np.asarray(cholesky(at.normal + TINY * np.eye(nv)))
    block = pose_by_parameters(kinematics, at.slopes, at.weighted)
    half = np.asarray(solve_triangular(root, np.column_stack([block, at.gradient]), trans=1))
    mixed, right = half[:, :-1], half[:, -1]
    pose_step = np.asarray(solve_triangular(root, right))
    return Reduced(at, normal - mixed.T @ mixed, gradient - mixed.T @ right, pose_step, root, mixed)


def _correlation_length(residuals: Array) -> float:
    """Return how many successive residuals (n, m, 3) count as one: 1 + 2 times the sum of their autocorrelations."""
    series = np.nan_to_num(residuals - np.nanmean(residuals, axis=0))
    series = series / np.maximum(np.sqrt(np.mean(series**2, axis=0)), 1e-12)
    length, n = 1.0, len(series)
    for lag in range(1, n // 2):
        correlation = float(np.mean(series[lag:] * series[:-lag]))
        if correlation <= 0:
            break
        length += 2 * correlation
    return length
