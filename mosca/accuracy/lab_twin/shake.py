"""Shake of a camera's body from a spectrum: white noise from frame to frame, a band of vibration, and steady drift.

The linear drift of the common motion of targets at rest (n, 2) [px] is removed. The periodogram I(f) of the remainder
is modelled by a white part w and, where that explains it better, a band of vibration v: ``S = w + v / width`` inside
the band. Both are estimated by the likelihood of Whittle (1953), ``-sum(log S + I / S)``. Vibration faster than half
the frame rate shows as white noise.
"""

import math
from dataclasses import dataclass

import numpy as np

from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate, Told, root
from mosca.data.arrays import Array

FEWEST_FRAMES = 40
GAIN = 10.0
"""Gain in log-likelihood over white noise that a band must reach. By chance, its three parameters and the choice
among some hundred bands make 8 in 1 of 1000 cases."""
EDGES = 18
"""Number of frequencies, evenly spaced in the logarithm, that are tried as a band's ends."""
DRIFT_SIGMAS = 4.0
"""Standard deviations from which a drift is stated."""


@dataclass(frozen=True)
class Spectrum:
    """Parts of a common motion; variances an axis [px^2]."""

    white: float
    white_sigma: float
    band: float
    band_sigma: float
    band_hz: tuple[float, float]
    drift: Array
    """(2,) [px/s]; ``drift_sigma``: its standard deviation."""
    drift_sigma: Array


def shake_estimates(camera: str, moved_px: Array, noise_px: float, rate_hz: float | None) -> list[Told]:
    """Return shake, vibration and drift of a camera.

    Parameters
    ----------
    camera
        Its name.
    moved_px
        Common motion of its targets at rest (n, 2), NaN where a frame is missing.
    noise_px
        Rms noise of ``moved_px``, an axis.
    rate_hz
        Frames a second; None where unknown.
    """
    keys = ("errors.body_px", "mount.vibration_px", "mount.drift_px_per_s")
    n = int(np.isfinite(moved_px[:, 0]).sum())
    if n < FEWEST_FRAMES:
        why = f"needs {FEWEST_FRAMES} frames of targets at rest: static:FOLDER"
        return [NotTold(camera, key, why) for key in keys]
    found = spectrum(moved_px, 1.0 if rate_hz is None else rate_hz)
    value, sigma = root(found.white - noise_px**2, found.white_sigma)
    what = f"common motion of targets at rest in {n} frames, noise {noise_px:.2g} px"
    told: list[Told] = [ParameterEstimate(camera, keys[0], value, sigma, what)]
    if rate_hz is None:
        return told + [NotTold(camera, key, "needs the frames' times: --fps") for key in keys[1:]]
    if found.band > 0.0:
        value, sigma = root(found.band, found.band_sigma)
        low, high = found.band_hz
        band = f"{what}; band {low:.1f} to {high:.1f} Hz"
        told.append(ParameterEstimate(camera, keys[1], value, sigma, band))
        step = rate_hz / n
        told += [
            ParameterEstimate(camera, f"mount.vibration_hz[{k}]", end, step, band)
            for k, end in enumerate((low, high))
        ]
    else:
        # the whole motion is taken for white noise: no band remains
        told.append(ParameterEstimate(camera, keys[1], 0.0, 0.0, f"{what}; no band below {0.5 * rate_hz:g} Hz"))
    if np.any(np.abs(found.drift) > DRIFT_SIGMAS * found.drift_sigma):
        told += [
            ParameterEstimate(camera, f"{keys[2]}[{k}]", float(found.drift[k]), float(found.drift_sigma[k]), what)
            for k in range(2)
        ]
    return told


def spectrum(moved_px: Array, rate_hz: float) -> Spectrum:
    """Return the parts of a common motion (n, 2) [px], which is NaN where a frame is missing."""
    n = len(moved_px)
    time = np.arange(n) / rate_hz
    there = np.isfinite(moved_px[:, 0])
    line = np.stack([np.ones(there.sum()), time[there] - time[there].mean()], axis=1)
    fitted, *_ = np.linalg.lstsq(line, moved_px[there], rcond=None)
    rest = np.zeros((n, 2))
    rest[there] = moved_px[there] - line @ fitted
    # a missing frame is set to zero: the power is that of fewer frames, as for white noise
    power = (np.abs(np.fft.rfft(rest, axis=0)[1:]) ** 2).sum(axis=1) / (2.0 * there.sum())
    frequency = np.fft.rfftfreq(n, 1.0 / rate_hz)[1:]
    level = float(power.mean())
    white = (2.0 * len(power) * (math.log(level) + 1.0), level)
    best, band = (white[0], white[1], 0.0), (0.0, 0.0)
    edges = np.geomspace(frequency[2], frequency[-1], EDGES)
    for i, low in enumerate(edges):
        for high in edges[i + 1 :]:
            inside = (frequency >= low) & (frequency <= high)
            if 4 <= inside.sum() < 0.9 * len(frequency):
                loss, floor, extra = _two_levels(power, inside)
                if loss < best[0]:
                    best, band = (loss, floor, extra), (float(low), float(high))
    if white[0] - best[0] < GAIN:
        best, band = (white[0], white[1], 0.0), (0.0, 0.0)
    _, floor, extra = best
    inside = (frequency >= band[0]) & (frequency <= band[1]) if extra else np.zeros(len(frequency), bool)
    share, outside = inside.mean(), max(int((~inside).sum()), 1)
    white_sigma = floor / math.sqrt(2.0 * outside)
    band_sigma = share * math.hypot((floor + extra) / math.sqrt(2.0 * max(inside.sum(), 1)), white_sigma)
    slope = np.sqrt(rest[there].var(axis=0) / (line[:, 1] ** 2).sum())
    return Spectrum(floor, white_sigma, extra * share, band_sigma, band, fitted[1], slope)


def _two_levels(power: Array, inside: Array) -> tuple[float, float, float]:
    """Return the loss, the floor, and the height above the floor of a spectrum that is higher inside a band."""
    floor, high = float(power[~inside].mean()), float(power[inside].mean())
    if high <= floor:
        return math.inf, floor, 0.0
    loss = 2.0 * ((~inside).sum() * (math.log(floor) + 1.0) + inside.sum() * (math.log(high) + 1.0))
    return float(loss), floor, high - floor
