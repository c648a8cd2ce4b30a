"""A run's result in its Rerun log: points coloured by their error, and the errors as plots on the timeline."""

import numpy as np

from mosca.data.arrays import Array
from reports.evidence import Evidence
from reports.viewer import RerunLog
from reports.viewer_colours import coloured, scale_top


def log_result(log: RerunLog | None, evidence: Evidence, limit_mm: float | None = None) -> None:
    """Log the points of each pulse, and plots of errors [mm]; ``limit_mm``: limit of the rms position error.

    Colours show the 3D error against the truth; without a truth, the stated standard deviation. Without a log,
    nothing is done.
    """
    if log is None:
        return
    tracks = evidence.tracks
    error_mm, marker = _errors(evidence)
    by_error = evidence.errors is not None
    shown = error_mm if by_error else 1e3 * np.sqrt(np.trace(tracks.covariance, axis1=1, axis2=2))
    top = scale_top(shown)
    log.log_scale("3D error" if by_error else "stated standard deviation, 3D", top, by_error)
    order = np.argsort(tracks.frame, kind="stable")
    frames, first = np.unique(tracks.frame[order], return_index=True)
    _log_gone(log, evidence, frames)
    for frame, rows in zip(frames.tolist(), np.split(order, first[1:]), strict=True):
        time_ns = int(tracks.time_ns[rows[0]])
        names = [_label(evidence, int(row), marker) for row in rows]
        log.log_points(frame, time_ns, tracks.xyz[rows], tracks.track[rows], coloured(shown[rows], top), names)
        values = shown[rows][np.isfinite(shown[rows])]
        if not len(values):
            continue
        kind = "error" if by_error else "sigma"
        rms = float(np.sqrt(np.mean(values**2)))
        log.log_plots({f"{kind}/rms": rms, f"{kind}/largest": float(values.max()), "points/measured": len(rows)})
        if by_error:
            known = rows[marker[rows] >= 0]
            log.log_plots({f"markers/{evidence.truth_names[marker[row]]}": float(error_mm[row]) for row in known})
    if limit_mm is not None and by_error and len(frames):
        for row in (order[0], order[-1]):
            log.set_time(int(tracks.frame[row]), int(tracks.time_ns[row]))
            log.log_plots({"error/limit": limit_mm})


def _log_gone(log: RerunLog, evidence: Evidence, frames: Array) -> None:
    """Clear the points at pulses in which nothing was measured: without that, the last points would stay."""
    if evidence.truth_time_ns is None:
        return
    for frame in np.setdiff1d(np.arange(len(evidence.truth_time_ns)), frames).tolist():
        time_ns = int(evidence.truth_time_ns[frame])
        log.log_points(frame, time_ns, np.empty((0, 3)), np.empty(0, int), np.empty((0, 3), np.uint8), [])


def _errors(evidence: Evidence) -> tuple[Array, Array]:
    """Return the error (n,) [mm] and the marker (n,) of each sample; NaN and -1 for a point without a marker."""
    n, errors = len(evidence.tracks), evidence.errors
    error_mm, marker = np.full(n, np.nan), np.full(n, -1)
    if errors is not None and errors.sample is not None:
        error_mm[errors.sample] = 1e3 * errors.distance_m()
        marker[errors.sample] = errors.marker
    return error_mm, marker


def _label(evidence: Evidence, row: int, marker: Array) -> str:
    """Return a point's name: its marker's, else its label, else its track's number."""
    if marker[row] >= 0:
        return str(evidence.truth_names[marker[row]])
    return str(evidence.tracks.label[row]) or f"track {int(evidence.tracks.track[row])}"
