"""The twin's sensor measured as one measures a camera (EMVA 1288, release 4.0 linear), and against scipy's laws."""

from dataclasses import replace

import numpy as np
import pytest
from emva_bench import SHAPE, Grab, by_levels, by_targets, complaints, measure
from emva_law import chi_square_p, law
from scipy.stats import kstest, norm, poisson

from scenarios.fidelity.sensor import SHEETS
from twin.cameras.sensor.background_light import Ambient
from twin.cameras.sensor.level_lookup import level_bank
from twin.cameras.sensor.readout import dark_table, expose
from twin.cameras.sensor.sensor import Sensor
from witness.emva import Array, PhotonTransfer, linearity_error, spatial, temporal

LEAST_P = 1e-3
"""One test in a thousand would fail by chance; the seeds are fixed, so that none fails twice."""


def flat(level_e: float, sensor: Sensor, key: int, shape: tuple[int, int] = SHAPE) -> Array:
    """Return a flat field's counts as floats; ``level_e`` electrons of light a pixel."""
    return expose(np.full(shape, level_e, dtype=np.float32), sensor, key).astype(float)


@pytest.mark.parametrize("way", [by_levels, by_targets])
@pytest.mark.parametrize("bits", [8, 10, 12])
def test_the_bench_finds_what_the_data_sheet_says(bits, way):
    # limits in emva_bench: K 2 %, quantum efficiency 2 %, dark noise 5 %, saturation 5 %, linearity 0.1 %, DSNU 4 %
    # and 0.02 of the dark noise, PRNU 4 % and 0.04 %. Measured: K 0.8 %, dark noise 1.5 %, DSNU 1.0 %, PRNU 0.3 % off
    # at most (K spreads by 0.2 %), saturation 3.9 % low (where the variance peaks), linearity error 7e-5
    sheet = SHEETS[bits]
    assert complaints(measure(way(sheet), sheet.photons(sheet.full_well_e)), sheet) == []


def test_8_bits_hide_a_small_dark_noise():
    # the default camera at 8 bit: a dark noise of 0.13 DN does not even dither the rounding, so that the standard
    # allows only a bound, 0.40 / K, and K itself comes out 7 % too large (rounding noise sets in with the signal)
    sheet = Sensor()
    found = measure(by_levels(sheet), sheet.photons(sheet.full_well_e)).transfer
    assert not found.dark_noise_measurable
    assert found.dark_noise_e == pytest.approx(0.40 / found.gain, rel=0.02)
    assert found.dark_noise_e > sheet.read_noise_e
    assert 1.03 < found.gain / sheet.gain_dn_per_e < 1.10


def test_dark_noise_of_the_default_camera_at_12_bits():
    # no background, no patterns; both ways through the sensor. Measured: 0.3 % off at most, its spread
    for read_noise in (6.0, 10.0, 25.0):
        sheet = Sensor(bits=12, read_noise_e=read_noise)
        for way in (by_levels, by_targets):
            _mean, variance = temporal(way(sheet)(0.0, 1), way(sheet)(0.0, 2))
            assert np.sqrt(variance - 1 / 12) / sheet.gain_dn_per_e == pytest.approx(read_noise, rel=0.02)


@pytest.mark.parametrize("way", [by_levels, by_targets])
@pytest.mark.parametrize("linearity", [0.02, -0.03])
def test_linearity(linearity, way):
    # the standard's error of the curve itself: the response e - linearity e^2 / full well, no noise
    sheet = Sensor(bits=12, linearity=linearity)
    found = measure(way(sheet), sheet.photons(sheet.full_well_e * (1 + linearity))).transfer
    part = found._range(0.05, 0.95)
    electrons = 0.6 * found.photons[part]
    expected = linearity_error(electrons, electrons - linearity * electrons**2 / 20_000)
    assert found.linearity_error == pytest.approx(expected, rel=0.05)
    assert expected > 0.002


@pytest.mark.parametrize("way", [by_levels, by_targets])
def test_dark_current(way):
    # mean and variance of the dark rise with the exposure: both slopes are the dark current (section 3)
    sheet = Sensor(bits=12, dark_current_e_per_s=2_000.0)
    gain, times = sheet.gain_dn_per_e, np.array([0.0, 0.05, 0.1, 0.2, 0.4])
    pairs = [temporal(way(sheet, 3, t)(0.0, 2 * k), way(sheet, 3, t)(0.0, 2 * k + 1)) for k, t in enumerate(times)]
    mean, variance = np.transpose(pairs)
    assert np.polyfit(times, mean, 1)[0] / gain == pytest.approx(2_000.0, rel=0.01)
    assert np.polyfit(times, variance, 1)[0] / gain**2 == pytest.approx(2_000.0, rel=0.05)


