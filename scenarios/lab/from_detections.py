"""Tracks from detections that were captured without images: the pipeline from its second stage on."""

import time
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from mosca.assemble import Assembly
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, FrameSet
from mosca.data.rig import Rig
from mosca.health import Health, HealthSettings
from mosca.match import match
from mosca.nearest import NearestTracker
from mosca.pipeline import PipelineSettings, Step, check_detections, learned_diameter
from mosca.track import Tracker
from mosca.triangulate import bundle_rays


def run_detections(
    sets: Iterable[tuple[FrameSet, Mapping[str, Detections]]],
    rig: Rig,
    settings: PipelineSettings | None = None,
    health: Health | None = None,
) -> Iterator[Step]:
    """Turn detections into tracks, as ``mosca.pipeline.run_sets`` does with those that it finds itself."""
    settings = PipelineSettings() if settings is None else settings
    if health is None:
        health = Health(rig, HealthSettings(start_px=settings.match.camera_sigma_px))
    low, high = settings.volume if settings.volume is not None else ((-np.inf,) * 3, (np.inf,) * 3)
    volume = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    tracker = Tracker(settings.track) if settings.nearest is None else NearestTracker(settings.nearest)
    typical_diameter_m = 0.0
    for frame_set, detections in sets:
        start = time.perf_counter()
        check_detections(detections, frame_set.pulse)
        predicted = tracker.predict(frame_set.time_ns * 1e-9)
        bundle = bundle_rays(rig, detections, health.noise.sigma_px, settings.match.target)
        points = match(bundle, predicted, settings.match, volume, typical_diameter_m)
        typical_diameter_m = learned_diameter(typical_diameter_m, points)
        samples = tracker.update(points, frame_set.pulse, frame_set.time_ns, health.noise.jitter_s)
        health.attend(rig, frame_set, detections, points)
        yield Step(frame_set, detections, points, samples, {"track": time.perf_counter() - start})


def counted(
    sets: Iterable[tuple[FrameSet, Mapping[str, Detections]]],
    cameras: Iterable[CameraInfo],
    assembly: Assembly,
) -> Iterator[tuple[FrameSet, Mapping[str, Detections]]]:
    """Pass frame sets on and count them in ``assembly``; numbers that are left out are skipped sets."""
    names = [info.name for info in cameras]
    following = 0
    for frame_set, detections in sets:
        assembly.sets += 1
        assembly.frames += len(detections)
        assembly.complete_sets += len(detections) == len(names)
        assembly.empty_sets += not detections
        if frame_set.pulse > following:
            assembly.skipped_sets += frame_set.pulse - following
            assembly.notes.setdefault("skipped", f"frame set {following}: not in the recording")
        following = frame_set.pulse + 1
        yield frame_set, detections
