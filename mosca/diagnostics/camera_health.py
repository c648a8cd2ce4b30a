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
from time import perf_counter

import numpy as np
from scipy.optimize import nnls

from mosca.camera.ray_table import make_ray_table
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rays import RayTable
from mosca.data.rig import Rig
from mosca.data.tracks import Points
from mosca.diagnostics.residual_sums import look

START_SETS = 200
"""Frame sets in which much is to be learned."""
CLOCK_LOOKS = 1000
"""Looks from which offsets of clocks are drawn."""
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

    ``nameless``: samples that had no identity yet when the run ended. ``seconds``: computing time so far.
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
        self._beforehand = np.zeros((c + 1, c + 1))
        self._beforehand[:c, :c] = ALIKE_LOOKS * (np.eye(c) - 1.0 / c) + START_LOOKS * np.eye(c)
        self._clocks: deque[tuple[Array, Array, Array]] = deque(maxlen=CLOCK_LOOKS)
        self._square, self._images = np.zeros(c), np.zeros(c)
        self._blocks: dict[int, Array] = {}
        self.nameless = 0
        self.seconds = 0.0

    def attend(
        self,
        rig: Rig,
        frame_set: FrameSet,
        detections: Mapping[str, Detections],
        points: Points,
        bundle: RayTable | None = None,
    ) -> None:
        """Take a frame set's points and the detections that they were made of; ``rig``: that they were made with.

        ``bundle``: the rays that they were made of, traced anew where not given.
        """
        begin = perf_counter()
        time_s = frame_set.time_ns * 1e-9
        self._sets += 1
        for k, name in enumerate(self._names):
            if name in detections:
                self._detected[k] += len(detections[name])
            else:
                self._missing[k] += 1.0
        if len(points):
            self._connected += (points.rays >= 0).sum(axis=0)
        s = self.settings
        if self._sets % (s.every if self._sets <= START_SETS else s.seldom) == 0 and len(points):
            if bundle is None:
                bundle = make_ray_table(rig, detections, self.noise.sigma_px)
            self._look(time_s, bundle, points)
        self._before = (time_s, points.xyz)
        self.seconds += perf_counter() - begin

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

    def _look(self, time_s: float, bundle: RayTable, points: Points) -> None:
        """Add what the residuals of some of the points say to the sums, and draw the conclusions."""
        if self._before is None:
            return
        before_s, before = self._before
        s, every = self.settings, -(-len(points) // self.settings.most_points)
        whole, usual, normal, right, square, images, pull, clock, timed = look(
            bundle.rays, bundle.views, bundle.start, bundle.covariance_px2, bundle.extra_px2, points.rays, points.xyz,
            points.n_cameras, points.trusted, before, time_s - before_s, -self._sets % every, every, s.farthest_m,
            s.adopt_px, self.noise.sigma_px**2, self.noise.jitter_s,
        )  # fmt: skip
        if whole == 0:
            return
        if usual > 0:
            keep = math.exp(-1.0 / s.memory)
            self._normal, self._right = keep * self._normal + normal, keep * self._right + right
            self._looks = keep * self._looks + 1.0
            self._square, self._images = keep * self._square + square, keep * self._images + images
            block = self._blocks.setdefault(int(time_s // s.block_s), np.zeros((2, len(self._names))))
            block += [square, images]
            self._conclude()
        self._clocks.append((pull, clock, timed))

    def _conclude(self) -> None:
        """Solve for the variances that each camera and the triggers add, none below zero."""
        c, s = len(self._names), self.settings
        own = self._normal.diagonal()[:c]
        seen = own > 0
        if not seen.any():
            return
        look = float(own[seen].mean()) / self._looks
        normal, right = self._normal + look * self._beforehand, self._right.copy()
        right[:c] += look * START_LOOKS * s.start_px**2
        size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        found = nnls(normal / size / size[:, None], right / size)[0] / size
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
