"""Labels of the tracks of a deforming surface, such as a face, from a surface model: no training, no static pose.

The points of the frame that shows most are matched with the model (``matching``). These labels give the pose of each
frame and every tracklet's mean place on the surface. Together these places are a face of mean expression, which is
matched once more. From it the model is adapted to this person's own places, so that only movement remains open. With
the adapted model, frames that show unlabelled tracklets are matched. At last each label is compared with its
neighbours over the whole take, and removed where they refute it.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field, PositiveInt
from pydantic.dataclasses import dataclass as checked_dataclass

from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.tracks import Tracks
from mosca.labelling.automatic.label import AutomaticLabels
from mosca.labelling.automatic.tracklets import TrackletSet, tracklets_of
from mosca.labelling.surface.fit import SurfaceFit, SurfaceFitter, SurfacePose
from mosca.labelling.surface.matching import SurfaceMatch, SurfaceMatcher
from mosca.labelling.surface.model import LEAST_MARKERS, NOISE_M, SurfaceModel

MEAN_SHARE = 0.5
"""Share of the squared mean over a take in a movement's mean square about rest. A face moves to one side of rest; for
values between 0 and a maximum that are mostly small, the square of the mean is about the variance."""
STEADY = 0.02
"""Standard deviation of the logarithm of a person's size after it was estimated."""
REFUTED = float(chi2.isf(1e-6, 3))
"""Squared Mahalanobis distance of a marker from its prediction by the others beyond which its label is refuted."""


@checked_dataclass(frozen=True, config=SETTINGS)
class SurfaceSettings:
    """How sure labels are, and what else there is."""

    sure: Annotated[float, Field(gt=0, lt=1)] = 0.99
    """Least probability of a label. What two neighbours' places leave open, every frame leaves open, and the surest
    of many is taken: 0.95 would be less than that."""
    frames: PositiveInt = 100
    """Frames, evenly spaced, in which labels are compared."""
    further: PositiveInt = 100
    """Frames that are matched with what is known, at most."""
    expression_s: Positive = 1.0
    """Time after which a face has another expression [s]."""
    shown: Annotated[float, Field(gt=0.5, lt=1)] = 0.97
    """Share of the model's markers that there are."""
    extra: Positive = 0.1
    """Points about the surface that are no markers of it, in a frame on average: ghosts, of which there are fewer,
    and markers that the model does not know."""


DEFAULTS = SurfaceSettings()


def label_surface(tracks: Tracks, model: SurfaceModel, settings: SurfaceSettings = DEFAULTS) -> AutomaticLabels:
    """Return ``tracks`` with labels of ``model``, where certain; the surface may have any place and orientation.

    Labels of ``tracks`` are replaced. Without a frame that shows six markers or more, none gets a label.
    """
    tracklets = tracklets_of(tracks)
    take = _SurfaceTake(tracklets, model, settings, _seconds(tracks))
    if len(tracklets) and take.first():
        take.mean_face()
        take.others()
        take.refuted()
    return _labelled(tracks, take)


def _seconds(tracks: Tracks) -> float:
    return float(np.ptp(tracks.time_ns)) * 1e-9 if len(tracks) else 0.0


@dataclass(frozen=True, eq=False)
class _SurfaceFrame:
    """Points (n, 3) of a frame, the tracklet (n,) of each, and the frame's index."""

    row: int
    xyz: Array
    piece: Array


