"""Detection in live frames: it runs beside the reading thread, and leaves out whole frame sets when it is behind."""

import os
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, Frame, FrameSet, FrameSource
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS
from mosca.detection.scheduler import FrameSetDetector, detect_ahead
from mosca.live import LiveSets
from mosca.pipeline import PipelineSettings
from mosca.synchronisation import Assembly

MOST_WORKERS = 2
"""Threads that detect ahead; more would hold more sets than a killed capture may lose."""


def detected(
    source: FrameSource, settings: PipelineSettings, assembly: Assembly, queued: int
) -> Iterator[tuple[FrameSet, Mapping[str, Detections]]]:
    """Yield the frame sets of a live ``source`` and their detections, with the pipeline's own first stage.

    ``queued``: sets that may wait; the oldest is left out where one more comes. ``assembly`` is filled.
    """
    look = FrameSetDetector(settings.detection, {info.name: info.bit_depth for info in source.cameras})
    sets = LiveSets(source, assembly, queued)
    try:
        for frame_set, detections, _ in detect_ahead(look, sets, min(os.cpu_count() or 1, MOST_WORKERS)):
            yield frame_set, detections
    finally:
        sets.close()


def warm_up(cameras: Sequence[CameraInfo], settings: PipelineSettings) -> None:
    """Detect once in pictures of a blurred disc, so that compilation is done before the first pulse."""
    look = FrameSetDetector(settings.detection, {info.name: info.bit_depth for info in cameras})
    learned = NO_STATISTICS
    for _ in range(2):
        frames = {info.name: Frame(info.name, 0, 0, 0, _disc(info)) for info in cameras}
        _, taught, _ = look.detect(FrameSet(0, 0, frames), learned)
        learned = learned.plus(taught)


def _disc(info: CameraInfo) -> np.ndarray:
    y, x = np.mgrid[: info.height, : info.width]
    away = np.hypot(x - info.width / 2, y - info.height / 2)
    image = 0.8 * (2**info.bit_depth - 1) * np.clip(4.5 - away, 0.0, 1.0)
    result: np.ndarray = image.astype(np.uint8 if info.bit_depth <= 8 else np.uint16)
    return result
