"""``mosca clinic``: the likeliest cause of the fault in a recording or a run folder, from the files in it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mosca.clinic.causes import merged
from mosca.clinic.diagnose import (
    ALPHA,
    FALSE_ALARMS,
    ClinicReport,
    KnownLengths,
    diagnose_frames,
    diagnose_sizes,
    diagnose_tracks,
    joined,
)
from mosca.clinic.history import CAUSE_OF, calibration_causes, health_causes, poorly_connected, said
from mosca.data.calibration import Finding
from mosca.data.files.rig_file import read_rig
from mosca.diagnostics.camera_health import CameraHealth
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.rigs.calibration_record import RECORD_SUFFIX, read_calibration_record
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.recording import open_recording
from reports.record import read_record
from scenarios.run.take_files import POSES_FILE, RECORD_FILE, RIG_FILE, TRACKS_FILES


@dataclass(frozen=True)
class ClinicRequest:
    """Arguments of ``mosca clinic``; ``rig``, ``tracks`` and ``calibration`` None: the files in the take."""

    take: Path
    rig: Path | None = None
    fps: float | None = None
    tracks: Path | None = None
    calibration: Path | None = None
    known: KnownLengths = field(default_factory=KnownLengths)


def clinic_of(request: ClinicRequest) -> ClinicReport:
    """Return the report on a take, from its frames with the rig, its tracks, its bodies' poses and its records.

    InputError where there is nothing to examine, or frames without a rig.
    """
    path = request.take
    if not path.exists():
        raise InputError(f"{path}: no such folder or file; a recording, a run's folder or a file of tracks is wanted")
    rig_file = request.rig or (path / RIG_FILE if (path / RIG_FILE).is_file() else None)
    report = _take_report(request, rig_file)
    beside = None if rig_file is None else rig_file.with_suffix(RECORD_SUFFIX)
    record = request.calibration or (beside if beside is not None and beside.is_file() else None)
    return report if record is None else with_calibration(report, record)


def _take_report(request: ClinicRequest, rig_file: Path | None) -> ClinicReport:
    path = request.take
    tracks_file = request.tracks or next((path / n for n in TRACKS_FILES if (path / n).is_file()), None)
    poses_file = path / POSES_FILE if (path / POSES_FILE).is_file() else None
    report = ClinicReport((), ())
    if path.is_file() and path.suffix != ".mcap":
        return diagnose_tracks(read_tracks(path), None)
    if tracks_file is not None or poses_file is not None:
        tracks = None if tracks_file is None else read_tracks(tracks_file)
        report = diagnose_tracks(tracks, None if poses_file is None else read_bodies_csv(poses_file))
        if (path / RECORD_FILE).is_file():
            period_s = None if tracks is None else tracks.frame_period_s
            return joined(report, health_report(path / RECORD_FILE, period_s))
    if rig_file is None:
        if tracks_file is not None:
            return report
        raise InputError(f"{path}: no {RIG_FILE} in it; give the rig that the take was measured with: --rig RIG.toml")
    rig = read_rig(rig_file)
    with open_recording(path, None, request.fps) as source:
        if wrong := diagnose_sizes(rig, source.cameras):
            return joined(report, ClinicReport(tuple(wrong), (f"sizes of the images and of {rig_file}",)))
    with open_recording(path, rig, request.fps) as source:
        return joined(report, diagnose_frames(source, rig, request.known))


def health_report(path: Path, period_s: float | None) -> ClinicReport:
    """Return the report on a run's cameras from its record; ``period_s``: time between frames, None: unknown."""
    cameras = [_health(name, values) for name, values in read_record(path).cameras.items()]
    if not cameras:
        return ClinicReport((), ())
    found = health_causes(cameras, period_s or float("inf"), ALPHA)
    return ClinicReport(
        tuple(found), (f"{path}: health of {len(cameras)} cameras",), tuple(poorly_connected(cameras))
    )


def _health(name: str, values: Mapping[str, Any]) -> CameraHealth:
    known = {
        key: values.get(key) for key in ("residual_px", "extra_px", "connected", "missing", "late_s", "late_sigma_s")
    }
    numbers = {key: float(v) if isinstance(v, int | float) else float("nan") for key, v in known.items()}
    return CameraHealth(name=name, residuals_px=(), **numbers)


def with_calibration(report: ClinicReport, path: Path) -> ClinicReport:
    """Return a report with the warnings in the calibration's record at ``path``.

    A warning is added to the evidence of its cause. A cause that the take does not show ranks last.
    """
    record = read_calibration_record(path)
    findings = [Finding(one.code, one.severity, one.message, one.camera) for one in record.findings]
    sigma0 = "unknown" if record.sigma0 is None else f"{record.sigma0:.2f}"
    told = [f"{path}: {record.target}, {record.image_points} image points, sigma0 {sigma0}"]
    told += [said(one) for one in findings if one.severity != "note" and one.code not in CAUSE_OF]
    causes = merged([*report.causes, *calibration_causes(findings)])
    return ClinicReport(tuple(causes), (*report.looked_at, *told), report.not_judged)


def clinic_lines(report: ClinicReport) -> list[str]:
    """Return a report in words."""
    lines = [f"looked at: {line}" for line in report.looked_at]
    lines += [f"not judged: {line}" for line in report.not_judged]
    if not report.causes and report.not_judged:
        return [*lines, "no cause is named; what could not be judged may hide one"]
    if not report.causes:
        return [*lines, f"nothing is wrong that can be seen (a false alarm in {1 / FALSE_ALARMS:.0f} takes at most)"]
    first = report.causes[0]
    lines += [f"likeliest cause: {first.code}: {first.cause.title}", *(f"  {line}" for line in first.evidence)]
    lines.append(f"  next: {first.cause.next_step}")
    for one in report.causes[1:]:
        lines += [f"also possible: {one.code}: {one.cause.title}", *(f"  {line}" for line in one.evidence)]
    return lines


def clinic_json(report: ClinicReport) -> str:
    """Return a report as JSON."""
    return json.dumps(
        {
            "alpha": ALPHA,
            "looked_at": report.looked_at,
            "not_judged": report.not_judged,
            "causes": [
                {
                    "code": one.code, "title": one.cause.title, "camera": one.camera, "p_value": one.p_value,
                    "explained": one.explained, "evidence": one.evidence, "figures": one.figures,
                    "next_step": one.cause.next_step,
                }
                for one in report.causes
            ],
        },
        indent=2,
    )  # fmt: skip
