"""Modes of vibration from a file of tracks: table, noise floor, findings, and files with these."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mosca.data.files.whole_file import check_writable, write_text
from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.machines.vibration.analysis import Vibration, VibrationSettings, analyse
from mosca.machines.vibration.displacements import displacements
from mosca.machines.vibration.modes_file import SUFFIXES, write_modes
from mosca.machines.vibration.subspace import SubspaceSettings
from reports.plot_style import svg_file
from reports.vibration_plots import spectra_picture
from scenarios.commands.labels import between, rate_of
from scenarios.run.vibration import vibration_evidence


@dataclass(frozen=True)
class VibrationOptions:
    """Options of ``vibration_take``; see ``mosca.machines.vibration`` for their meaning."""

    axes: Literal["normal", "xyz"] = "normal"
    direction: tuple[float, float, float] | None = None
    rigid: str | None = None
    """"all", or names of targets on the carrier, separated by commas."""
    fps: float | None = None
    frames: str | None = None
    lowest_hz: float = 1.0
    exposure_s: float = 0.0
    segment_s: float = 8.0
    highest_order: int = 60


def vibration_take(path: Path, out: Path | None, plot: Path | None, options: VibrationOptions) -> list[str]:
    """Find the modes in the tracks of ``path``, write ``out`` and ``plot``; return the lines to print.

    InputError where the file, an option or the record is not suitable.
    """
    _check_files(out, plot)
    if options.direction is not None and options.axes == "xyz":
        raise InputError("--direction and --axes xyz given; leave one of them out")
    tracks = read_tracks(path)
    if options.frames is not None:
        tracks = between(tracks, options.frames)
    if not len(tracks):
        raise InputError(f"{path}: no samples" + (f" in frames {options.frames}" if options.frames else ""))
    rate_hz = rate_of(tracks, options.fps, path)
    rigid: tuple[str, ...] | Literal["all"] | None = None
    if options.rigid is not None:
        rigid = "all" if options.rigid == "all" else tuple(filter(None, options.rigid.split(",")))
    settings = VibrationSettings(
        options.lowest_hz,
        options.exposure_s,
        options.segment_s,
        SubspaceSettings(orders=tuple(range(4, options.highest_order + 1, 2))),
    )
    try:
        direction = None if options.direction is None else np.array(options.direction)
        record = displacements(tracks, rate_hz, axes=options.axes, direction=direction, rigid_by=rigid)
        found = analyse(record, settings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if out is not None:
        write_modes(found, out)
    if plot is not None:
        write_text(plot, svg_file(spectra_picture(vibration_evidence(found))))
    files = [f"modes in {out}" if out else "", f"spectra in {plot}" if plot else ""]
    return [*words(found), *filter(None, files)]


def words(found: Vibration) -> list[str]:
    """Return lines with the table of modes, the noise floor and the findings."""
    record, floor = found.displacements, found.floor
    lines = [
        f"{len(record.names)} targets, {record.length_s:.4g} s at {record.rate_hz:.6g} Hz, modes up to "
        f"{0.4 * record.rate_hz:.4g} Hz are claimed",
        f"{'frequency [Hz]':>22} {'damping [%]':>18} {'rms [um]':>9} {'MPC':>6}",
    ]
    for mode in found.modes:
        lines.append(
            f"{mode.frequency_hz:10.4f} +- {mode.frequency_sigma_hz:8.4f} {100 * mode.damping:9.4f} +- "
            f"{100 * mode.damping_sigma:6.4f} {1e6 * mode.rms_m:9.2f} {mode.mpc:6.3f}"
            + ("  steady line: no mode" if mode.is_line else "")
        )
    if not found.modes:
        lines.append("no mode stands out of the noise: record longer, or with more excitation")
    measured = 1e6 * floor.sigma_m(record.rate_hz)
    line = f"noise floor {1e6 * math.sqrt(floor.measured_m2_per_hz):.3g} um/sqrt(Hz) ({measured:.3g} um a sample)"
    if math.isfinite(floor.ratio):
        line += f", {floor.ratio:.3g} times the power that the tracks' covariances state"
    return [*lines, line, *(f"note: {text}" for text in found.findings)]


def _check_files(out: Path | None, plot: Path | None) -> None:
    for path, suffixes in ((out, SUFFIXES), (plot, (".svg",))):
        if path is None:
            continue
        if path.suffix.lower() not in suffixes:
            raise InputError(f"{path}: suffix '{path.suffix}' given; {' or '.join(suffixes)} is wanted here")
        check_writable(path)
