"""All data of a calibration that a report page shows."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mosca.calibration.quality.accuracy_map import accuracy_map
from mosca.calibration.quality.limits import QualityLimits
from mosca.calibration.quality.network import coverage, links, missing_links
from mosca.calibration.quality.scale import LengthErrors
from mosca.data.calibration import Calibration
from mosca.data.calibration_evidence import AccuracyGrid, CalibrationEvidence, HeldOutLengths

GRID = 13
"""Points of the accuracy map along the volume's longest edge; odd, so that one lies in the middle."""
LEAST_GRID = 3


def evidence_of(
    calibration: Calibration,
    *,
    volume: tuple[Sequence[float], Sequence[float]] | None = None,
    lengths: LengthErrors | None = None,
    made_from: str = "",
    rigid_target: bool = False,
) -> CalibrationEvidence:
    """Return the evidence for ``calibration``.

    ``volume`` (low, high) [m, world] of the accuracy map: default the box of the target's points (1 to 99 %).
    The other arguments as for ``check_calibration``.
    """
    strength = links(calibration, rigid_target)
    covered = np.array([coverage(calibration, k, QualityLimits().cells) for k in range(len(calibration.rig.cameras))])
    groups = connected_components(coo_array(strength), directed=False)[1]
    return CalibrationEvidence(
        covered,
        strength,
        groups,
        np.array([pair[:2] for pair in missing_links(calibration, groups)]),
        _accuracy(calibration, volume),
        None
        if lengths is None
        else HeldOutLengths(
            lengths.length_m, lengths.sigma_m, lengths.true_m, lengths.scale_error, lengths.scale_sigma
        ),
        made_from=made_from,
    )


def _accuracy(
    calibration: Calibration, volume: tuple[Sequence[float], Sequence[float]] | None
) -> AccuracyGrid | None:
    if len(calibration.rig.cameras) < 2:
        return None
    if volume is None:
        points = calibration.points_in_world()[calibration.used]
        low, high = np.percentile(points, (1, 99), axis=0)
    else:
        low, high = (np.asarray(side, dtype=float) for side in volume)
    extent = high - low
    if not (extent > 0).all():
        return None
    known = calibration.sigma_px[np.isfinite(calibration.sigma_px).all(axis=1)]
    # later measurements are also affected by the cameras' shake
    sigma_px = float(np.sqrt(np.mean(known**2) + calibration.body_px**2)) if len(known) else 0.1
    count = [max(LEAST_GRID, int(GRID * edge / extent.max()) // 2 * 2 + 1) for edge in extent]
    return accuracy_map(calibration, low, high, (count[0], count[1], count[2]), sigma_px)
