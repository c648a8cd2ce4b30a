"""Frames of free-running cameras -> detections of each camera, frame by frame; no image is kept.

Each frame is examined by the usual detector with the statistics of the camera's earlier frames. It counts at its own
instant: mid-exposure by its own stamp (``mosca.data.frames``); with a rolling shutter, that of an image point's row.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, Frame, FrameSource, mid_exposure_ns
from mosca.detection.detect import NO_STATISTICS, CameraStatistics, DetectionSettings, detect_with_statistics
from mosca.errors import InputError

FEWEST_FRAMES = 8
"""Fewest frames of a camera that distinguish a trajectory from a few isolated points."""
MOST_DETECTIONS = 5000
"""Most image points of a frame; more are noise."""
COLUMNS = ("xy_px", "covariance_px2", "diameter_px", "peak", "elongation", "flags")
"""Columns of ``CameraDetections``, one value for each image point."""


@dataclass(frozen=True, eq=False)
class CameraDetections:
    """Detections of one camera: f frames, n image points in the order of the frames.

    ``frame_ns`` (f,) mid-exposure of each frame's first row on the camera's own clock, strictly rising; ``start``
    (f + 1,) first image point of each frame; ``xy_px`` (n, 2), ``covariance_px2`` (n, 2, 2), ``diameter_px``,
    ``peak``, ``elongation`` and ``flags`` (n,) as in ``Detections``. ``row_time_s``: as the frames state it.
    """

    info: CameraInfo
    frame_ns: Array
    start: Array
    xy_px: Array
    covariance_px2: Array
    diameter_px: Array
    peak: Array
    elongation: Array
    flags: Array
    row_time_s: float = 0.0

    @property
    def frame(self) -> Array:
        """Number of the frame of each image point (n,)."""
        return np.repeat(np.arange(len(self.frame_ns)), np.diff(self.start))

    @property
    def period_s(self) -> float:
        """Median time from one frame to the next [s]."""
        return float(np.median(np.diff(self.frame_ns))) * 1e-9

    def time_s(self, origin_ns: int) -> Array:
        """Return the instant of each image point (n,) on the camera's own clock, counted from ``origin_ns`` [s]."""
        first_row = (self.frame_ns - origin_ns) * 1e-9
        return first_row[self.frame] + self.row_time_s * self.xy_px[:, 1]


@dataclass
class FrameCount:
    """Running counts by camera: frames that came, and frames without a usable image."""

    frames: dict[str, int] = field(default_factory=dict)
    unusable: dict[str, int] = field(default_factory=dict)


@dataclass
class _Notes:
    """Data of one camera, accumulated over frames."""

    info: CameraInfo
    frame_ns: list[int] = field(default_factory=list)
    index: list[int] = field(default_factory=list)
    found: list[Detections] = field(default_factory=list)
    learned: CameraStatistics = NO_STATISTICS
    row_time_ns: int = 0


def detect_in_frames(
    source: FrameSource,
    names: Iterable[str],
    settings: DetectionSettings,
    backgrounds: Mapping[str, Array] | None = None,
    count: FrameCount | None = None,
    attend: Callable[[int], None] | None = None,
) -> tuple[CameraDetections, ...]:
    """Return the detections of the source's cameras ``names``, in that order; frames of other cameras are skipped.

    ``backgrounds``: camera -> image that is subtracted first. ``attend``: called with the number of frames so far.
    InputError where a camera sends no frames, too few, or frames whose stamps do not rise.
    """
    infos = {info.name: info for info in source.cameras}
    notes = {name: _Notes(infos[name]) for name in names}
    counts = FrameCount() if count is None else count
    done = 0
    for frame in source:
        note = notes.get(frame.camera)
        if note is None:
            continue
        done += 1
        counts.frames[frame.camera] = counts.frames.get(frame.camera, 0) + 1
        if frame.image is None:
            counts.unusable[frame.camera] = counts.unusable.get(frame.camera, 0) + 1
        else:
            _detect(note, frame, settings, (backgrounds or {}).get(frame.camera))
        if attend is not None:
            attend(done)
    return tuple(_seen(note) for note in notes.values())


def _detect(note: _Notes, frame: Frame, settings: DetectionSettings, background: Array | None) -> None:
    assert frame.image is not None
    first_row = mid_exposure_ns(frame) - frame.row_time_ns * (frame.rows - 1) // 2
    check_rise(frame.camera, note.index, note.frame_ns, frame.index, first_row)
    backgrounds = None if background is None else [background]
    (found,), taught = detect_with_statistics(
        [frame.image], [frame.camera], settings, note.info.bit_depth, backgrounds, statistics=note.learned
    )
    if len(found) > MOST_DETECTIONS:
        raise InputError(
            f"camera '{frame.camera}', frame {frame.index}: {len(found)} detections, {MOST_DETECTIONS} are "
            "allowed; noise is taken for targets: lower detection.false_alarms, or give a background"
        )
    note.learned = note.learned.plus(taught)
    note.row_time_ns = frame.row_time_ns
    note.frame_ns.append(first_row)
    note.index.append(frame.index)
    note.found.append(found)


def check_rise(camera: str, indices: list[int], times_ns: list[int], index: int, time_ns: int) -> None:
    """Raise InputError where a frame's instant is not later than that of the camera's preceding frame."""
    if not times_ns or time_ns > times_ns[-1]:
        return
    if time_ns == times_ns[-1]:
        raise InputError(
            f"camera '{camera}': frames {indices[-1]} and {index} have the same time stamp ({time_ns} "
            "ns mid-exposure); "
            "each exposure needs its own: record the camera's stamps, not those of a common pulse or of a file"
        )
    raise InputError(
        f"camera '{camera}': frame {index} is stamped {(times_ns[-1] - time_ns) * 1e-6:g} ms before frame "
        f"{indices[-1]}, which came earlier; sort the frames of each camera by their stamps"
    )


def _seen(note: _Notes) -> CameraDetections:
    if len(note.frame_ns) < FEWEST_FRAMES:
        raise InputError(
            f"camera '{note.info.name}': {len(note.frame_ns)} usable frames given, {FEWEST_FRAMES} are "
            "needed to tell a motion; record longer, or leave the camera out of the rig file"
        )
    columns: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in note.found]) for name in COLUMNS}
    return CameraDetections(
        note.info,
        np.array(note.frame_ns, dtype=np.int64),
        np.concatenate([[0], np.cumsum([len(one) for one in note.found])]),
        row_time_s=note.row_time_ns * 1e-9,
        **columns,
    )
