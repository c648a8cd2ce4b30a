"""Check that sigma0 is about 1: where residuals are not as large as expected, the likeliest cause is named."""

from collections.abc import Sequence

import numpy as np

from mosca.calibration.quality.findings import warn
from mosca.calibration.quality.limits import QualityLimits
from mosca.data.calibration import Calibration, Finding

CAUSES = {
    "target-shape": "the target is not as its file says (target-shape)",
    "lens-model": "the lens model cannot follow a lens (lens-model)",
    "blunders": "many image points are not the target's (blunders)",
}
"""Findings that explain large residuals, the likeliest first."""
NO_BETTER = "points are less exact than detection expects: defocus, motion blur, glare"


def unit_weight(calibration: Calibration, found: Sequence[Finding], settings: QualityLimits) -> tuple[Finding, ...]:
    """Return a finding where sigma0 is far from 1, with the cause; ``found``: findings of the other checks."""
    sigma0, most = calibration.sigma0, settings.unit_weight
    if 1 / most <= sigma0 <= most:
        return ()
    if sigma0 < 1:
        cause = "the standard deviations of image points are stated too large (a table's sigma_px)"
    else:
        told = {one.code for one in found if one.severity != "note"}
        cause = next((text for code, text in CAUSES.items() if code in told), "")
        if not cause and calibration.body_px > np.sqrt(np.mean(calibration.sigma_px**2)):
            cause = (
                f"whole images shift by {calibration.body_px:.2g} px rms, more than points scatter: cameras are not "
                "synchronised, or not firm"
            )
    text = f"sigma0 is {sigma0:.2g}, {1 / most:.2g} to {most:.2g} allowed; likeliest cause: {cause or NO_BETTER}"
    return (warn("unit-weight", text),)
