"""What is done with tracks once they are measured: smoothed on the way, labelled, their gaps filled."""

from dataclasses import dataclass
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
class Finish:
    """``lag``: frames that a sample waits to be smoothed; ``labels``: a marker model's file; ``fill_s``: gaps up to
    this [s] are filled. None: not.
    """

    lag: int | None = None
    labels: Path | None = None
    fill_s: float | None = None


PLAIN = Finish()


class Finisher:
    """Takes samples as they leave the tracker and gives finished tracks; InputError at once for what cannot be."""

    def __init__(self, finish: Finish) -> None:
        if finish.fill_s is not None and not 0 < finish.fill_s < float("inf"):
            raise InputError(
                f"--fill {finish.fill_s:g}: the longest gap to fill is wanted, in seconds above 0"
            )
        self._finish = finish
        self._model = None if finish.labels is None else read_model(finish.labels)
        self._smoother = None if finish.lag is None else FixedLag(LagSettings(lag=finish.lag))
        self._measured: list[Samples] = []
        self._smoothed: list[Samples] = []

    def take(self, frame: int, samples: Samples) -> None:
        """Take what left the tracker at ``frame``."""
        self._measured.append(samples)
        if self._smoother is not None:
            self._smoothed.append(self._smoother.step(frame, samples))

    def finished(self) -> tuple[Tracks, list[str]]:
        """Return the tracks, and what to tell of them, a line each."""
        told = []
        tracks = measured = table(self._measured)
        if self._smoother is not None:
            tracks = table([*self._smoothed, self._smoother.rest()])
            told.append(f"positions are smoothed with a lag of {self._finish.lag} frames")
        if self._model is not None:
            # names come from distances as they were measured
            labelled = label_tracks(measured, self._model)
            found = dict(zip(labelled.track.tolist(), labelled.label.tolist(), strict=True))
            tracks, measured = _with_labels(tracks, found), labelled
            names = {name for name in found.values() if name}
            told.append(f"{len(names)} of {len(self._model.names)} markers of {self._finish.labels} found")
        if self._finish.fill_s is not None:
            # what is missing is estimated from the measured positions: the smoothed ones' errors hang together
            fills = gaps_filled(measured, self._finish.fill_s)
            tracks = _joined(tracks, fills)
            told.append(filled_line(fills, self._finish.fill_s))
        return tracks, told


def gaps_filled(tracks: Tracks, fill_s: float) -> Tracks:
    """Return the samples of status ``filled`` that close gaps of ``tracks`` up to ``fill_s`` [s]; those alone."""
    together = filled(tracks, SmoothSettings(longest_gap_s=fill_s))
    return together.select(together.status == "filled")


def with_gaps_filled(tracks: Tracks, fill_s: float) -> tuple[Tracks, str]:
    """Return ``tracks`` with their gaps up to ``fill_s`` [s] filled, and a line that says how many samples."""
    fills = gaps_filled(tracks, fill_s)
    return _joined(tracks, fills), filled_line(fills, fill_s)


def filled_line(fills: Tracks, fill_s: float) -> str:
    """Return what to tell of filled samples."""
    said = f"{len(fills)} samples filled in gaps up to {fill_s:g} s, marked 'filled'"
    if not len(fills):
        return said
    worst = float(np.sqrt(np.trace(fills.covariance, axis1=1, axis2=2).max()))
    return f"{said}; the least certain is known to {1e3 * worst:.2g} mm"


def _with_labels(tracks: Tracks, label_of: dict[int, str]) -> Tracks:
    labels = np.array([label_of.get(track, "") for track in tracks.track.tolist()], dtype=np.str_)
    return Tracks(
        **({name: getattr(tracks, name) for name in Tracks.__dataclass_fields__} | {"label": labels})
    )


def _joined(tracks: Tracks, more: Tracks) -> Tracks:
    """Return the samples of both, sorted by frame and track."""
    both = Tracks(
        *(np.concatenate([getattr(tracks, n), getattr(more, n)]) for n in Tracks.__dataclass_fields__)
    )
    return both.select(np.lexsort((both.track, both.frame)))
