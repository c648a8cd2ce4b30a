"""Error and completeness of each marker and of each camera, as rows of sortable tables."""

from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from reports.evidence import Evidence
from reports.plot_style import per_marker
from reports.units import figure


class Cell(NamedTuple):
    """A cell of a sortable table."""

    text: str
    key: float | str
    """Key by which rows are sorted; missing values sort last."""


def number_cell(value: float | None, unit: str = "") -> Cell:
    """Return the cell of a number; a dash where it is unknown."""
    if value is None or not np.isfinite(value):
        return Cell("–", "")
    return Cell(f"{figure(float(value))} {unit}".rstrip(), float(f"{value:.9g}"))


def marker_table(evidence: Evidence) -> list[dict[str, Any]]:
    """Return a row per true marker: errors rms, 95 % and largest, share found, samples, frames, gaps, longest gap."""
    errors = evidence.errors
    if errors is None or evidence.truth_xyz is None or evidence.truth_time_ns is None:
        return []
    distance_mm = 1e3 * errors.distance_m()
    seconds = 1e-9 * np.asarray(evidence.truth_time_ns, float)
    table: list[dict[str, Any]] = []
    could_be = evidence.could_be_measured().T
    rows_of = per_marker(evidence.truth_names, errors.marker)
    for name, rows, could in zip(evidence.truth_names, rows_of, could_be, strict=True):
        one = distance_mm[rows]
        found = len(rows) if evidence.could_see is None else int(could[errors.frame[rows]].sum())
        gaps, longest_s = _gaps(np.sort(errors.frame[rows]), seconds)
        known = len(one) > 0
        table.append(
            {
                "index": len(table),
                "name": name,
                "cells": (
                    number_cell(float(np.sqrt(np.mean(one**2))) if known else None, "mm"),
                    number_cell(float(np.percentile(one, 95)) if known else None, "mm"),
                    number_cell(float(one.max()) if known else None, "mm"),
                    number_cell(100 * found / int(could.sum()) if could.any() else None, "%"),
                    number_cell(len(one)),
                    number_cell(int(could.sum())),
                    number_cell(gaps),
                    number_cell(longest_s, "s"),
                ),
            }
        )
    return table


def _gaps(frames: Array, seconds: Array) -> tuple[int, float]:
    """Return the number of gaps between the frames (k,) that have a sample, and the longest gap [s]."""
    steps = np.diff(frames)
    if not (steps > 1).any():
        return 0, 0.0
    lengths = seconds[frames[1:]] - seconds[frames[:-1]] - (seconds[-1] - seconds[0]) / max(len(seconds) - 1, 1)
    return int((steps > 1).sum()), float(lengths[steps > 1].max())


def camera_table(
    evidence: Evidence, marker: Array, frame: Array, used: Array | None
) -> dict[str, tuple[Cell, Cell, Cell, Cell]]:
    """Return for each camera: rms error of the points that it measured, their number, its views, share measured.

    ``marker``, ``frame`` (k,): those of samples with an error; ``used`` (k, c): which cameras measured each sample.
    """
    if used is None or evidence.errors is None:
        return {}
    table = {}
    lookup = np.full((int(evidence.errors.frame.max(initial=0)) + 1, len(evidence.truth_names)), np.nan)
    lookup[evidence.errors.frame, evidence.errors.marker] = 1e3 * evidence.errors.distance_m()
    distance_mm = lookup[frame, marker]
    frames = np.unique(frame)
    for c, camera in enumerate(evidence.rig.cameras):
        own = used[:, c]
        views = None
        if evidence.could_see is not None:
            views = int(evidence.could_see[frames, :, c].sum())
            seen = own & evidence.could_see[frame, marker, c]
        table[camera.name] = (
            number_cell(float(np.sqrt(np.mean(distance_mm[own] ** 2))) if own.any() else None, "mm"),
            number_cell(int(own.sum())),
            number_cell(views),
            number_cell(100 * float(seen.sum()) / views if views else None, "%"),
        )
    return table
