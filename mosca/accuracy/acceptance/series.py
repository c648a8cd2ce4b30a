"""Stretches of tracks, and the standard uncertainty of the mean of a series."""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.diagnostics.long_run_covariance import long_run_covariance


def stretch(tracks: Tracks, time_s: tuple[float, float] | None) -> Tracks:
    """Return the measured samples from ``time_s[0]`` to ``time_s[1]`` [s] after the first sample; None: all."""
    rows = tracks.status == "measured"
    if time_s is not None:
        since_s = seconds(tracks)
        rows &= (since_s >= time_s[0]) & (since_s <= time_s[1])
    return tracks.select(rows)


def seconds(tracks: Tracks) -> Array:
    """Return the time (n,) of each sample since the first one [s]."""
    return np.asarray((tracks.time_ns - tracks.time_ns.min(initial=np.iinfo(np.int64).max)) * 1e-9)


def frames_expected(tracks: Tracks, time_s: tuple[float, float] | None) -> int:
    """Return how many frames a stretch has: those without any sample count too; 0 where the rate is not known."""
    period_s = tracks.frame_period_s
    if period_s is None:
        return min(len(tracks), 1)
    if time_s is None:
        return int(tracks.frame.max() - tracks.frame.min() + 1)
    # a frame at the stretch's very end belongs to it, whatever the last digits of its stamp
    return int(np.floor(time_s[1] / period_s + 1e-3) - np.ceil(time_s[0] / period_s - 1e-3)) + 1


def sigma_of_mean(values: Array, variance: Array) -> float:
    """Return the standard uncertainty of the mean of ``values`` (n,), each with a stated ``variance`` (n,).

    The larger one of two: what the stated variances give for n independent values, and what the scatter of the values
    with its correlation in time gives (``long_run_covariance``). Stated variances that are not known (NaN) leave the
    scatter; one value leaves what is stated, and NaN where nothing is.
    """
    n = len(values)
    stated = float(np.mean(variance)) / n if n else np.nan
    seen = np.nan
    if n > 1:
        away = values - values.mean()
        seen = float(long_run_covariance(away[:, None])[0, 0]) / n**2 * n / (n - 1)
    return float(np.sqrt(np.fmax(stated, seen)))
