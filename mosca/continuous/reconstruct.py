"""Frames -> observations -> curves -> image points assigned again to the curves -> curves -> tracks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mosca.continuous.association.associate import Associated, AssociationSettings, associate
from mosca.continuous.association.coarse_sync import ClockTie
from mosca.continuous.association.correspondence import observed
from mosca.continuous.association.lone_sightings import with_lone
from mosca.continuous.estimator.estimate import ContinuousEstimate, ContinuousSettings, estimate
from mosca.continuous.findings import association_findings, late_cameras, on_curves_clock
from mosca.continuous.model.estimated import Clock
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations, UncertainCurves
from mosca.continuous.resample import residuals_px, tracks_on_grid
from mosca.data.arrays import Array
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.errors import InputError

FEW_TOGETHER = 6
"""Most points whose curves are estimated together before clocks are known."""
BETTER_PX = 0.1
"""Gate for assigning image points to the estimated curves again [px]."""
ALMOST = 1.1
"""Factor of change by residuals below which image errors are stated well enough."""
LEAST_PX = 0.005
"""Least image error besides the detections' [px] (``mosca.diagnostics.camera_health``)."""
LEFT_OUT = 2.0**5
"""Ratio of the variance of an interpolation across a left-out exposure to that between exposures, as in
``Tracklets``."""
MOST_ROUNDS, SETTLED = 16, 0.005
"""Most rounds of assigning image points to better curves again, and the relative change of their number at which the
rounds end."""


@dataclass(frozen=True)
class EstimatedClock(Clock):
    """A camera's clock by its stamps.

    An instant of the common clock [s], which counts from the first camera's ``origin_ns``, is
    ``offset_s + (1 + drift) (stamp_ns - origin_ns) / 1e9 + row_time_s y``; ``row_time_s`` is added to that stated by
    the frames.
    """

    origin_ns: int = 0


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """Result from frames of free-running cameras. ``observations``: on the curves' clock. ``findings``: notes for the
    user, one line each. ``cameras``: their paths where they move; ``observations`` are then those of markers.
    """

    gathered: Associated
    estimated: ContinuousEstimate
    observations: TimedObservations
    clocks: tuple[EstimatedClock, ...]
    findings: tuple[str, ...]
    rig: Rig
    cameras: CameraPaths | None = None

    @property
    def origin_ns(self) -> int:
        """Stamp of the first camera at which the common clock is 0 [ns]."""
        return self.gathered.ties[0].origin_ns

    def span_ns(self) -> tuple[int, int]:
        """Return the first and last instant of an image point, as stamps of the first camera [ns]."""
        first = self.clocks[0]
        span = np.array([self.observations.time_s.min(), self.observations.time_s.max()])
        own = (span - first.offset_s) / (1.0 + first.drift)
        return self.origin_ns + int(np.ceil(own[0] * 1e9)), self.origin_ns + int(np.floor(own[1] * 1e9))

    def tracks(self, time_ns: Array, curves: UncertainCurves | None = None) -> Tracks:
        """Return samples of all markers at ``time_ns`` (t,), stamps of the first camera's clock.

        ``curves``: of the same markers, another method's; None: the estimated ones.
        """
        first = self.clocks[0]
        time_ns = np.asarray(time_ns)
        instants_s = first.offset_s + (1.0 + first.drift) * ((time_ns - self.origin_ns) * 1e-9)
        curves = self.estimated.curves if curves is None else curves
        periods_s = [one.period_s for one in self.gathered.seen]
        return tracks_on_grid(curves, self.observations, self.rig, instants_s, time_ns, periods_s, self.cameras)

    def residual_rms_px(self) -> float:
        """Return the rms deviation of image points from their curves, per axis [px]."""
        rest = residuals_px(self.estimated.curves, self.observations, self.rig, self.cameras)
        return float(np.sqrt(np.nanmean(rest**2)))


def reconstruct(
    source: FrameSource,
    rig: Rig,
    gathering: AssociationSettings | None = None,
    settings: ContinuousSettings | None = None,
    backgrounds: Mapping[str, Array] | None = None,
    attend: Callable[[int], None] | None = None,
) -> Reconstructed:
    """Reconstruct the curves of markers and the cameras' clocks, from frames of fixed, calibrated, free-running
    cameras.

    ``settings.clocks`` "known" becomes "drift" where clocks had to be searched for. InputError: see ``associate``.
    """
    return reconstruct_gathered(associate(source, rig, gathering, backgrounds, attend), rig, settings)


