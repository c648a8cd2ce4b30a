"""Labelled markers frame by frame, as the skeleton's fit and tracking read them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.tracks import Tracks


@dataclass(frozen=True, eq=False)
class MarkerFrames:
    """Measured places of m labelled markers in n frames.

    ``frame``, ``time_ns`` (n,); ``xyz`` (n, m, 3) world [m], NaN where not measured; ``covariance`` (n, m, 3, 3) of
    the measurement [m^2], 0 where not known.
    """

    labels: tuple[str, ...]
    frame: Array
    time_ns: Array
    xyz: Array
    covariance: Array

    def __post_init__(self) -> None:
        n, m = len(np.asarray(self.frame)), len(self.labels)
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,))
        set_read_only(self, xyz=(n, m, 3), covariance=(n, m, 3, 3))

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def seen(self) -> Array:
        """(n, m) whether a marker was measured."""
        return np.asarray(np.isfinite(self.xyz[:, :, 0]))

    def select(self, rows: Array) -> "MarkerFrames":
        """Return the frames that a boolean mask or an index array names."""
        return MarkerFrames(self.labels, self.frame[rows], self.time_ns[rows], self.xyz[rows], self.covariance[rows])


def short_label(label: str) -> str:
    """Return a label without its subject ("Anna:LKNE" is LKNE), as C3D files write them."""
    return label.rsplit(":", 1)[-1]


def labels_of(tracks: Tracks) -> tuple[str, ...]:
    """Return the labels of ``tracks`` without their subject, sorted."""
    return tuple(sorted({short_label(label) for label in np.unique(tracks.label).tolist() if label}))


def marker_frames(tracks: Tracks, labels: Sequence[str]) -> MarkerFrames:
    """Return the measured samples of ``labels`` in all frames of ``tracks``; of two with one label, the surer one."""
    frame, first, row = np.unique(tracks.frame, return_index=True, return_inverse=True)
    xyz = np.full((len(frame), len(labels), 3), np.nan)
    covariance = np.zeros((len(frame), len(labels), 3, 3))
    column_of = {label: k for k, label in enumerate(labels)}
    names, which = np.unique(tracks.label, return_inverse=True)
    column = np.array([column_of.get(short_label(name), -1) for name in names.tolist()], dtype=np.int64)[which]
    known = np.where(np.isfinite(tracks.covariance), tracks.covariance, 0.0)
    used = np.flatnonzero((column >= 0) & (tracks.status == "measured"))
    used = used[np.argsort(-np.trace(known[used], axis1=1, axis2=2), kind="stable")]
    xyz[row[used], column[used]] = tracks.xyz[used]
    covariance[row[used], column[used]] = known[used]
    return MarkerFrames(tuple(labels), frame, tracks.time_ns[first], xyz, covariance)
