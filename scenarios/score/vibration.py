"""Modes of vibration compared with the true ones. Pure: no files, no clocks.

Each true mode is compared with the found mode nearest in frequency; steady lines do not count as modes. Where a rigid
motion was removed, its part of a mode's shape is also removed from the true shape.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.vibration.analysis import Vibration
from mosca.machines.vibration.displacements import channels_of
from mosca.machines.vibration.modal import damping_bound, frequency_bound, mac
from scenarios.types import Score
from twin.scenes.plate import PlateModes

DAMPING_SHARE = 0.15
NEAR = 0.05
"""Largest relative difference in frequency between a found mode and its true mode."""


def vibration_scores(
    found: Vibration, modes: PlateModes, place: Array
) -> tuple[dict[str, Score], dict[str, dict[str, Any]]]:
    """Return the metrics of modes and, mode by mode, a table for the record.

    ``place`` (m, 3): true mean positions of the markers [m], in the order of the rows of ``modes``, whose deflections
    are along the world's z. ``mode_damping_error`` is the worst relative error of a damping over the allowed error:
    15 %, or twice the bound for the record's length.
    """
    record = found.displacements
    near = np.argmin(np.linalg.norm(record.place[:, None] - place[None], axis=-1), axis=1)
    space = modes.shapes[near, None, :] * np.array([0.0, 0.0, 1.0])[None, :, None]
    true = channels_of(space, record.direction)
    true = true - record.rigid @ (record.rigid.T @ true)
    own = [mode for mode in found.modes if not mode.is_line]
    rows: dict[str, dict[str, Any]] = {}
    for k, (hz, damping) in enumerate(zip(modes.frequency_hz, modes.damping, strict=True)):
        bounds = [bound(hz, damping, record.length_s) for bound in (frequency_bound, damping_bound)]
        row: dict[str, Any] = {"true_hz": float(hz), "true_damping": float(damping)}
        row |= {"frequency_bound": bounds[0], "damping_bound": bounds[1]}
        rows[f"mode {k + 1}"] = row
        nearest = min(own, key=lambda mode: abs(mode.frequency_hz / hz - 1), default=None)
        if nearest is None or abs(nearest.frequency_hz / hz - 1) > NEAR:
            continue
        row |= {
            "frequency_hz": nearest.frequency_hz,
            "frequency_sigma_hz": nearest.frequency_sigma_hz,
            "damping": nearest.damping,
            "damping_sigma": nearest.damping_sigma,
            "frequency_error": nearest.frequency_hz / hz - 1,
            "damping_error": nearest.damping / damping - 1,
            "mac": float(mac(nearest.shape[:, None], true[:, [k]])[0, 0]),
        }
    return _scores(found, rows), rows


def _scores(found: Vibration, rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Score]:
    there = [row for row in rows.values() if "mac" in row]
    scores = {"modes_found": Score(len(there) / len(rows), len(rows))}
    if not there:
        return scores
    n = len(there)
    damped = [abs(row["damping_error"]) / max(DAMPING_SHARE, 2 * row["damping_bound"]) for row in there]
    scores["mode_frequency_error"] = Score(max(abs(row["frequency_error"]) for row in there), n)
    scores["mode_damping_error"] = Score(max(damped), n)
    scores["mode_mac"] = Score(min(row["mac"] for row in there), n)
    if np.isfinite(found.floor.ratio):
        scores["noise_floor_ratio"] = Score(found.floor.ratio, found.displacements.values.shape[1])
    return scores
