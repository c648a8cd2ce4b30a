"""Stretches of tracks, and the standard uncertainty of a series' mean."""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.diagnostics.long_run_covariance import long_run_covariance


def stretch(tracks: Tracks, time_s: tuple[float, float] | None) -> Tracks:
    """Return the measured samples from ``time_s[0]`` to ``time_s[1]`` [s] after the first sample; all for None."""
    rows = tracks.status == "measured"
    if time_s is not None:
        since_s = seconds(tracks)
        rows &= (since_s >= time_s[0]) & (since_s <= time_s[1])
    return tracks.select(rows)


def seconds(tracks: Tracks) -> Array:
    """Return the time (n,) of each sample since the first one [s]."""
    return np.asarray((tracks.time_ns - tracks.time_ns.min(initial=np.iinfo(np.int64).max)) * 1e-9)


def frames_expected(tracks: Tracks, time_s: tuple[float, float] | None) -> int:
    """Return the number of frames of a stretch, also those without samples.

    Where the rate is not known: 1, or 0 without any sample.
    """
    period_s = tracks.frame_period_s
    if period_s is None:
        return min(len(tracks), 1)
    if time_s is None:
        return int(tracks.frame.max() - tracks.frame.min() + 1)
    # a frame at the very end of the stretch belongs to it, whatever the last digits of its stamp
    return int(np.floor(time_s[1] / period_s + 1e-3) - np.ceil(time_s[0] / period_s - 1e-3)) + 1


def sigma_of_mean(values: Array, variance: Array) -> float:
    """Return the standard uncertainty of the mean of ``values`` (n,), each with a stated ``variance`` (n,).

    The larger of two estimates is returned. One follows from the stated variances of n independent values; the other
    from the scatter of the values with its correlation in time (``long_run_covariance``). Where the stated variances
    are unknown (NaN), the scatter alone is used; for a single value the stated variance alone, NaN if unknown.
    """
    n = len(values)
    stated = float(np.mean(variance)) / n if n else np.nan
    seen = np.nan
    if n > 1:
        away = values - values.mean()
        seen = float(long_run_covariance(away[:, None])[0, 0]) / n**2 * n / (n - 1)
    return float(np.sqrt(np.fmax(stated, seen)))
