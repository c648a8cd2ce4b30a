"""``mosca clinic``: a recording or a run folder, with what lies in it, and the likeliest cause of its fault."""

import json
from pathlib import Path

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
from mosca.data.files.rig_file import read_rig
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.recording import open_recording
from scenarios.run.take_files import POSES_FILE, RIG_FILE, TRACKS_FILES


def clinic_of(
    path: Path, rig_path: Path | None, fps: float | None, tracks_path: Path | None, known: KnownLengths
) -> ClinicReport:
    """Return what is wrong with the take in ``path``: its frames with the rig, its tracks, its bodies' poses.

    InputError where there is nothing to look at, or frames without a rig.
    """
    if not path.exists():
        raise InputError(f"{path}: no such folder or file; a recording, a run's folder or a file of tracks is wanted")
    rig_file = rig_path or (path / RIG_FILE if (path / RIG_FILE).is_file() else None)
    tracks_file = tracks_path or next((path / n for n in TRACKS_FILES if (path / n).is_file()), None)
    poses_file = path / POSES_FILE if (path / POSES_FILE).is_file() else None
    report = ClinicReport((), ())
    if path.is_file() and path.suffix != ".mcap":
        return diagnose_tracks(read_tracks(path), None)
    if tracks_file is not None or poses_file is not None:
        tracks = None if tracks_file is None else read_tracks(tracks_file)
        report = diagnose_tracks(tracks, None if poses_file is None else read_bodies_csv(poses_file))
    is_run = (path / "record.json").is_file()
    if is_run and tracks_file is not None:
        return report
    if rig_file is None:
        if tracks_file is not None:
            return report
        raise InputError(f"{path}: no {RIG_FILE} in it; give the rig that the take was measured with: --rig RIG.toml")
    rig = read_rig(rig_file)
    with open_recording(path, None, fps) as source:
        if wrong := diagnose_sizes(rig, source.cameras):
            return joined(report, ClinicReport(tuple(wrong), (f"sizes of the images and of {rig_file}",)))
    with open_recording(path, rig, fps) as source:
        return joined(report, diagnose_frames(source, rig, known))


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
