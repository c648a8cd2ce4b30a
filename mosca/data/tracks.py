"""Points of one instant and tracks over time: what the pipeline gives and scoring reads."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.files.npz import from_npz, whole_numbers, write_npz_file

STATUSES = ("measured", "filled", "predicted", "edited")
"""Where a position comes from; "edited": moved by hand. Only "measured" ones count as seen by cameras."""


@dataclass(frozen=True, eq=False)
class Points:
    """Triangulated points of one frame set, before data association with tracks."""

    xyz: Array
    """(n, 3) world frame [m]."""
    covariance: Array
    """(n, 3, 3) of the measurement [m^2]."""
    n_cameras: Array
    """(n,) number of cameras that measured it."""
    residual_px: Array
    """(n,) rms reprojection error."""
    rays: Array
    """(n, n_rig_cameras) index of the detection that each camera contributed, -1 where it contributed none."""
    diameter_m: Array
    """(n,) diameter of the target, from the largest of its images."""
    trusted: Array
    """(n,) effective number of cameras: images of odd size (partly occluded, merged) count less than one."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.xyz))
        set_read_only(self, xyz=(None, 3), covariance=(n, 3, 3), residual_px=(n,), diameter_m=(n,), trusted=(n,))
        set_read_only(self, np.int64, n_cameras=(n,), rays=(n, None))

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def handed_over(cls, columns: Sequence[Array]) -> "Points":
        """Return points of valid read-only columns in the order of the fields, without checks or copies."""
        new = object.__new__(cls)
        new.__dict__.update(zip(cls.__dataclass_fields__, columns, strict=True))
        return new

    def moved(self, xyz: Array, covariance: Array) -> "Points":
        """Return the same points at other places, without checks: both are read-only."""
        new = object.__new__(Points)
        new.__dict__.update(self.__dict__, xyz=xyz, covariance=covariance)
        return new


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples as they leave the tracker, frame set by frame set: columns, unchecked for speed.

    As in ``Tracks``, but unsorted, without labels, and ``status`` (n,) int8 an index into STATUSES.
    """

    frame: Array
    time_ns: Array
    track: Array
    xyz: Array
    covariance: Array
    n_cameras: Array
    residual_px: Array
    status: Array

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def none(cls) -> "Samples":
        """No samples."""
        return cls(
            np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)),
            np.empty((0, 3, 3)), np.empty(0, np.int64), np.empty(0), np.empty(0, np.int8),
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence["Samples"]) -> "Samples":
        """Return the samples of several parts, in their order."""
        if not parts:
            return cls.none()
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))

    def select(self, rows: Array) -> "Samples":
        """Return the samples that a boolean mask or an index array (m,) selects."""
        return Samples(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def certain(self, worst_sigma_m: float) -> "Samples":
        """Return the samples whose largest standard deviation [m] is not above ``worst_sigma_m``."""
        # no standard deviation exceeds the root of the trace, so that hardly any sample needs its eigenvalues
        kept = np.trace(self.covariance, axis1=1, axis2=2) <= worst_sigma_m**2
        kept[~kept] = np.linalg.eigvalsh(self.covariance[~kept])[:, -1] <= worst_sigma_m**2
        return self.select(kept)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Samples of trajectories as columns, one row per track and frame, sorted by (frame, track)."""

    frame: Array
    """(n,) pulse number."""
    time_ns: Array
    """(n,) mid-exposure."""
    track: Array
    """(n,) identity."""
    label: Array
    """(n,) str, empty where unknown."""
    xyz: Array
    """(n, 3) world frame [m]."""
    covariance: Array
    """(n, 3, 3) [m^2], of the measurement alone."""
    n_cameras: Array
    """(n,) number of cameras that measured it."""
    residual_px: Array
    """(n,), NaN where unknown."""
    status: Array
    """(n,) one of STATUSES."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.frame))
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,), track=(n,), n_cameras=(n,))
        set_read_only(self, np.str_, label=(n,), status=(n,))
        set_read_only(self, xyz=(n, 3), covariance=(n, 3, 3), residual_px=(n,))
        unknown = set(np.unique(self.status)) - set(STATUSES)
        if unknown:
            raise ValueError(f"status: {sorted(unknown)} given, {STATUSES} allowed")

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def none(cls) -> "Tracks":
        """No samples."""
        e = np.empty(0)
        return cls(e, e, e, e.astype(str), np.empty((0, 3)), np.empty((0, 3, 3)), e, e, e.astype(str))

    @property
    def frame_period_s(self) -> float | None:
        """Median time from frame to frame [s]; None where there are fewer than two."""
        frame, first = np.unique(self.frame, return_index=True)
        if len(frame) < 2:
            return None
        return float(np.median(np.diff(self.time_ns[first]) / np.diff(frame))) * 1e-9

    def select(self, rows: Array) -> "Tracks":
        """Return the samples that a boolean mask or an index array (m,) selects."""
        return Tracks(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def table(parts: Sequence[Samples]) -> Tracks:
    """Return samples as tracks without labels, sorted by frame and track."""
    if not parts:
        return Tracks.none()
    samples = Samples.joined(parts)
    samples = samples.select(np.lexsort((samples.track, samples.frame)))
    columns = {name: getattr(samples, name) for name in Samples.__dataclass_fields__}
    status = np.asarray(STATUSES)[columns.pop("status")]
    return Tracks(**columns, label=np.full(len(samples), ""), status=status)


def write_npz(tracks: Tracks, path: Path) -> None:
    """Write all columns of ``tracks`` under their names (numpy .npz, no pickles), with a checksum."""
    write_npz_file(path, {name: getattr(tracks, name) for name in tracks.__dataclass_fields__})


def read_npz(path: Path) -> Tracks:
    """Read what ``write_npz`` wrote; raises InputError for a file that is missing or holds something else."""
    return from_npz(path, _tracks_of, "tracks", "'mosca run' or 'mosca reconstruct'")


def _tracks_of(columns: Mapping[str, Array]) -> Tracks:
    whole_numbers(columns, "frame", "time_ns", "track", "n_cameras")
    return Tracks(**{name: columns[name] for name in Tracks.__dataclass_fields__})
