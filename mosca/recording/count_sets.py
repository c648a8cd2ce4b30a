"""Counting of detections without images as they enter the pipeline."""

from collections.abc import Iterable, Iterator, Mapping

from mosca.data.detections import Detections, Seen
from mosca.data.frames import CameraInfo, FrameSet
from mosca.synchronisation import Assembly


def counted(
    sets: Iterable[tuple[FrameSet, Mapping[str, Detections]]], cameras: Iterable[CameraInfo], assembly: Assembly
) -> Iterator[Seen]:
    """Pass frame sets on, for ``run_seen``, and count them in ``assembly``; missing numbers are skipped sets."""
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
        yield frame_set, detections, 0.0
