"""Scoring of all entrants: their tables of points against the truth, as in ``scenarios.score.tracks``.

OSPA (Schuhmacher, Vo and Vo 2008, IEEE Trans. Signal Process. 56(8), eq. 3) of order 2 is one figure for accuracy,
misses and ghosts: over all frames, the root of ``(sum min(d, c)^2 + c^2 (k - pairs)) / sum k``, d the distance of a
pair, c the cut-off, k the larger of the number of points and the number of visible markers.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import integers, parsed, read_columns, read_named, reals, write_columns
from scenarios.score.tracks import block_of, metrics, pair, ratio_of_sums
from scenarios.types import Score, TruthPairs

POINTS, DETECTIONS, MATCHED = (
    ("frame", "x", "y", "z"),
    ("camera", "frame", "u", "v"),
    ("frame", "target", "camera", "u", "v"),
)
COVARIANCE = ("var_u", "cov_uv", "var_v")
"""Columns [px^2] that an entrant may add to its image points; it then gets them back for triangulation."""
CUT_OFF_M = 0.01
"""Cut-off of OSPA: a miss or a ghost counts as an error of 10 mm, far above the typical error of any set."""
KEPT = ("position_rms", "position_p95", "position_max", "completeness", "ghosts_per_frame")
MOST_POINTS = 20
"""Most points per frame that are read, as a multiple of the markers; and 1000 more."""
NEAREST_PX = 1.0
"""Least gate of an image point: it belongs to a marker within half of the diameter of its image, or within this."""
SEEN_SHARE = 0.1
"""Visible share of a marker's disc from which its image is matched."""


@dataclass(frozen=True, eq=False)
class FoundPoints:
    """Points of an entrant: ``frame`` (n,), ``xyz`` (n, 3) [m]."""

    frame: Array
    xyz: Array


def read_found(path: Path, truth: Truth) -> FoundPoints:
    """Return the points that an entrant wrote; InputError in one line for a table that cannot be of this set."""
    cells = read_columns(path, POINTS, "table of points")
    frame = parsed(cells["frame"], "frame", int, path)
    xyz = np.stack([parsed(cells[name], name, float, path) for name in POINTS[1:]], axis=1)
    _check_frames(frame, truth, path)
    if not np.isfinite(xyz).all():
        row = int(np.flatnonzero(~np.isfinite(xyz).all(axis=1))[0])
        raise InputError(f"{path}, row {row + 2}: a point that is not finite; leave it out")
    most = MOST_POINTS * len(truth.names) + 1000
    if len(frame) and np.bincount(frame).max() > most:
        raise InputError(f"{path}: frame {int(np.bincount(frame).argmax())} has more than {most} points")
    return FoundPoints(frame, xyz)


def score_found(found: FoundPoints, truth: Truth, working_space_m: float) -> dict[str, Score]:
    """Return the metrics of an entrant's points, by name; lengths in m."""
    n = len(found.frame)
    order = np.argsort(found.frame, kind="stable")
    # entrants state no covariances in their tables, and need not track
    tracks = Tracks(
        found.frame[order], truth.time_ns[found.frame[order]], np.zeros(n), np.full(n, ""), found.xyz[order],
        np.tile(np.eye(3), (n, 1, 1)), np.zeros(n), np.full(n, np.nan), np.full(n, "measured"),
    )  # fmt: skip
    matched = pair(tracks, truth, working_space_m)
    of_all = metrics(matched, working_space_m)
    return {"ospa": ospa(matched)} | {name: of_all[name] for name in KEPT if name in of_all}


def ospa(matched: TruthPairs) -> Score:
    """Return OSPA of order 2 [m] with its block bootstrap over frames; 0 where there was nothing to find."""
    frames = len(matched.seen)
    block = block_of(frames)
    count = int(block.max(initial=-1)) + 1
    squares = np.minimum(matched.distance_m, CUT_OFF_M) ** 2
    pairs = np.bincount(matched.frame, minlength=frames)
    most = pairs + np.maximum(matched.missed, matched.ghosts)
    total = np.bincount(matched.frame, weights=squares, minlength=frames) + CUT_OFF_M**2 * (most - pairs)
    sums, weights = (np.bincount(block, weights=values, minlength=count) for values in (total, most))
    return ratio_of_sums(sums, weights, int(most.sum()), np.sqrt)


def nothing_found(truth: Truth, working_space_m: float) -> dict[str, Score]:
    """Return the metrics of an entrant that gave no result."""
    return score_found(FoundPoints(np.empty(0, int), np.empty((0, 3))), truth, working_space_m)


def match_detections(path: Path, truth: Truth, out: Path) -> int:
    """Write the assignment of an entrant's image points to markers, from the truth; return the number assigned.

    In each image it is one to one, with the least total distance from the true images of the markers' centres.
    InputError in one line for a table that cannot be of this set.
    """
    cells = read_named(path, DETECTIONS, COVARIANCE, "table of image points")
    frame = parsed(cells["frame"], "frame", int, path)
    places = np.stack([parsed(cells[name], name, float, path) for name in ("u", "v")], axis=1)
    _check_frames(frame, truth, path)
    if not np.isfinite(places).all():
        row = int(np.flatnonzero(~np.isfinite(places).all(axis=1))[0])
        raise InputError(f"{path}, row {row + 2}: an image point that is not finite; leave it out")
    unknown = set(cells["camera"]) - set(truth.cameras)
    if unknown:
        raise InputError(f"{path}: camera '{min(unknown)[:40]}'; the set has {', '.join(truth.cameras)}")
    camera = np.array([truth.cameras.index(name) for name in cells["camera"]], dtype=int)
    rows = [
        (f, marker, c, row)
        for f in range(len(truth.time_ns))
        for c in range(len(truth.cameras))
        for row, marker in _pairs(np.flatnonzero((frame == f) & (camera == c)), places, truth, f, c)
    ]
    table = np.array(rows, int).reshape(-1, 4)
    chosen = places[table[:, 3]]
    names = [truth.cameras[c] for c in table[:, 2]]
    columns = [integers(table[:, 0]), integers(table[:, 1]), names, reals(chosen[:, 0]), reals(chosen[:, 1])]
    stated = [name for name in COVARIANCE if name in cells]
    columns += [[cells[name][row] for row in table[:, 3].tolist()] for name in stated]
    write_columns(out, (*MATCHED, *stated), columns)
    return len(table)


def _pairs(rows: Array, places: Array, truth: Truth, frame: int, camera: int) -> list[tuple[int, int]]:
    """Return (row of the table, marker) of one image."""
    true = truth.image_xy_px[frame, :, camera]
    there = np.flatnonzero(np.isfinite(true).all(axis=1) & (truth.visible[frame, :, camera] >= SEEN_SHARE))
    if len(rows) == 0 or len(there) == 0:
        return []
    distance = cdist(places[rows], true[there])
    gate = np.maximum(NEAREST_PX, 0.5 * truth.diameter_px[frame, there, camera])
    allowed = distance <= gate
    first, second = linear_sum_assignment(np.where(allowed, distance, gate.max() * (1 + min(distance.shape))))
    good = allowed[first, second]
    return list(zip(rows[first[good]].tolist(), there[second[good]].tolist(), strict=True))


def _check_frames(frame: Array, truth: Truth, path: Path) -> None:
    wrong = (frame < 0) | (frame >= len(truth.time_ns))
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise InputError(f"{path}, row {row + 2}: frame {frame[row]}; the set has 0 to {len(truth.time_ns) - 1}")
