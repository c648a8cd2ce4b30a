"""Operational modal analysis of displacements: modes, spectra, noise floor and warnings.

Poles that are stable from order to order (SSI-cov) give the modes and their shapes. Each mode's displacement is
computed by least squares over all shapes; from it frequency and damping are estimated by maximum likelihood.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from mosca.machines.vibration.displacements import Displacements
from mosca.machines.vibration.findings import findings_of
from mosca.machines.vibration.likelihood import ModeFit, expected_periodogram, fit_mode
from mosca.machines.vibration.modal import Mode, looks_steady, mac, phase_collinearity, real_shape
from mosca.machines.vibration.spectra import NoiseFloor, Spectra, filled, noise_floor, spectra
from mosca.machines.vibration.subspace import Candidate, Poles, SubspaceSettings, candidates, correlations, poles_of

_FILLED_BY = 8  # patterns: as many modes as a record of few targets can separate
_LEAST_EVIDENCE = 30.0
"""Least evidence of a mode: chi squared of three parameters exceeds it once in 700,000 places without a mode."""
_ALIKE = 0.8
"""MAC from which on two shapes are not separated by a spatial filter."""


@dataclass(frozen=True)
class VibrationSettings:
    """How a record is analysed."""

    lowest_hz: float = 1.0
    """Lower poles are not modes, but drift and the remainder of a rigid motion."""
    exposure_s: float = 0.0
    """Exposure of the cameras [s]: averaging over it leaves sinc(f T) of an amplitude; 0 (unknown): no correction."""
    segment_s: float = 8.0
    """Length of a segment of the spectra: resolution 1.5 / segment."""
    subspace: SubspaceSettings = field(default_factory=SubspaceSettings)


@dataclass(frozen=True, eq=False)
class Vibration:
    """Results of the analysis of a record."""

    displacements: Displacements
    modes: tuple[Mode, ...]
    """Lowest frequency first; steady lines are included."""
    spectra: Spectra
    poles: Poles
    floor: NoiseFloor
    findings: tuple[str, ...]
    settings: VibrationSettings


def analyse(record: Displacements, settings: VibrationSettings | None = None) -> Vibration:
    """Return modes, spectra, noise floor and findings of ``record``."""
    settings = settings or VibrationSettings()
    if 2 * settings.exposure_s * record.rate_hz > 2.0:
        raise InputError(
            f"exposure {settings.exposure_s:g} s given; it does not fit between frames at {record.rate_hz:g} Hz"
        )
    whole = filled(record.values, min(_FILLED_BY, record.values.shape[1] // 2))
    segment = min(round(settings.segment_s * record.rate_hz), len(whole) // 4)
    averaged = spectra(whole, record.rate_hz, segment)
    poles = _poles(record, whole, settings)
    # a removed rigid motion leaves no pole; a carrier's motion that was not removed is below the lowest mode
    chosen = [
        one for one in candidates(poles, settings.subspace)
        if settings.lowest_hz <= one.frequency_hz < 0.5 * record.rate_hz
    ]  # fmt: skip
    modes = _modes(record, whole, chosen, settings)
    modal = _modal_density(averaged.frequency_hz, modes, len(whole), record.rate_hz, settings.exposure_s)
    floor = noise_floor(averaged, modal, record.variance, record.rate_hz, record.rigid)
    found = Vibration(record, modes, averaged, poles, floor, (), settings)
    told = findings_of(record, modes, averaged, floor, settings.exposure_s)
    return replace(found, findings=told)


def _poles(record: Displacements, whole: Array, settings: VibrationSettings) -> Poles:
    """Return the poles of the strongest components of the channels."""
    own = settings.subspace
    size = min(own.components, whole.shape[1])
    basis = np.linalg.eigh(np.cov(whole.T).reshape(whole.shape[1], -1))[1][:, ::-1][:, :size]
    seen = np.isfinite(record.values)
    components = (whole - whole.mean(axis=0)) @ basis
    # an instant counts where most channels were measured; filled values there come from these channels
    components[seen.mean(axis=1) < 0.5] = np.nan
    return poles_of(correlations(components, 2 * own.block_rows), record.rate_hz, basis, own)


def _modes(
    record: Displacements, whole: Array, chosen: list[Candidate], settings: VibrationSettings
) -> tuple[Mode, ...]:
    """Return the candidates that stand out of the spectrum, with frequency and damping by maximum likelihood."""
    if not chosen:
        return ()
    # each one alone: a false one must not reduce the others' band or shape
    sure = _distinct([_fitted([one], record, whole, settings)[0] for one in chosen])
    if not sure:
        return ()
    modes = []
    for one, shape, q, fit in _fitted(sure, record, whole, settings):
        peak = _kurtosis(q, fit.frequency_hz, record.rate_hz)
        steady = looks_steady(peak, fit.frequency_hz, fit.damping, record.length_s)
        modes.append(
            Mode(
                fit.frequency_hz, fit.frequency_sigma_hz, fit.damping, fit.damping_sigma, shape,
                phase_collinearity(one.shape), fit.rms_m, peak, one.orders, steady,
            )
        )  # fmt: skip
    return tuple(modes)


_Fitted = tuple[Candidate, Array, Array, ModeFit]


def _fitted(ones: list[Candidate], record: Displacements, whole: Array, settings: VibrationSettings) -> list[_Fitted]:
    """Return for each candidate its real shape (c,), its displacement (t,) [m], and the fit to the displacement."""
    shapes = np.stack([real_shape(one.shape) for one in ones], axis=1)
    frequencies = np.array([one.frequency_hz for one in ones])
    moved = whole - whole.mean(axis=0)
    rows = []
    for k, one in enumerate(ones):
        # modes of nearly the same shape cannot be separated by shape, only by frequency
        apart = mac(shapes[:, [k]], shapes)[0] < _ALIKE
        q = moved @ np.linalg.pinv(np.column_stack([shapes[:, k], shapes[:, apart]]))[0]
        others = np.delete(frequencies, k)
        fit = fit_mode(q, record.rate_hz, (one.frequency_hz, one.damping), others, settings.exposure_s)
        rows.append((one, shapes[:, k], q, fit))
    return rows


def _distinct(rows: list[_Fitted]) -> list[Candidate]:
    """Return the candidates that stand out of the spectrum; of several that found one peak, the nearest to it."""
    left = [row for row in rows if row[3].evidence > _LEAST_EVIDENCE]
    left.sort(key=lambda row: abs(row[3].frequency_hz - row[0].frequency_hz) / row[0].frequency_hz)
    kept: list[_Fitted] = []
    for row in left:
        peak = row[3]
        if not any(
            abs(peak.frequency_hz - its.frequency_hz) < 2 * max(peak.damping, its.damping) * its.frequency_hz
            and mac(row[1][:, None], shape[:, None])[0, 0] > _ALIKE
            for _, shape, _, its in kept
        ):
            kept.append(row)
    return sorted((row[0] for row in kept), key=lambda one: one.frequency_hz)


def _modal_density(frequency_hz: Array, modes: tuple[Mode, ...], n: int, rate_hz: float, exposure_s: float) -> Array:
    """Return the modes' density (k,) [m^2/Hz], mean over channels; steady lines, at one frequency, are left out."""
    total = np.zeros(len(frequency_hz))
    for mode in modes:
        if not mode.is_line:
            power = mode.rms_m**2 * float(np.mean(mode.shape**2))
            total += power * expected_periodogram(frequency_hz, mode.frequency_hz, mode.damping, n, rate_hz)
    return np.asarray(total * np.sinc(frequency_hz * exposure_s) ** 2)


def _kurtosis(values: Array, frequency_hz: float, rate_hz: float) -> float:
    """Return the kurtosis of values (t,) within 5 % of a frequency."""
    from scipy.signal import butter, sosfiltfilt  # takes a second to import
    from scipy.stats import kurtosis

    high = min(1.05 * frequency_hz, 0.499 * rate_hz)
    sections = butter(2, (0.95 * frequency_hz, high), "bandpass", fs=rate_hz, output="sos")
    return float(kurtosis(sosfiltfilt(sections, values), fisher=False))