class _SurfaceTake:
    """Labels of the tracklets of a take, and the steps that find them."""

    def __init__(
        self, tracklets: TrackletSet, model: SurfaceModel, settings: SurfaceSettings, seconds: float
    ) -> None:
        self.tracklets, self.model, self.settings, self.seconds = tracklets, model, settings, seconds
        self.of = np.repeat(np.arange(len(tracklets)), np.diff(tracklets.starts))
        self.label = np.full(len(tracklets), -1)
        self.probability = np.zeros(len(tracklets))
        self.bad = np.zeros(len(self.of), dtype=bool)
        self._order = np.argsort(tracklets.row, kind="stable")
        self._bounds = np.searchsorted(tracklets.row[self._order], np.arange(tracklets.frames + 1))
        self._pose: SurfacePose | None = None

    def frame(self, row: int) -> _SurfaceFrame:
        """Return the points of a frame."""
        at = self._order[self._bounds[row] : self._bounds[row + 1]]
        return _SurfaceFrame(row, self.tracklets.xyz[at], self.of[at])

    def rows(self) -> list[int]:
        """Return the frames that are used, evenly spaced."""
        most = min(self.settings.frames, self.tracklets.frames)
        return [int(row) for row in np.unique(np.linspace(0, self.tracklets.frames - 1, most).round())]

    def first(self) -> bool:
        """Label the tracklets of the frame that shows most long ones; return whether there are labels."""
        lengths = np.diff(self.tracklets.starts)
        score = np.bincount(self.tracklets.row, weights=np.minimum(lengths, 100)[self.of], minlength=1)
        frame = self.frame(int(np.argmax(score)))
        matcher = self._matcher(SurfaceFitter(self.model))
        matches = matcher.found(frame.xyz)
        if not matches:
            return False
        best, rivals = matcher.challenged(frame.xyz, matches)
        self._give(best, matcher.probability(best, rivals), frame.piece)
        self._pose = best.fit.pose
        return bool((self.label >= 0).any())

    def mean_face(self) -> None:
        """Match each tracklet's mean place on the surface with the model, and learn this person's places."""
        fitter = SurfaceFitter(self.model)
        total, count = np.zeros((len(self.tracklets), 3)), np.zeros(len(self.tracklets))
        for row in self.rows():
            frame = self.frame(row)
            fit = self._fitted(fitter, frame)
            if fit is not None:
                np.add.at(total, frame.piece, fit.pose.local(frame.xyz))
                np.add.at(count, frame.piece, 1)
        # tracklets of one marker are one point; of unlabelled ones, those seen for long are points
        groups = [np.flatnonzero((self.label == k) & (count > 0)) for k in range(len(self.model.names))]
        groups = [group for group in groups if len(group)]
        groups += [np.array([k]) for k in np.flatnonzero((self.label < 0) & (count > 0.5 * max(count.max(), 1)))]
        if len(groups) < LEAST_MARKERS:
            self.label[:] = -1
            return
        places = np.array([total[group].sum(axis=0) / count[group].sum() for group in groups])
        share = MEAN_SHARE + (1 - MEAN_SHARE) / (1 + self.seconds / self.settings.expression_s)
        matcher = self._matcher(SurfaceFitter(self.model, share))
        chosen = np.full(len(self.model.names), -1)
        for point, group in enumerate(groups):
            if self.label[group[0]] >= 0:
                chosen[self.label[group[0]]] = point
        start = SurfacePose(np.eye(3), np.zeros(3), 1.0)
        best, rivals = matcher.challenged(places, [matcher.refined(places, chosen, start)])
        probability = matcher.probability(best, rivals)
        self.label[:], self.probability[:] = -1, 0.0
        for marker in np.flatnonzero(probability >= self.settings.sure).tolist():
            self.label[groups[best.chosen[marker]]] = marker
            self.probability[groups[best.chosen[marker]]] = probability[marker]
        self.learned = SurfaceFitter(_of_person(self.model, best, places, probability >= self.settings.sure))

    def others(self) -> None:
        """Label further tracklets, the longest first: match a frame that shows each, using the labels so far."""
        matcher, lengths = self._matcher(self.learned), np.diff(self.tracklets.starts)
        waits = self.label < 0
        for _ in range(self.settings.further):
            if not waits.any():
                break
            own = self.tracklets.row[self.tracklets.part(int(np.argmax(np.where(waits, lengths, 0))))]
            known = np.bincount(self.tracklets.row, self.label[self.of] >= 0)[own]
            # the middle of the frames that show most labels: tracks that break are doubtful at their ends
            fullest = own[known == known.max()]
            frame = self.frame(int(fullest[len(fullest) // 2]))
            waits[frame.piece] = False
            fit = self._fitted(self.learned, frame)
            if fit is None:
                continue
            chosen = np.full(len(self.model.names), -1)
            named = self.label[frame.piece]
            chosen[named[named >= 0]] = np.flatnonzero(named >= 0)
            best, rivals = matcher.challenged(frame.xyz, [matcher.refined(frame.xyz, chosen, fit.pose)])
            self._give(best, matcher.probability(best, rivals), frame.piece)

    def refuted(self) -> None:
        """Mark samples whose label is refuted by the other markers in the nearest frame that is used."""
        rows = np.array(self.rows())
        wrong = np.zeros((len(rows), len(self.tracklets)), dtype=bool)
        for k, row in enumerate(rows.tolist()):
            frame = self.frame(row)
            fit = self._fitted(self.learned, frame)
            if fit is None:
                wrong[k] = True
                continue
            label = self.label[frame.piece]
            for point in np.flatnonzero(label >= 0).tolist():
                away = fit.pose.local(frame.xyz[point]) - fit.mean[label[point]]
                wrong[k, frame.piece[point]] = away @ np.linalg.solve(fit.spread[label[point]], away) > REFUTED
        nearest = np.abs(self.tracklets.row[:, None] - rows).argmin(axis=1)
        self.bad = wrong[nearest, self.of]

    def _matcher(self, fitter: SurfaceFitter) -> SurfaceMatcher:
        return SurfaceMatcher(fitter, self.settings.shown, self.settings.extra)

    def _give(self, match: SurfaceMatch, probability: Array, piece: Array) -> None:
        """Give certain labels to tracklets without one, where no simultaneous tracklet has the label."""
        begin = self.tracklets.row[self.tracklets.starts[:-1]]
        end = self.tracklets.row[self.tracklets.starts[1:] - 1]
        for marker in np.flatnonzero(probability >= self.settings.sure).tolist():
            k = int(piece[match.chosen[marker]])
            meanwhile = (begin <= end[k]) & (end >= begin[k])
            if self.label[k] < 0 and not (self.label[meanwhile] == marker).any():
                self.label[k], self.probability[k] = marker, probability[marker]

    def _fitted(self, fitter: SurfaceFitter, frame: _SurfaceFrame) -> SurfaceFit | None:
        """Return the fit to a frame's labelled points; None for too few of them."""
        points = np.full((len(self.model.names), 3), np.nan)
        label = self.label[frame.piece]
        points[label[label >= 0]] = frame.xyz[label >= 0]
        if np.isfinite(points[:, 0]).sum() < LEAST_MARKERS or self._pose is None:
            return None
        fit = fitter.fit(points, self._pose)
        self._pose = fit.pose
        return fit


def _of_person(model: SurfaceModel, match: SurfaceMatch, places: Array, sure: Array) -> SurfaceModel:
    """Return the model adapted to a person from the ``sure`` (m,) markers of a mean face with ``places`` (n, 3)."""
    pose, seen = match.fit.pose, sure & (match.chosen >= 0)
    expected = pose.size * model.place_m
    r = np.where(seen[:, None], pose.local(places[np.maximum(match.chosen, 0)]) - expected, 0.0).reshape(-1)
    stays, about = model.covariance(MEAN_SHARE), (1 - MEAN_SHARE) * model.motion
    at = np.repeat(seen, 3)
    noise = about[np.ix_(at, at)] + NOISE_M**2 * np.eye(int(at.sum()))
    gain = np.linalg.solve(stays[np.ix_(at, at)] + noise, stays[at]).T
    place = expected + (gain @ r[at]).reshape(-1, 3)
    person = stays - gain @ stays[at]
    return SurfaceModel(model.names, place, 0.5 * (person + person.T), about, STEADY)


def _labelled(tracks: Tracks, take: _SurfaceTake) -> AutomaticLabels:
    """Return ``tracks`` with the labels of a take's tracklets; samples that were not measured get none."""
    names = np.array(["", *take.model.names])
    sample, label = take.tracklets.sample, np.where(take.bad, -1, take.label[take.of])
    new_label, sure = np.full(len(tracks), "", dtype=names.dtype), np.zeros(len(tracks))
    new_label[sample] = names[label + 1]
    sure[sample] = np.where(label >= 0, take.probability[take.of], 0.0)
    number = np.array(tracks.track)
    # a track of several markers, or partly of none, gets a number for each
    highest = int(number.max(initial=0))
    if take.tracklets.linked:
        number[sample] = highest + 1 + take.of
    else:
        for track in np.unique(number[sample]).tolist():
            mine = sample[number[sample] == track]
            kinds, first = np.unique(new_label[mine], return_index=True)
            for kind in kinds[np.argsort(first)][1:]:
                highest += 1
                number[mine[new_label[mine] == kind]] = highest
    order = np.lexsort((number, tracks.frame))
    return AutomaticLabels(replace(tracks, track=number, label=new_label).select(order), sure[order])
