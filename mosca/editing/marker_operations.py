"""Operations on tracks: trim, delete, rename, swap, filter, offset.

``status`` is the origin of a position. It becomes "edited" for samples moved by hand. Cut, renamed, swapped and
filtered samples keep it, as smoothed ones do.
"""

from dataclasses import replace

import numpy as np
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.tracks import Tracks
from mosca.editing.low_pass import SHORTEST, low_pass
from mosca.editing.operation import (
    Blend,
    EditError,
    Frames,
    Labels,
    OffsetKeyframes,
    between_keyframes,
    marker_names,
    rate_hz,
    rows_between,
    rows_of,
)


@dataclass(frozen=True, config=SETTINGS)
class TrimTracks:
    """Keep a stretch of frames alone; numbers and times of frames stay."""

    frames: Frames

    def apply(self, take: Tracks) -> Tracks:
        """Return the samples in these frames."""
        return take.select(rows_between(take.frame, self.frames))


@dataclass(frozen=True, config=SETTINGS)
class DeleteSamples:
    """Remove markers, in ``frames`` alone where they are given."""

    labels: Labels
    frames: Frames | None = None

    def apply(self, take: Tracks) -> Tracks:
        """Return the samples that are left."""
        gone = np.zeros(len(take), bool)
        for label in self.labels:
            gone |= _some(take, label, self.frames)
        return take.select(~gone)


@dataclass(frozen=True, config=SETTINGS)
class RenameMarkers:
    """Give markers other labels, in ``frames`` alone where they are given: ``labels = { OLD = "NEW" }``.

    A part of a track gets a track number of its own.
    """

    labels: dict[str, str]
    frames: Frames | None = None

    def apply(self, take: Tracks) -> Tracks:
        """Return the same samples, renamed."""
        for old, new in self.labels.items():
            rows = _some(take, old, self.frames)
            taken = np.intersect1d(take.frame[rows], take.frame[~rows & (take.label == new)])
            if len(taken) and new:
                raise EditError(
                    "labels",
                    f"'{new}' given for '{old}'; it has a sample in frame {taken[0]} already: delete that, or swap",
                )
            parted = np.isin(take.track, take.track[rows]) & ~rows
            track = np.where(rows, take.track.max() + 1, take.track) if parted.any() else take.track
            take = _in_order(replace(take, label=np.where(rows, new, take.label), track=track))
        return take


@dataclass(frozen=True, config=SETTINGS)
class SwapLabels:
    """Exchange two markers, label and track, in ``frames`` alone where they are given."""

    labels: tuple[str, str]
    frames: Frames | None = None

    def apply(self, take: Tracks) -> Tracks:
        """Return the same samples, exchanged."""
        wholes = [rows_of(take, label) for label in self.labels]
        inside = rows_between(take.frame, self.frames)
        if not (inside & (wholes[0] | wholes[1])).any() or (wholes[0] & wholes[1]).any():
            raise EditError(
                "labels", f"{list(self.labels)} given; two markers with samples in these frames are wanted"
            )
        label, track = take.label, np.array(take.track)
        moved = [inside & whole for whole in wholes]
        for rows, other in zip(moved, reversed(wholes), strict=True):
            label = np.where(rows, take.label[other][0], label)
            track[rows] = _main_track(take, other)
        pairs = np.unique(np.column_stack([take.frame, track]), axis=0)
        if len(pairs) < len(take):  # another sample has that number in one of these frames
            for k, rows in enumerate(moved):
                track[rows] = take.track.max() + 1 + k
        return _in_order(replace(take, label=label, track=track))


@dataclass(frozen=True, config=SETTINGS)
class FilterTracks:
    """Zero-phase Butterworth low-pass of positions, run by run between gaps; the covariance is that of the result.

    Its errors are correlated in time then, which a covariance of single samples does not tell.
    """

    cutoff_hz: Positive
    labels: Labels | None = None

    def apply(self, take: Tracks) -> Tracks:
        """Return the same samples, filtered."""
        made = low_pass(self.cutoff_hz, rate_hz(take, "cutoff_hz"))
        xyz, covariance = np.array(take.xyz), np.array(take.covariance)
        names = marker_names(take) if self.labels is None else self.labels
        runs = [run for name in names for run in _runs(take, rows_of(take, name)) if len(run) >= SHORTEST]
        if not runs:
            raise EditError("labels", f"{list(names)[:5]} given; none is seen in {SHORTEST} frames in a row")
        for run in runs:
            xyz[run], covariance[run] = made.filtered(take.xyz[run]), made.covariance(take.covariance[run])
        return replace(take, xyz=xyz, covariance=covariance)


@dataclass(frozen=True, config=SETTINGS)
class OffsetMarkers:
    """Move markers by offsets at keyframes, blended between them and held before the first and after the last."""

    labels: Labels
    keyframes: OffsetKeyframes
    blend: Blend = "smooth"

    def apply(self, take: Tracks) -> Tracks:
        """Return the same samples, moved; those that moved have the status "edited"."""
        away = between_keyframes(take.frame, self.keyframes, self.blend)
        rows = np.zeros(len(take), bool)
        for label in self.labels:
            rows |= rows_of(take, label)
        rows &= np.any(away != 0.0, axis=1)
        xyz = np.array(take.xyz)
        xyz[rows] += away[rows]
        return replace(take, xyz=xyz, status=np.where(rows, "edited", take.status))


def _some(take: Tracks, label: str, frames: Frames | None) -> Array:
    """Return the mask of a marker's samples in ``frames``; EditError where there is none."""
    rows = rows_of(take, label) & rows_between(take.frame, frames)
    if not rows.any():
        raise EditError("frames", f"{list(frames or ())} given; '{label}' has no sample there")
    return np.asarray(rows)


def _main_track(take: Tracks, rows: Array) -> int:
    numbers, counts = np.unique(take.track[rows], return_counts=True)
    return int(numbers[np.argmax(counts)])


def _in_order(take: Tracks) -> Tracks:
    return take.select(np.lexsort((take.track, take.frame)))


def _runs(take: Tracks, rows: Array) -> list[Array]:
    """Return the rows of a marker as runs of one sample a frame without a gap, in order of time."""
    own = np.flatnonzero(rows & np.isfinite(take.xyz).all(axis=1))
    own = own[np.argsort(take.frame[own], kind="stable")]
    return np.split(own, np.flatnonzero(np.diff(take.frame[own]) != 1) + 1)
