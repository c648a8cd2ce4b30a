"""Labelled markers frame by frame, as the skeleton's fit and tracking read them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.triangulation.camera_shake import no_more_than, shake_covariance, without


@dataclass(frozen=True, eq=False)
class MarkerFrames:
    """Measured places of m labelled markers in n frames.

    ``frame``, ``time_ns`` (n,); ``xyz`` (n, m, 3) world [m], NaN where not measured; ``covariance`` (n, m, 3, 3) of
    the measurement [m^2], 0 where not known. Where the cameras' shake is separated, ``covariance`` covers each
    marker's own errors, and ``shared`` (n, 3, 3) [m^2] a shift of all markers of a frame; else ``shared`` is 0.
    """

    labels: tuple[str, ...]
    frame: Array
    time_ns: Array
    xyz: Array
    covariance: Array
    shared: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def __post_init__(self) -> None:
        n, m = len(np.asarray(self.frame)), len(self.labels)
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,))
        if not len(self.shared):
            object.__setattr__(self, "shared", np.zeros((n, 3, 3)))
        set_read_only(self, xyz=(n, m, 3), covariance=(n, m, 3, 3), shared=(n, 3, 3))

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def seen(self) -> Array:
        """(n, m) whether a marker was measured."""
        return np.asarray(np.isfinite(self.xyz[:, :, 0]))

    def select(self, rows: Array) -> "MarkerFrames":
        """Return the frames selected by a boolean mask or an index array."""
        columns = (self.frame, self.time_ns, self.xyz, self.covariance, self.shared)
        return MarkerFrames(self.labels, *(column[rows] for column in columns))

    def of(self, labels: Sequence[str]) -> "MarkerFrames":
        """Return some of the markers, in the order of ``labels``."""
        columns = [self.labels.index(label) for label in labels]
        of_markers = self.xyz[:, columns], self.covariance[:, columns]
        return MarkerFrames(tuple(labels), self.frame, self.time_ns, *of_markers, self.shared)


def short_label(label: str) -> str:
    """Return a label without its subject ("Anna:LKNE" is LKNE), as C3D files write them."""
    return label.rsplit(":", 1)[-1]


def labels_of(tracks: Tracks) -> tuple[str, ...]:
    """Return the labels of ``tracks`` without their subject, sorted."""
    return tuple(sorted({short_label(label) for label in np.unique(tracks.label).tolist() if label}))


def marker_frames(tracks: Tracks, labels: Sequence[str], rig: Rig | None = None) -> MarkerFrames:
    """Return the measured samples of ``labels`` in all frames of ``tracks``; of two with one label, the more certain.

    ``rig``: the cameras that measured them, whose shake is separated; None where not known.
    """
    frame, first, row = np.unique(tracks.frame, return_index=True, return_inverse=True)
    xyz = np.full((len(frame), len(labels), 3), np.nan)
    covariance = np.zeros((len(frame), len(labels), 3, 3))
    n_cameras = np.zeros((len(frame), len(labels)))
    column_of = {label: k for k, label in enumerate(labels)}
    names, which = np.unique(tracks.label, return_inverse=True)
    column = np.array([column_of.get(short_label(name), -1) for name in names.tolist()], dtype=np.int64)[which]
    known = np.where(np.isfinite(tracks.covariance), tracks.covariance, 0.0)
    used = np.flatnonzero((column >= 0) & (tracks.status == "measured"))
    used = used[np.argsort(-np.trace(known[used], axis1=1, axis2=2), kind="stable")]
    at = row[used], column[used]
    xyz[at], covariance[at], n_cameras[at] = tracks.xyz[used], known[used], tracks.n_cameras[used]
    shared = np.zeros((len(frame), 3, 3))
    if rig is not None:
        shared, covariance = _told_apart(rig, xyz, covariance, n_cameras)
    return MarkerFrames(tuple(labels), frame, tracks.time_ns[first], xyz, covariance, shared)


def _told_apart(rig: Rig, xyz: Array, covariance: Array, n_cameras: Array) -> tuple[Array, Array]:
    """Return the covariances (n, 3, 3) of the shift of all markers by camera shake, and of the markers' own errors.

    ``xyz`` (n, m, 3), ``covariance`` (n, m, 3, 3), ``n_cameras`` (n, m), 0 where not measured.
    """
    seen = n_cameras > 0
    some = np.flatnonzero(seen.any(axis=1))
    shared, alike = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3, 3))
    each = n_cameras[some].sum(axis=1) / seen[some].sum(axis=1)
    stated = usual_covariance(covariance[some], seen[some])
    shared[some], alike[some] = common_shift(rig, np.nanmean(xyz[some], axis=1), each, stated)
    return shared, np.where(seen[..., None, None], without(covariance, alike[:, None]), covariance)


def usual_covariance(covariance: Array, seen: Array) -> Array:
    """Return the covariance (n, 3, 3), of those (n, m, 3, 3) of the ``seen`` (n, m), one or more, of median trace."""
    trace = np.where(seen, np.trace(covariance, axis1=2, axis2=3), np.inf)
    rows = np.arange(len(seen))
    return np.asarray(covariance[rows, np.argsort(trace, axis=1)[rows, (seen.sum(axis=1) - 1) // 2]])


def common_shift(rig: Rig, middle: Array, images: Array, stated_m2: Array) -> tuple[Array, Array]:
    """Return the covariance (n, 3, 3) [m^2] of a body's shift by camera shake, and the part that turns no segment.

    ``middle`` (n, 3): mean place of its markers [m]; ``images`` (n,): mean number of images of a marker;
    ``stated_m2`` (n, 3, 3): covariance of a usual marker [m^2]. The shift has at most this, on the whole and in each
    direction: where many targets have shown the cameras' turns (``mosca.correspondence.shared_turns``), less than the
    whole shake is left.
    """
    shared, most = shake_covariance(rig, middle)
    whole, usual = (np.trace(one, axis1=1, axis2=2) for one in (shared, stated_m2))
    shared *= np.minimum(usual / np.maximum(whole, 1e-300), 1.0)[:, None, None]
    shared = no_more_than(shared, stated_m2)
    return shared, turned_alike(images / np.maximum(most, 1))[:, None, None] * shared


def turned_alike(seen_by: Array) -> Array:
    """Return the share (n,) of a body's common shift by shake that does not turn its segments, where each marker is
    ``seen_by`` a share (n,) of the cameras.

    Markers around a body are seen by the cameras on their own side. If the normals of two markers differ by the angle
    f, a share o(f) of the cameras that see one also sees the other: the overlap of two arcs of 2 w = 2 pi
    ``seen_by``. The covariance of their errors is o pi / w times that of the common shift. A turn weights pairs by
    their squared distances, sin^2 (f / 2). The share is 1 where all cameras see all markers, 0.6 where half do.
    """
    f = (np.arange(180) + 0.5) * np.pi / 180
    w = np.pi * np.clip(seen_by, 1e-3, 1.0)[:, None]
    overlap = (np.maximum(2 * w - f, 0.0) + np.maximum(2 * w - 2 * np.pi + f, 0.0)) / (2 * w)
    weight = np.sin(f / 2) ** 2
    return np.asarray((np.pi / w * overlap * weight).sum(axis=1) / weight.sum())
