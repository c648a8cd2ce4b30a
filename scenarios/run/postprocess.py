"""Postprocessing of measured tracks: smoothing during the run, labelling, gap filling."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mosca.data.tracks import Samples, Tracks, table
from mosca.errors import InputError
from mosca.formats.bodies.model_file import read_model
from mosca.labelling.assign import label_tracks
from mosca.smoothing.fixed_lag import FixedLag, LagSettings
from mosca.smoothing.gap_filling import filled
from mosca.smoothing.rts import SmoothSettings


@dataclass(frozen=True)
class Postprocessing:
    """Steps of postprocessing; None: the step is left out."""

    lag: int | None = None
    """Lag of smoothing [frames]."""
    labels: Path | None = None
    """File of a marker model that names the tracks."""
    fill_s: float | None = None
    """Longest gap that is filled [s]."""


NONE = Postprocessing()


class Postprocessor:
    """Takes samples from the tracker and returns processed tracks; InputError at once for wrong settings."""

    def __init__(self, settings: Postprocessing) -> None:
        if settings.fill_s is not None and not 0 < settings.fill_s < float("inf"):
            raise InputError(f"--fill {settings.fill_s:g}: the longest gap to fill is wanted, in seconds above 0")
        self._settings = settings
        self._model = None if settings.labels is None else read_model(settings.labels)
        self._smoother = None if settings.lag is None else FixedLag(LagSettings(lag=settings.lag))
        self._measured: list[Samples] = []
        self._smoothed: list[Samples] = []

    def take(self, frame: int, samples: Samples) -> None:
        """Take the samples that the tracker returned at ``frame``."""
        self._measured.append(samples)
        if self._smoother is not None:
            self._smoothed.append(self._smoother.step(frame, samples))

    def finished(self) -> tuple[Tracks, list[str]]:
        """Return the tracks, and lines about them to print."""
        lines = []
        tracks = measured = table(self._measured)
        if self._smoother is not None:
            tracks = table([*self._smoothed, self._smoother.rest()])
            lines.append(f"positions are smoothed with a lag of {self._settings.lag} frames")
        if self._model is not None:
            # names are found from the measured distances
            labelled = label_tracks(measured, self._model)
            found = dict(zip(labelled.track.tolist(), labelled.label.tolist(), strict=True))
            label = np.array([found.get(track, "") for track in tracks.track.tolist()], dtype=np.str_)
            tracks, measured = replace(tracks, label=label), labelled
            names = {name for name in found.values() if name}
            lines.append(f"{len(names)} of {len(self._model.names)} markers of {self._settings.labels} found")
        if self._settings.fill_s is not None:
            # gaps are filled from the measured positions, since the errors of smoothed ones are correlated
            fills = gaps_filled(measured, self._settings.fill_s)
            tracks = _joined(tracks, fills)
            lines.append(filled_line(fills, self._settings.fill_s))
        return tracks, lines


def gaps_filled(tracks: Tracks, fill_s: float) -> Tracks:
    """Return only the samples of status ``filled`` that close gaps of ``tracks`` up to ``fill_s`` [s]."""
    together = filled(tracks, SmoothSettings(longest_gap_s=fill_s))
    return together.select(together.status == "filled")


def with_gaps_filled(tracks: Tracks, fill_s: float) -> tuple[Tracks, str]:
    """Return ``tracks`` with their gaps up to ``fill_s`` [s] filled, and a line with the number of samples."""
    fills = gaps_filled(tracks, fill_s)
    return _joined(tracks, fills), filled_line(fills, fill_s)


def filled_line(fills: Tracks, fill_s: float) -> str:
    """Return a line about filled samples."""
    line = f"{len(fills)} samples filled in gaps up to {fill_s:g} s, marked 'filled'"
    if not len(fills):
        return line
    worst = float(np.sqrt(np.trace(fills.covariance, axis1=1, axis2=2).max()))
    return f"{line}; the least certain is known to {1e3 * worst:.2g} mm"


def _joined(tracks: Tracks, more: Tracks) -> Tracks:
    """Return the samples of both, sorted by frame and track."""
    both = Tracks(*(np.concatenate([getattr(tracks, n), getattr(more, n)]) for n in Tracks.__dataclass_fields__))
    return both.select(np.lexsort((both.track, both.frame)))