def test_patterns_stay_while_noise_changes():
    # one pattern for all frames of a camera, another for another camera
    sheet = replace(SHEETS[12], read_noise_e=2.0)
    one, same, other = by_targets(sheet, 1), by_targets(sheet, 1), by_targets(sheet, 2)
    half = sheet.photons(10_000.0)
    means = [
        np.mean([grab(half, k + 40 * n) for k in range(IMAGES_APART)], axis=0)
        for n, grab in enumerate((one, same, other))
    ]
    correlation = np.corrcoef([m.ravel() for m in means])
    assert correlation[0, 1] > 0.85  # 100 e of pattern over 100 / sqrt(16) e of noise: 0.94
    assert abs(correlation[0, 2]) < 0.02


IMAGES_APART = 16


def wrong(**change: float) -> Grab:
    """Return a camera that deviates from its 12-bit data sheet."""
    return by_targets(replace(SHEETS[12], **change))


def noise_that_does_not_follow_the_signal(photons: float, frame: int) -> Array:
    """A camera whose noise is 100 e- at all levels."""
    electrons = 0.6 * photons + np.random.default_rng(frame).normal(0.0, 100.0, SHAPE)
    return np.clip(np.rint(64 + 4031 / 20_000 * electrons), 0, 4095)


def noise_that_stands_still(photons: float, frame: int) -> Array:
    """A camera with the same noise in all frames."""
    return by_targets(SHEETS[12])(photons, 1)


def a_pattern_drawn_for_each_frame(photons: float, frame: int) -> Array:
    """A camera whose PRNU and DSNU change from frame to frame."""
    return by_targets(SHEETS[12], frame)(photons, frame)


def rows_of_their_own(photons: float, frame: int) -> Array:
    """A camera whose rows differ by a quarter of its PRNU."""
    rows = np.random.default_rng(5).normal(1.0, 0.0025, (SHAPE[0], 1))
    return np.clip(64 + np.rint((by_targets(SHEETS[12])(photons, frame) - 64.0) * rows), 0, 4095)


CONTROLS = {
    "K 3 % too large": (wrong(full_well_e=20_000 / 1.03), "gain"),
    "K 3 % too small": (wrong(full_well_e=20_000 / 0.97), "gain"),
    "read noise 10 % too large": (wrong(read_noise_e=11.0), "dark noise"),
    "read noise 10 % too small": (wrong(read_noise_e=9.0), "dark noise"),
    "quantum efficiency 3 % too small": (wrong(quantum_efficiency=0.582), "quantum efficiency"),
    "bent by 1 %": (wrong(linearity=0.01), "linearity"),
    "DSNU 12 % too large": (wrong(dsnu_e=5.6), "DSNU"),
    "PRNU 12 % too large": (wrong(prnu=0.0112), "PRNU"),
    "noise that does not follow the signal": (noise_that_does_not_follow_the_signal, "gain"),
    "noise that stands still": (noise_that_stands_still, "temporal noise"),
    "a pattern drawn for each frame": (a_pattern_drawn_for_each_frame, "PRNU"),
    "rows of their own": (rows_of_their_own, "rows and columns"),
}


@pytest.mark.parametrize("name", CONTROLS)
def test_a_wrong_camera_is_noticed(name):
    camera, complaint = CONTROLS[name]
    sheet = SHEETS[12]
    assert complaint in complaints(measure(camera, sheet.photons(sheet.full_well_e)), sheet)


