"""Labels for all other tracklets, by the distances between the markers of this person.

The distance of two markers and its change are learned from labelled tracklets. Each further tracklet is compared with
the labelled ones where both are seen. A label is given where it is clearly likelier than any other, and than none.
Labels that do not fit the distances learned later are taken back.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from mosca.data.arrays import Array
from mosca.labelling.automatic.template import Expectation
from mosca.labelling.automatic.tracklets import TrackletSet

SOFT_M = 0.005
"""Standard deviation of a distance on one limb, at least [m]."""
POSE_S = 0.5
"""Time after which poses of a person are assumed to be independent: half a stride [s]."""
TIGHTEST, FEWEST = 4, 3
"""Most and fewest distances that decide, the least changing first: three leave a place and its mirror image."""
ROOM_M = 0.3
"""Spread of the distances of a point of no marker [m]."""
DIMENSIONS = 3
"""A point's position has three coordinates, however many distances determine it."""
BOUND = 25.0
"""Largest cost of one distance, in units of its variance: one wrong point does not decide."""
CERTAIN = 1000.0
"""Degrees of freedom that make Student's t a normal distribution: for distances on one limb."""
ROWS = 12
"""Frames of a tracklet that are compared."""
RIVAL = 3.0
"""No tracklet gets a label for which two simultaneous tracklets have log likelihood ratios that differ by less."""
ROUNDS = 20
"""Most rounds of giving labels and taking them back."""


@dataclass(frozen=True, eq=False)
class PersonDistances:
    """A person's distances (m, m), NaN where two markers were not seen together."""

    mean_m: Array
    sigma_m: Array
    freedom: Array
    """Degrees of freedom of Student's t: number of poses seen, and one for prior knowledge."""


