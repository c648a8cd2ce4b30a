"""The truth for frames from other sources than the twin: a recorded truth, or a user's own reference.

A user's reference, ``truth.csv``, has one row for each marker and instant: ``label,x,y,z`` [m, the rig's world frame]
and ``time_ns`` [session clock, as in ``tracks.csv``], which is left out where nothing moves. The optional ``sigma_m``
is each coordinate's standard deviation. Other columns are ignored, so that a ``tracks.csv`` of another system can be
used. A table with a column for each coordinate, ``time,NAME.x,NAME.y,NAME.z,...`` ([s] and [m]), can be used too.
Between the instants positions are interpolated by a cubic spline, but never over a gap.

A reference has positions of markers but not their visibility to cameras: metrics of seen markers need the twin's
truth.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_TEXT_BYTES, open_file
from mosca.data.motion.joint_csv import read_points_csv
from mosca.data.truth import Truth, read_truth
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import parsed, read_named
from scenarios.types import RunOptions

JUDGED = (
    "position_rms", "position_p95", "position_max", "relative_accuracy", "nees", "coverage95", "identity_switches",
)  # fmt: skip
"""Metrics that a reference without visibility can judge."""
GAP = 2.5
"""Number of usual steps between two instants above which there is a gap between them."""
SAME_NS = 1000


@dataclass(frozen=True, eq=False)
class ReferenceTrajectories:
    """Reference positions of markers."""

    names: tuple[str, ...]
    """(m)"""
    time_ns: tuple[Array, ...]
    """Instants of each marker (t,), rising."""
    xyz: tuple[Array, ...]
    """Positions of each marker (t, 3) [m]."""
    still: bool
    """Whether the markers never move; each then has one instant."""
    sigma_m: float
    """Standard deviation of a coordinate, rms over all rows; 0 where the file has none."""
    path: Path
    """The file, for messages."""

    def at(self, time_ns: Array) -> Truth:
        """Return the reference at instants (t,) as a truth without visibility; NaN where it has no samples."""
        t, m = len(time_ns), len(self.names)
        xyz = np.full((t, m, 3), np.nan)
        for k, (own, places) in enumerate(zip(self.time_ns, self.xyz, strict=True)):
            xyz[:, k] = places[0] if self.still else _between(own, places, time_ns)
        unseen = np.zeros((t, m, 0))
        return Truth(time_ns, self.names, xyz, unseen, (), np.zeros((t, m, 0, 2)), unseen, np.zeros((t, 0), np.int64))

    def share(self, other: Callable[[Array], Array] | None) -> Callable[[Array], Array]:
        """Return covariances (n, 3, 3) [m^2] to add to those of points (n, 3): ``other`` plus the reference's."""

        def both(points: Array) -> Array:
            own = np.broadcast_to(self.sigma_m**2 * np.eye(3), (len(points), 3, 3))
            return own if other is None else own + other(points)

        return both


def requested_truth(options: RunOptions) -> Truth | ReferenceTrajectories | None:
    """Return the requested truth, else the one beside a recording, else None."""
    if options.truth is not None:
        return read_reference(options.truth)
    kind, _, folder = options.source.partition(":")
    if kind == "recording":
        for name in ("truth.npz", "truth.csv"):
            if (Path(folder) / name).exists():
                return read_reference(Path(folder) / name)
    return None


def read_reference(path: Path) -> Truth | ReferenceTrajectories:
    """Read a ``truth.npz`` or a ``truth.csv``. Raises InputError that names file, row and column."""
    match path.suffix.lower():
        case ".npz":
            return read_truth(path)
        case ".csv":
            return read_reference_csv(path)
    raise InputError(f"{path}: suffix '{path.suffix}' given; a truth is a .npz (the twin's) or a .csv (your own)")


