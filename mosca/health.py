"""How a running rig is doing, camera by camera: residuals, what connects, what is missing, whose clock lags.

And how large the errors of image points really are. A detection's covariance holds the noise of its pixels alone;
the camera's body shakes, its trigger jitters, its lens is not quite what the calibration says. These are learned
from the residuals themselves: with weights W = S^-1, S an image's whole covariance, and J the change of its place
with the point's, what is left of its error after the point is fitted has the trace ``tr (S - J P J')``,
P = (sum J' W J)^-1. Squared residuals regressed on it give the variance that each camera adds and, as the part that
grows with the square of the image's speed, the jitter of the triggers (variance components, Foerstner 1979).

A camera that exposes d seconds late shows every point u d farther on, u its image's speed: d follows from the same
residuals by least squares. All cameras late by the same is a shift of time that nothing tells: offsets are against
their mean. How certain an offset is follows from the scatter of whole frame sets about it (White 1980), since a
body's shake moves all images of a set together.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rig import Rig
from mosca.data.tracks import Points
from mosca.ray_kernels import ANGLE, DIRECTION, RADIUS, WHITE
from mosca.triangulate import Bundle, bundle_rays

START_SETS = 200
"""Frame sets in which much is to be learned."""
CLOCK_LOOKS = 1000
"""Looks from which offsets of clocks are drawn."""
FARTHEST_SIGMAS = 5.0
"""Images farther from their point say nothing of the usual error."""
ALIKE_LOOKS, START_LOOKS = 6.0, 0.5
"""What is known beforehand counts as so many looks: that cameras of a rig shake alike to about half, and
``start_px``. A body shakes all images of a set together: a look has one or two independent residuals a camera."""


@dataclass(frozen=True)
class HealthSettings:
    """``every``: frame sets from one look at the residuals to the next, ``seldom`` after the first ``START_SETS``;
    ``most_points`` of a set are looked at, others each time. ``memory``: looks after which an old one
    counts 1/e. ``start_px``: random error of image points besides detection noise until it is learned, and
    ``least_px`` below which it is not taken. ``least_images``: of a camera, before anything is said of its clock
    and its connections.
    ``farthest_m``: how far a point may move from set to set to have a speed. ``late_s``: clock offsets below this are
    let pass, and ``certain_sigma``: by how many standard deviations one must be sure. ``poor_share``: of a camera's
    detections that connect, below which it is told of. ``block_s``: length of the residuals' time blocks.
    ``adopt_px``: how far from its point an image may lie that matching left out, to be asked whether its camera is
    late.
    """

    every: int = 2
    seldom: int = 10
    most_points: int = 20
    memory: float = 400.0
    start_px: float = 0.06
    least_px: float = 0.005
    least_images: float = 300.0
    farthest_m: float = 0.1
    late_s: float = 100e-6
    certain_sigma: float = 6.0
    poor_share: float = 0.5
    block_s: float = 1.0
    adopt_px: float = 3.0


@dataclass(frozen=True, eq=False)
class Noise:
    """Error of image points besides detection noise: ``sigma_px`` (c,) an axis, of each camera, what was learned and
    what the calibration says that its lens model leaves; ``jitter_s`` of the triggers.
    """

    sigma_px: Array
    jitter_s: float


@dataclass(frozen=True)
class CameraHealth:
    """One camera since the start: ``residual_px`` rms an axis of late; ``extra_px`` error besides detection noise;
    ``connected``: share of its detections that became part of points; ``missing``: share of frame sets without it;
    ``late_s`` how much later than the mean of all cameras it exposes, with its standard deviation (NaN: unknown).
    ``residuals_px``: rms of each block of time.
    """

    name: str
    residual_px: float
    extra_px: float
    connected: float
    missing: float
    late_s: float
    late_sigma_s: float
    residuals_px: tuple[float, ...]


class Health:
    """Watches the points of a running pipeline. ``attend`` takes each frame set; ``noise`` is what was learned.

    ``nameless``: samples that had no identity yet when the run ended.
    """

    def __init__(self, rig: Rig, settings: HealthSettings | None = None) -> None:
        self.settings = settings or HealthSettings()
        self._names = rig.names
        c = len(rig.cameras)
        self.noise = Noise(np.full(c, self.settings.start_px), 0.0)
        # of the lens's misfit the points take up most: little of it shows in residuals
        self._lens_px = np.array([camera.residual_px for camera in rig.cameras])
        self._looks = 0.0
        self._sets = 0
        self._missing, self._detected, self._connected = np.zeros(c), np.zeros(c), np.zeros(c)
        self._before: tuple[float, Array] | None = None
        self._normal, self._right = np.zeros((c + 1, c + 1)), np.zeros(c + 1)
        self._clocks: deque[tuple[Array, Array, Array]] = deque(maxlen=CLOCK_LOOKS)
        self._square, self._images = np.zeros(c), np.zeros(c)
        self._blocks: dict[int, Array] = {}
        self.nameless = 0

    def attend(
        self, rig: Rig, frame_set: FrameSet, detections: Mapping[str, Detections], points: Points
    ) -> None:
        """Take a frame set's points and the detections that they were made of; ``rig``: that they were made with."""
        time_s = frame_set.time_ns * 1e-9
        self._sets += 1
        self._missing += [name not in detections for name in self._names]
        self._detected += [len(detections[n]) if n in detections else 0 for n in self._names]
        if len(points):
            self._connected += (points.rays >= 0).sum(axis=0)
        s = self.settings
        if self._sets % (s.every if self._sets <= START_SETS else s.seldom) == 0 and len(points):
            self._look(rig, time_s, detections, points)
        self._before = (time_s, points.xyz)

    def cameras(self) -> tuple[CameraHealth, ...]:
        """Return how each camera is doing."""
        late, sigma = self._offsets()
        rms = np.sqrt(self._square / np.maximum(2 * self._images, 1))
        share = np.minimum(self._connected / np.maximum(self._detected, 1), 1.0)
        missing = self._missing / max(self._sets, 1)
        blocks = [np.sqrt(b[0] / np.maximum(2 * b[1], 1)) for _, b in sorted(self._blocks.items())]
        return tuple(
            CameraHealth(
                name, float(rms[k]), float(self.noise.sigma_px[k]), float(share[k]), float(missing[k]),
                float(late[k]), float(sigma[k]), tuple(float(b[k]) for b in blocks),
            )
            for k, name in enumerate(self._names)
        )  # fmt: skip

    def findings(self) -> tuple[str, ...]:
        """Return what a person should look at, a line each."""
        s, told = self.settings, []
        cameras = self.cameras()
        poor = [
            self._detected[k] >= s.least_images and one.connected < s.poor_share
            for k, one in enumerate(cameras)
        ]
        for k, one in enumerate(cameras):
            # a camera that was moved shows its points displaced, as one that is late does
            if not any(poor) and abs(one.late_s) > max(s.late_s, s.certain_sigma * one.late_sigma_s):
                when = "later" if one.late_s > 0 else "earlier"
                told.append(
                    f"camera '{one.name}' exposes {1e3 * abs(one.late_s):.2f} ms {when} than the others' mean "
                    f"(+- {1e3 * 2 * one.late_sigma_s:.2f}): check its trigger and its clock"
                )
            if poor[k]:
                told.append(
                    f"camera '{one.name}': only {100 * one.connected:.0f} % of {self._detected[k]:.0f} detections "
                    "meet other cameras': look for reflections, bright clothes, or a camera that was moved"
                )
        return tuple(told)

    def _look(self, rig: Rig, time_s: float, detections: Mapping[str, Detections], points: Points) -> None:
        speed, known = self._speeds(time_s, points.xyz)
        step = -(-len(points) // self.settings.most_points)
        known &= (np.arange(len(points)) + self._sets) % step == 0
        wanted = min(3, len(rig.cameras))
        whole = (points.n_cameras >= wanted) & (points.trusted >= points.n_cameras - 0.5)
        chosen = whole & known
        if not chosen.any():
            return
        bundle = bundle_rays(rig, detections, 0.0)
        covariance = np.concatenate([detections[n].covariance_px2 for n in self._names if n in detections])
        connected = self._fitted(_images(bundle, covariance, points, chosen), speed[chosen])
        usual = np.all(connected.squared < FARTHEST_SIGMAS**2, axis=1)
        if usual.any():
            part = connected.select(usual)
            self._learn_noise(math.exp(-1.0 / self.settings.memory), part)
            sums = self._blocks.setdefault(
                int(time_s // self.settings.block_s), np.zeros((2, len(self._names)))
            )
            sums += [(part.rest**2).sum(axis=(0, 2)), part.seen.sum(axis=0)]
        # the images of a camera that is late are left out of the points: look for them beside their place
        moving = known & (points.n_cameras >= 2)
        images = _images(bundle, covariance, points, moving, self.settings.adopt_px)
        self._learn_clocks(self._fitted(images, speed[moving]))

    def _fitted(self, images: "_Images", speed: Array) -> "_Fit":
        """Return the images of points with their speeds (n, 3), after the points have moved to their best places."""
        seen, rest, slope, own = images
        flow = np.einsum("ncij,nj->nci", slope, speed)
        extra = self.noise.sigma_px[:, None, None] ** 2 * np.eye(2)
        total = own + extra + self.noise.jitter_s**2 * flow[..., :, None] * flow[..., None, :]
        weight = np.where(seen[..., None, None], np.linalg.inv(total), 0.0)
        weighted = np.swapaxes(slope, 2, 3) @ weight
        normal = (weighted @ slope).sum(axis=1)
        values = np.linalg.eigvalsh(normal)
        fit = (values[:, 0] > 1e-9 * values[:, 2]) & (seen.sum(axis=1) >= 2)
        seen, rest, slope, own, flow, total, weight, weighted = (
            part[fit] for part in (seen, rest, slope, own, flow, total, weight, weighted)
        )
        inverse = np.linalg.inv(normal[fit])
        move = np.einsum("nij,ncjk,nck->ni", inverse, weighted, rest)
        rest = np.where(seen[..., None], rest - np.einsum("ncij,nj->nci", slope, move), 0.0)
        squared = np.einsum("nci,ncij,ncj->nc", rest, weight, rest)
        return _Fit(seen, rest, slope, own, flow, total, weight, inverse, squared)

    def _learn_noise(self, keep: float, fit: "_Fit") -> None:
        """Add the residuals of connected images to the sums, old ones counting ``keep``, and draw the conclusions."""
        c = len(self._names)
        square = (fit.rest**2).sum(axis=2)
        whole = np.trace(fit.total, axis1=2, axis2=3)
        left = 1.0 - np.einsum("ncij,njk,ncik->nc", fit.slope, fit.inverse, fit.slope) / whole
        use = fit.seen & (left > 0.05)
        scale = np.where(use, 1.0 / (left * whole), 0.0)
        per_px, per_speed = 2.0 * left * scale, left * (fit.flow**2).sum(axis=2) * scale
        known = (square - left * np.trace(fit.own, axis1=2, axis2=3)) * scale
        normal, right = np.zeros((c + 1, c + 1)), np.zeros(c + 1)
        normal[range(c), range(c)] = (per_px**2).sum(axis=0)
        normal[:c, c] = normal[c, :c] = (per_px * per_speed).sum(axis=0)
        normal[c, c] = (per_speed**2).sum()
        right[:c], right[c] = (per_px * known).sum(axis=0), (per_speed * known).sum()
        self._normal, self._right = keep * self._normal + normal, keep * self._right + right
        self._looks = keep * self._looks + 1.0
        self._square = keep * self._square + square.sum(axis=0)
        self._images = keep * self._images + fit.seen.sum(axis=0)
        self._conclude()

    def _learn_clocks(self, fit: "_Fit") -> None:
        """Add what residuals along the motion say of each camera's delay."""
        c = len(self._names)
        pull = np.einsum("nci,ncij,ncj->c", fit.flow, fit.weight, fit.rest)
        toward = np.einsum("ncij,ncjk,nck->nci", np.swapaxes(fit.slope, 2, 3), fit.weight, fit.flow)
        clock = -np.einsum("nci,nij,ndj->cd", toward, fit.inverse, toward)
        clock[range(c), range(c)] += np.einsum("nci,ncij,ncj->c", fit.flow, fit.weight, fit.flow)
        self._clocks.append((pull, clock, fit.seen.sum(axis=0)))

    def _conclude(self) -> None:
        c, s = len(self._names), self.settings
        seen = np.diag(self._normal)[:c] > 0
        if not seen.any():
            return
        normal, right = self._normal.copy(), self._right.copy()
        look = float(np.diag(self._normal)[:c][seen].mean()) / self._looks
        normal[:c, :c] += look * (ALIKE_LOOKS * (np.eye(c) - 1.0 / c) + START_LOOKS * np.eye(c))
        right[:c] += look * START_LOOKS * s.start_px**2
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        found = nnls(normal / np.outer(size, size), right / size)[0] / size
        sigma = np.sqrt(np.maximum(found[:c], s.least_px**2) + self._lens_px**2)
        self.noise = Noise(sigma, math.sqrt(found[c]))

    def _offsets(self) -> tuple[Array, Array]:
        """Return by how much each camera is late (c,) and the standard deviation [s]; NaN where nothing moved."""
        nothing = np.full(len(self._names), np.nan)
        if not self._clocks:
            return nothing, nothing
        pulls, clocks, images = (np.array(part) for part in zip(*self._clocks, strict=True))
        clock = clocks.sum(axis=0)
        seen = (images.sum(axis=0) >= self.settings.least_images) & (np.diag(clock) > 0)
        n = int(seen.sum())
        if n < 2:
            return nothing, nothing
        some = np.ix_(seen, seen)
        mean = np.full((n, n), float(np.diag(clock)[seen].mean()) / n)  # gauge: offsets sum to zero
        inverse = np.linalg.inv(clock[some] + mean)
        late, sigma = nothing.copy(), nothing.copy()
        late[seen] = inverse @ pulls[:, seen].sum(axis=0)
        scatter = (pulls - np.einsum("kij,j->ki", clocks, np.nan_to_num(late)))[:, seen]
        # as many looks as are left when the offsets are taken from them
        few = len(pulls) / max(len(pulls) - n + 1, 0.5)
        sigma[seen] = np.sqrt(few * np.diag(inverse @ (scatter.T @ scatter) @ inverse))
        return late, sigma

    def _speeds(self, time_s: float, xyz: Array) -> tuple[Array, Array]:
        """Return each point's speed (n, 3) since the set before, and whether it is known (n,)."""
        speed, known = np.zeros(xyz.shape), np.zeros(len(xyz), dtype=bool)
        if self._before is None or not len(self._before[1]) or not len(xyz):
            return speed, known
        before_s, before = self._before
        away, there = cKDTree(before).query(xyz, distance_upper_bound=self.settings.farthest_m)
        back = cKDTree(xyz).query(before)[1]
        known = np.isfinite(away) & (time_s > before_s)
        known[known] = back[there[known]] == np.flatnonzero(known)
        speed[known] = (xyz[known] - before[there[known]]) / max(time_s - before_s, 1e-9)
        return speed, known


class _Images(NamedTuple):
    """Images of n points in c cameras: whether there is one (n, c), residual (n, c, 2), its change by the point
    (n, c, 2, 3), own covariance (n, c, 2, 2).
    """

    seen: Array
    rest: Array
    slope: Array
    own: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """Images of points at their best places: as ``_Images``, and ``flow`` (n, c, 2) their speeds [px/s],
    ``total`` and ``weight`` (n, c, 2, 2), the points' covariances ``inverse`` (n, 3, 3), squared whitened
    residuals (n, c).
    """

    seen: Array
    rest: Array
    slope: Array
    own: Array
    flow: Array
    total: Array
    weight: Array
    inverse: Array
    squared: Array

    def select(self, rows: Array) -> "_Fit":
        """Return the points that a mask names."""
        return _Fit(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def _images(
    bundle: Bundle, covariance_px2: Array, points: Points, chosen: Array, adopt_px: float = 0.0
) -> _Images:
    """Return the images of the chosen points; rays that no point has are adopted by one that lies so near.

    ``bundle``: the rays of the frame set, whitened by ``covariance_px2`` (rays, 2, 2), the detections' own. A ray
    gives the residual of its image to first order, as triangulation does: no point needs to be projected.
    """
    which = np.where(points.rays[chosen] >= 0, points.rays[chosen] + bundle.start[:-1], -1)
    away = points.xyz[chosen][:, None, :] - bundle.views[:, :3]
    if adopt_px > 0.0:
        _adopt(bundle, which, away, points.rays, adopt_px)
    rays = bundle.rays[which]  # of those without a ray any: they are not seen
    depth = np.einsum("nci,nci->nc", rays[..., DIRECTION : DIRECTION + 3], away)
    seen = (which >= 0) & (depth > 0.0)
    own = np.where(seen[..., None, None], covariance_px2[which], np.eye(2))
    white = np.where(seen[..., None], rays[..., WHITE : WHITE + 6], 0.0).reshape(*which.shape, 2, 3)
    slope = np.linalg.cholesky(own) @ white / np.where(seen, depth, 1.0)[..., None, None]
    return _Images(seen, -np.einsum("ncij,ncj->nci", slope, away), slope, own)


def _adopt(bundle: Bundle, which: Array, away: Array, taken: Array, reach_px: float) -> None:
    """Give points without an image in a camera, in ``which`` (n, c), the free ray nearest to them (n, c, 3)."""
    for c in range(which.shape[1]):
        free = np.setdiff1d(np.arange(bundle.start[c + 1] - bundle.start[c]), taken[:, c]) + bundle.start[c]
        lonely = np.flatnonzero(which[:, c] < 0)
        if len(free) and len(lonely):
            rays = bundle.rays[free]
            toward = away[lonely, c] / np.linalg.norm(away[lonely, c], axis=1, keepdims=True)
            beside = np.linalg.norm(toward[:, None] - rays[:, DIRECTION : DIRECTION + 3], axis=2)
            beside_px = np.nan_to_num(beside * (2.0 * rays[:, RADIUS] / rays[:, ANGLE]), nan=np.inf)
            nearest = beside_px.argmin(axis=1)
            near = beside_px[np.arange(len(lonely)), nearest] <= reach_px
            which[lonely[near], c] = free[nearest[near]]
