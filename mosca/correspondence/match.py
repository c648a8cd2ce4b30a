"""Which images in different cameras are the same target: epipolar geometry over any number of cameras.

Mosca paper, section 3.2: the ray of a target in one camera appears as an epipolar line in another; targets
on that line are candidates, and further cameras decide where the lines meet. "On the line" is judged by the
covariances of both detections, never by a fixed number of pixels.

The search (``mosca.correspondence.candidates``) lists the consistent groups of rays; the choice
(``mosca.correspondence.selection``) takes a set of them in which no image serves twice, by their likelihood against
chance, and lets the tracks decide by their predictions what two cameras alone leave open.
"""

from dataclasses import dataclass

import numpy as np

from mosca.correspondence.candidates import search
from mosca.correspondence.hypothesis import (
    GATE,
    HIGH,
    JUDGE,
    LOW,
    MINIMUM,
    OUTLIER,
    RULES,
    SHAPES,
    SIZES,
    TYPICAL,
    WORST,
)
from mosca.correspondence.selection import OPEN, choose, columns
from mosca.data.arrays import Array
from mosca.data.rays import Predicted, RayTable
from mosca.data.settings import MatchSettings as MatchSettings
from mosca.data.tracks import Points

USUAL = 0.25
"""Share of images that are long, or stand alone without a fit, from which that says nothing of an image: targets are
flat or fast, fits were not tried."""
EVERYWHERE = (np.full(3, -np.inf), np.full(3, np.inf))
"""A volume without bounds."""


@dataclass(frozen=True, eq=False)
class Matched:
    """The points of a frame set; ``considered``: how many groups of rays met; ``left_open``: how many pairs were
    not taken because another that meets about as well wants one of their images.
    """

    points: Points
    considered: int
    left_open: int


def match(
    bundle: RayTable,
    predicted: Predicted,
    settings: MatchSettings,
    volume: tuple[Array, Array] = EVERYWHERE,
    typical_diameter_m: float = 0.0,
) -> Points:
    """Return the points within ``volume`` (low (3,), high (3,)) [m] whose rays meet, best group first taken.

    ``typical_diameter_m``: of the targets, as far as it is known (0: compare the images of a group alone). An
    image too small for it is a target partly hidden, one too large is merged with another; the centroid is
    shifted by about ``share of the area x radius``: the ray counts for less and is searched for farther away. Such
    a merged image serves a second group if a track speaks for it.

    A group's worth is its likelihood against chance, with what a track says that expects it there (each track
    speaks for one group). A pair without a track is taken only where no other such pair that meets about as well
    wants one of its rays: two cameras cannot tell, time will.
    """
    return match_counted(bundle, predicted, settings, volume, typical_diameter_m).points


def match_counted(
    bundle: RayTable,
    predicted: Predicted,
    settings: MatchSettings,
    volume: tuple[Array, Array] = EVERYWHERE,
    typical_diameter_m: float = 0.0,
) -> Matched:
    """As ``match``, with the counts of what was considered and what was left open."""
    rules = np.empty(RULES)
    rules[GATE], rules[OUTLIER] = settings.gate_sigma, settings.outlier_sigma
    rules[MINIMUM], rules[WORST] = settings.minimum_cameras, settings.worst_sigma_m**2
    rules[JUDGE] = _judged_by(bundle) if settings.judge_sizes else 0.0
    rules[TYPICAL] = typical_diameter_m
    rules[LOW:HIGH], rules[HIGH:RULES] = volume
    values, members, trusts = search(
        bundle.rays, bundle.views, bundle.pairs, bundle.bases, bundle.start, rules, predicted.xyz,
        predicted.covariance,
    )  # fmt: skip
    state = choose(
        values, members, trusts, bundle.rays, bundle.views, rules, predicted.xyz, predicted.covariance,
        float(settings.support_sigma),
    )  # fmt: skip
    found = columns(values, members, trusts, state, bundle.rays, bundle.start)
    for column in found:
        column.setflags(write=False)
    return Matched(Points.handed_over(found), len(values), int(np.count_nonzero(state == OPEN)))


def _judged_by(bundle: RayTable) -> float:
    """Return whether images are judged by their sizes alone or by their shapes too."""
    return SHAPES if bundle.odd < USUAL * len(bundle.rays) else SIZES
