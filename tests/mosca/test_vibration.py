"""Modes of vibration from displacements: against closed forms, and records of oscillators with known modes."""

from functools import cache

import numpy as np
import pytest
from vibration_records import (
    DAMPING,
    FREQUENCIES_HZ,
    NOISE_M,
    PLACES,
    RATE_HZ,
    RMS_M,
    oscillator,
    plate_shapes,
    plate_values,
    record_of,
)

from mosca.data.arrays import Array
from mosca.errors import InputError
from mosca.machines.vibration.analysis import Vibration, VibrationSettings, analyse
from mosca.machines.vibration.likelihood import expected_periodogram, fit_mode
from mosca.machines.vibration.modal import (
    damping_bound,
    frequency_bound,
    looks_steady,
    mac,
    phase_collinearity,
    real_shape,
)
from mosca.machines.vibration.spectra import filled, noise_floor, spectra
from mosca.machines.vibration.subspace import correlations

LENGTH_S = 40.0


@cache
def whole() -> Vibration:
    """Return the analysis of a record without gaps."""
    return analyse(record_of(plate_values(LENGTH_S, 3)))


def test_modes_of_a_plate_are_found_within_their_stated_errors() -> None:
    found = whole()
    assert [mode.is_line for mode in found.modes] == [False] * 4
    for mode, hz, damping, rms, true in zip(
        found.modes, FREQUENCIES_HZ, DAMPING, RMS_M, plate_shapes().T, strict=True
    ):
        assert abs(mode.frequency_hz - hz) < 3.5 * mode.frequency_sigma_hz
        assert abs(mode.damping - damping) < 3.5 * mode.damping_sigma
        # the stated errors are those that the length allows: neither less nor much more
        assert 0.8 < mode.frequency_sigma_hz / hz / frequency_bound(hz, damping, LENGTH_S) < 1.5
        assert 0.8 < mode.damping_sigma / damping / damping_bound(hz, damping, LENGTH_S) < 1.7
        assert mac(mode.shape[:, None], true[:, None])[0, 0] > 0.98
        assert mode.mpc > 0.95
        largest = np.abs(true).max()
        assert mode.rms_m == pytest.approx(rms * largest, rel=6 * damping_bound(hz, damping, LENGTH_S))


def test_the_noise_floor_is_that_of_the_noise_and_doubled_noise_shows() -> None:
    assert whole().floor.ratio == pytest.approx(1.0, abs=0.03)
    assert whole().floor.measured_m2_per_hz == pytest.approx(2 * NOISE_M**2 / RATE_HZ, rel=0.03)
    stated = analyse(record_of(plate_values(LENGTH_S, 3), variance=NOISE_M**2 / 2))
    assert stated.floor.ratio == pytest.approx(2.0, abs=0.06)
    assert any("noise floor" in line for line in stated.findings)


def test_gaps_change_little_and_are_told() -> None:
    values = plate_values(LENGTH_S, 3)
    rng = np.random.default_rng(8)
    values[rng.random(values.shape) < 0.03] = np.nan
    values[rng.integers(0, len(values), 40)] = np.nan  # whole frames
    found = analyse(record_of(values))
    assert len(found.modes) == 4
    for mode, other in zip(found.modes, whole().modes, strict=True):
        assert mode.frequency_hz == pytest.approx(other.frequency_hz, abs=other.frequency_sigma_hz)
    assert found.floor.ratio == pytest.approx(1.0, abs=0.1)
    assert any("% of the samples are missing" in line for line in found.findings)


def test_a_steady_line_is_no_mode() -> None:
    values = plate_values(LENGTH_S, 4)
    time = np.arange(len(values)) / RATE_HZ
    values += 80e-6 * np.sin(2 * np.pi * 30.0 * time)[:, None] * plate_shapes()[:, 0]
    found = analyse(record_of(values))
    lines = [mode for mode in found.modes if mode.is_line]
    assert [round(mode.frequency_hz, 1) for mode in lines] == [30.0]
    assert len(found.modes) == 5


def test_a_mode_of_few_time_constants_is_no_line() -> None:
    # 20 Hz, 0.2 %, 40 s: a peak of 0.08 Hz, resolved to 0.025 Hz
    assert not looks_steady(1.9, 20.0, 0.002, 40.0)
    assert looks_steady(1.9, 20.0, 0.0002, 40.0)
    assert not looks_steady(3.0, 20.0, 0.0002, 40.0)


def test_noise_alone_has_no_modes() -> None:
    rng = np.random.default_rng(1)
    assert analyse(record_of(NOISE_M * rng.standard_normal((6000, len(PLACES))))).modes == ()


def test_content_at_half_the_frame_rate_is_told_of() -> None:
    values = plate_values(LENGTH_S, 5)
    rng = np.random.default_rng(6)
    # 106 Hz, seen at 200 fps as 94 Hz
    alias = oscillator(len(values), 106.0, 0.01, 40e-6, rng)
    found = analyse(record_of(values + alias[:, None] * np.cos(np.arange(len(PLACES)))))
    assert [round(mode.frequency_hz) for mode in found.modes][-1] == 94
    told = [line for line in found.findings if line.startswith("aliasing")]
    # 200 minus the frequency found, which is known to 0.1 Hz
    assert any("at 106." in line or "at 105.9" in line for line in told)
    assert any("has not ended" in line for line in told)
    assert not [line for line in whole().findings if line.startswith("aliasing")]