def reconstruct_gathered(gathered: Associated, rig: Rig, settings: ContinuousSettings | None = None) -> Reconstructed:
    """As ``reconstruct``, from a given data association."""
    settings = ContinuousSettings() if settings is None else settings
    if gathered.searched and settings.clocks == "known":
        settings = replace(settings, clocks="drift")
    # one camera sees a point up to a period before and after two cameras do
    reach_s = max(one.period_s for one in gathered.seen)
    settings = replace(settings, reach_s=reach_s)
    # clocks and names need curves, not the correlations between points, which are expensive
    quick = replace(settings, limbs=False, most_together=min(FEW_TOGETHER, settings.most_together))
    found, row, ties, sigma_px = gathered.observations, gathered.row, gathered.ties, gathered.sigma_px
    curves: Curves | None = gathered.start
    for _round in range(MOST_ROUNDS):
        estimated = estimate(found, rig, quick, curves)
        ties, before, stated_px = _tied(ties, estimated), len(found), sigma_px
        sigma_px = _as_residuals(sigma_px, gathered, rig, estimated.of_camera)
        if gathered.start is None:
            found = _with_names(gathered, ties, sigma_px)
        else:
            reaching = estimated.curves.reaching(reach_s)
            found, row = observed(gathered.seen, ties, rig, reaching, sigma_px, BETTER_PX, used=(found, row))
            known = reaching.from_s, reaching.to_s
            found, row = with_lone(found, row, known, gathered.seen, gathered.tracklet, ties, sigma_px)
        if not len(found):
            raise InputError("no image point lies on its curve: the clocks or the rig do not fit the images")
        curves = estimated.curves
        changed = np.abs(np.log(sigma_px / np.maximum(stated_px, LEAST_PX))).max()
        if abs(len(found) - before) < SETTLED * before and changed < np.log(ALMOST):
            break
    estimated = estimate(found, rig, settings, curves)
    clocks = _clocks(ties, estimated)
    findings = association_findings(gathered, found)
    if settings.clocks == "known":
        findings += late_cameras(estimated.curves, found, rig)
    return Reconstructed(
        gathered, estimated, on_curves_clock(found, estimated), clocks, (*findings, *estimated.findings), rig
    )


def _with_names(gathered: Associated, ties: tuple[ClockTie, ...], sigma_px: Array) -> TimedObservations:
    """Return the observations, whose names are given, with better clocks and image errors."""
    found = gathered.observations
    time_s, covariance = np.empty(len(found)), np.empty((len(found), 2, 2))
    for c, (one, tie) in enumerate(zip(gathered.seen, ties, strict=True)):
        own = found.camera == c
        row = gathered.row[own]
        time_s[own] = tie.common_s(one.time_s(tie.origin_ns)[row])
        covariance[own] = one.covariance_px2[row] + sigma_px[c] ** 2 * np.eye(2)
    return replace(found, time_s=time_s, covariance_px2=covariance)


def _as_residuals(sigma_px: Array, gathered: Associated, rig: Rig, of_camera: Array) -> Array:
    """Return the image errors (c,) [px] besides the detections' with which residuals are as large as stated.

    ``of_camera`` (c,): the residuals in units of the stated errors. The cameras' errors relative to each other are
    estimated here, since interpolation hides them at common instants. Curves take up lasting errors, such as those of
    lenses, 3 of 2 C parts where C cameras see a point; this part is added to that shown by residuals. The result is
    at least the error at common instants less the largest part that interpolation may have added there: its error
    where an exposure is left out.
    """
    covariances = [one.covariance_px2 for one in gathered.seen]
    detected = np.array([0.5 * np.median(np.trace(one, axis1=1, axis2=2)) for one in covariances])
    lens = np.array([max(camera.residual_px, LEAST_PX) for camera in rig.cameras])
    taken = min(3.0 / (2.0 * len(rig.cameras)), 1.0)
    shown = of_camera**2 * (sigma_px**2 + detected) - detected
    least = np.maximum(lens**2, gathered.sigma_px**2 - LEFT_OUT * gathered.between_px**2)
    return np.asarray(np.sqrt(np.maximum(shown + taken * lens**2, least)))


def _tied(ties: tuple[ClockTie, ...], estimated: ContinuousEstimate) -> tuple[ClockTie, ...]:
    """Return the ties combined with the estimated clocks."""
    return tuple(
        replace(
            tie,
            offset_s=clock.offset_s + (1.0 + clock.drift) * tie.offset_s,
            drift=(1.0 + clock.drift) * (1.0 + tie.drift) - 1.0,
        )
        for tie, clock in zip(ties, estimated.clocks, strict=True)
    )


def _clocks(ties: tuple[ClockTie, ...], estimated: ContinuousEstimate) -> tuple[EstimatedClock, ...]:
    return tuple(
        EstimatedClock(**vars(replace(clock, offset_s=tie.offset_s, drift=tie.drift)), origin_ns=tie.origin_ns)
        for tie, clock in zip(_tied(ties, estimated), estimated.clocks, strict=True)
    )
