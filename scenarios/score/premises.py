"""Premises of a scenario: conditions without which its score is meaningless."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mosca.data.truth import Truth
from mosca.errors import PremiseError
from scenarios.spec.scenario import Scenario

STATED = {
    "trigger_jitter_s": "errors.trigger_jitter_s",
    "shake_px": "errors.body_px",
    "motion_px": "[mount]",
    "gap_px": "model_gap",
}
"""Disturbance -> the key that states it."""


def premises_met(
    spec: Scenario, truth: Truth, name: str, disturbed: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """Return the premises of the score, and whether each holds; PremiseError where one does not.

    ``disturbed``: the stated disturbances in the truth (``disturbances``), where they are known.
    """
    diameter = truth.diameter_px[truth.visible >= 0.5]
    moved = np.linalg.norm(np.diff(truth.image_xy_px, axis=0), axis=-1)
    share = spec.capture.exposure_s * spec.capture.frame_rate_hz
    blur = moved[np.isfinite(moved)] * share
    wanted = spec.premises
    views = float((truth.visible >= 0.5).sum(axis=2).mean()) if truth.visible.size else 0.0
    found: dict[str, Any] = {
        "marker_px": between(float(np.median(diameter)) if diameter.size else 0.0, minimum=wanted.marker_px),
        "blur_px": between(float(np.quantile(blur, 0.95)) if blur.size else 0.0, maximum=wanted.blur_px),
        "views": between(views, minimum=wanted.views),
    }
    for key, premise in (disturbed or {}).items():
        found[key] = premise
        if not premise["holds"]:
            least, most = (premise.get(end, np.inf) for end in ("minimum", "maximum"))
            raise PremiseError(
                f"{name}: premise '{key}' does not hold: {premise['value']:.3g} in the truth, {least:.3g} to "
                f"{most:.3g} by what the scenario states ({STATED[key]}); the score would not be under that "
                "disturbance. Change the key if it is not meant; otherwise the twin has a fault: report it"
            )
    for key, premise in found.items():
        if not premise["holds"]:
            bound = "minimum" if "minimum" in premise else "maximum"
            raise PremiseError(
                f"{name}: premise '{key}' does not hold: {premise['value']:.3g}, {bound} {premise[bound]:g}; the "
                f"score would mean nothing. Change the cameras or the markers, or premises.{key}"
            )
    return found


def between(value: float, minimum: float = -np.inf, maximum: float = np.inf) -> dict[str, Any]:
    """Return a premise: its value, the finite ends of its range, and whether it lies in the range."""
    ends = {"minimum": float(minimum), "maximum": float(maximum)}
    finite = {name: end for name, end in ends.items() if np.isfinite(end)}
    return {"value": value, **finite, "holds": bool(minimum <= value <= maximum)}