def _read_wide_csv(path: Path) -> ReferenceTrajectories | None:
    """Return the reference in a table ``time,NAME.x,NAME.y,NAME.z,...`` [s, m]; None for another table."""
    if not path.is_file():
        return None
    with open_file(path) as file:
        first = file.readline(MOST_TEXT_BYTES).split(b",")
    if first[0].strip().strip(b'"').lower() != b"time":
        return None
    motion = read_points_csv(path)
    known = np.asarray(np.isfinite(motion.xyz).all(axis=2))
    time_ns = np.rint(motion.time_s * 1e9).astype(np.int64)
    names = [k for k in range(len(motion.names)) if known[:, k].any()]
    return ReferenceTrajectories(
        tuple(motion.names[k] for k in names),
        tuple(time_ns[known[:, k]] for k in names),
        tuple(motion.xyz[known[:, k], k] for k in names),
        False,
        0.0,
        path,
    )


def read_reference_csv(path: Path) -> ReferenceTrajectories:
    """Read a ``truth.csv``. Raises InputError naming file, row and column."""
    if (wide := _read_wide_csv(path)) is not None:
        return wide
    cells = read_named(path, ("label", "x", "y", "z"), ("time_ns", "sigma_m"), "truth.csv")
    label = np.array(cells["label"], dtype=np.str_)
    if not len(label):
        raise InputError(f"{path}: no row is in it; one a marker and instant is wanted")
    xyz = np.stack([parsed(cells[name], name, float, path) for name in "xyz"], axis=1)
    sigma = parsed(cells["sigma_m"], "sigma_m", float, path) if "sigma_m" in cells else np.zeros(len(label))
    still = "time_ns" not in cells
    time_ns = np.zeros(len(label), np.int64) if still else parsed(cells["time_ns"], "time_ns", int, path)
    for bad, message in (
        (label == "", "label is empty; each marker needs a name"),
        (np.isinf(xyz).any(axis=1) | np.isin(np.isnan(xyz).sum(axis=1), (1, 2)),
         "x, y, z: three numbers are wanted, or none where the marker was not seen"),
        (~((sigma >= 0) & (sigma < np.inf)), "sigma_m: a number of 0 or more is wanted [m]"),
    ):  # fmt: skip
        if bad.any():
            raise InputError(f"{path}, row {int(np.argmax(bad)) + 2}: {message}")
    known = ~np.isnan(xyz).any(axis=1)
    names = tuple(str(name) for name in dict.fromkeys(label[known].tolist()))
    if not names:
        raise InputError(f"{path}: no row has x, y and z")
    times, places = [], []
    for name in names:
        rows = np.flatnonzero(known & (label == name))
        rows = rows[np.argsort(time_ns[rows], kind="stable")]
        if (np.diff(time_ns[rows]) <= 0).any():
            twice = time_ns[rows][1:][np.diff(time_ns[rows]) <= 0][0]
            when = "twice; leave one, or add a column time_ns" if still else f"twice at {twice} ns; leave one"
            raise InputError(f"{path}: marker '{name}' stands {when}")
        times.append(time_ns[rows])
        places.append(xyz[rows])
    return ReferenceTrajectories(
        names, tuple(times), tuple(places), still, float(np.sqrt(np.mean(sigma[known] ** 2))), path
    )


def _between(own_ns: Array, places: Array, wanted_ns: Array) -> Array:
    """Return the positions (n, 3) at instants; NaN for instants in a gap or outside."""
    out = np.full((len(wanted_ns), 3), np.nan)
    steps = np.diff(own_ns)
    ends = np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else np.empty(0, int)
    for rows in np.split(np.arange(len(own_ns)), ends):
        first, last = own_ns[rows[0]], own_ns[rows[-1]]
        inside = (wanted_ns >= first - SAME_NS) & (wanted_ns <= last + SAME_NS)
        since_s = (wanted_ns[inside] - first) * 1e-9
        own_s = (own_ns[rows] - first) * 1e-9
        if len(rows) >= 4:
            out[inside] = CubicSpline(own_s, places[rows])(since_s)
        else:
            out[inside] = np.stack([np.interp(since_s, own_s, places[rows, k]) for k in range(3)], axis=1)
    return out
