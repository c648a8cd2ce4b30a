"""``tracks.csv``: one line for each track and frame, every number at full precision.

Columns ``frame,time_ns,track,label,x,y,z,sxx,syy,szz,sxy,sxz,syz,n_cameras,residual_px,status``: position in m
and covariance of the measurement in m^2, world frame; cells are empty where unknown. The covariance is symmetric,
so six of its elements are written.
"""

from pathlib import Path

import numpy as np

from mosca.data.tracks import STATUSES, Tracks
from mosca.formats.tracks.csv_columns import integers, one_of, parsed, read_columns, reals, write_columns

COLUMNS = (
    "frame", "time_ns", "track", "label", "x", "y", "z", "sxx", "syy", "szz", "sxy", "sxz", "syz",
    "n_cameras", "residual_px", "status",
)  # fmt: skip
COVARIANCE_ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def write_tracks_csv(tracks: Tracks, path: Path) -> None:
    """Write ``tracks`` to ``path``, whole or not at all. Raises InputError where that fails."""
    write_columns(path, COLUMNS, cells_of(tracks))


def cells_of(tracks: Tracks) -> list[list[str]]:
    """Return the text of each column of ``tracks`` (n cells each), in the order of COLUMNS."""
    return [
        integers(tracks.frame),
        integers(tracks.time_ns),
        integers(tracks.track),
        tracks.label.tolist(),
        *(reals(tracks.xyz[:, k]) for k in range(3)),
        *(reals(tracks.covariance[:, i, j]) for i, j in COVARIANCE_ELEMENTS),
        integers(tracks.n_cameras),
        reals(tracks.residual_px),
        tracks.status.tolist(),
    ]


def read_tracks_csv(path: Path) -> Tracks:
    """Read a ``tracks.csv``. Raises InputError naming the line or column and what is allowed."""
    path = Path(path)
    cells = read_columns(path, COLUMNS, "tracks.csv")
    status = one_of(cells["status"], "status", STATUSES, path)
    covariance = np.empty((len(status), 3, 3))
    for (i, j), name in zip(COVARIANCE_ELEMENTS, COLUMNS[7:13], strict=True):
        covariance[:, i, j] = covariance[:, j, i] = parsed(cells[name], name, float, path)
    return Tracks(
        frame=parsed(cells["frame"], "frame", int, path),
        time_ns=parsed(cells["time_ns"], "time_ns", int, path),
        track=parsed(cells["track"], "track", int, path),
        label=np.array(cells["label"], dtype=np.str_),
        xyz=np.stack([parsed(cells[name], name, float, path) for name in "xyz"], axis=1),
        covariance=covariance,
        n_cameras=parsed(cells["n_cameras"], "n_cameras", int, path),
        residual_px=parsed(cells["residual_px"], "residual_px", float, path),
        status=status,
    )
