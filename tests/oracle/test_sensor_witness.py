"""The twin's sensor measured as one measures a camera (in the manner of EMVA 1288), and against scipy's laws."""

import numpy as np
import pytest
from scipy.stats import chisquare, kstest, linregress, norm, poisson
from witness_render import Array

from twin.cameras.sensor import Sensor, dark_table, expose

SHAPE = (200, 300)
LEAST_P = 1e-3
"""One test in a thousand would fail by chance; the seeds are fixed, so that none fails twice."""


def flat(level_e: float, sensor: Sensor, key: int, shape: tuple[int, int] = SHAPE) -> Array:
    """Return a flat field's counts as floats; ``level_e`` electrons of light a pixel."""
    return expose(np.full(shape, level_e, dtype=np.float32), sensor, key).astype(float)


def pair(level_e: float, sensor: Sensor, key: int) -> tuple[float, float]:
    """Return mean and temporal variance of two flat fields (EMVA 1288: half the variance of the difference)."""
    a, b = flat(level_e, sensor, key), flat(level_e, sensor, key + 1_000_003)
    return float((a.mean() + b.mean()) / 2), float(np.mean((a - b) ** 2) / 2 - (a.mean() - b.mean()) ** 2 / 2)


def chi_square_p(counts: Array, pmf: Array, first: int) -> float:
    """Return the p-value of observed counts against probabilities of first, first + 1, ...; tails pooled."""
    seen = np.bincount((counts - first).astype(int).ravel(), minlength=len(pmf)).astype(float)
    assert len(seen) == len(pmf), "a count outside the law's support"
    expected = pmf * counts.size
    often = np.flatnonzero(expected >= 10)
    below, above = slice(0, often[0]), slice(often[-1] + 1, None)
    observed = np.array([seen[below].sum(), *seen[often], seen[above].sum()])
    wanted = np.array([expected[below].sum(), *expected[often], expected[above].sum()])
    observed, wanted = observed[wanted > 0.5], wanted[wanted > 0.5]
    return float(chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue)


@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(bits=12),
        Sensor(bits=12, full_well_e=9_000.0, read_noise_e=25.0, black_dn=8.0, background_e=0.0),
        Sensor(bits=10, full_well_e=30_000.0, read_noise_e=40.0),
        Sensor(bits=8),
    ],
    ids=["12 bit", "12 bit, small well", "10 bit", "8 bit"],
)
def test_photon_transfer_gives_the_system_gain(sensor):
    # EMVA 1288, photon transfer: variance over mean has the slope K. Measured: 0.7 % off at most, its spread
    gain = ((2**sensor.bits - 1) - sensor.black_dn * 2 ** (sensor.bits - 8)) / sensor.full_well_e
    levels = np.linspace(0.1, 0.7, 8) * sensor.full_well_e
    means, variances = np.transpose([pair(level, sensor, 17 + k) for k, level in enumerate(levels)])
    slope = linregress(means, variances).slope
    assert slope == pytest.approx(gain, rel=0.02)
    assert sensor.gain_dn_per_e == pytest.approx(gain, rel=1e-12)


@pytest.mark.parametrize("read_noise", [6.0, 10.0, 25.0])
@pytest.mark.parametrize("light_e", [0.0, 0.01], ids=["dark pixels", "pixels with light"])
def test_dark_noise(read_noise, light_e):
    # 12 bit, so that quantisation (1/12 DN^2) is small; both ways through the sensor: table and drawing.
    # Measured: 0.3 % off at most, its spread
    sensor = Sensor(bits=12, read_noise_e=read_noise, background_e=0.0)
    _mean, variance = pair(light_e, sensor, 5)
    measured = np.sqrt(variance - 1 / 12) / sensor.gain_dn_per_e
    assert measured == pytest.approx(read_noise, rel=0.05)


def test_linearity():
    # EMVA 1288: largest deviation from the line over full scale, 5 to 95 % of saturation; measured 4e-5
    sensor = Sensor(bits=12, background_e=0.0)
    levels = np.linspace(0.05, 0.95, 10) * sensor.full_well_e
    means = np.array([flat(level, sensor, 40 + k).mean() for k, level in enumerate(levels)])
    expected = sensor.black + sensor.gain_dn_per_e * levels
    assert np.abs(means - expected).max() / sensor.top < 5e-4


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_black_level_and_background(bits):
    # mean of the dark = black + K background; at 8 bit a spread of 0.22 DN hardly dithers the quantiser,
    # so that the mean of the exact law stands in place of the line
    for background in (0.0, 200.0, 700.0):
        sensor = Sensor(bits=bits, background_e=background)
        pmf, first = law(sensor, background)
        expected = (pmf * (first + np.arange(len(pmf)))).sum()
        mean = flat(0.0, sensor, 9).mean()
        spread = np.sqrt((pmf * (first + np.arange(len(pmf)) - expected) ** 2).sum())
        assert abs(mean - expected) < 4 * spread / np.sqrt(np.prod(SHAPE))
        if bits == 12:
            assert expected == pytest.approx(64 + sensor.gain_dn_per_e * background, abs=0.01)


