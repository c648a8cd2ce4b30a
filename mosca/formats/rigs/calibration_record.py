"""The record of a calibration, as JSON beside the rig file: precision of each camera, and findings."""

import math
from pathlib import Path

from pydantic import Field

from mosca.data.calibration import Calibration, Severity
from mosca.data.files.bounded import parse_json, read_bytes
from mosca.data.files.toml import NotNegative, Table, check
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError

RECORD_SUFFIX = ".calibration.json"
"""Suffix of the record, in place of the rig file's."""


class RecordedFinding(Table):
    """One finding, as ``mosca.data.calibration.Finding``."""

    code: str = Field(description="of mosca.calibration.quality.findings.CODES")
    severity: Severity = Field(description="refuse: the rig must not be used; warn: it may be wrong; note")
    message: str = Field(description="what was found, what is allowed, what to do next")
    camera: str | None = Field(None, description="whose, where it is one camera's")


class RecordedCamera(Table):
    """A-posteriori standard deviations of a camera's image coordinates x, y; null where unknown."""

    name: str = Field(description="as in the rig file")
    sigma_px: tuple[NotNegative | None, NotNegative | None] = Field(description="in the image [px]")
    sigma_m: tuple[NotNegative | None, NotNegative | None] = Field(description="projected to the target [m]")


class CalibrationRecord(Table):
    """The record of one calibration."""

    target: str = Field(description="what was seen")
    image_points: int = Field(ge=0, description="observed")
    left_out: int = Field(ge=0, description="of these: blunders, and points without a position")
    sigma0: NotNegative | None = Field(description="standard deviation of unit weight; null where unknown")
    scaled_by: str = Field(description="origin of the scale")
    shake_px: NotNegative | None = Field(description="shake of whole images, rms an axis [px]")
    weak: tuple[str, ...] = Field(description="parameters that the data hardly determine")
    cameras: tuple[RecordedCamera, ...] = Field(description="of the rig")
    findings: tuple[RecordedFinding, ...] = Field(description="the gravest first")


def record_of(calibration: Calibration) -> CalibrationRecord:
    """Return the record of a calibration."""
    pairs = zip(calibration.rig.names, calibration.sigma_px.tolist(), calibration.sigma_m.tolist(), strict=True)
    return CalibrationRecord(
        target=calibration.target,
        image_points=len(calibration.sightings),
        left_out=int((~calibration.used).sum()),
        sigma0=_known(calibration.sigma0),
        scaled_by=calibration.scaled_by,
        shake_px=_known(calibration.body_px),
        weak=calibration.weak,
        cameras=tuple(
            RecordedCamera(name=name, sigma_px=(_known(a), _known(b)), sigma_m=(_known(x), _known(y)))
            for name, (a, b), (x, y) in pairs
        ),
        findings=tuple(
            RecordedFinding(code=one.code, severity=one.severity, message=one.message, camera=one.camera)
            for one in calibration.findings
        ),
    )


def write_calibration_record(calibration: Calibration, path: Path) -> None:
    """Write the record of a calibration."""
    write_text(path, record_of(calibration).model_dump_json(indent=2) + "\n")


def read_calibration_record(path: Path) -> CalibrationRecord:
    """Return the record at ``path``; InputError where there is none."""
    try:
        document = parse_json(read_bytes(path))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; 'mosca calibrate' writes one beside its rig file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no record of a calibration: {getattr(error, 'strerror', None) or error}") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: no record of a calibration; 'mosca calibrate' writes one beside its rig file")
    return check(CalibrationRecord, document, path)


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
