"""Spectra of displacements: averaged periodograms with intervals, singular values, and the floor of the noise."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array, set_read_only
from mosca.data.distributions import chi2

_PASSES = 4
"""Number of times that patterns are found anew from the values that they filled."""
_QUIET = 0.25
"""Share of the frequencies that show the noise: those with the least density of the modes."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """One-sided cross spectra of c channels at k frequencies, averaged over segments (Welch 1967)."""

    frequency_hz: Array
    """(k,)"""
    matrix: Array
    """(k, c, c) complex [m^2/Hz]."""
    averages: float
    """Effective number of independent segments."""

    def __post_init__(self) -> None:
        k = len(np.asarray(self.frequency_hz))
        set_read_only(self, frequency_hz=(k,))
        set_read_only(self, np.complex128, matrix=(k, None, None))

    @property
    def densities(self) -> Array:
        """Power spectral density of each channel (k, c) [m^2/Hz]."""
        return np.asarray(np.einsum("kcc->kc", self.matrix).real)

    @property
    def singular_values(self) -> Array:
        """Singular values of the matrices (k, c) [m^2/Hz], largest first (frequency domain decomposition)."""
        return np.asarray(np.linalg.eigvalsh(self.matrix)[:, ::-1])

    @property
    def interval95(self) -> tuple[float, float]:
        """Factors on a density for the ends of its 95 % interval: chi squared, two degrees of freedom per average."""
        freedom = 2 * self.averages
        return float(freedom / chi2.ppf(0.975, freedom)), float(freedom / chi2.ppf(0.025, freedom))


def spectra(values: Array, rate_hz: float, segment: int) -> Spectra:
    """Return spectra of values (t, c) without gaps, over Hann-windowed ``segment``s that overlap by half."""
    from scipy.signal import get_window  # takes a second to import

    window = get_window("hann", segment)
    starts = range(0, len(values) - segment + 1, max(segment // 2, 1))
    total = np.zeros((segment // 2 + 1, values.shape[1], values.shape[1]), dtype=np.complex128)
    for start in starts:
        part = values[start : start + segment]
        y = np.fft.rfft(window[:, None] * (part - part.mean(axis=0)), axis=0)
        total += y[:, :, None] * y[:, None, :].conj()
    total *= 2 / (len(starts) * rate_hz * np.sum(window**2))
    total[0] /= 2
    if segment % 2 == 0:
        total[-1] /= 2
    n = len(starts)
    # neighbouring segments that overlap by half have a correlation of 1/6 in amplitude
    effective = n / (1 + 2 / 36 * (n - 1) / n)
    return Spectra(np.fft.rfftfreq(segment, 1 / rate_hz), total, effective)


def filled(values: Array, rank: int) -> Array:
    """Return values (t, c) with gaps (NaN) filled, for spectra only: filled values do not count as measured.

    Where more than ``rank`` channels were measured, the ``rank`` strongest patterns of all channels are fitted to the
    measured channels of the instant; the patterns are found anew from the filled values several times. Other instants
    are filled by a cubic spline in time.
    """
    there = np.isfinite(values)
    if there.all():
        return values
    mean = np.nanmean(values, axis=0)
    y = np.where(there, values, mean)
    some = there.sum(axis=1) > rank
    holes = np.flatnonzero(some & ~there.all(axis=1))
    seen, moved = there[holes].astype(np.float64), np.where(there[holes], values[holes] - mean, 0.0)
    for _ in range(_PASSES):
        patterns = np.linalg.eigh((y[some] - mean).T @ (y[some] - mean))[1][:, -rank:]
        normal = np.einsum("tc,ci,cj->tij", seen, patterns, patterns)
        size = np.linalg.solve(normal, (moved @ patterns)[..., None])[..., 0]
        y[holes] = np.where(there[holes], values[holes], mean + size @ patterns.T)
    if not some.all():
        at = np.arange(len(y))
        y[~some] = CubicSpline(at[some], y[some], axis=0)(at[~some])
    return np.asarray(y)


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """Noise that the spectra show, and noise that the tracks' covariances state."""

    measured_m2_per_hz: float
    """Mean density over the channels that no mode explains, at frequencies where the modes have least."""
    expected_m2_per_hz: float
    """2 sigma^2 / rate; NaN where the tracks state no covariance."""

    @property
    def ratio(self) -> float:
        """Measured over expected density."""
        return self.measured_m2_per_hz / self.expected_m2_per_hz

    def sigma_m(self, rate_hz: float) -> float:
        """Return the standard deviation [m] of one sample that corresponds to the measured floor."""
        return float(np.sqrt(self.measured_m2_per_hz * rate_hz / 2))


def noise_floor(averaged: Spectra, modal: Array, variance: Array, rate_hz: float, rigid: Array) -> NoiseFloor:
    """Return the noise in ``averaged`` spectra, and the noise expected from ``variance`` (c,) [m^2].

    The measured noise is the channels' mean density less that of the modes, ``modal`` (k,) [m^2/Hz]. It is averaged
    over the quarter of the frequencies where the modes have least, since their part rests on few independent values.
    A median would not do: noise common to all targets, from camera shake, also has few independent values, and its
    median lies below its mean. White noise removed with the rigid motions ``rigid`` (c, r) is allowed for. Filled
    samples have the noise of those that they come from, without a correction.
    """
    keeps = 1 - np.sum(rigid**2, axis=1)
    left = averaged.densities.sum(axis=1)[1:-1] - averaged.matrix.shape[1] * modal[1:-1]
    quiet = modal[1:-1] <= np.quantile(modal[1:-1], _QUIET)
    measured = float(np.mean(left[quiet])) / float(keeps.sum())
    return NoiseFloor(measured, float(2 / rate_hz * np.sum(keeps * variance) / keeps.sum()))
