"""Positions of balls that cameras see, and which of them are which balls of a known figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mosca.calibration.common.robust_fit import rigid
from mosca.camera.projection import project, rays
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.errors import CalibrationError
from mosca.triangulation.triangulate import triangulate

MATCH_PX = 3.0
"""Gate of a ball's image about its projection."""
MOST_SPOTS, MOST_DETECTIONS = 24, 200
# factor by which the better one of two assignments of a figure must fit better
TIMES_BETTER = 3.0


@dataclass(frozen=True, eq=False)
class BallCandidates:
    """Positions (n, 3) [m] where rays of two cameras or more meet, with their covariances (n, 3, 3) from detection.

    ``xy_px`` (n, c, 2): each camera's image of them, NaN without any; ``sigma_px``: of an image coordinate.
    """

    places: Array
    covariance: Array
    xy_px: Array
    sigma_px: float

    def __len__(self) -> int:
        return len(self.places)

    def of(self, chosen: Sequence[int]) -> "BallCandidates":
        """Return the chosen ones, in this order."""
        rows = list(chosen)
        return BallCandidates(self.places[rows], self.covariance[rows], self.xy_px[rows], self.sigma_px)


def spots(rig: Rig, detections: Mapping[str, Detections]) -> BallCandidates:
    """Return the positions where rays of two cameras or more intersect.

    Those seen by most cameras come first; each detection belongs to one position at the most.
    """
    known = [k for k, camera in enumerate(rig.cameras) if len(detections.get(camera.name, ())) > 0]
    for k in known:
        count = len(detections[rig.cameras[k].name])
        if count > MOST_DETECTIONS:
            raise CalibrationError(
                f"camera '{rig.cameras[k].name}': {count} targets found; show the L-frame alone (up to "
                f"{MOST_DETECTIONS} are allowed)"
            )
    groups: dict[tuple[int, ...], None] = {}
    for first, second in combinations(known, 2):
        for place in _meetings(rig, detections, first, second):
            group = _seen(rig, detections, place)
            if sum(index >= 0 for index in group) >= 2:
                groups[group] = None
    if not groups:
        return BallCandidates(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(rig.cameras), 2)), 1.0)
    table = np.array(list(groups))
    xy = np.full((*table.shape, 2), np.nan)
    for k in known:
        there = table[:, k] >= 0
        xy[there, k] = detections[rig.cameras[k].name].xy_px[table[there, k]]
    noise = np.concatenate([detections[rig.cameras[k].name].covariance_px2 for k in known])
    sigma = max(float(np.sqrt(np.median(np.trace(noise, axis1=1, axis2=2)) / 2)), 1e-3)
    places, covariance, residual = triangulate(rig, xy, sigma)
    order = np.lexsort((residual, -(table >= 0).sum(axis=1)))
    taken: set[tuple[int, int]] = set()
    chosen = []
    for row in order:
        own = {(k, int(index)) for k, index in enumerate(table[row]) if index >= 0}
        if residual[row] <= MATCH_PX and not own & taken:
            taken |= own
            chosen.append(row)
    return BallCandidates(places, covariance, xy, sigma).of(chosen[:MOST_SPOTS])


def _meetings(rig: Rig, detections: Mapping[str, Detections], first: int, second: int) -> Array:
    """Return the points (m, 3) nearest to both rays of all pairs of detections of two cameras, before both."""
    one, two = (rays(rig.cameras[k], detections[rig.cameras[k].name].xy_px) for k in (first, second))
    a, b = (side.reshape(-1, 3) for side in np.broadcast_arrays(one.direction[:, None], two.direction[None]))
    base = two.origin - one.origin
    ab = (a * b).sum(axis=1)
    across = 1 - ab**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (a @ base - ab * (b @ base)) / across
        r = (ab * (a @ base) - b @ base) / across
    good = (across > 1e-6) & (s > 0) & (r > 0)
    return np.asarray((one.origin + s[:, None] * a + two.origin + r[:, None] * b)[good] / 2)


def _seen(rig: Rig, detections: Mapping[str, Detections], place: Array) -> tuple[int, ...]:
    """Return the detection of point ``place`` (3,) in each camera, -1 where there is none."""
    out = []
    for camera in rig.cameras:
        found = detections.get(camera.name)
        if found is None or len(found) == 0:
            out.append(-1)
            continue
        away = np.linalg.norm(found.xy_px - project(camera, place[None])[0], axis=1)
        nearest = int(np.argmin(np.nan_to_num(away, nan=np.inf)))
        out.append(nearest if away[nearest] <= MATCH_PX else -1)
    return tuple(out)


def best_match(places: Array, known: Array, fits: float, near: float | None) -> tuple[int, ...] | None:
    """Return which of the positions (m, 3) are the points ``known`` (n, 3), or None.

    ``fits``: largest root mean square misfit over the figure's size; ``near``: how far the scale may be from 1,
    None for any. CalibrationError where two assignments fit equally well.
    """
    between = np.linalg.norm(places[:, None] - places, axis=2)
    wanted = np.linalg.norm(known[:, None] - known, axis=2)
    size = wanted.max()
    first, second = np.unravel_index(int(np.argmax(wanted)), wanted.shape)
    order = [int(first), int(second), *(k for k in range(len(known)) if k not in (first, second))]
    found: list[tuple[float, tuple[int, ...]]] = []
    for i in range(len(places)):
        for j in range(len(places)):
            scale = between[i, j] / wanted[first, second]
            if i == j or (near is not None and abs(scale - 1) > near) or scale <= 0:
                continue
            partial = [[i, j]]
            for k in order[2:]:
                partial = [
                    [*one, c]
                    for one in partial
                    for c in range(len(places))
                    if c not in one
                    and all(
                        abs(between[c, p] / scale - wanted[k, q]) < 4 * fits * size
                        for p, q in zip(one, order, strict=False)
                    )
                ]
            for one in partial:
                match = tuple(one[order.index(k)] for k in range(len(known)))
                misfit = _misfit(places[list(match)], known) / size
                if misfit <= fits:
                    found.append((misfit, match))
    if not found:
        return None
    found.sort()
    if len(found) > 1 and found[1][0] < max(TIMES_BETTER * found[0][0], 0.1 * fits):
        raise CalibrationError(
            "L-frame: the balls found can be read in two ways that fit alike; remove other shining things, or make "
            "its arms more unlike"
        )
    return found[0][1]


def _misfit(found: Array, known: Array) -> float:
    """Return the rms distance after the best motion and stretch, in the known figure's lengths."""
    spread = np.linalg.norm(known - known.mean(axis=0)) / np.linalg.norm(found - found.mean(axis=0))
    moved = rigid(found * spread, known).transform(found * spread)
    return float(np.sqrt(np.mean(((moved - known) ** 2).sum(axis=1))))
