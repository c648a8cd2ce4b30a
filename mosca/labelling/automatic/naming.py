"""Names of tracklets, from comparing frames of a take, and the whole take, with a template."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.labelling.automatic.body import TemplateBody
from mosca.labelling.automatic.matching import CANNOT, Matching
from mosca.labelling.automatic.refine import refine
from mosca.labelling.automatic.search import Assignment, searched, starts, unlike
from mosca.labelling.automatic.spread import Labelling
from mosca.labelling.automatic.template import Expectation
from mosca.labelling.automatic.tracklets import TrackletSet

MOST_POINTS = 110
"""Most points of a frame that are matched: those with the longest tracklets."""
NAMED = 3
"""Number of frames of the take in which names are compared at last."""
STATISTICS = 600
"""Most frames of the take in which distances are compared."""
LONG = 20
"""Least length of a tracklet that is matched [frames], or half of ``FrameNaming.half`` where that is less."""


@dataclass(frozen=True, eq=False)
class Names:
    """Names of the tracklets that are labelled as each marker (m) at present."""

    name: Array
    """(m,) the marker that they are; -1 for none, or where no tracklet has this label."""
    probability: Array
    """(m,) probability of the name."""
    spare: list[tuple[int, int, float]]
    """Tracklets that had no label, with marker and probability of each."""
    sets: Array
    """(s + 1,) probability of each of the template's sets, and of none of them (last)."""


