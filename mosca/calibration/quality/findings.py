"""Codes of all findings about calibrations."""

from mosca.data.calibration import Finding, Severity

CODES: dict[str, str] = {
    "mirrored-pose": "a plane was seen so flatly that its mirrored pose fits as well",
    "little-depth": "the target's points hardly differ in distance: principal distance and distance look alike",
    "few-views": "too few images or points to determine the camera and to notice mistakes",
    "wrong-size": "the target is not as large as its file says",
    "swapped-cameras": "two cameras stand for each other",
    "mixed-units": "lengths in other units than metres",
    "interior-ran-away": "the interior orientation is not that of a real camera",
    "rig-moved": "a camera no longer stands where it was calibrated",
    "no-link": "cameras that no common view joins",
    "weak-link": "cameras joined by few common views",
    "little-coverage": "the target was seen in a part of the image only",
    "scale-error": "lengths that were not used come out wrong",
    "weak-parameter": "a parameter that the data hardly determine was held",
    "blunders": "many image points do not fit",
    "hidden-balls": "balls whose image is cut by what is before them are left out",
    "target-shape": "the target's marks are elsewhere on it than its file says",
    "unit-weight": "residuals are not as large as the image points' own errors",
    "left-out": "cameras that saw too little are not in the rig, as was asked for",
    "lens-choice": "which lens model predicts views best that took no part in its estimation",
    "lens-model": "residuals have a pattern that the lens model cannot follow",
}


def refuse(code: str, message: str, camera: str | None = None) -> Finding:
    """Return a finding for which the rig must not be used."""
    return _finding(code, "refuse", message, camera)


def warn(code: str, message: str, camera: str | None = None) -> Finding:
    """Return a finding for which the rig may be wrong."""
    return _finding(code, "warn", message, camera)


def note(code: str, message: str, camera: str | None = None) -> Finding:
    """Return a finding of severity "note"."""
    return _finding(code, "note", message, camera)


def _finding(code: str, severity: Severity, message: str, camera: str | None) -> Finding:
    if code not in CODES:
        raise ValueError(f"code '{code}' is unknown; there are {', '.join(CODES)}")
    return Finding(code, severity, message, camera)
