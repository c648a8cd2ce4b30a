"""Evidence: the data of one run that its page shows besides the figures. Plain data, made by the scorer."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only_image, set_read_only
from mosca.data.detections import Detections
from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from reports.flight_evidence import FlightEvidence
from reports.self_orientation_evidence import SelfOrientationEvidence
from reports.vibration_evidence import VibrationEvidence
from reports.virtual_evidence import VirtualEvidence


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Errors of matched samples, one row for each sample."""

    frame: Array
    """(k,) pulse."""
    time_s: Array
    """(k,) the truth's instant [s from session start]."""
    marker: Array
    """(k,) index into the truth's names."""
    error_xyz_m: Array
    """(k, 3) measured minus true position, world frame [m]."""
    sample: Array | None = None
    """(k,) row of the sample in the tracks."""

    def __post_init__(self) -> None:
        k = len(np.asarray(self.frame))
        set_read_only(self, np.int64, frame=(k,), marker=(k,))
        if self.sample is not None:
            set_read_only(self, np.int64, sample=(k,))
        set_read_only(self, time_s=(k,), error_xyz_m=(k, 3))

    def distance_m(self) -> Array:
        """Return the length of each error (k,) [m]."""
        result: Array = np.linalg.norm(self.error_xyz_m, axis=1)
        return result


@dataclass(frozen=True, eq=False)
class MarkerCounts:
    """Visible, found and false points, one row for each frame."""

    time_s: Array
    """(t,) [s from session start]."""
    n_true_seen: Array
    """(t,) number of visible markers."""
    n_matched: Array
    """(t,) number of these that were found."""
    n_ghosts: Array
    """(t,) points that belong to no marker."""

    def __post_init__(self) -> None:
        t = len(np.asarray(self.time_s))
        set_read_only(self, time_s=(t,))
        set_read_only(self, np.int64, n_true_seen=(t,), n_matched=(t,), n_ghosts=(t,))


@dataclass(frozen=True, eq=False)
class CameraView:
    """One frame of one camera and what was detected in it.

    ``image`` (H, W) uint8 or uint16; ``true_xy_px`` (n, 2): true positions of the targets, or None.
    """

    camera: str
    image: Array
    detections: Detections
    true_xy_px: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", read_only_image(self.image))
        if self.true_xy_px is not None:
            set_read_only(self, true_xy_px=(None, 2))


@dataclass(frozen=True, eq=False)
class KeptImage:
    """A small copy of one camera's image, and the detections in the original."""

    camera: str
    webp: bytes
    """WebP file; the same field of view, thinned by block maxima, contrast stretched."""
    size_px: tuple[int, int]
    """Width and height of the whole image."""
    xy_px: Array
    """(n, 2) detections in the whole image."""
    diameter_px: Array
    """(n,)"""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.xy_px))
        set_read_only(self, xy_px=(n, 2), diameter_px=(n,))


@dataclass(frozen=True)
class KeptSet:
    """Images of one frame set."""

    pulse: int
    images: tuple[KeptImage, ...]


@dataclass(frozen=True, eq=False)
class MeasuredBy:
    """The cameras that measured each point, at some of the pulses."""

    frame: Array
    """(k,) pulse."""
    xyz: Array
    """(k, 3) measured position, world frame [m]."""
    cameras: Array
    """(k, c) bool, in the rig's order."""

    def __post_init__(self) -> None:
        k = len(np.asarray(self.frame))
        set_read_only(self, np.int64, frame=(k,))
        set_read_only(self, xyz=(k, 3))
        set_read_only(self, np.bool_, cameras=(k, None))


@dataclass(frozen=True, eq=False)
class Evidence:
    """Data of one run to be drawn. Without ground truth (a real recording) the truth's fields are None or empty."""

    rig: Rig
    working_space_center: Array
    """(3,) of the box in the world [m]."""
    working_space_size: Array
    """(3,) [m]."""
    tracks: Tracks
    views: tuple[CameraView, ...] = ()
    truth_time_ns: Array | None = None
    """(t,)"""
    truth_xyz: Array | None = None
    """(t, m, 3) [m]."""
    truth_names: tuple[str, ...] = ()
    """(m)"""
    marker_seen: Array | None = None
    """(m,) number of frames in which each marker was visible."""
    errors: ErrorTable | None = None
    counts: MarkerCounts | None = None
    angles: JointAngles | None = None
    """Joint angles of a person."""
    true_angles: JointAngles | None = None
    joints: JointMotion | None = None
    """Joints of a person."""
    true_joints: JointMotion | None = None
    vibration: VibrationEvidence | None = None
    """Spectra and modes of a panel."""
    self_orientation: SelfOrientationEvidence | None = None
    """Errors of a camera's own poses and of those by a rig."""
    flight: FlightEvidence | None = None
    """A flight in closed loop."""
    virtual: VirtualEvidence | None = None
    """Virtual objects as they were shown."""
    kept_sets: tuple[KeptSet, ...] = ()
    """Images of all cameras at some pulses."""
    measured_by: MeasuredBy | None = None
    could_see: Array | None = None
    """(t, m, c) bool: the cameras to which each marker was visible, from the truth alone."""

    def __post_init__(self) -> None:
        set_read_only(self, working_space_center=(3,), working_space_size=(3,))
        object.__setattr__(self, "views", tuple(self.views))
        object.__setattr__(self, "truth_names", tuple(self.truth_names))
        if (self.truth_time_ns is None) != (self.truth_xyz is None):
            raise ValueError("evidence: truth_time_ns and truth_xyz belong together")
        if self.truth_xyz is not None and self.truth_time_ns is not None:
            t, m = len(np.asarray(self.truth_time_ns)), len(self.truth_names)
            set_read_only(self, np.int64, truth_time_ns=(t,))
            set_read_only(self, truth_xyz=(t, m, 3))
        if self.marker_seen is not None:
            m = len(self.truth_names)
            set_read_only(self, np.int64, marker_seen=(m,))
        if self.could_see is not None:
            set_read_only(self, np.bool_, could_see=(None, len(self.truth_names), len(self.rig.cameras)))
        if self.errors is not None:
            markers = self.errors.marker
            if self.truth_xyz is None:
                raise ValueError("evidence: errors without the truth that they are errors of")
            if len(markers) and not 0 <= markers.min() <= markers.max() < len(self.truth_names):
                raise ValueError(f"evidence: errors of marker {markers.max()}, {len(self.truth_names)} named")

    def could_be_measured(self) -> Array:
        """Return the markers visible to two cameras (t, m) bool; if that is unknown, those with a known position."""
        assert self.truth_xyz is not None
        if self.could_see is not None:
            return np.asarray(self.could_see.sum(axis=2) >= 2)
        return np.asarray(np.isfinite(self.truth_xyz).all(axis=2))


def true_positions(evidence: Evidence) -> Array:
    """Return the true position (k, 3) of each sample of the error table: the truth nearest in time [m]."""
    assert evidence.errors is not None
    assert evidence.truth_time_ns is not None
    assert evidence.truth_xyz is not None
    times = 1e-9 * evidence.truth_time_ns
    rows = np.clip(np.searchsorted(times, evidence.errors.time_s), 1, max(1, len(times) - 1))
    rows = np.minimum(rows, len(times) - 1)
    before = np.maximum(rows - 1, 0)
    nearer = np.abs(times[before] - evidence.errors.time_s) < np.abs(times[rows] - evidence.errors.time_s)
    return np.asarray(evidence.truth_xyz[np.where(nearer, before, rows), evidence.errors.marker])
