"""Brightness of a lamp in each frame of each camera: the sum over the pixels that it changes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import Frame, FrameSource, mid_exposure_ns
from mosca.errors import InputError

HALF = 0.5
"""Pixels belong to the lamp if they change by more than this share of the largest change of a pixel."""


@dataclass(frozen=True)
class Brightness:
    """A camera's frames in order: ``start_ns`` of the exposure at the lamp's row, ``exposure_ns``, ``light`` (n,)."""

    start_ns: Array
    exposure_ns: Array
    light: Array
    most_dn: float
    """Largest change of any pixel; ``full_dn``: largest value that a pixel can have."""
    full_dn: float
    clipped: bool
    """Whether the lamp's pixels reach ``full_dn``, so that a part of the light cannot be measured."""


def light_of_lamp(source: FrameSource) -> Mapping[str, Brightness]:
    """Return each camera's brightness of what changes most in its images; reads ``source`` twice."""
    lows, highs = _extremes(source)
    masks: dict[str, Array] = {}
    clipped: dict[str, bool] = {}
    for info in source.cameras:
        if info.name not in lows:
            raise InputError(f"camera '{info.name}': no whole frame; nothing can be seen in it")
        change = highs[info.name].astype(np.int64) - lows[info.name]
        changing = change > HALF * change.max()
        free = changing & (highs[info.name] < 2**info.bit_depth - 1)
        # saturated pixels do not measure a part of the light; where all are saturated, no part is measured
        clipped[info.name] = not free.any()
        masks[info.name] = changing if clipped[info.name] else free
    rows: dict[str, list[tuple[int, int, float]]] = {info.name: [] for info in source.cameras}
    for frame in source:
        if frame.image is not None:
            rows[frame.camera].append(_row(frame, masks[frame.camera]))
    return {
        info.name: _brightness(
            rows[info.name],
            float((highs[info.name].astype(np.int64) - lows[info.name]).max()),
            float(2**info.bit_depth - 1),
            clipped[info.name],
        )
        for info in source.cameras
    }


def _row(frame: Frame, mask: Array) -> tuple[int, int, float]:
    assert frame.image is not None
    rows = np.flatnonzero(mask.any(axis=1))
    off_centre = float(rows.mean()) - (frame.rows - 1) / 2
    start = mid_exposure_ns(frame) - frame.exposure_ns // 2 + round(frame.row_time_ns * off_centre)
    return start, frame.exposure_ns, float(frame.image[mask].sum(dtype=np.int64))


def _brightness(rows: Sequence[tuple[int, int, float]], most: float, full: float, clipped: bool) -> Brightness:
    ordered = sorted(rows)
    start, exposure = (np.array([row[k] for row in ordered], dtype=np.int64) for k in (0, 1))
    return Brightness(start, exposure, np.array([row[2] for row in ordered]), most, full, clipped)


def _extremes(frames: Iterable[Frame]) -> tuple[dict[str, Array], dict[str, Array]]:
    lows: dict[str, Array] = {}
    highs: dict[str, Array] = {}
    for frame in frames:
        if frame.image is None:
            continue
        if frame.camera not in lows:
            lows[frame.camera], highs[frame.camera] = frame.image.copy(), frame.image.copy()
        else:
            np.minimum(lows[frame.camera], frame.image, out=lows[frame.camera])
            np.maximum(highs[frame.camera], frame.image, out=highs[frame.camera])
    return lows, highs