class Labelling:
    """Labels of the tracklets, which change during the search."""

    def __init__(self, tracklets: TrackletSet, expected: Expectation, frame_s: float) -> None:
        self.tracklets, self.expected, self.frame_s = tracklets, expected, frame_s
        self.label = np.full(len(tracklets), -1)
        self.probability = np.zeros(len(tracklets))
        self.xyz = np.full((tracklets.frames, len(expected.mean_m), 3), np.nan)

    def give(self, k: int, marker: int, probability: float = 1.0) -> None:
        """Label tracklet ``k`` as ``marker`` (-1: take its label away)."""
        part = self.tracklets.part(k)
        if self.label[k] >= 0:
            self.xyz[self.tracklets.row[part], self.label[k]] = np.nan
        if marker >= 0:
            self.xyz[self.tracklets.row[part], marker] = self.tracklets.xyz[part]
        self.label[k], self.probability[k] = marker, probability

    def rename(self, names: Array) -> None:
        """Replace each label m by ``names[m]``, -1 for none; no two ``names`` may be the same, used or not."""
        xyz = np.full_like(self.xyz, np.nan)
        xyz[:, names[names >= 0]] = self.xyz[:, names >= 0]
        self.xyz = xyz
        self.label = np.where(self.label >= 0, names[self.label], -1)
        self.probability = np.where(self.label >= 0, self.probability, 0.0)

    def busy(self, k: int) -> Array:
        """Return which markers (m,) another tracklet has as label in some frame of tracklet ``k``."""
        out = np.isfinite(self.xyz[self.tracklets.row[self.tracklets.part(k)], :, 0]).any(axis=0)
        if self.label[k] >= 0:
            out[self.label[k]] = False
        return np.asarray(out)

    def distances(self) -> PersonDistances:
        """Return the distances learned from the labelled tracklets.

        A few poses predict later distances across two limbs poorly. So the variance of such a distance is the mean of
        that of people's motions, counted as one pose, and that of the poses seen.
        """
        step = max(1, len(self.xyz) // 400)
        some = self.xyz[::step]
        m = some.shape[1]
        mean, sigma, poses = np.full((m, m), np.nan), np.full((m, m), np.inf), np.zeros((m, m))
        for k in range(m):
            away = np.linalg.norm(some - some[:, k : k + 1], axis=2)
            there = np.isfinite(away)
            count = np.where(there.any(axis=0), there.sum(axis=0), np.nan)
            mean[k] = np.where(there, away, 0.0).sum(axis=0) / count
            sigma[k] = np.sqrt(np.where(there, (away - mean[k]) ** 2, 0.0).sum(axis=0) / count)
            poses[k] = there.sum(axis=0) * step * self.frame_s / POSE_S
        of_all = np.sqrt((self.expected.moved_m**2 + poses * sigma**2) / (1 + poses))
        sigma = np.where(self.expected.same, sigma, of_all)
        sigma = np.hypot(sigma, SOFT_M)
        sigma[np.isnan(mean) | np.eye(m, dtype=bool)] = np.inf
        return PersonDistances(mean, sigma, np.where(self.expected.same, CERTAIN, np.minimum(1 + poses, CERTAIN)))

    def ratios(self, k: int, known: PersonDistances) -> Array:
        """Return the log likelihood ratio (m,) of tracklet ``k`` as each marker, against none; -inf where unknown."""
        part = self.tracklets.part(k)
        rows, xyz = self.tracklets.row[part], self.tracklets.xyz[part]
        step = max(1, len(rows) // ROWS)
        others = self.xyz[rows[::step]].copy()
        if self.label[k] >= 0:
            others[:, self.label[k]] = np.nan
        away = np.linalg.norm(others - xyz[::step, None], axis=2)
        there = np.isfinite(away)
        count = there.sum(axis=0)
        seen = np.flatnonzero(count >= max(1, 0.3 * len(away)))
        if len(seen) < FEWEST:
            return np.full(len(known.mean_m), -np.inf)
        first = np.where(there, away, 0.0).sum(axis=0)[seen] / count[seen]
        second = np.where(there, away**2, 0.0).sum(axis=0)[seen] / count[seen]
        mean, sigma = known.mean_m[:, seen], known.sigma_m[:, seen]
        tight = np.argsort(sigma, axis=1)[:, :TIGHTEST]
        mean, sigma = np.take_along_axis(mean, tight, axis=1), np.take_along_axis(sigma, tight, axis=1)
        good = np.isfinite(sigma)
        cost = (second[tight] - 2 * mean * first[tight] + mean**2) / np.where(good, sigma, 1.0) ** 2
        freedom = np.take_along_axis(known.freedom[:, seen], tight, axis=1)
        fit = _log_t(np.minimum(cost, BOUND), freedom) - np.log(np.where(good, sigma, 1.0) / ROOM_M)
        each = np.where(good, fit, 0.0)
        enough = good.sum(axis=1)
        return np.where(enough >= FEWEST, DIMENSIONS * each.sum(axis=1) / np.maximum(enough, 1), -np.inf)


def _log_t(squared: Array, freedom: Array) -> Array:
    """Return the log density of Student's t at a ``squared`` standardised distance, times the root of 2 pi."""
    half = 0.5 * (freedom + 1)
    constant = gammaln(half) - gammaln(0.5 * freedom) - 0.5 * np.log(0.5 * freedom)
    return np.asarray(constant - half * np.log1p(squared / freedom))


def spread(labelling: Labelling, sure: float) -> None:
    """Give labels to tracklets that have none, where their probability is ``sure`` or more."""
    for _ in range(ROUNDS):
        known = labelling.distances()
        _take_back(labelling, known, sure)
        wanted: list[tuple[float, float, int, int]] = []
        for k in np.flatnonzero(labelling.label < 0).tolist():
            ratios = np.where(labelling.busy(k), -np.inf, labelling.ratios(k, known))
            probability, marker = _best(ratios)
            if probability >= sure:
                wanted.append((float(ratios[marker]), probability, k, marker))
        if not _give_best(labelling, wanted):
            return


def _best(ratios: Array) -> tuple[float, int]:
    """Return probability and index of the likeliest marker, against the others and none."""
    marker = int(ratios.argmax())
    if not np.isfinite(ratios[marker]):
        return 0.0, marker
    top = max(float(ratios[marker]), 0.0)
    total = np.exp(-top) + np.exp(ratios - top).sum()
    return float(np.exp(ratios[marker] - top) / total), marker


def _give_best(labelling: Labelling, wanted: list[tuple[float, float, int, int]]) -> int:
    """Give labels, the likeliest first, unless a tracklet of the same frames is nearly as likely; return how many."""
    given = 0
    by_marker: dict[int, list[tuple[float, int]]] = {}
    for ratio, _, k, marker in wanted:
        by_marker.setdefault(marker, []).append((ratio, k))
    rows = labelling.tracklets.row
    for ratio, probability, k, marker in sorted(wanted, key=lambda one: -one[0]):
        if labelling.busy(k)[marker]:
            continue
        own = rows[labelling.tracklets.part(k)]
        rivals = (
            other != k and abs(theirs - ratio) < RIVAL and labelling.label[other] < 0
            and len(np.intersect1d(own, rows[labelling.tracklets.part(other)], assume_unique=True)) > 0
            for theirs, other in by_marker[marker]
        )  # fmt: skip
        if not any(rivals):
            labelling.give(k, marker, probability)
            given += 1
    return given


def _take_back(labelling: Labelling, known: PersonDistances, sure: float) -> None:
    """Take labels away where, by the distances ``known``, another label or none fits better."""
    for k in np.flatnonzero(labelling.label >= 0).tolist():
        ratios = labelling.ratios(k, known)
        own = ratios[labelling.label[k]]
        if not np.isfinite(own):
            continue
        free = np.where(labelling.busy(k), -np.inf, ratios)
        probability, marker = _best(free)
        if marker != labelling.label[k] or own < 0:
            labelling.give(k, -1)
        else:
            labelling.probability[k] = probability
