"""Labels without training and without a static pose: a template of a marker set is all that is known.

The tracklets of a frame that shows many are matched with the template (``matching``); what is learned of this person
labels the tracklets of the other frames (``spread``); where markers are seen that were not in that frame, another
frame is matched, with what is known. At last the names are compared once more with the template over frames of the
whole take, and exchanged where that is likelier: a label given early is not final before the take ends.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field, PositiveInt
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.tracks import Tracks
from mosca.labelling.automatic.body import TemplateBody
from mosca.labelling.automatic.matching import Assignment, MatchedMarkers, Matching, refine, searched, starts, unlike
from mosca.labelling.automatic.spread import Labelling, spread
from mosca.labelling.automatic.template import Expectation, MarkerTemplate, expectation
from mosca.labelling.automatic.tracklets import TrackletSet, tracklets_of

MOST_POINTS = 110
"""Points of a frame that are matched: those that are seen longest about it."""

NAMED = 3
"""Frames of the take in which names are compared at last."""


@checked_dataclass(frozen=True, config=SETTINGS)
class AutomaticSettings:
    """How sure labels are, and where they are looked for."""

    sure: Annotated[float, Field(gt=0, lt=1)] = 0.95
    """Least probability of a label."""
    window_s: Positive = 1.0
    """Time before and after a frame in which its points' distances are compared."""
    frames: PositiveInt = 3
    """Frames that are matched from nothing; the best is taken."""
    further: PositiveInt = 4
    """Frames that are matched with what is known, at most."""


DEFAULTS = AutomaticSettings()


@dataclass(frozen=True, eq=False)
class AutomaticLabels:
    """Labelled tracks."""

    tracks: Tracks
    """With new numbers where a track had to be split."""
    probability: Array
    """(n,) that a sample's label is right; 0 without a label."""


def label_automatically(
    tracks: Tracks, template: MarkerTemplate, settings: AutomaticSettings = DEFAULTS
) -> AutomaticLabels:
    """Return ``tracks`` with labels of ``template``, where they are sure; tracks may have no identity over time.

    z is up, and the person stands more or less upright in some frame. Labels that ``tracks`` have are replaced.
    """
    body, expected = TemplateBody(template), expectation(template)
    tracklets = tracklets_of(tracks)
    labelling = Labelling(tracklets, expected)
    if len(tracklets):
        take = _Take(tracklets, body, expected, settings, _window(tracks, tracklets, settings))
        take.first(labelling)
        spread(labelling, settings.sure)
        for _ in range(settings.further):
            if not take.another(labelling):
                break
            spread(labelling, settings.sure)
        names, of_name = take.names(labelling)
        label = np.where(labelling.label >= 0, names[labelling.label], -1)
        probability = np.where(label >= 0, labelling.probability * of_name[labelling.label], 0.0)
        label[probability < settings.sure] = -1
        return _labelled(tracks, tracklets, label, probability, template)
    return _labelled(tracks, tracklets, labelling.label, labelling.probability, template)


def _window(tracks: Tracks, tracklets: TrackletSet, settings: AutomaticSettings) -> int:
    """Return the frames in ``window_s``."""
    seconds = float(tracks.time_ns.max() - tracks.time_ns.min()) * 1e-9
    return max(2, round(settings.window_s * (tracklets.frames - 1) / max(seconds, 1e-6)))


