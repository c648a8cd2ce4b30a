"""Tracks as a table of frames by markers: what C3D and TRC files hold."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.tracks import Tracks
from mosca.errors import InputError

MOST_CELLS = 100_000_000
"""Frames times markers that a table may have; it holds 5 numbers a cell in memory."""


@dataclass(frozen=True, eq=False)
class MarkerTable:
    """Marker trajectories on a regular grid of frames.

    ``names`` (m) distinct; ``xyz`` (t, m, 3) world frame [m], NaN where a marker was not seen; ``measured``
    (t, m) False where a value was filled or predicted, or there is none; ``deviation_m`` (t, m) standard
    deviation of the 3D position [m], NaN where unknown; ``first_frame`` number of the first row;
    ``rate_hz`` frames per second.
    """

    names: tuple[str, ...]
    xyz: Array
    measured: Array
    deviation_m: Array
    first_frame: int
    rate_hz: float

    def __post_init__(self) -> None:
        m = len(self.names)
        set_read_only(self, xyz=(None, m, 3), deviation_m=(len(self.xyz), m))
        set_read_only(self, np.bool_, measured=(len(self.xyz), m))


def table_from_tracks(tracks: Tracks, rate_hz: float) -> MarkerTable:
    """Return ``tracks`` as a table from their first to their last frame.

    A marker's name is its label. Tracks of one label share a column (a marker that was lost and found again) unless
    they have a frame in common; then, and for tracks without a label, the track's number is appended.
    """
    if len(tracks) == 0:
        none = np.empty((0, 0))
        return MarkerTable((), np.empty((0, 0, 3)), none.astype(bool), none, 0, rate_hz)
    columns = _column_names(tracks)
    names = tuple(dict.fromkeys(columns[track] for track in sorted(columns)))
    column_of = {track: names.index(name) for track, name in columns.items()}
    identities, inverse = np.unique(tracks.track, return_inverse=True)
    column = np.array([column_of[int(track)] for track in identities])[inverse]
    first, last = int(tracks.frame.min()), int(tracks.frame.max())
    if (last - first + 1) * len(names) > MOST_CELLS:
        raise InputError(
            f"tracks: {len(names)} markers in frames {first} to {last} make a table of more than {MOST_CELLS:g} "
            "cells; write .npz or .csv, or fewer frames"
        )
    xyz = np.full((last - first + 1, len(names), 3), np.nan)
    measured = np.zeros(xyz.shape[:2], dtype=bool)
    row = tracks.frame - first
    xyz[row, column] = tracks.xyz
    measured[row, column] = (tracks.status == "measured") & np.isfinite(tracks.xyz).all(axis=1)
    deviation = np.full(xyz.shape[:2], np.nan)
    deviation[row, column] = np.sqrt(np.trace(tracks.covariance, axis1=1, axis2=2))
    return MarkerTable(names, xyz, measured, deviation, first, rate_hz)


def plain_names(names: tuple[str, ...], longest: int | None = None) -> tuple[str, ...]:
    """Return names that a line of a file can hold: no line breaks, tabs or blanks at the ends, all distinct.

    ``longest``: most characters, in a one-byte encoding; characters outside it are written as ?.
    """
    plain: list[str] = []
    for k, name in enumerate(names, start=1):
        one = " ".join("".join(c if c.isprintable() else " " for c in name).split()) or f"marker_{k}"
        if longest is not None:
            one = one.encode("latin-1", "replace").decode("latin-1")[:longest]
        tail = 0
        while one in plain:
            tail += 1
            one = f"{one[: (longest or len(one) + 12) - 12]}_{k}_{tail}"
        plain.append(one)
    return tuple(plain)


def tracks_from_table(table: MarkerTable) -> Tracks:
    """Return the samples of a table; a track for each marker, covariance and residual unknown."""
    rows, columns = np.nonzero(np.isfinite(table.xyz).all(axis=2))
    n = len(rows)
    frame = rows + table.first_frame
    return Tracks(
        frame=frame,
        time_ns=np.round(frame * (1e9 / table.rate_hz)).astype(np.int64),
        track=columns,
        label=np.array(table.names, dtype=np.str_)[columns] if n else np.empty(0, dtype=np.str_),
        xyz=table.xyz[rows, columns],
        covariance=np.full((n, 3, 3), np.nan),
        n_cameras=np.zeros(n, dtype=np.int64),
        residual_px=np.full(n, np.nan),
        status=np.where(table.measured[rows, columns], "measured", "filled"),
    )


def _column_names(tracks: Tracks) -> dict[int, str]:
    """Return track -> the name of its column."""
    label_of: dict[int, str] = {}
    frames_of: dict[int, set[int]] = {}
    for track, label, frame in zip(tracks.track.tolist(), tracks.label.tolist(), tracks.frame.tolist(), strict=True):
        frames_of.setdefault(track, set()).add(frame)
        if label or track not in label_of:
            label_of[track] = label
    names: dict[int, str] = {}
    for label in dict.fromkeys(label_of.values()):
        same = [track for track, other in label_of.items() if other == label]
        taken = sum(len(frames_of[track]) for track in same)
        shared = taken > len(set().union(*(frames_of[track] for track in same)))
        for track in same:
            if not label:
                names[track] = f"track_{track}"
            else:
                names[track] = f"{label}_{track}" if shared else label
    return names