def test_the_standard_on_numbers_of_ones_own():
    # images made here with numpy: K = 0.5, rows 3, columns 2, pixels 4 DN rms, temporal 5 DN rms
    rng = np.random.default_rng(2)
    shape = (400, 500)
    pattern = rng.normal(0, 3, (400, 1)) + rng.normal(0, 2, (1, 500)) + rng.normal(0, 4, shape)
    found = spatial(np.stack([100 + pattern + rng.normal(0, 5, shape) for _ in range(8)]))
    assert np.sqrt([found.row, found.column, found.pixel]) == pytest.approx([3, 2, 4], rel=0.1)
    assert found.total == pytest.approx(29, rel=0.06)
    photons = np.linspace(0, 2000, 21)
    curve = PhotonTransfer(photons, 10 + 0.3 * photons, 2 + 0.15 * photons)
    assert curve.gain == pytest.approx(0.5)
    assert curve.quantum_efficiency == pytest.approx(0.6)
    assert curve.dark_noise_e == pytest.approx(np.sqrt(2 - 1 / 12) / 0.5)
    assert curve.saturation_e == pytest.approx(1200)
    assert curve.linearity_error < 1e-12


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_black_level_and_background(bits):
    # mean of the dark = black + K background; at 8 bit a spread of 0.22 DN hardly dithers the quantiser,
    # so that the mean of the exact distribution replaces the line
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
    # a full well (background included) is at the last count: half of the pixels reach it, none wraps
    full = flat(sensor.full_well_e - sensor.background_e, sensor, 4)
    spread = sensor.gain_dn_per_e * np.sqrt(sensor.full_well_e + sensor.read_noise_e**2)
    assert full.max() == top
    assert full.min() > top - 6 * spread - 1
    assert (full == top).mean() == pytest.approx(norm.cdf(0.5 / spread), abs=0.02)


SENSORS = [
    Sensor(bits=8),
    Sensor(bits=10),
    Sensor(bits=12),
    Sensor(bits=12, background_e=3.0, read_noise_e=2.0),
    Sensor(bits=12, background_e=0.5, read_noise_e=0.3, full_well_e=4000.0),
    Sensor(bits=8, background_e=0.0, black_dn=0.0),
    Sensor(bits=12, background_e=5000.0),
    Sensor(bits=10, background_e=9000.0, linearity=0.15),
    Sensor(bits=12, background_e=18_000.0, linearity=-0.1),
]


@pytest.mark.parametrize("light_e", [0.0, 1e-6], ids=["table", "drawn"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_dark_counts_follow_the_mixture(sensor, light_e):
    # pixels without light are tabulated, pixels with little are drawn: both have one distribution
    counts = flat(light_e, sensor, 77, (400, 500))
    pmf, first = law(sensor, sensor.background_e + light_e)
    assert chi_square_p(counts, pmf, first) > LEAST_P
    # four pixels share one random number: each of the four alone, and their sums, follow it too
    for lane in range(4):
        assert chi_square_p(counts.ravel()[lane::4], pmf, first) > LEAST_P / 10


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_levels_have_the_exact_law(bits):
    # probabilities of levels all over the range, by scipy: below 1e-12 apart (the bank counts in 2^-63)
    sensor = Sensor(bits=bits, dsnu_e=20.0, linearity=0.03)
    bank = level_bank(sensor, 200.0)
    for number in (0, 40, bank.anchor, bank.anchor + 300, len(bank.levels_e) - 60):
        pmf, first = law(sensor, float(bank.levels_e[number]))
        start, shares = bank.law(number)
        wanted = np.zeros(2**bits)
        wanted[first : first + len(pmf)] = pmf
        got = np.zeros(2**bits)
        got[start : start + len(shares)] = shares
        np.testing.assert_allclose(got, wanted, atol=2e-12)


@pytest.mark.parametrize("bits", [8, 12])
def test_each_level_of_uneven_light_follows_its_own_law(bits):
    # a gradient from 0 to 2,000 e- over the picture: all pixels of one level together
    sensor = Sensor(bits=bits, background_e=500.0)
    ambient = Ambient.of(sensor, np.broadcast_to(np.linspace(0, 2_000, 500), (400, 500)))
    counts = expose(np.zeros((400, 500), dtype=np.float32), sensor, 12, ambient)
    numbers = np.unique(ambient.index)
    assert len(numbers) > 100
    p = [
        chi_square_p(counts[ambient.index == k], *law(sensor, float(ambient.bank.levels_e[k])))
        for k in numbers[numbers > numbers[len(numbers) // 3]][::4]  # below, 8 bits give one count only
    ]
    assert min(p) > LEAST_P / len(p)
    assert kstest(p, "uniform").pvalue > LEAST_P


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


def test_a_wrong_law_is_noticed():
    # control: one electron of background more or 5 % more read noise fails the chi-square
    counts = flat(0.0, Sensor(bits=12, background_e=201.0), 77, (400, 500))
    assert chi_square_p(counts, *law(Sensor(bits=12), 200.0)) < 1e-6
    counts = flat(0.0, Sensor(bits=12, read_noise_e=10.5), 77, (400, 500))
    assert chi_square_p(counts, *law(Sensor(bits=12), 200.0)) < 1e-6