@dataclass
class _Take:
    """What is the same for all frames that are matched."""

    tracklets: TrackletSet
    body: TemplateBody
    expected: Expectation
    settings: AutomaticSettings
    half: int

    def first(self, labelling: Labelling) -> None:
        """Label the tracklets of the frame that matches the template best."""
        best: tuple[float, Matching, Array, list[Assignment]] | None = None
        for row in self._fullest(np.ones(len(self.tracklets), dtype=bool), self.settings.frames):
            problem, pieces = self._problem(row)
            if problem.n < 4:
                continue
            found = starts(problem)
            value = found[0].evidence / problem.n
            if best is None or value > best[0]:
                best = value, problem, pieces, found
        if best is None:
            return
        _, problem, pieces, found = best
        end = max((searched(problem, one) for one in unlike(found)), key=lambda one: one.evidence)
        self._give(labelling, refine(problem, end.chosen, end.poses), pieces)

    def another(self, labelling: Labelling) -> bool:
        """Label further tracklets in a frame that shows many without a label; return whether there were any."""
        without = labelling.label < 0
        lengths = np.diff(self.tracklets.starts)
        row = self._fullest(without & (lengths >= min(self.half // 2, 20)), 1)
        if not row:
            return False
        problem, pieces = self._problem(row[0])
        chosen = np.full(problem.m, -1)
        named = labelling.label[pieces]
        chosen[named[named >= 0]] = np.flatnonzero(named >= 0)
        if (chosen >= 0).sum() < 6:
            return False
        found = searched(problem, _posed(problem, chosen))
        matched = refine(problem, found.chosen, found.poses, (chosen >= 0) & (found.chosen == chosen))
        before = int((labelling.label >= 0).sum())
        for marker in np.flatnonzero(matched.chosen >= 0).tolist():
            k = int(pieces[matched.chosen[marker]])
            fits = matched.probability[marker] >= self.settings.sure and not labelling.busy(k)[marker]
            if labelling.label[k] < 0 and fits:
                labelling.give(k, marker, float(matched.probability[marker]))
        return int((labelling.label >= 0).sum()) > before

    def names(self, labelling: Labelling) -> tuple[Array, Array]:
        """Return the best name (m,) of what is labelled as each marker now, and its probability."""
        xyz = labelling.xyz
        there = np.flatnonzero(np.isfinite(xyz[:, :, 0]).any(axis=0))
        names, probability = np.arange(xyz.shape[1]), np.zeros(xyz.shape[1])
        if len(there) < 4:
            return names, probability
        seen = np.isfinite(xyz[:, there, 0]).sum(axis=1)
        rows = _spaced(seen, NAMED, max(1, len(xyz) // (2 * NAMED)))
        step = max(1, len(xyz) // 600)
        used = np.unique(np.concatenate([np.arange(0, len(xyz), step), rows]))
        problem = Matching(xyz[used][:, there], np.searchsorted(used, rows).tolist(), self.body, self.expected)
        chosen = np.full(problem.m, -1)
        chosen[there] = np.arange(len(there))
        poses = []
        for f in range(len(rows)):
            poses += _posed(problem.frame(f), chosen).poses
        found = searched(problem, Assignment(*problem.evidence(chosen, poses), chosen))
        matched = refine(problem, found.chosen, found.poses)
        for marker in np.flatnonzero(matched.chosen >= 0).tolist():
            names[there[matched.chosen[marker]]] = marker
            probability[there[matched.chosen[marker]]] = matched.probability[marker]
        return names, probability

    def _fullest(self, of: Array, count: int) -> list[int]:
        """Return frames that show many of the tracklets ``of`` (k,), long ones, apart from each other."""
        score = np.zeros(self.tracklets.frames)
        lengths = np.diff(self.tracklets.starts)
        for k in np.flatnonzero(of).tolist():
            score[self.tracklets.row[self.tracklets.part(k)]] += min(int(lengths[k]), self.half)
        return _spaced(score, count, self.half)

    def _problem(self, row: int) -> tuple[Matching, Array]:
        """Return what is to be matched in a frame, and its tracklets."""
        of = np.repeat(np.arange(len(self.tracklets)), np.diff(self.tracklets.starts))
        pieces = of[self.tracklets.row == row]
        lengths = np.diff(self.tracklets.starts)[pieces]
        pieces = np.sort(pieces[np.argsort(-lengths, kind="stable")[:MOST_POINTS]])
        window = slice(max(0, row - self.half), min(self.tracklets.frames, row + self.half + 1))
        xyz = self.tracklets.window(pieces, window)
        return Matching(xyz, [row - window.start], self.body, self.expected), pieces

    def _give(self, labelling: Labelling, matched: MatchedMarkers, pieces: Array) -> None:
        for marker in np.flatnonzero(matched.chosen >= 0).tolist():
            labelling.give(int(pieces[matched.chosen[marker]]), marker, float(matched.probability[marker]))


def _spaced(score: Array, count: int, apart: int) -> list[int]:
    """Return the frames of the highest ``score`` (t,), above 0, with ``apart`` frames between them, in order."""
    left = score.astype(float)
    out: list[int] = []
    while len(out) < count and left.max(initial=0.0) > 0:
        # of equal ones the middle: most is known about it
        best = np.flatnonzero(left == left.max())
        row = int(best[len(best) // 2])
        out.append(row)
        left[max(0, row - apart) : row + apart + 1] = 0.0
    return sorted(out)


def _labelled(
    tracks: Tracks, tracklets: TrackletSet, label: Array, probability: Array, template: MarkerTemplate
) -> AutomaticLabels:
    """Return ``tracks`` with the labels (k,) of its tracklets."""
    of = np.repeat(np.arange(len(tracklets)), np.diff(tracklets.starts))
    names = np.array(["", *template.names])
    new_label, sure = np.full(len(tracks), "", dtype=names.dtype), np.zeros(len(tracks))
    new_label[tracklets.sample] = names[label[of] + 1]
    sure[tracklets.sample] = probability[of] * (label[of] >= 0)
    number = np.array(tracks.track)
    if tracklets.linked:
        number = number.max(initial=0) + 1 + number
        number[tracklets.sample] = of
    else:
        _split(number, new_label, tracklets, label, of)
        _to_filled(number, new_label, sure)
    order = np.lexsort((number, tracks.frame))
    done = replace(tracks, track=number, label=new_label).select(order)
    return AutomaticLabels(done, sure[order])


def _split(number: Array, new_label: Array, tracklets: TrackletSet, label: Array, of: Array) -> None:
    """Give tracklets of a track that has several labels numbers of their own, in ``number`` (n,)."""
    highest = int(number.max(initial=0))
    mine = number[tracklets.sample[tracklets.starts[:-1]]]
    for track in np.unique(mine).tolist():
        pieces = np.flatnonzero(mine == track)
        kinds = np.unique(label[pieces])
        for kind in kinds[kinds != label[pieces[0]]].tolist():
            highest += 1
            number[tracklets.sample[np.isin(of, pieces[label[pieces] == kind])]] = highest


def _to_filled(number: Array, new_label: Array, sure: Array) -> None:
    """Give samples that are not measured the label of their track, and its least probability."""
    for track in np.unique(number[(new_label == "") & np.isin(number, number[new_label != ""])]).tolist():
        mine = number == track
        named = mine & (new_label != "")
        if len(np.unique(new_label[named])) == 1:
            new_label[mine], sure[mine & ~named] = new_label[named][0], sure[named].min()


def _posed(problem: Matching, chosen: Array) -> Assignment:
    """Return an assignment with the pose that fits it best: from standing as these markers are."""
    there = np.flatnonzero((chosen >= 0) & problem.seen[0][np.maximum(chosen, 0)])
    points, places = problem.points[0][chosen[there]], problem.template.place_m[there]
    whole, _ = Rotation.align_vectors(points - points.mean(axis=0), places - places.mean(axis=0))
    start = problem.body.start(whole.as_matrix(), np.nanmedian(points, axis=0))
    value, poses = problem.evidence(chosen, [start], 10)
    return Assignment(value, poses, chosen)
