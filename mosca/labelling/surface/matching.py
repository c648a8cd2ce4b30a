"""Assignment of a frame's points to a surface's markers, with or without an initial guess, and its probability.

Without a guess, places are aligned to the points in 60 orientations (the rotations of an icosahedron: no rotation is
farther than 45 degrees from one of them). Assignment and alignment then alternate within a gate that narrows. The
best are refined with the model's covariances: each marker is compared with its prediction from the others, so that a
wrong point does not support itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.labelling.surface.fit import SurfaceFit, SurfaceFitter, SurfacePose, aligned
from mosca.labelling.surface.model import LEAST_MARKERS

GATES = (0.3, 0.2, 0.15, 0.12, 0.1, 0.08, 0.08, 0.08)
"""Largest distance of a point from its marker in each successive turn, in units of the surface's extent."""
REFINED = 6
"""Number of starts that are refined."""
TURNS = 12
NEAR = 3.0
"""Unseen markers are compared with points this near to their prediction, in standard deviations."""


@dataclass(frozen=True, eq=False)
class SurfaceMatch:
    """Points chosen for the markers of a surface."""

    chosen: Array
    """(m,) point of each marker, or -1."""
    value: float
    """Log density of the points, against none of them being a marker."""
    fit: SurfaceFit
    cost: Array
    """(m, n) cost of each point as each marker, by the prediction from all others: log-odds against neither."""