def test_exposure_is_corrected() -> None:
    n, hz = 6000, 80.0
    values = oscillator(n, hz, 0.01, 1e-4, np.random.default_rng(2))
    one, two = (fit_mode(values, RATE_HZ, (hz, 0.01), np.empty(0), exposure) for exposure in (0.0, 0.004))
    # sin(pi f T) / (pi f T) at 80 Hz and 4 ms: sin(1.0053) / 1.0053
    assert two.rms_m / one.rms_m == pytest.approx(1 / 0.8398, rel=5e-3)


@pytest.mark.parametrize(("hz", "damping", "n"), [(20.0, 0.003, 400), (80.0, 0.05, 64), (97.0, 0.2, 33)])
def test_the_expected_periodogram_is_the_sum_over_the_correlation(hz: float, damping: float, n: int) -> None:
    w = 2 * np.pi * hz
    lag = np.arange(n)
    t = lag / RATE_HZ
    root = np.sqrt(1 - damping**2)
    correlation = np.exp(-damping * w * t) * (np.cos(w * root * t) + damping / root * np.sin(w * root * t))
    f = np.array([1.0, 0.7 * hz, hz, 99.0])
    terms = (1 - lag / n) * correlation * np.cos(2 * np.pi * f[:, None] * t)
    direct = 2 / RATE_HZ * (2 * terms.sum(axis=1) - 1)
    np.testing.assert_allclose(expected_periodogram(f, hz, damping, n, RATE_HZ), direct, rtol=1e-9)


def test_welch_keeps_the_power_of_a_sine_and_of_white_noise() -> None:
    n = 20000
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((n, 1))
    found = spectra(noise, RATE_HZ, 400)
    assert found.densities[5:-5].mean() == pytest.approx(2 / RATE_HZ, rel=0.03)
    sine = np.sqrt(2) * np.sin(2 * np.pi * 25.0 * np.arange(n) / RATE_HZ)[:, None]
    one = spectra(sine, RATE_HZ, 400)
    assert one.densities.sum() * RATE_HZ / 400 == pytest.approx(1.0, rel=1e-3)
    low, high = found.interval95
    inside = (found.densities[5:-5] * low < 2 / RATE_HZ) & (found.densities[5:-5] * high > 2 / RATE_HZ)
    assert inside.mean() == pytest.approx(0.95, abs=0.04)


def test_correlations_count_only_pairs_that_were_measured() -> None:
    values = np.array([[1.0], [2.0], [np.nan], [4.0]])
    np.testing.assert_allclose(correlations(values, 2)[:, 0, 0], [(1 + 4 + 16) / 3, 2 / 1, 8 / 1])


def test_filled_gaps_come_from_the_other_channels() -> None:
    pattern = np.array([1.0, 2.0, -1.0, 0.5])
    values = np.random.default_rng(0).standard_normal((500, 1)) * pattern
    holes: Array = values.copy()
    holes[::7, 1] = np.nan
    # the mean of a channel is that of its measured samples: of 71 of 500 missing, off by 2 * 0.02 or so
    np.testing.assert_allclose(filled(holes, 1), values, atol=0.06)


def test_the_floor_of_unequal_noise_is_that_of_what_rigid_motions_leave() -> None:
    rng = np.random.default_rng(0)
    sigma = np.array([1.0, 2.0, 3.0, 4.0])
    values = sigma * rng.standard_normal((20000, 4))
    pattern = np.array([[0.0], [0.0], [0.0], [1.0]])  # took the last channel out whole
    values[:, 3] = 0.0
    found = noise_floor(spectra(values, RATE_HZ, 200), np.zeros(101), sigma**2, RATE_HZ, pattern)
    assert found.expected_m2_per_hz == pytest.approx(2 / RATE_HZ * (1 + 4 + 9) / 3)
    assert found.ratio == pytest.approx(1.0, abs=0.03)


def test_shapes_by_hand() -> None:
    a, b = np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    assert mac(a[:, None], b[:, None])[0, 0] == pytest.approx(0.5)
    assert mac(a[:, None], (-2j * a)[:, None])[0, 0] == pytest.approx(1.0)
    assert phase_collinearity(a * np.exp(0.3j)) == pytest.approx(1.0)
    assert phase_collinearity(np.exp(2j * np.pi * np.arange(5) / 5)) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(real_shape(np.array([1.0, -4.0, 2.0]) * 1j), [-0.25, 1.0, -0.5])


def test_bounds_by_hand() -> None:
    # zeta / (2 pi f T) = 0.003 / (2 pi 20 100) = 2.387e-7
    assert frequency_bound(20.0, 0.003, 100.0) == pytest.approx(4.886e-4, rel=1e-3)
    assert damping_bound(20.0, 0.003, 100.0) == pytest.approx(0.16287, rel=1e-3)


def test_an_exposure_longer_than_a_frame_is_refused() -> None:
    with pytest.raises(InputError, match="exposure"):
        analyse(record_of(plate_values(5.0, 1)), VibrationSettings(exposure_s=0.01))