@pytest.mark.parametrize("bits", [8, 12])
def test_saturation(bits):
    sensor = Sensor(bits=bits)
    top = 2**bits - 1
    image = expose(np.full(SHAPE, 1e7, dtype=np.float32), sensor, 3)
    assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert image.min() == image.max() == top
    # a full well (background included) stands at the last count: half of the pixels reach it, none wraps
    full = flat(sensor.full_well_e - sensor.background_e, sensor, 4)
    spread = sensor.gain_dn_per_e * np.sqrt(sensor.full_well_e + sensor.read_noise_e**2)
    assert full.max() == top
    assert full.min() > top - 6 * spread - 1
    assert (full == top).mean() == pytest.approx(norm.cdf(0.5 / spread), abs=0.02)


def law(sensor: Sensor, mean_e: float) -> tuple[Array, int]:
    """Return the exact law of counts: Poisson electrons, Gaussian noise, rounding, limits; and its first count.

    P(count = c) = sum_n Poisson(n; mean) [Phi(upper edge) - Phi(lower edge)], written from the definition.
    """
    n = np.arange(poisson.ppf(1e-14, mean_e), poisson.isf(1e-14, mean_e) + 1)
    weights = poisson.pmf(n, mean_e)
    top = 2**sensor.bits - 1
    black = sensor.black_dn * 2 ** (sensor.bits - 8)
    gain = (top - black) / sensor.full_well_e
    centres = black + gain * n
    sigma = gain * sensor.read_noise_e
    first = max(0, int(centres.min() - 9 * sigma) - 1)
    last = min(top, int(centres.max() + 9 * sigma) + 2)
    edges = np.arange(first, last + 2) - 0.5
    edges[0], edges[-1] = -np.inf, np.inf
    below = norm.cdf((edges[:, None] - centres) / sigma) @ weights
    return np.diff(below), first


SENSORS = [
    Sensor(bits=8),
    Sensor(bits=10),
    Sensor(bits=12),
    Sensor(bits=12, background_e=3.0, read_noise_e=2.0),
    Sensor(bits=12, background_e=0.5, read_noise_e=0.3, full_well_e=4000.0),
    Sensor(bits=8, background_e=0.0, black_dn=0.0),
    Sensor(bits=12, background_e=5000.0),
]