@dataclass
class FrameNaming:
    """Data and methods common to all frames of a take that are matched."""

    tracklets: TrackletSet
    body: TemplateBody
    expected: Expectation
    sure: float
    half: int
    """Number of frames before and after a frame over which distances of its points are compared."""

    def first(self, labelling: Labelling, frames: int) -> None:
        """Label the tracklets of one frame: of ``frames`` that are tried, the one that matches the template best."""
        best: tuple[float, Matching, Array, list[Assignment]] | None = None
        for row in self._fullest(np.ones(len(self.tracklets), dtype=bool), frames):
            pieces = self._pieces(row)
            window = slice(max(0, row - self.half), min(self.tracklets.frames, row + self.half + 1))
            if len(pieces) < 4:
                continue
            xyz = self.tracklets.window(pieces, window)
            problem = Matching(xyz, [row - window.start], self.body, self.expected)
            found = starts(problem)
            value = found[0].evidence / problem.n
            if best is None or value > best[0]:
                best = value, problem, pieces, found
        if best is None:
            return
        _, problem, pieces, found = best
        end = max((searched(problem, one) for one in unlike(found)), key=lambda one: one.evidence)
        matched = refine(problem, end.chosen, end.poses)
        for marker in np.flatnonzero(matched.chosen >= 0).tolist():
            labelling.give(int(pieces[matched.chosen[marker]]), marker, float(matched.probability[marker]))

    def another(self, labelling: Labelling, share: Array) -> bool:
        """Match a frame with many unlabelled tracklets, using the labels so far; return whether a label changed.

        A labelled tracklet may get another label, which all tracklets of the take with its old label then get too.
        ``share`` (m,): share of takes that show each marker.
        """
        rows = self._fullest(self._long(labelling), 1)
        if not rows:
            return False
        row, pieces = rows[0], self._pieces(rows[0])
        used = self._used([row])
        xyz = self.tracklets.window(pieces, slice(0, self.tracklets.frames))[used]
        named = labelling.label[pieces]
        xyz[:, named >= 0] = labelling.xyz[used][:, named[named >= 0]]
        problem = Matching(xyz, [int(np.searchsorted(used, row))], self.body, self.expected).worn(share)
        problem.barred[:] = impossible(labelling, named, pieces)
        chosen = np.full(problem.m, -1)
        chosen[named[named >= 0]] = np.flatnonzero(named >= 0)
        if (chosen >= 0).sum() < 6:
            return False
        found = searched(problem, posed(problem, chosen))
        matched = refine(problem, found.chosen, found.poses)
        new = np.full(problem.n, -1)
        new[matched.chosen[matched.chosen >= 0]] = np.flatnonzero(matched.chosen >= 0)
        before = labelling.label.copy()
        rename(labelling, named, new)
        for k in np.flatnonzero((named < 0) & (new >= 0)).tolist():
            marker, piece = int(new[k]), int(pieces[k])
            if matched.probability[marker] >= self.sure and not labelling.busy(piece)[marker]:
                labelling.give(piece, marker, float(matched.probability[marker]))
        return bool((labelling.label != before).any())

    def names(self, labelling: Labelling) -> Names:
        """Return the names of the labelled tracklets, compared over the take with each set of the template."""
        xyz, sets = labelling.xyz, self.body.template.sets
        there = np.flatnonzero(np.isfinite(xyz[:, :, 0]).any(axis=0))
        names, probability = np.full(xyz.shape[1], -1), np.zeros(xyz.shape[1])
        if len(there) < 4:
            return Names(names, probability, [], np.eye(len(sets) + 1)[-1])
        problem, pieces = self._whole(labelling, there)
        chosen = np.full(problem.m, -1)
        chosen[there] = np.arange(len(there))
        poses = [posed(problem.frame(f), chosen).poses[0] for f in range(len(problem.points))]
        few = problem.without_spare()
        found = searched(few, Assignment(*few.evidence(chosen, poses), chosen))
        score, is_name = np.empty(len(sets) + 1), np.zeros((len(sets) + 1, problem.n, problem.m))
        for k, share in enumerate([*(one.share for one in sets), self.body.template.share]):
            worn = problem.worn(share)
            matched = refine(worn, found.chosen, found.poses)
            score[k] = matched.score + worn.none
            marker = np.flatnonzero(matched.chosen >= 0)
            is_name[k, matched.chosen[marker], marker] = matched.probability[marker]
        of_set = np.exp(score - score.max())
        of_set /= of_set.sum()
        mean = np.tensordot(of_set, is_name, axes=1)
        column, marker = linear_sum_assignment(mean, maximize=True)
        spare = []
        for c, i in zip(column.tolist(), marker.tolist(), strict=True):
            if c < len(there) and mean[c, i] > 0:
                names[there[c]], probability[there[c]] = i, mean[c, i]
            elif c >= len(there) and mean[c, i] >= self.sure:
                spare.append((int(pieces[c - len(there)]), i, float(mean[c, i])))
        return Names(names, probability, spare, of_set)

    def _whole(self, labelling: Labelling, there: Array) -> tuple[Matching, Array]:
        """Return the problem of the labels ``there`` and spare tracklets over the take, and the spare tracklets."""
        rows = _spaced(np.isfinite(labelling.xyz[:, there, 0]).sum(axis=1), NAMED, max(1, len(labelling.xyz) // 6))
        pieces = np.empty(0, dtype=int)
        if fullest := self._fullest(self._long(labelling), 1):
            rows = sorted({*rows, *fullest})
            pieces = self._pieces(fullest[0])
            pieces = pieces[self._long(labelling)[pieces]]
        used = self._used(rows)
        spare = self.tracklets.window(pieces, slice(0, self.tracklets.frames))[used]
        xyz = np.concatenate([labelling.xyz[used][:, there], spare], axis=1)
        problem = Matching(xyz, np.searchsorted(used, rows).tolist(), self.body, self.expected)
        problem.spare = np.arange(problem.n) >= len(there)
        return problem, pieces

    def _used(self, rows: list[int]) -> Array:
        frames = self.tracklets.frames
        return np.unique(np.concatenate([np.arange(0, frames, max(1, frames // STATISTICS)), rows]))

    def _long(self, labelling: Labelling) -> Array:
        """Return which tracklets (k,) have no label and are long."""
        lengths = np.diff(self.tracklets.starts)
        return np.asarray((labelling.label < 0) & (lengths >= min(self.half // 2, LONG)))

    def _fullest(self, of: Array, count: int) -> list[int]:
        """Return frames, apart from each other, that show many long ones of the tracklets ``of`` (k,)."""
        score = np.zeros(self.tracklets.frames)
        lengths = np.diff(self.tracklets.starts)
        for k in np.flatnonzero(of).tolist():
            score[self.tracklets.row[self.tracklets.part(k)]] += min(int(lengths[k]), self.half)
        return _spaced(score, count, self.half)

    def _pieces(self, row: int) -> Array:
        """Return the tracklets that a frame shows, the longest if there are many."""
        of = np.repeat(np.arange(len(self.tracklets)), np.diff(self.tracklets.starts))
        pieces = of[self.tracklets.row == row]
        lengths = np.diff(self.tracklets.starts)[pieces]
        return np.sort(pieces[np.argsort(-lengths, kind="stable")[:MOST_POINTS]])


def impossible(labelling: Labelling, named: Array, pieces: Array) -> Array:
    """Return the loss (m, n), below 0, where a point cannot be a marker; 0 where it can.

    Points are the tracklets ``pieces`` (n,), labelled as ``named`` (n,), -1 for none. A marker that has a label in
    the take but is hidden at present cannot be a point that is seen together with it at other times.
    """
    there = np.isfinite(labelling.xyz[:, :, 0])
    hidden = np.setdiff1d(np.flatnonzero(there.any(axis=0)), named)
    lost = np.zeros((there.shape[1], len(pieces)))
    for k, (label, piece) in enumerate(zip(named.tolist(), pieces.tolist(), strict=True)):
        rows = there[:, label] if label >= 0 else labelling.tracklets.row[labelling.tracklets.part(piece)]
        lost[hidden[there[rows][:, hidden].any(axis=0)], k] = -CANNOT
    return lost


def rename(labelling: Labelling, named: Array, new: Array) -> None:
    """Replace the labels ``named`` (n,) by the labels ``new`` (n,), where no other tracklet has them."""
    changed = np.flatnonzero((named >= 0) & (new != named))
    held = np.unique(labelling.label[labelling.label >= 0])
    # names without a tracklet stay -1: otherwise their empty positions would overwrite those of the tracklets renamed
    names = np.full(labelling.xyz.shape[1], -1)
    names[held] = held
    names[named[changed]] = new[changed]
    kept = np.setdiff1d(held, named[changed])
    if np.isin(new[changed], kept).any():
        # two tracklets with one name at different times may be one marker, or not
        names[named[changed]] = np.where(np.isin(new[changed], kept), -1, new[changed])
    labelling.rename(names)


def _spaced(score: Array, count: int, apart: int) -> list[int]:
    """Return the frames of the highest ``score`` (t,), above 0, with ``apart`` frames between them, in order."""
    left = score.astype(float)
    out: list[int] = []
    while len(out) < count and left.max(initial=0.0) > 0:
        # among equal scores take the middle frame, about which most is known
        best = np.flatnonzero(left == left.max())
        row = int(best[len(best) // 2])
        out.append(row)
        left[max(0, row - apart) : row + apart + 1] = 0.0
    return sorted(out)


def posed(problem: Matching, chosen: Array) -> Assignment:
    """Return an assignment with the pose that fits it best, starting from a standing person aligned to it."""
    there = np.flatnonzero((chosen >= 0) & problem.seen[0][np.maximum(chosen, 0)])
    points, places = problem.points[0][chosen[there]], problem.template.place_m[there]
    whole, _ = Rotation.align_vectors(points - points.mean(axis=0), places - places.mean(axis=0))
    start = problem.body.start(whole.as_matrix(), np.nanmedian(points, axis=0))
    value, poses = problem.evidence(chosen, [start], 10)
    return Assignment(value, poses, chosen)
