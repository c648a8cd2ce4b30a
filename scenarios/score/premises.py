"""What must hold in a scenario for its score to mean anything."""

from typing import Any

import numpy as np

from mosca.data.truth import Truth
from mosca.errors import PremiseError
from scenarios.spec.scenario import Scenario


def premises_met(spec: Scenario, truth: Truth, name: str) -> dict[str, Any]:
    """Return what must hold for the score to mean anything, and whether it does; PremiseError where it does not."""
    diameter = truth.diameter_px[truth.visible >= 0.5]
    moved = np.linalg.norm(np.diff(truth.image_xy_px, axis=0), axis=-1)
    share = spec.capture.exposure_s * spec.capture.frame_rate_hz
    blur = moved[np.isfinite(moved)] * share
    wanted = spec.premises
    views = float((truth.visible >= 0.5).sum(axis=2).mean()) if truth.visible.size else 0.0
    found: dict[str, Any] = {
        "marker_px": _at_least(float(np.median(diameter)) if diameter.size else 0.0, wanted.marker_px),
        "blur_px": _at_most(float(np.quantile(blur, 0.95)) if blur.size else 0.0, wanted.blur_px),
        "views": _at_least(views, wanted.views),
    }
    for key, premise in found.items():
        if not premise["holds"]:
            bound = "minimum" if "minimum" in premise else "maximum"
            raise PremiseError(
                f"{name}: premise '{key}' does not hold: {premise['value']:.3g}, {bound} {premise[bound]:g}; the "
                f"score would mean nothing. Change the cameras or the markers, or premises.{key}"
            )
    return found


def _at_least(value: float, minimum: float) -> dict[str, Any]:
    return {"value": value, "minimum": minimum, "holds": value >= minimum}


def _at_most(value: float, maximum: float) -> dict[str, Any]:
    return {"value": value, "maximum": maximum, "holds": value <= maximum}
