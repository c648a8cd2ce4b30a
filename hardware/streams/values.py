"""What is streamed: one frame of markers and bodies, and the model that names them. Metres, quaternions xyzw.

Marker and body records are packed structured arrays, so that a frame is encoded by a copy. Flags are those of NatNet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array

BODY = np.dtype(
    [("id", "<u4"), ("position", "<f4", 3), ("quaternion", "<f4", 4), ("error", "<f4"), ("params", "<u2")]
)
"""One rigid body: pose world_from_body [m], quaternion xyzw, mean marker error [m], flags."""
MARKER = np.dtype([("id", "<u4"), ("position", "<f4", 3), ("size", "<f4"), ("params", "<u2"), ("residual", "<f4")])
"""One marker: asset and member number in ``id``, position [m], diameter [m], flags, residual [m]."""
TRACKED = 0x01
"""Flag of a body: it has a pose in this frame."""
OCCLUDED, SEEN, FROM_MODEL, HAS_MODEL, UNLABELLED = 0x01, 0x02, 0x04, 0x08, 0x10
"""Flags of a marker. ``SEEN``: position from rays of this frame; ``FROM_MODEL``: from a model of the motion."""
NO_BODIES, NO_MARKERS = np.empty(0, BODY), np.empty(0, MARKER)
NO_POINTS, NO_ANGLES = np.empty((0, 3), "<f4"), np.empty(0)


@dataclass(frozen=True, eq=False)
class StreamFrame:
    """Content of one frame, for any version of a protocol."""

    number: int
    timestamp_s: float
    """Mid-exposure on the take's own clock."""
    marker_sets: tuple[tuple[str, Array], ...] = ()
    """(name, (m, 3) positions of its markers, in the order of the model)."""
    other: Array = field(default_factory=lambda: NO_POINTS)
    """(n, 3) positions without a label."""
    bodies: Array = field(default_factory=lambda: NO_BODIES)
    """(b,) BODY."""
    skeletons: tuple[tuple[int, Array], ...] = ()
    """(number, (b,) BODY of its bones)."""
    markers: Array = field(default_factory=lambda: NO_MARKERS)
    """(n,) MARKER, those without a label too."""
    angles: Array = field(default_factory=lambda: NO_ANGLES)
    """(a,) of joints [rad], NaN where unknown; for protocols that have them."""
    timecode: tuple[int, int] = (0, 0)
    params: int = 0
    """0x01: a take is being recorded; 0x02: the model has changed."""


@dataclass(frozen=True)
class StreamedSet:
    """A named list of markers."""

    name: str
    markers: tuple[str, ...]


@dataclass(frozen=True)
class StreamedBody:
    """A rigid body: ``markers`` at ``positions`` [m] in its own frame. ``parent``: -1 where it has none."""

    name: str
    number: int
    markers: tuple[str, ...] = ()
    positions: tuple[tuple[float, float, float], ...] = ()
    parent: int = -1
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StreamedSkeleton:
    """A skeleton of rigid bodies."""

    name: str
    number: int
    bones: tuple[StreamedBody, ...]


@dataclass(frozen=True)
class StreamNames:
    """Meaning of the numbers and columns of frames, where a protocol does not take it from its model.

    ``numbers``: number of each label's marker; ``angles``: names of the joint angles, in their order.
    """

    numbers: Mapping[str, int] = field(default_factory=dict)
    angles: tuple[str, ...] = ()


StreamModel = Sequence[StreamedSet | StreamedBody | StreamedSkeleton]
