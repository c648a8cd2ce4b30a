"""Labels without training and without a static pose, from a template of a marker set alone.

The tracklets of a frame that shows many are matched with the template (``matching``). The distances learned of this
person label the tracklets of the other frames (``spread``). Where markers are seen that were not in that frame,
another frame is matched, using the labels so far. At last the names are compared once more with the template over
frames of the whole take, and exchanged where that is likelier: an early label is not final before the take ends.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field, PositiveInt
from pydantic.dataclasses import dataclass as checked_dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, Positive
from mosca.data.tracks import Tracks
from mosca.labelling.automatic.body import TemplateBody
from mosca.labelling.automatic.naming import FrameNaming, Names
from mosca.labelling.automatic.spread import Labelling, spread
from mosca.labelling.automatic.template import MarkerTemplate, expectation
from mosca.labelling.automatic.tracklets import TrackletSet, tracklets_of

LEARNED = 0.95
"""Least probability of a label that is used to learn about this person, whatever probability is wanted at last."""


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
    """The given tracks, with new numbers where a track had to be split."""
    probability: Array
    """(n,) that a sample's label is right; 0 without a label."""
    set_name: str = ""
    """The template's set that the person wears, where it is certain, else "". See ``MarkerTemplate.called``."""


def label_automatically(
    tracks: Tracks, template: MarkerTemplate, settings: AutomaticSettings = DEFAULTS
) -> AutomaticLabels:
    """Return ``tracks`` with labels of ``template``, where certain; tracks may have no identity over time.

    z is up, and the person must stand more or less upright in some frame. Labels of ``tracks`` are replaced.
    """
    body, expected = TemplateBody(template), expectation(template)
    tracklets = tracklets_of(tracks)
    seconds = float(tracks.time_ns.max(initial=0) - tracks.time_ns.min(initial=0)) * 1e-9
    frame_s = max(seconds / max(tracklets.frames - 1, 1), 1e-6)
    labelling = Labelling(tracklets, expected, frame_s)
    if not len(tracklets):
        return _labelled(tracks, tracklets, labelling.label, labelling.probability, template.names)
    naming = FrameNaming(tracklets, body, expected, LEARNED, max(2, round(settings.window_s / frame_s)))
    naming.first(labelling, settings.frames)
    spread(labelling, LEARNED)
    found = _renamed(labelling, naming)
    for _ in range(settings.further):
        shares = np.array([*(one.share for one in template.sets), template.share])
        if not naming.another(labelling, found.sets @ shares):
            break
        spread(labelling, LEARNED)
    found = _renamed(labelling, naming)
    label = labelling.label.copy()
    probability = np.where(label >= 0, labelling.probability * found.probability[label], 0.0)
    label[probability < settings.sure] = -1
    best = int(found.sets.argmax())
    worn = best < len(template.sets) and found.sets[best] >= LEARNED
    title = template.sets[best].title if worn else ""
    return _labelled(tracks, tracklets, label, probability, template.names, title)


def _renamed(labelling: Labelling, naming: FrameNaming) -> Names:
    """Give the labelled tracklets their names; return the names with the probability of each marker (m,)."""
    found = naming.names(labelling)
    labelling.rename(found.name)
    probability = np.zeros(len(found.name))
    known = found.name >= 0
    probability[found.name[known]] = found.probability[known]
    for k, marker, sure in found.spare:
        if not labelling.busy(k)[marker]:
            labelling.give(k, marker, sure)
            probability[marker] = sure
    return replace(found, probability=probability)


def _labelled(
    tracks: Tracks, pieces: TrackletSet, label: Array, probability: Array, names: tuple[str, ...], set_name: str = ""
) -> AutomaticLabels:
    """Return ``tracks`` with the labels (k,) of its pieces."""
    of = np.repeat(np.arange(len(pieces)), np.diff(pieces.starts))
    called = np.array(["", *names])
    new_label, sure = np.full(len(tracks), "", dtype=called.dtype), np.zeros(len(tracks))
    new_label[pieces.sample] = called[label[of] + 1]
    sure[pieces.sample] = probability[of] * (label[of] >= 0)
    number = np.array(tracks.track)
    if pieces.linked:
        number = number.max(initial=0) + 1 + number
        number[pieces.sample] = of
    else:
        _split(number, new_label, pieces, label, of)
        _to_filled(number, new_label, sure)
    order = np.lexsort((number, tracks.frame))
    done = replace(tracks, track=number, label=new_label).select(order)
    return AutomaticLabels(done, sure[order], set_name)


def _split(number: Array, new_label: Array, tracklets: TrackletSet, label: Array, of: Array) -> None:
    """Where a track has several labels, give its tracklets numbers of their own in ``number`` (n,)."""
    highest = int(number.max(initial=0))
    mine = number[tracklets.sample[tracklets.starts[:-1]]]
    for track in np.unique(mine).tolist():
        pieces = np.flatnonzero(mine == track)
        kinds = np.unique(label[pieces])
        for kind in kinds[kinds != label[pieces[0]]].tolist():
            highest += 1
            number[tracklets.sample[np.isin(of, pieces[label[pieces] == kind])]] = highest


def _to_filled(number: Array, new_label: Array, sure: Array) -> None:
    """Give samples that were not measured the label of their track, and its least probability."""
    for track in np.unique(number[(new_label == "") & np.isin(number, number[new_label != ""])]).tolist():
        mine = number == track
        named = mine & (new_label != "")
        if len(np.unique(new_label[named])) == 1:
            new_label[mine], sure[mine & ~named] = new_label[named][0], sure[named].min()
