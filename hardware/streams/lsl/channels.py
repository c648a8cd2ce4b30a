"""Channels of LSL streams of markers, bodies, segments of a skeleton and joint angles, and a frame's samples of them.

An LSL stream has a fixed list of channels of one number each. Labels and units follow the conventions for motion
capture in XDF (https://github.com/sccn/xdf/wiki/MoCap-Meta-Data): positions in metres, quaternions A B C D with A the
real part, Confidence from 0 to 1; each channel names its marker or object. Each stream ends with the frame's number.
Values that are not known in a frame are NaN, with confidence 0.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hardware.streams.values import (
    OCCLUDED,
    TRACKED,
    UNLABELLED,
    StreamedBody,
    StreamedSkeleton,
    StreamFrame,
    StreamModel,
    StreamNames,
)
from mosca.data.arrays import Array

POSITION = ("PositionX", "PositionY", "PositionZ")
ORIENTATION = ("OrientationA", "OrientationB", "OrientationC", "OrientationD")
CONFIDENCE, NUMBER, ANGLE, TRACK = "Confidence", "FrameNumber", "JointAngle", "TrackNumber"
_UNITS = {CONFIDENCE: "normalized", NUMBER: "count", TRACK: "count", ANGLE: "radians"}
MODELLED = 0.5
"""Confidence of a marker that no camera saw in this frame: filled or predicted."""


class LslChannel(NamedTuple):
    """One channel's description; ``kind``: its type in XDF."""

    label: str
    kind: str
    unit: str
    marker: str = ""
    object: str = ""


class LslContent(ABC):
    """One stream: its ``kind`` (the end of its name), its ``channels``, and each frame's sample of them."""

    kind: str
    channels: tuple[LslChannel, ...]

    @abstractmethod
    def sample(self, frame: StreamFrame) -> Array:
        """Return the values (channels,) float64 of a frame."""


class LslMarkers(LslContent):
    """Markers by label, then ``places`` for markers without one: a track keeps its place until it is not seen.

    ``left_out``: samples of markers without a label that found no place.
    """

    kind = "markers"

    def __init__(self, names: StreamNames, places: int) -> None:
        self._numbers = np.array(list(names.numbers.values()), np.uint32)
        self._order = np.argsort(self._numbers)
        self._holder = np.full(places, -1, np.int64)
        self.left_out = 0
        named = [_channels((*POSITION, CONFIDENCE), marker=label) for label in names.numbers]
        free = [_channels((*POSITION, CONFIDENCE, TRACK), marker=f"unlabelled{k + 1}") for k in range(places)]
        self.channels = _with_number(named + free)

    def sample(self, frame: StreamFrame) -> Array:
        """Return the values (channels,) of a frame."""
        n, places = len(self._numbers), len(self._holder)
        named, free = _unknown(n, 4, 3), _unknown(places, 5, 3)
        markers = frame.markers
        loose = (markers["params"] & UNLABELLED) != 0
        values = np.column_stack(
            [markers["position"], np.where(markers["params"] & OCCLUDED, MODELLED, 1.0), markers["id"]]
        )
        if n:
            labelled = values[~loose]
            ids = labelled[:, 4].astype(np.uint32)
            at = self._order[np.minimum(np.searchsorted(self._numbers, ids, sorter=self._order), n - 1)]
            known = self._numbers[at] == ids
            named[at[known]] = labelled[known, :4]
        if places:
            self._place(values[loose], free)
        return np.concatenate([named.ravel(), free.ravel(), [frame.number]])

    def _place(self, values: Array, free: Array) -> None:
        """Write markers without a label (m, 5) to their places (p, 5)."""
        ids = values[:, 4].astype(np.int64)
        self._holder[~np.isin(self._holder, ids)] = -1
        new = ids[~np.isin(ids, self._holder)]
        empty = np.flatnonzero(self._holder < 0)
        taken = min(len(new), len(empty))
        self._holder[empty[:taken]] = new[:taken]
        self.left_out += len(new) - taken
        row_of = {number: row for row, number in enumerate(ids.tolist())}
        for place in np.flatnonzero(self._holder >= 0).tolist():
            free[place] = values[row_of[int(self._holder[place])]]


class LslBodies(LslContent):
    """Poses of bodies, or of a skeleton's segments."""

    def __init__(self, kind: str, bodies: Sequence[StreamedBody]) -> None:
        self.kind = kind
        self._row_of = {body.number: row for row, body in enumerate(bodies)}
        kinds = (*POSITION, *ORIENTATION, CONFIDENCE)
        self.channels = _with_number([_channels(kinds, body=body.name) for body in bodies])

    def sample(self, frame: StreamFrame) -> Array:
        """Return the values (channels,) of a frame."""
        poses = frame.bodies
        if self.kind == "segments":
            poses = np.concatenate([bones for _, bones in frame.skeletons]) if frame.skeletons else poses[:0]
        values = _unknown(len(self._row_of), 8, 7)
        for one in poses[(poses["params"] & TRACKED) != 0]:
            x, y, z, w = one["quaternion"]
            # the high half of a bone's number is the skeleton's
            values[self._row_of[int(one["id"]) & 0xFFFF]] = (*one["position"], w, x, y, z, 1.0)
        return np.append(values.ravel(), frame.number)


class LslAngles(LslContent):
    """Joint angles."""

    kind = "angles"

    def __init__(self, names: StreamNames) -> None:
        self.channels = _with_number([[LslChannel(name, ANGLE, _UNITS[ANGLE], object=name) for name in names.angles]])

    def sample(self, frame: StreamFrame) -> Array:
        """Return the values (channels,) of a frame."""
        return np.append(frame.angles, frame.number)


def contents(model: StreamModel, names: StreamNames, places: int) -> tuple[LslContent, ...]:
    """Return a stream for each kind of content that exists: markers, bodies, segments, angles.

    ``places``: for markers without a label.
    """
    bodies = [one for one in model if isinstance(one, StreamedBody)]
    bones = [bone for one in model if isinstance(one, StreamedSkeleton) for bone in one.bones]
    found: list[LslContent] = []
    if names.numbers or places:
        found.append(LslMarkers(names, places))
    if bodies:
        found.append(LslBodies("bodies", bodies))
    if bones:
        found.append(LslBodies("segments", bones))
    if names.angles:
        found.append(LslAngles(names))
    return tuple(found)


def _channels(kinds: Sequence[str], marker: str = "", body: str = "") -> list[LslChannel]:
    def unit(kind: str) -> str:
        return _UNITS.get(kind) or ("meters" if kind in POSITION else "quaternion")

    return [LslChannel(f"{marker or body}_{_short(kind)}", kind, unit(kind), marker, body) for kind in kinds]


def _short(kind: str) -> str:
    return kind.removeprefix("Position").removeprefix("Orientation")


def _with_number(parts: Sequence[Sequence[LslChannel]]) -> tuple[LslChannel, ...]:
    return (*(channel for part in parts for channel in part), LslChannel("frame", NUMBER, _UNITS[NUMBER]))


def _unknown(rows: int, columns: int, confidence: int) -> Array:
    made = np.full((rows, columns), np.nan)
    made[:, confidence] = 0.0
    return made
