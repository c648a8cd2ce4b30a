"""Modes of vibration as JSON, or as a table (.csv) with one row per mode."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import write_text
from mosca.machines.vibration.analysis import Vibration
from mosca.machines.vibration.modal import Mode

SUFFIXES = (".json", ".csv")


def write_modes(found: Vibration, path: Path) -> None:
    """Write modes, shapes and noise floor: a table where ``path`` is a .csv (modes alone), else JSON."""
    if path.suffix.lower() == ".csv":
        write_text(path, _table(found))
    else:
        write_text(path, json.dumps(_document(found), indent=1, allow_nan=False) + "\n")


def _document(found: Vibration) -> dict[str, Any]:
    """Return modes, floor and findings as plain data for JSON; unknown values are None."""
    record = found.displacements
    return {
        "frame_rate_hz": record.rate_hz,
        "length_s": record.length_s,
        "targets": {name: [float(v) for v in place] for name, place in zip(record.names, record.place, strict=True)},
        "directions": record.direction.tolist(),
        "left_out": list(record.left_out),
        "modes": [_mode(mode) for mode in found.modes],
        "noise_floor_m2_per_hz": found.floor.measured_m2_per_hz,
        "noise_floor_expected_m2_per_hz": _known(found.floor.expected_m2_per_hz),
        "findings": list(found.findings),
    }


def _table(found: Vibration) -> str:
    """Return the modes as a table with one row per mode; the last columns are its shape by target and direction."""
    record = found.displacements
    axes = [""] if len(record.direction) == 1 else ["_x", "_y", "_z"]
    shape = [f"shape_{name}{axis}" for name in record.names for axis in axes]
    keys = [key for key in _mode(found.modes[0]) if key != "shape"] if found.modes else ["frequency_hz"]
    rows: list[Sequence[object]] = [[*keys, *shape]]
    for mode in found.modes:
        plain = _mode(mode)
        rows.append([*("" if plain[key] is None else plain[key] for key in keys), *plain["shape"]])
    return "".join(",".join(str(value).replace(",", ";") for value in row) + "\n" for row in rows)


def _mode(mode: Mode) -> dict[str, Any]:
    return {
        "kind": "line" if mode.is_line else "mode",
        "frequency_hz": mode.frequency_hz,
        "frequency_sigma_hz": _known(mode.frequency_sigma_hz),
        "damping": mode.damping,
        "damping_sigma": _known(mode.damping_sigma),
        "rms_m": mode.rms_m,
        "mpc": mode.mpc,
        "kurtosis": mode.kurtosis,
        "shape": [float(v) for v in mode.shape],
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