class SurfaceMatcher:
    """Matches the points of a frame with a fitter's model.

    ``shown``: share of the markers that a frame shows; ``extra``: points in the surface's box that are no markers.
    """

    def __init__(self, fitter: SurfaceFitter, shown: float, extra: float) -> None:
        self.fitter, self.place = fitter, fitter.model.place_m
        size = np.ptp(self.place, axis=0)
        self.extent = float(np.linalg.norm(size))
        # box with a margin of a tenth of the extent on all sides
        self.log_density = float(np.log(extra / np.prod(size + 0.2 * self.extent)))
        self.log_shown = float(np.log(shown / (1 - shown)))

    def found(self, points: Array) -> list[SurfaceMatch]:
        """Return possible matches of points (n, 3), the likeliest first; none where too few fit."""
        if len(points) < LEAST_MARKERS:
            return []
        begun = sorted(
            (self._laid(points, turn) for turn in Rotation.create_group("I").as_matrix()), key=lambda b: b[0]
        )
        matches: list[SurfaceMatch] = []
        for _, chosen, pose in begun[:REFINED]:
            if (chosen >= 0).sum() < LEAST_MARKERS:
                continue
            match = self.refined(points, chosen, pose)
            if not any((match.chosen == other.chosen).all() for other in matches):
                matches.append(match)
        return sorted(matches, key=lambda match: -match.value)

    def refined(self, points: Array, chosen: Array, pose: SurfacePose) -> SurfaceMatch:
        """Return the best match from ``chosen`` (m,) at ``pose``: alternating fit and assignment, then exchanges."""
        return self._exchanged(points, self._turned(points, chosen, pose))

    def _turned(self, points: Array, chosen: Array, pose: SurfacePose) -> SurfaceMatch:
        """Return the best match of alternating fit and assignment."""
        best = now = self.valued(points, chosen, pose)
        for _ in range(TURNS):
            again = self._assigned(now.cost)
            if (again == now.chosen).all() or (again >= 0).sum() < LEAST_MARKERS:
                break
            now = self.valued(points, again, now.fit.pose)
            if now.value > best.value:
                best = now
        return best

    def valued(self, points: Array, chosen: Array, pose: SurfacePose) -> SurfaceMatch:
        """Return the match ``chosen`` (m,) of points (n, 3), fitted from ``pose``."""
        taken = np.where((chosen >= 0)[:, None], points[np.maximum(chosen, 0)], np.nan)
        fit = self.fitter.fit(taken, pose)
        count = int((chosen >= 0).sum())
        each = self.log_shown - self.log_density - 1.5 * np.log(2 * np.pi)
        return SurfaceMatch(chosen, fit.evidence + count * each, fit, self.costs(points, fit))

    def costs(self, points: Array, fit: SurfaceFit) -> Array:
        """Return log-odds (m, n) against points (n, 3) being the markers, by a fit's predictions from all others."""
        away = fit.pose.local(points)[None] - fit.mean[:, None]
        square = np.einsum("mna,mab,mnb->mn", away, np.linalg.inv(fit.spread), away)
        log_det = np.linalg.slogdet(2 * np.pi * fit.spread)[1]
        return np.asarray(0.5 * (square + log_det[:, None]) + self.log_density - self.log_shown)

    def _assigned(self, cost: Array) -> Array:
        """Return the points (m,) of least total cost; -1 where none is better."""
        rows, columns = linear_sum_assignment(np.minimum(cost, 0.0))
        chosen = np.full(len(cost), -1)
        good = cost[rows, columns] < 0
        chosen[rows[good]] = columns[good]
        return chosen

    def _laid(self, points: Array, turn: Array) -> tuple[float, Array, SurfacePose]:
        """Return the cost, the points (m,) and the pose found by alternating assignment and alignment."""
        sigma = self.fitter.model.size_sigma
        ratio = np.linalg.norm(points.std(axis=0)) / np.linalg.norm(self.place.std(axis=0))
        least, most = np.exp(-2 * sigma), np.exp(2 * sigma)
        size = float(np.clip(ratio, least, most))
        pose = SurfacePose(turn, points.mean(axis=0) - size * turn @ self.place.mean(axis=0), size)
        chosen, value = np.full(len(self.place), -1), np.inf
        for gate in GATES:
            reach = gate * self.extent
            away = np.minimum(cdist(pose.translation + pose.size * self.place @ pose.rotation.T, points), reach) ** 2
            rows, columns = linear_sum_assignment(away)
            near = away[rows, columns] < reach**2
            chosen = np.full(len(self.place), -1)
            chosen[rows[near]] = columns[near]
            value = float(away[rows, columns].sum()) + (len(self.place) - len(rows)) * reach**2
            if near.sum() < LEAST_MARKERS:
                break
            pose = aligned(points[columns[near]], self.place[rows[near]])
            pose = SurfacePose(pose.rotation, pose.translation, float(np.clip(pose.size, least, most)))
        return value, chosen, pose

    def _exchanged(self, points: Array, match: SurfaceMatch) -> SurfaceMatch:
        """Return the match after exchanges of two markers' points, as long as they make it likelier."""
        for _ in range(TURNS):
            odds = exchange_odds(match)
            i, j = (int(k) for k in np.unravel_index(np.argmax(odds), odds.shape))
            if odds[i, j] <= 1.0:
                break
            chosen = match.chosen.copy()
            chosen[[i, j]] = chosen[[j, i]]
            other = self.valued(points, chosen, match.fit.pose)
            if other.value <= match.value:
                break
            match = other
        return match

    def challenged(self, points: Array, matches: Sequence[SurfaceMatch]) -> tuple[SurfaceMatch, list[SurfaceMatch]]:
        """Return the likeliest match (of one or more), and others that were compared with it.

        A chain of neighbours, each with the next one's point, is not found by looking at single markers. So every
        unseen marker is given each point near its prediction, and every free point is given to each marker near it.
        The assignment starts again from there.
        """
        best, rivals = matches[0], list(matches[1:])
        for _ in range(TURNS):
            tried = [self._turned(points, chosen, best.fit.pose) for chosen in self._forced(points, best)]
            tried += [self.valued(points, chosen, best.fit.pose) for chosen in self._forced(points, best)]
            rivals += [one for one in tried if (one.chosen != best.chosen).any()]
            better = max(rivals, key=lambda one: one.value, default=best)
            if better.value <= best.value:
                break
            best, rivals = better, [best, *(one for one in rivals if (one.chosen != better.chosen).any())]
        return best, list({one.chosen.tobytes(): one for one in rivals}.values())

    def _forced(self, points: Array, match: SurfaceMatch) -> list[Array]:
        """Return assignments (m,) with an unseen marker at a point near it, or a marker at a free point near it."""
        local = match.fit.pose.local(points)
        away = np.linalg.norm(local[None] - match.fit.mean[:, None], axis=2)
        reach = NEAR * np.sqrt(np.trace(match.fit.spread, axis1=1, axis2=2))
        free = np.setdiff1d(np.arange(len(points)), match.chosen)
        out = []
        for marker, point in zip(*np.nonzero(away < reach[:, None]), strict=True):
            if (match.chosen[marker] < 0) != (point in free):
                chosen = np.where(match.chosen == point, -1, match.chosen)
                chosen[marker] = point
                if (chosen >= 0).sum() >= LEAST_MARKERS:
                    out.append(chosen)
        return out

    def probability(self, match: SurfaceMatch, rivals: Sequence[SurfaceMatch]) -> Array:
        """Return the probability (m,) of each point, against exchanges of two points and against ``rivals``."""
        odds = exchange_odds(match).sum(axis=1)
        seen = np.flatnonzero(match.chosen >= 0)
        odds[seen] += np.exp(np.clip(match.cost[seen, match.chosen[seen]], -700, 50))
        for rival in rivals:
            odds[rival.chosen != match.chosen] += np.exp(np.clip(rival.value - match.value, -700, 50))
        return np.where(match.chosen >= 0, 1.0 / (1.0 + odds), 0.0)


def exchange_odds(match: SurfaceMatch) -> Array:
    """Return the odds (m, m) of exchanging two seen markers' points, against the match; 0 for unseen ones."""
    fit = match.fit
    m = len(match.chosen)
    index = np.arange(m)
    q, own = fit.information, fit.information[index, :, index]
    # a marker's point: prediction from the others, plus the residual from it
    local = fit.mean + np.einsum("iab,ib->ia", np.linalg.inv(own), fit.pull)
    u = local[None] - local[:, None]
    cross = q.transpose(0, 2, 1, 3)
    bend = own[:, None] + own[None] - cross - cross.transpose(1, 0, 2, 3)
    change = 2 * np.einsum("ija,ija->ij", u, fit.pull[:, None] - fit.pull[None])
    change += np.einsum("ija,ijab,ijb->ij", u, bend, u)
    both = fit.seen[:, None] & fit.seen
    np.fill_diagonal(both, False)
    return np.where(both, np.exp(np.clip(-0.5 * change, -700, 50)), 0.0)
