"""Frequency and damping of one mode by maximum likelihood from the periodogram of its own displacement.

Whittle's likelihood: ordinates of a long periodogram are independent and exponentially distributed about their
expectation. For a sampled oscillator driven by white force, the expectation over a finite record is known in closed
form, so that the record's length causes no bias (debiased Whittle likelihood, Sykulski et al., Biometrika 2019). The
estimate reaches the bound of ``mosca.machines.vibration.modal.frequency_bound``; standard deviations come from the
likelihood's curvature.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array

_STEPS = 60
_BAND = 25.0
"""Half width of the band, in half widths of the resonance: 1 / (1 + 25^2) of its peak remains at the ends."""
_FEWEST = 15  # ordinates: three for each parameter
_LEAST_LOG = float(np.log(1e-6))  # of a damping: no record distinguishes it from a steady line's 0
_NOTHING = 1e-30  # m^2/Hz: avoids the logarithm of 0 for a record of zeros


@dataclass(frozen=True)
class ModeFit:
    """Frequency [Hz], damping, their standard deviations, and rms of the mode [m]; NaN where nothing was fitted."""

    frequency_hz: float
    frequency_sigma_hz: float
    damping: float
    damping_sigma: float
    rms_m: float
    evidence: float
    """Twice the log likelihood ratio of the ordinates with the resonance to those without any."""


def expected_periodogram(frequency_hz: Array, f0: float, damping: float, n: int, rate_hz: float) -> Array:
    """Return the expected one-sided periodogram (k,) [1/Hz] of n samples of an oscillator of mean square 1.

    Its correlation is Re(C e^(lambda t)), lambda = w (-zeta + i sqrt(1 - zeta^2)), C = 1 - i zeta / sqrt(1 - zeta^2).
    The sum of (1 - m / n) z^m over the lags m, z = e^((lambda - i w) / rate), is a geometric series.
    """
    if damping >= 1:  # no oscillation: not allowed in a search
        return np.full(len(frequency_hz), np.nan)
    root = np.sqrt(1 - damping**2)
    c = 1 - 1j * damping / root
    pole = 2 * np.pi * f0 * (-damping + 1j * root)
    total = np.zeros(len(frequency_hz))
    for size, rate in ((c / 2, pole), (c.conjugate() / 2, pole.conjugate())):
        z = np.exp((rate - 2j * np.pi * frequency_hz) / rate_hz)
        lags = 1 / (1 - z) - z * (1 - z**n) / (n * (1 - z) ** 2)
        total += 2 * (size * lags).real
    return np.asarray(2 / rate_hz * (total - 1.0))


def fit_mode(
    values: Array, rate_hz: float, start: tuple[float, float], neighbours_hz: Array, exposure_s: float = 0.0
) -> ModeFit:
    """Return the fit to a mode's displacement ``values`` (t,) [m], from ``start`` (frequency [Hz], damping).

    ``neighbours_hz``: frequencies of other modes; the band ends half way to the nearest. ``exposure_s``: the low pass
    by exposure is part of the model, and is corrected in the rms.
    """
    n = len(values)
    ordinates = np.abs(np.fft.rfft(values - values.mean())) ** 2 * 2 / (n * rate_hz)
    grid = np.fft.rfftfreq(n, 1 / rate_hz)
    f0, damping = start
    width = max(_BAND * damping * f0, _FEWEST * rate_hz / n)
    gaps = np.abs(neighbours_hz - f0)
    if len(gaps):
        width = min(width, float(gaps.min()) / 2)
    band = (np.abs(grid - f0) <= width) & (grid > 0) & (grid < rate_hz / 2)
    nothing = ModeFit(f0, np.nan, damping, np.nan, float(np.std(values)), 0.0)
    if band.sum() < _FEWEST:
        return nothing
    f, power = grid[band], ordinates[band]
    low_pass = np.sinc(f * exposure_s) ** 2

    beside = (f - f0) / width

    def without(p: Array) -> Array:
        return np.asarray(np.exp(p[0] + p[1] * beside))

    def model(p: Array) -> Array:
        shape = expected_periodogram(f, f0 + p[0] * damping * f0, float(np.exp(max(p[1], _LEAST_LOG))), n, rate_hz)
        return np.asarray(np.exp(p[2]) * low_pass * shape) + without(p[3:])

    floor = np.log(max(float(np.percentile(power, 10)), _NOTHING))
    plain, _, _ = _maximum(without, np.array([np.log(max(float(power.mean()), _NOTHING)), 0.0]), power)
    p = np.array([0.0, np.log(damping), np.log(max(float(power.sum()) * rate_hz / n, _NOTHING)), floor, 0.0])
    best, p, information = _maximum(model, p, power)
    if not np.isfinite(best):
        return nothing
    sigma = np.sqrt(np.abs(np.diag(np.linalg.pinv(information, hermitian=True))))
    fitted = float(np.exp(p[1]))
    return ModeFit(
        float(f0 + p[0] * damping * f0), float(sigma[0] * damping * f0), fitted, float(sigma[1] * fitted),
        float(np.exp(p[2] / 2)), 2 * (plain - best),
    )  # fmt: skip


def _maximum(model: Callable[[Array], Array], p: Array, power: Array) -> tuple[float, Array, Array]:
    """Return the minimum of sum(ln S + I / S) by damped Fisher scoring, its parameters, and the information there."""
    cost, damp = _cost(model(p), power), 1e-3
    information = np.eye(len(p))
    for _ in range(_STEPS):
        spectrum = model(p)
        slopes = np.stack(
            [np.log(model(p + step) / model(p - step)) / 2e-4 for step in 1e-4 * np.eye(len(p))], axis=1
        )
        information = slopes.T @ slopes
        if not np.isfinite(slopes).all():
            return np.inf, p, information
        gradient = slopes.T @ (power / spectrum - 1)
        damped = information + damp * np.diag(np.diag(information) + 1e-12)
        step = np.clip(np.linalg.solve(damped, gradient), -1.0, 1.0)
        trial = _cost(model(p + step), power)
        if trial <= cost:
            p, gained, cost, damp = p + step, cost - trial, trial, damp / 4
            if gained < 1e-9 * len(power):
                break
        else:
            damp *= 8
            if damp > 1e8:
                break
    return cost, p, information


def _cost(spectrum: Array, power: Array) -> float:
    if not (np.isfinite(spectrum).all() and (spectrum > 0).all()):
        return np.inf
    return float(np.sum(np.log(spectrum) + power / spectrum))
