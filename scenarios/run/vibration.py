"""The vibration of a scenario's panel, from its tracks, and its data for the page and the run folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from mosca.errors import InputError
from mosca.machines.vibration.analysis import Vibration, VibrationSettings, analyse
from mosca.machines.vibration.displacements import displacements
from mosca.machines.vibration.modes_file import write_modes
from reports.vibration_evidence import VibrationEvidence
from scenarios.spec.faults import RateFault
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected

_LARGEST = 3


def vibration_of(spec: Scenario, collected: Collected) -> Vibration | None:
    """Return the modes in the tracks; None where too little was measured.

    The missing data are then named in the notes, and no limit of a mode is met.
    """
    assert spec.vibration is not None
    rate_hz = spec.capture.frame_rate_hz
    if isinstance(spec.fault, RateFault):
        rate_hz *= spec.fault.factor
    rigid_by: Literal["all"] | None = "all" if spec.vibration.rigid == "all" else None
    settings = VibrationSettings(exposure_s=spec.capture.exposure_s, segment_s=spec.vibration.segment_s)
    try:
        up = np.array([0.0, 0.0, 1.0])
        found = analyse(displacements(collected.tracks, rate_hz, direction=up, rigid_by=rigid_by), settings)
    except InputError as error:
        collected.assembly.notes["vibration"] = str(error)
        return None
    for k, line in enumerate(found.findings):
        collected.assembly.notes[f"vibration {k + 1}"] = line
    return found


def vibration_evidence(found: Vibration) -> VibrationEvidence:
    """Return the data of the pictures; a shape along several directions is shown along the first."""
    record, averaged = found.displacements, found.spectra
    every = len(record.direction)
    shapes = np.array([mode.shape[::every] for mode in found.modes]).reshape(len(found.modes), len(record.names))
    return VibrationEvidence(
        averaged.frequency_hz,
        averaged.densities.mean(axis=1),
        averaged.singular_values[:, :_LARGEST],
        averaged.interval95,
        found.floor.measured_m2_per_hz,
        found.floor.expected_m2_per_hz,
        np.array([mode.frequency_hz for mode in found.modes]),
        tuple(mode.is_line for mode in found.modes),
        record.place,
        shapes,
        record.rate_hz,
    )


def vibration_files(found: Vibration) -> dict[str, Callable[[Path], object]]:
    """Return name of each file of a run folder -> function that writes it there."""
    return {"modes.json": lambda path: write_modes(found, path)}
