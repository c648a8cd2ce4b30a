"""Health of a running rig, camera by camera: residuals, connected detections, dropouts, clock offsets.

A camera that exposes d seconds late shows every point u d farther along its motion, where u is the speed of its
image. The delay d is estimated from the residuals by least squares. A delay that all cameras share is a shift of time
that no residual shows: offsets are relative to their mean. The standard deviation of an offset is estimated from the
scatter of whole frame sets about it, since a body's shake moves all images of a set together. The errors of a rig
change as slowly as points move through the images, so they are alike in neighbouring sets (``long_run_covariance``).
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from time import perf_counter

import numpy as np
from pydantic import PositiveInt
from pydantic.dataclasses import dataclass

from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.shared_turns import share_likelihoods
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.frames import FrameSet
from mosca.data.rays import RayTable
from mosca.data.rig import Rig
from mosca.data.settings import MatchSettings
from mosca.data.tracks import Points
from mosca.diagnostics.long_run_covariance import long_run_covariance
from mosca.diagnostics.noise_model import FIELD_SHARES, OWN_SHARES, ImageNoise, NoiseModel
from mosca.diagnostics.residual_sums import MOST_DOUBT, ImageErrors, PointColumns, RayColumns, Sampling, residual_sums

START_SETS = 200
"""Frame sets at the start after each ``every`` of which residuals are summed."""
MOST_TOGETHER, SHARES_EVERY = 4, 5
"""Most cameras whose images together show how much they have in common, and after WHOLE_SETS every so many-th update
does: it takes ten times as long as the others."""
WHOLE_SETS = 20
"""Frame sets at the start of which all points count. With ``most_points`` a set, ten sets have too few where images
err unequally (a target field's rings): its nees was 2.1 to 8.6, depending on which points were drawn and on a
processor's last digits; with all points, 4.1. With 10 or 40 the same."""
CLOCK_UPDATES = 1000
"""Latest updates from which clock offsets are estimated."""


@dataclass(frozen=True, config=SETTINGS)
class HealthSettings:
    """How often residuals are summed, and what is reported."""

    every: PositiveInt = 1
    """Frame sets from one update to the next, in the first ``START_SETS``."""
    seldom: PositiveInt = 10
    """The same after those."""
    most_points: PositiveInt = 20
    """Points of a frame set that are used after the first ``WHOLE_SETS``, others each time."""
    memory: Positive = 400.0
    """Updates after which an old one counts 1/e."""
    start_px: NotNegative = 0.06
    """Random error of image points besides detection noise until it is learned."""
    least_images: NotNegative = 300.0
    """Images of a camera before its clock and its connections are reported."""
    farthest_m: Positive = 0.1
    """How far a point may move from set to set to have a speed."""
    late_s: NotNegative = 100e-6
    """Clock offsets below this are not reported."""
    certain_sigma: NotNegative = 6.0
    """Nor those below so many of their standard deviations."""
    poor_share: NotNegative = 0.5
    """A camera is reported if a smaller share of its detections becomes part of points."""
    odd_error: Positive = 3.0
    """A camera is reported if its images err so many times as much as those of any other."""
    block_s: Positive = 1.0
    """Length of the residuals' time blocks."""
    adopt_px: NotNegative = 3.0
    """How far from its point an image may lie that matching left out, to count for its camera's clock."""


@plain_dataclass(frozen=True)
class CameraHealth:
    """One camera since the start."""

    name: str
    residual_px: float
    """Recent rms residual an axis."""
    extra_px: float
    """Error besides detection noise."""
    connected: float
    """Share of its detections that became part of points."""
    missing: float
    """Share of frame sets without it."""
    late_s: float
    """How much later than the mean of all cameras it exposes; NaN: unknown."""
    late_sigma_s: float
    """Standard deviation of that."""
    residuals_px: tuple[float, ...]
    """Rms of each block of time."""


class Health:
    """Health of a running pipeline's cameras. ``attend`` takes each frame set.

    ``nameless``: samples that had no identity yet when the run ended. ``withheld``: samples that were too uncertain.
    ``seconds``: computing time so far.
    """

    def __init__(self, rig: Rig, settings: HealthSettings | None = None) -> None:
        self.settings = settings or HealthSettings()
        self._names = rig.names
        c = len(rig.cameras)
        one = self.settings
        self._model = NoiseModel(rig, one.start_px, one.memory)
        self._sets = self._updates = 0
        self._missing, self._detected, self._connected = np.zeros(c), np.zeros(c), np.zeros(c)
        self._before: tuple[float, Array] | None = None
        self._clocks: deque[tuple[Array, Array, Array]] = deque(maxlen=CLOCK_UPDATES)
        self._square, self._images = np.zeros(c), np.zeros(c)
        self._blocks: dict[int, Array] = {}
        self.nameless = self.withheld = 0
        self.seconds = 0.0

    @classmethod
    def of(cls, rig: Rig, match: MatchSettings) -> "Health":
        """Return the health of a rig that starts from the error set for matching."""
        return cls(rig, HealthSettings(start_px=match.camera_sigma_px))

    @property
    def noise(self) -> ImageNoise:
        """Error of image points besides detection noise, as learned so far."""
        return self._model.noise

    def start_from(self, trial: "Health") -> None:
        """Use the image points' errors that ``trial`` has learned, until this one has as many updates."""
        self._model.start_from(trial._model)

    def keep_start(self) -> None:
        """Keep the image points' errors assumed at the start: what follows is too little to learn them."""
        self._model.keep_start()

    def attend(
        self,
        rig: Rig,
        frame_set: FrameSet,
        detections: Mapping[str, Detections],
        points: Points,
        bundle: RayTable | None = None,
    ) -> None:
        """Take a frame set's points, and the detections and the ``rig`` that they were made from.

        ``bundle``: the rays that they were made from, computed again if not given.
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
            self._add_residuals(time_s, bundle, points)
        self._before = (time_s, points.xyz)
        self.seconds += perf_counter() - begin

    def cameras(self) -> tuple[CameraHealth, ...]:
        """Return the health of each camera."""
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
        """Return what a person should check, a line each."""
        s, lines = self.settings, []
        cameras = self.cameras()
        extra = np.array([one.extra_px for one in cameras])
        poor = [self._detected[k] >= s.least_images and one.connected < s.poor_share for k, one in enumerate(cameras)]
        for k, one in enumerate(cameras):
            # a camera that was moved shows displaced points, as a late one does
            if not any(poor) and abs(one.late_s) > max(s.late_s, s.certain_sigma * one.late_sigma_s):
                when = "later" if one.late_s > 0 else "earlier"
                lines.append(
                    f"camera '{one.name}' exposes {1e3 * abs(one.late_s):.2f} ms {when} than the others' mean "
                    f"(+- {1e3 * 2 * one.late_sigma_s:.2f}): check its trigger and its clock"
                )
            if poor[k]:
                lines.append(
                    f"camera '{one.name}': only {100 * one.connected:.0f} % of {self._detected[k]:.0f} detections "
                    "meet other cameras': look for reflections, bright clothes, or a camera that was moved"
                )
            others = np.delete(extra, k).max(initial=0.0)
            if len(extra) > 2 and self._images[k] >= s.least_images and one.extra_px > s.odd_error * others:
                lines.append(
                    f"camera '{one.name}': its images err by {one.extra_px:.2f} px, those of the others by at most "
                    f"{others:.2f}: look for a camera that was moved or is loose"
                )
        return tuple(lines)

    def left_out(self) -> dict[str, str]:
        """Return how many samples are in no track, one line for each reason."""
        lines = {
            "nameless": (self.nameless, "at the end had no identity yet"),
            "withheld": (self.withheld, "have a standard deviation above track.worst_sigma_m"),
        }
        return {kind: f"{count} samples {why} and are left out" for kind, (count, why) in lines.items() if count}

    def _add_residuals(self, time_s: float, bundle: RayTable, points: Points) -> None:
        """Add the residuals of some of the points to the sums, and update the noise model."""
        if self._before is None:
            return
        before_s, before = self._before
        s, noise = self.settings, self._model.noise
        every = 1 if self._sets <= WHOLE_SETS else -(-len(points) // s.most_points)
        sums = residual_sums(
            RayColumns(bundle.rays, bundle.views, bundle.start, bundle.covariance_px2, bundle.extra_px2),
            PointColumns(points.rays, points.xyz, points.n_cameras, points.trusted, before, time_s - before_s),
            ImageErrors(noise.sigma_px**2, noise.jitter_s),
            Sampling(-self._sets % every, every, s.farthest_m, s.adopt_px),
        )
        if sums.whole == 0:
            return
        if sums.usual > 0:
            keep = math.exp(-1.0 / s.memory)
            self._square, self._images = keep * self._square + sums.square, keep * self._images + sums.images
            block = self._blocks.setdefault(int(time_s // s.block_s), np.zeros((2, len(self._names))))
            block += [sums.square, sums.images]
            self._updates += 1
            told = self._sets <= WHOLE_SETS or self._updates % SHARES_EVERY == 0
            self._model.update(sums, self._share_likelihoods(bundle, points) if told else None)
        self._clocks.append((sums.pull, sums.clock, sums.timed))

    def _share_likelihoods(self, bundle: RayTable, points: Points) -> Array:
        """Return the log-likelihoods of the shares by some of the points whose images count in full.

        Equations grow with the square of the number of cameras: MOST_TOGETHER of them are taken, in turn.
        """
        n, every = len(self._names), -(-len(points) // self.settings.most_points)
        chosen = np.sort((self._sets + np.arange(min(n, MOST_TOGETHER))) % n)
        whole = (points.n_cameras >= 2) & (points.trusted >= points.n_cameras - MOST_DOUBT)
        found: Array = share_likelihoods(
            bundle.rays, bundle.views, bundle.start, points.rays, points.xyz, whole,
            np.maximum(bundle.extra_px2 - self._model.lens_px**2, 0.0),
            (OWN_SHARES, FIELD_SHARES), chosen, (-self._sets % every, every),
        )  # fmt: skip
        return found

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
        # degrees of freedom that the offsets leave
        few = len(pulls) / max(len(pulls) - n + 1, 0.5)
        sigma[seen] = np.sqrt(few * np.diag(inverse @ long_run_covariance(scatter) @ inverse))
        return late, sigma
