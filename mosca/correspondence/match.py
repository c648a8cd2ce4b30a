"""Matching of the images of a target in any number of cameras, by epipolar geometry.

Mosca paper, section 3.2: the ray of a target in one camera appears as an epipolar line in another; targets
on that line are candidates, and further cameras decide where the lines meet. "On the line" is judged by the
covariances of both detections (gating), never by a fixed number of pixels.

The search (``mosca.correspondence.candidates``) lists the hypotheses, which are sets of rays that meet. The selection
(``mosca.correspondence.selection``) takes a consistent set of them, by their likelihood against clutter; each
detection is used at most once. Predictions of tracks decide where two cameras alone leave an ambiguity.
"""

from dataclasses import dataclass

import numpy as np

from mosca.correspondence.agreement import weigh_by_agreement
from mosca.correspondence.candidates import search
from mosca.correspondence.disc_centres import Images, aim_at_centres
from mosca.correspondence.hypothesis import FIRST_HIDDEN, PAIR, SHAPES, SIZES, Hypotheses, MatchData, Rules, record_of
from mosca.correspondence.selection import OPEN, choose, columns
from mosca.data.arrays import Array
from mosca.data.rays import Predicted, RayTable
from mosca.data.settings import MatchSettings as MatchSettings
from mosca.data.tracks import Points
from mosca.numba_support.decorators import kernel

USUAL, USUAL_DISCS = 0.125, 0.25
"""Shares of images that are elongated, or isolated without a fit, from which this is no evidence against an image
(targets are flat or fast, or fits were not tried), and from which two such images suffice to take a target for a
disc."""
GRADIENTS = {"unknown": (0.25, 1.0 / 48.0), "even": (0.0, 0.0)}
"""Mean and variance of the shift that a gradient of the light gives to flat targets' images, over their eccentricity:
from 0 for distant lamps to 1/2 for the light's centroid under lamps at the lens (``mosca.camera.disc_rays``)."""
EVERYWHERE = (np.full(3, -np.inf), np.full(3, np.inf))
"""A volume without bounds."""


@dataclass(frozen=True, eq=False)
class Matched:
    """The points of a frame set, and counts of the hypotheses behind them."""

    points: Points
    considered: int
    """How many hypotheses there were."""
    left_open: int
    """Number of ambiguous pairs: another pair with about the same residual shares one of their images."""
    trusts: Array
    """(n, c) how much each image of a point counts, from 0 to 1: that of a partly hidden target counts less."""


def match(
    table: RayTable,
    predicted: Predicted,
    settings: MatchSettings,
    volume: tuple[Array, Array] = EVERYWHERE,
    typical_diameter_m: float = 0.0,
    hidden: float = FIRST_HIDDEN,
) -> Points:
    """Return the points whose rays meet, from a consistent set of hypotheses.

    A hypothesis is scored by its likelihood ratio against clutter and that of the track that predicts it (each track
    supports one hypothesis). A pair without a track is accepted only if no other such pair with about the same
    residual shares one of its rays: two cameras cannot resolve this ambiguity, later frame sets do.

    Parameters
    ----------
    table
        The rays of a frame set.
    predicted
        Predicted positions of the tracks.
    settings
        Gates, and what is judged.
    volume
        Corners low (3,) and high (3,) [m] of where points may be.
    typical_diameter_m
        Diameter of the targets if it is known (0: only the images of a hypothesis are compared). An image too small
        for it is of a partly hidden target, one too large is merged with another. The centroid is then shifted by
        about ``share of the area x radius``, so the ray counts for less and its gate is wider. A merged image is used
        a second time if a track predicts that hypothesis.
    hidden
        Share of the images that are of partly hidden targets. The larger it is, the sooner a small image is one.
    """
    return match_counted(table, predicted, settings, volume, typical_diameter_m, hidden).points


def match_counted(
    table: RayTable,
    predicted: Predicted,
    settings: MatchSettings,
    volume: tuple[Array, Array] = EVERYWHERE,
    typical_diameter_m: float = 0.0,
    hidden: float = FIRST_HIDDEN,
) -> Matched:
    """Return what ``match`` does, with the counts of hypotheses considered and of pairs left open."""
    (x0, y0, z0), (x1, y1, z1) = volume
    rules = Rules(
        float(settings.gate_sigma), float(settings.outlier_sigma), float(settings.support_sigma),
        settings.minimum_cameras, float(settings.worst_sigma_m) ** 2, _judged_by(table, settings),
        _fewest_images(table, settings), float(typical_diameter_m), float(hidden),
        (float(x0), float(y0), float(z0)), (float(x1), float(y1), float(z1)),
    )  # fmt: skip
    images = Images(
        settings.target == "auto",
        table.cameras,
        table.xy_px,
        table.detected_px2,
        table.covariance_px2,
        table.extra_px2,
        *GRADIENTS[settings.light],
    )
    found, trusts, considered, left_open = match_rays(
        table.rays, table.views, table.pairs, table.bases, table.start, rules, predicted.xyz, predicted.covariance,
        images,
    )  # fmt: skip
    for column in found:
        column.setflags(write=False)
    return Matched(Points.handed_over(found), considered, left_open, trusts)


@kernel
def match_rays(rays, views, pairs, bases, start, rules, xyz, covariance, images):
    """Return the columns of ``Points``, ``Matched.trusts``, and the numbers of hypotheses and of pairs left open."""
    data = MatchData(rays, views, record_of(rules))
    kept, count = search(data, pairs, bases, start, xyz, covariance)
    kept = Hypotheses(kept.values[:count], kept.members[:count], kept.trusts[:count])
    state = choose(kept, data, xyz, covariance)
    if images.freed:
        aim_at_centres(kept, state, data, images)
    weigh_by_agreement(kept, state, data)
    left_open = 0
    for g in range(count):
        left_open += state[g] == OPEN
    found, taken_trusts = columns(kept, state, rays, start)
    return found, taken_trusts, count, left_open


def _fewest_images(table: RayTable, settings: MatchSettings) -> int:
    """Return how many images must fit a circle for a target to be taken for a disc.

    Two suffice where many images are long. Where long images are rare, two that are merged with neighbours may fit a
    circle by chance.
    """
    if settings.target == "ball":
        return 0
    return PAIR + 1 if table.odd < USUAL_DISCS * len(table.rays) else PAIR


def _judged_by(table: RayTable, settings: MatchSettings) -> float:
    """Return whether images are judged by their sizes alone, by their shapes too, or not at all (0)."""
    if not settings.judge_sizes:
        return 0.0
    return SHAPES if table.odd < USUAL * len(table.rays) else SIZES
