"""A rig from a light that is waved through the volume, nothing of it known: neither lengths nor focal lengths.

In the manner of Svoboda, Martinec and Pajdla 2005. The lengths of the result are arbitrary until one is known
(``mosca.calibration.world_frame.l_frame``); so are its axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.calibration.uncalibrated.final_adjustment import finished
from mosca.calibration.uncalibrated.image_points import point_views
from mosca.calibration.uncalibrated.incremental import grow
from mosca.calibration.uncalibrated.result import calibration_of, check
from mosca.calibration.uncalibrated.seed import core
from mosca.calibration.uncalibrated.view_graph import check_links, common_bend
from mosca.data.calibration import Calibration
from mosca.data.rig import Lens
from mosca.data.sightings import Sightings

MOST_WHILE_GROWING = 1200
"""Image points a camera that the start and the growth work with; the last adjustment has all."""


@dataclass(frozen=True)
class SelfSettings:
    """``blunder_significance``: chance that a good image point is rejected, in the whole session; None: only gross
    blunders are.
    """

    blunder_significance: float | None = 0.05


def self_calibrate(
    sightings: Sightings,
    rng: np.random.Generator,
    lenses: Sequence[Lens] | None = None,
    settings: SelfSettings | None = None,
) -> Calibration:
    """Calibrate cameras from sightings of one light (mark 0) a frame.

    ``lenses``: one a camera; model (mosca or opencv) and shape of the pixels count, all else is found anew; default
    OpenCV's model with square pixels. CalibrationError where cameras are not joined by common views, or where the
    result cannot be a rig.
    """
    settings = settings or SelfSettings()
    marks = int(sightings.mark.max(initial=0)) + 1
    tracks = point_views(sightings, marks, lenses)
    check_links(tracks)
    some = tracks.thinned(MOST_WHILE_GROWING * len(tracks.names), rng)
    bend = common_bend(some, rng)
    start = grow(core(some, bend, rng), some, bend, rng)
    final = finished(start, tracks, tracks.lenses, settings.blunder_significance)
    check(final, tracks)
    return calibration_of(final, tracks, sightings, "light", "nothing: lengths are arbitrary", None)
