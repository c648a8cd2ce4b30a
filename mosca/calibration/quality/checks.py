"""Quality checks of a calibration, one after the other.

    findings = check_calibration(calibration, known=rig_of_last_week, target_diameters_m=field_diameters)

A finding is a refusal, a warning or a note; a good calibration has no refusals or warnings.
"""

from collections.abc import Sequence

from mosca.calibration.quality.against_reference import exchanged, moved
from mosca.calibration.quality.interior import changed_interior, little_depth, ran_away, weak_parameters
from mosca.calibration.quality.limits import QualityLimits
from mosca.calibration.quality.mirror_pose import mirrored_poses
from mosca.calibration.quality.network import few_views, linked, little_coverage
from mosca.calibration.quality.residuals import blunders, lens_misfit
from mosca.calibration.quality.scale import LengthErrors, distances, scale_error, sizes
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.rig import Rig

ORDER = {"refuse": 0, "warn": 1, "note": 2}


def check_calibration(
    calibration: Calibration,
    *,
    known: Rig | None = None,
    target_diameters_m: Array | float | None = None,
    lengths: LengthErrors | None = None,
    volume: tuple[Sequence[float], Sequence[float]] | None = None,
    rigid_target: bool = False,
    settings: QualityLimits | None = None,
) -> tuple[Finding, ...]:
    """Return the findings on ``calibration``, the gravest first.

    ``known``: an earlier rig of the same cameras; ``target_diameters_m``: true diameter of each mark (m,), or one for
    all; ``lengths``: held-out lengths (``scale.length_errors``); ``volume`` (low, high) [m, world] of the
    measurement; ``rigid_target``: whether the positions of the world's marks were known a priori, so that the target
    joins cameras that see none of its marks in common.
    """
    s = settings or QualityLimits()
    found = [
        *few_views(calibration, s),
        *linked(calibration, s, rigid_target),
        *mirrored_poses(calibration, s),
        *little_depth(calibration, s),
        *ran_away(calibration, s),
        *distances(calibration, s),
        *little_coverage(calibration, s, volume),
        *blunders(calibration, s),
        *lens_misfit(calibration, s),
        *weak_parameters(calibration),
    ]
    if target_diameters_m is not None:
        found += sizes(calibration, target_diameters_m, s)
    if lengths is not None:
        found += scale_error(lengths, s)
    if known is not None:
        found += _against(calibration, known, s)
    return tuple(sorted(found, key=lambda one: ORDER[one.severity]))


def _against(calibration: Calibration, known: Rig, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return findings on differences from an earlier rig; exchanged cameras explain all other differences."""
    swapped = exchanged(calibration, known, settings)
    if swapped:
        return swapped
    return (*changed_interior(calibration, known, settings), *moved(calibration, known, settings))
