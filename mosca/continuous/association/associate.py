"""Frames of free-running cameras -> observations, each image point with its own instant and its marker's name.

Steps: detect in every frame on its own (``frame_detections``) -> follow points in each camera (``gather_tracklets``)
-> synchronise independent camera clocks coarsely (``coarse_sync``) -> distinguish markers by comparing the cameras at
common instants, and assign every measured image point to its marker (``correspondence``). No frame sets anywhere.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from mosca.continuous.association.coarse_sync import ClockTie, common_clock, tied_clocks
from mosca.continuous.association.correspondence import CURVE_PX, common_instants, curves_of, observed, tracked
from mosca.continuous.association.frame_detections import CameraDetections, FrameCount, detect_in_frames
from mosca.continuous.association.interpolated_tracks import SampledCurves
from mosca.continuous.association.space_motion import quick_for, settings_for, space_motion
from mosca.continuous.association.tracklet_merging import joined
from mosca.continuous.association.tracklets_2d import Tracklets, tracklets
from mosca.continuous.model.observations import Curves, TimedObservations
from mosca.continuous.model.rig_at_time import MovingRig
from mosca.data.arrays import Array
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, check_source
from mosca.tracking.motion_scale import motion_scale

SHORTEST_S = 0.1
"""Shorter recordings determine the motion too poorly [s]."""


@dataclass(frozen=True)
class AssociationSettings:
    """Settings of the data association. ``pipeline``: settings of detection, matching and tracking. ``clocks``:
    "common" where all stamps are of one clock, "own" where each camera has its own and was started at an unknown
    time, "auto" by the cameras' own statement (``CameraInfo.clock``: "device" is a clock of its own). ``search_s``:
    largest difference of start times of cameras with clocks of their own [s].
    """

    pipeline: PipelineSettings = field(default_factory=PipelineSettings)
    clocks: Literal["auto", "common", "own"] = "auto"
    search_s: float = 10.0


@dataclass(frozen=True, eq=False)
class Associated:
    """Result of the data association.

    ``observations``: image points with times on the common clock, as coarsely as it is known; ``row`` (n,): index of
    each among its camera's image points. ``start``: curves through the interpolated tracks, None where names are
    given. ``ties``: maps of the cameras' own clocks to the common one, which counts seconds from the first camera's
    ``origin_ns``. ``seen``: detections of each camera. ``sigma_px`` (c,): random error of each camera's image points
    besides their detections'. ``searched``: whether clocks had to be searched for. ``between_px``: rms standard
    deviation of positions interpolated at the common instants; infinite where ``sigma_px`` was not learned there.
    ``tracklet``: tracklet of each camera's image points.
    """

    observations: TimedObservations
    row: Array
    start: SampledCurves | None
    ties: tuple[ClockTie, ...]
    seen: tuple[CameraDetections, ...]
    sigma_px: Array
    count: FrameCount
    searched: bool
    between_px: float = np.inf
    tracklet: tuple[Array, ...] = ()

    def again(self, rig: Rig, curves: Curves, curve_px: float = 0.1) -> "Associated":
        """Return the result with image points assigned to markers again, using better curves of the same points."""
        found, row = observed(self.seen, self.ties, rig, curves, self.sigma_px, curve_px)
        return replace(self, observations=found, row=row)


def associate(
    source: FrameSource,
    rig: Rig,
    settings: AssociationSettings | None = None,
    backgrounds: Mapping[str, Array] | None = None,
    attend: Callable[[int], None] | None = None,
) -> Associated:
    """Return the observations of markers in a source's frames, for ``mosca.continuous.estimator.estimate``.

    ``backgrounds``: camera -> image (H, W) subtracted before detection. ``attend``: called with a rising count of
    steps. InputError where a camera's stamps do not rise, where it never ran together with others or sends too few
    frames, or where no marker is followed by two cameras.
    """
    settings = AssociationSettings() if settings is None else settings
    check_source(source, rig)
    count = FrameCount()
    seen = detect_in_frames(source, rig.names, settings.pipeline.detection, backgrounds, count, attend)
    return gather_seen(seen, rig, settings, count, attend)


def gather_seen(
    seen: tuple[CameraDetections, ...],
    rig: Rig,
    settings: AssociationSettings,
    count: FrameCount | None = None,
    attend: Callable[[int], None] | None = None,
) -> Associated:
    """As ``associate``, from given detections of the rig's cameras."""
    for one in seen:
        check_long_enough(one)
    own = settings.clocks == "own" or (
        settings.clocks == "auto" and any(one.info.clock == "device" for one in seen) and len(seen) > 1
    )
    tracklet = [tracklets(one) for one in seen]
    ties = tied_clocks(seen, tracklet, rig, settings.search_s) if own else common_clock(seen)
    return markers_of(seen, tracklet, ties, rig, settings, count or FrameCount(), attend, searched=own)


def markers_of(
    seen: tuple[CameraDetections, ...],
    tracklet: Sequence[Array],
    ties: tuple[ClockTie, ...],
    rig: Rig,
    settings: AssociationSettings,
    count: FrameCount,
    attend: Callable[[int], None] | None = None,
    moving: MovingRig | None = None,
    searched: bool = False,
) -> Associated:
    """Return markers' image points and first curves for given ``ties``: matched, tracked, joined over pauses.

    ``tracklet``: tracklet of each camera's image points; ``count``: frames that were examined, from which ``attend``
    continues; ``moving``: the cameras' poses at each instant, None where they are as in ``rig``.
    """
    paths = [
        Tracklets.of(one, of_point, tie.common_s(one.time_s(tie.origin_ns)))
        for one, of_point, tie in zip(seen, tracklet, ties, strict=True)
    ]
    done = sum(count.frames.values())
    on = None if attend is None else lambda k: attend(done + k)
    instants, pipeline = common_instants(seen, ties), settings.pipeline
    if moving is None:
        motion = space_motion(paths, rig)
        if quick_for(pipeline, motion, float(np.median(np.diff(instants)))):
            instants = common_instants(seen, ties, all_cameras=True)
        pipeline = settings_for(pipeline, motion, float(np.quantile(np.diff(instants), 0.9)))
    tracks, sigma = tracked(seen, paths, instants, rig, pipeline, on, moving)
    track = pipeline.track
    # curves through interpolated positions are as uncertain as these; at exposures there is no interpolation
    between = np.concatenate([path.at(instants).variance_px2 for path in paths])
    between_px = float(np.sqrt(between.sum() / max(len(between), 1)))
    off_px = float(np.hypot(CURVE_PX, between_px)) if moving is None else CURVE_PX
    curves = curves_of(tracks, track.coast_s)
    found, row = observed(seen, ties, rig, curves, sigma, off_px, moving)
    tracks = joined(tracks, curves, found, tracklet, row, motion_scale(track).acceleration_mps2)
    curves = curves_of(tracks, track.coast_s)
    found, row = observed(seen, ties, rig, curves, sigma, off_px, moving)
    return Associated(found, row, curves, ties, seen, np.asarray(sigma), count, searched, between_px, tuple(tracklet))


def check_long_enough(one: CameraDetections) -> None:
    """Raise InputError where a camera filmed for too short a time."""
    length = (one.frame_ns[-1] - one.frame_ns[0]) * 1e-9
    if length < SHORTEST_S:
        raise InputError(
            f"camera '{one.info.name}': filmed for {length:g} s; {SHORTEST_S:g} s at least are needed to tell how "
            "things move; record longer"
        )