@pytest.mark.parametrize("light_e", [0.0, 1e-6], ids=["table", "drawn"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_dark_counts_follow_the_mixture(sensor, light_e):
    # pixels without light are looked up, pixels with next to none are drawn: both follow one law
    counts = flat(light_e, sensor, 77, (400, 500))
    p = chi_square_p(counts, *law(sensor, sensor.background_e + light_e))
    assert p > LEAST_P


@pytest.mark.parametrize("mean_e", [0.5, 3.0, 9.9, 10.1, 30.0, 250.0, 1500.0])
def test_electrons_are_poisson(mean_e):
    # K = 1 DN/e-, no read noise: the counts are the electrons
    sensor = Sensor(full_well_e=4095.0, read_noise_e=0.0, bits=12, black_dn=0.0, background_e=0.0)
    counts = flat(mean_e, sensor, 31, (400, 500))
    top = int(counts.max())
    mean = float(np.float32(mean_e))
    pmf = poisson.pmf(np.arange(max(top, int(poisson.isf(1e-12, mean))) + 1), mean)
    p = chi_square_p(counts, pmf, 0)
    assert p > LEAST_P


@pytest.mark.parametrize("mean_e", [0.5, 2.0, 9.0, 11.0, 100.0, 1_000.0, 5_000.0, 12_000.0, 19_000.0])
def test_signal_mean_and_variance(mean_e):
    # K = 0.2 DN/e-: mean and variance in electrons, quantisation taken off; 4 standard errors
    sensor = Sensor(full_well_e=4095 / 0.2, read_noise_e=4.0, bits=12, black_dn=0.0, background_e=100.0)
    electrons = flat(mean_e, sensor, 1234, (400, 500)) / 0.2
    n = electrons.size
    variance = mean_e + 100.0 + 16.0 + 1 / (12 * 0.2**2)
    assert abs(electrons.mean() - mean_e - 100.0) < 4 * np.sqrt(variance / n)
    assert abs(electrons.var(ddof=1) - variance) < 4 * variance * np.sqrt(2 / n) * 1.05


def test_large_signal_is_gaussian():
    # Kolmogorov-Smirnov of 19,000 electrons a pixel, dithered within a count
    sensor = Sensor(full_well_e=4095 / 0.2, read_noise_e=10.0, bits=12, black_dn=0.0, background_e=0.0)
    counts = flat(19_000.0, sensor, 8) + np.random.default_rng(1).uniform(-0.5, 0.5, SHAPE)
    spread = 0.2 * np.sqrt(19_000.0 + 100.0)
    assert kstest(counts.ravel(), norm(3800.0, spread).cdf).pvalue > LEAST_P


def test_8_and_12_bits_tell_the_same_light():
    # the coarse converter adds its 1/12 DN^2 and no more; the mean is the same light
    eight, twelve = Sensor(bits=8), Sensor(bits=12)
    light = np.full(SHAPE, 8_000.0, dtype=np.float32)
    e8 = (expose(light, eight, 50).astype(float) - 4.0) / eight.gain_dn_per_e
    e12 = (expose(light, twelve, 51).astype(float) - 64.0) / twelve.gain_dn_per_e
    error = np.sqrt(8_300.0 / light.size)
    assert abs(e8.mean() - 8_200.0) < 5 * error
    assert abs(e12.mean() - 8_200.0) < 5 * error
    added = e8.var() - e12.var()
    expected = (eight.gain_dn_per_e**-2 - twelve.gain_dn_per_e**-2) / 12
    assert abs(added - expected) < 5 * 8_300.0 * np.sqrt(4 / light.size)
    assert expected > 5 * 8_300.0 * np.sqrt(4 / light.size) / 2


@pytest.mark.parametrize("light_e", [0.0, 300.0])
def test_pixels_rows_and_frames_are_independent(light_e):
    # correlations of neighbours (1, 2, 7 px, one row) and of frames whose keys differ by little
    sensor = Sensor(bits=12)
    noise = [flat(light_e, sensor, key) for key in (1000, 1001, 1002, 2**63 + 5)]
    noise = [(image - image.mean()) / image.std() for image in noise]
    limit = 4.5 / np.sqrt(noise[0].size)
    for dy, dx in ((0, 1), (0, 2), (0, 7), (1, 0), (1, 1)):
        a = noise[0][: SHAPE[0] - dy, : SHAPE[1] - dx]
        assert abs((a * noise[0][dy:, dx:]).mean()) < limit
    for other in noise[1:]:
        assert abs((noise[0] * other).mean()) < limit


def test_same_key_same_bytes():
    sensor = Sensor()
    light = np.linspace(0, 15_000, SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(SHAPE)
    one = expose(light, sensor, 99)
    np.testing.assert_array_equal(one, expose(light, sensor, 99, dark_table(sensor)))
    assert (one != expose(light, sensor, 98)).mean() > 0.3


def test_light_on_one_pixel_changes_no_other():
    sensor = Sensor()
    light = np.zeros(SHAPE, dtype=np.float32)
    dark = expose(light, sensor, 6)
    light[10, 20] = 5_000.0
    lit = expose(light, sensor, 6)
    assert lit[10, 20] > 40
    lit = lit.copy()
    lit[10, 20] = dark[10, 20]
    np.testing.assert_array_equal(lit, dark)


def test_a_wrong_gain_is_noticed():
    # control: a sensor whose gain is off by 6 % (three times the limit) breaks the limit
    true, wrong = Sensor(bits=12), Sensor(bits=12, full_well_e=20_000.0 / 1.06)
    levels = np.linspace(0.1, 0.7, 8) * true.full_well_e
    means, variances = np.transpose([pair(level, wrong, 17 + k) for k, level in enumerate(levels)])
    assert abs(linregress(means, variances).slope / true.gain_dn_per_e - 1) > 0.04


def test_a_wrong_law_is_noticed():
    # control: one electron of background more or 5 % more read noise fails the chi-square
    counts = flat(0.0, Sensor(bits=12, background_e=201.0), 77, (400, 500))
    assert chi_square_p(counts, *law(Sensor(bits=12), 200.0)) < 1e-6
    counts = flat(0.0, Sensor(bits=12, read_noise_e=10.5), 77, (400, 500))
    assert chi_square_p(counts, *law(Sensor(bits=12), 200.0)) < 1e-6
