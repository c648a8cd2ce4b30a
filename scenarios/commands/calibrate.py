"""Calibration from real images: a rig file and its page from a recording and a target file."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mosca.calibration.session import EstimateSettings, Shown, calibrate_session
from mosca.calibration.single_camera.adjust import AdjustmentSettings
from mosca.calibration.single_camera.from_points import calibrate_from_points, summary
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.calibration.targets.read_session import check_shown
from mosca.calibration.targets.reader import reader_of
from mosca.data.calibration import Calibration
from mosca.data.files.rig_file import read_rig, write_rig
from mosca.data.files.target_file import PointsTarget, read_target_file, read_wand_points_table
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.files.whole_file import check_writable
from mosca.data.sightings import Sightings
from mosca.data.targets import ScaleBar
from mosca.data.wands import LFrame, SingleLight, Wand
from mosca.detection.detect import DetectionSettings
from mosca.errors import CalibrationError, InputError
from mosca.formats.rigs.calibration_record import RECORD_SUFFIX, write_calibration_record
from mosca.formats.selfcal_points import read_selfcal_points
from mosca.formats.wand_points import read_wand_points
from mosca.recording import open_recording
from reports.calibration_page import write_calibration_page
from scenarios.commands.reconstruct import reconstruct_settings, reconstruct_spec

LOG = logging.getLogger(__name__)
T = TypeVar("T", LFrame, ScaleBar)


@dataclass(frozen=True)
class CalibrateOptions:
    """The options of ``mosca calibrate``, under their names; its help describes them."""

    recording: Path
    target: Path
    out: Path
    lens: str | None = None
    free: str | None = None
    pixel_pitch_mm: float = 0.01
    known: Path | None = None
    exterior_only: bool = False
    axes: tuple[Path, Path] | None = None
    lengths: tuple[Path, Path] | None = None
    fps: float | None = None
    every: int = 1
    reference: int | None = None
    leave_out_unseen: bool = False
    overrides: tuple[str, ...] = ()

    def settings(self) -> EstimateSettings:
        """Return the settings of the estimate: free parameters, and frame sets used."""
        free = None if self.free is None else tuple(name.strip() for name in self.free.split(","))
        lens = LensChoice(self.lens or "mosca", self.pixel_pitch_mm)
        return EstimateSettings(
            lens,
            self.lens is None and free is None and not self.exterior_only,
            free,
            self.exterior_only,
            self.every,
            self.reference,
            self.detection(),
            leave_out_unseen=self.leave_out_unseen,
        )

    def detection(self) -> DetectionSettings:
        """Return the detection settings of balls; InputError for keys of other stages, and without a detection."""
        for text in self.overrides:
            if not text.startswith("detection."):
                raise InputError(f"--set {text}: a calibration has the settings of detection.KEY=VALUE alone")
        return reconstruct_settings(reconstruct_spec(None, self.overrides)).detection


def calibrate(request: CalibrateOptions, progress: Callable[[int, int | None], None]) -> list[str]:
    """Calibrate, write the rig and its page, and return the lines to print.

    For a calibration that must not be used, only page and record are written, and CalibrationError is raised.
    """
    settings = request.settings()
    out = request.out
    if out.suffix != ".toml":
        raise InputError(f"{out}: a rig file ends in .toml")
    page, record = out.with_suffix(".html"), out.with_suffix(RECORD_SUFFIX)
    for path in (out, page, record):
        check_writable(path)
    target = read_target_file(request.target)
    if isinstance(target, PointsTarget):
        return _from_points(request, target, settings)
    if request.overrides and request.axes is None and not isinstance(target, Wand):
        raise InputError(f"--set {request.overrides[0]}: balls alone are detected; {request.target} describes none")
    known = None if request.known is None else read_rig(request.known)
    if settings.exterior_only and known is None:
        raise InputError("--exterior-only keeps the lenses of an earlier rig; give it with --known RIG.toml")
    LOG.info("%s: target %s, reading and adjusting", request.recording, request.target)
    sightings = _table(request, target)
    if sightings is None:
        with open_recording(request.recording, known, request.fps, times_matter=False) as source:
            check_shown(
                source, lambda: reader_of(target, settings.detection), source.n_frames, settings.every,
                lambda n: progress(n, None),
            )  # fmt: skip
    calibration, evidence = calibrate_session(
        Shown(target, lambda rig: open_recording(request.recording, rig, request.fps, times_matter=False)),
        settings,
        axes=_shown(request.axes, LFrame, "--axes", request.fps),
        lengths=_shown(request.lengths, ScaleBar, "--lengths", request.fps),
        known=known,
        sightings=sightings,
        made_from=f"{request.recording} with {request.target.name}",
        progress=lambda n: progress(n, None),
    )
    LOG.info("%d image points adjusted, %d findings", len(calibration.sightings), len(calibration.findings))
    write_calibration_page(page, calibration, evidence)
    write_calibration_record(calibration, record)
    if calibration.refused:
        first = calibration.refused[0]
        kept = "; the earlier file is unchanged" if out.exists() else ""
        raise CalibrationError(f"{out} not written{kept}: {first.code}: {first.message} (see {page})")
    write_rig(calibration.rig, out)
    return [*summary_lines(calibration), f"{out} written; {page}, {record}"]


def summary_lines(calibration: Calibration) -> list[str]:
    """Return a summary of a calibration in a few lines: precision of each camera, and warnings."""
    size = f"{len(calibration.sightings)} image points, {int((~calibration.used).sum())} left out"
    lines = [f"{calibration.target}: {size}; sigma0 {calibration.sigma0:.2f}, scale from {calibration.scaled_by}"]
    if calibration.body_px:
        lines.append(f"whole images shake by {calibration.body_px:.3f} px rms")
    for k, camera in enumerate(calibration.rig.cameras):
        (px_x, px_y), (m_x, m_y) = calibration.sigma_px[k], calibration.sigma_m[k]
        lines.append(
            f"{camera.name}: sigma_x {px_x:.3f} px, sigma_y {px_y:.3f} px; sigma_x {1e3 * m_x:.4f} mm, "
            f"sigma_y {1e3 * m_y:.4f} mm on the target"
        )
    mark = {"refuse": "REFUSED", "warn": "WARNING", "note": "note"}
    return lines + [f"{mark[one.severity]} {one.code}: {one.message}" for one in calibration.findings]


def _table(request: CalibrateOptions, target: CalibrationTarget) -> Sightings | None:
    """Return the image points of a wand or a light from a table; None where the recording holds images."""
    if not isinstance(target, SingleLight) and request.recording.suffix.lower() != ".csv":
        return None
    if request.every != 1:
        raise InputError(f"--every: not with a table of image points; leave out rows of {request.recording}")
    if isinstance(target, SingleLight):
        return read_selfcal_points(request.recording, target)
    if not isinstance(target, Wand):
        raise InputError(
            f'{request.recording}: a table of image points calibrates with kind = "wand"; {request.target} describes '
            f"a {type(target).__name__}"
        )
    return read_wand_points(request.recording, read_wand_points_table(request.target), len(target.along_m))


def _from_points(request: CalibrateOptions, target: PointsTarget, settings: EstimateSettings) -> list[str]:
    for option, given in (
        ("--known", request.known),
        ("--axes", request.axes),
        ("--lengths", request.lengths),
        ("--exterior-only", settings.exterior_only or None),
        ("--reference", settings.reference),
        ("--set", request.overrides or None),
        ("--leave-out-unseen", request.leave_out_unseen or None),
    ):
        if given is not None:
            raise InputError(f'{option}: not with kind = "points", whose points are in the world already')
    how = AdjustmentSettings(parameters=settings.free)
    rig, adjustments = calibrate_from_points(request.recording, target, how, request.lens)
    write_rig(rig, request.out)
    return [*summary(adjustments).splitlines(), f"{request.out} written"]


def _shown(paths: tuple[Path, Path] | None, kind: type[T], option: str, fps: float | None) -> Shown[T] | None:
    """Return the target file's ``kind`` of target with the recording that shows it; None where not given."""
    if paths is None:
        return None
    recording, file = paths
    target = read_target_file(file)
    if not isinstance(target, kind):
        raise InputError(f"{option} {file}: describes a {type(target).__name__}; a {kind.__name__} is wanted")
    return Shown(target, lambda rig: open_recording(recording, rig, fps, times_matter=False))
