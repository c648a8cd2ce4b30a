"""Sensor parameters against sensors written here in plain numpy by the EMVA 1288 law; lost frames against counts."""

import numpy as np
import pytest

from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate, root, weighted_mean
from mosca.accuracy.lab_twin.frame_losses import arrived, loss_estimates
from mosca.accuracy.lab_twin.photon_transfer import normal_from_rounded, sensor_estimates, temporal_share
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics

SHAPE = (120, 160)


def images(light_e, *, bits=12, well=11_000.0, read=7.0, black_dn=4.0, n=16, pattern=None, flicker=0.0, seed=0):
    """Return sums of n images of even light [e-] on a sensor by the EMVA law."""
    random = np.random.default_rng(seed)
    black, top = black_dn * 2 ** (bits - 8), 2**bits - 1
    gain = (top - black) / well
    factor, dark = (1.0, 0.0) if pattern is None else pattern
    sums = PixelStatistics(*SHAPE, bits)
    for _ in range(n):
        lamp = 1.0 + flicker * random.standard_normal()
        electrons = random.poisson(light_e * lamp * factor * np.ones(SHAPE)) + dark
        value = np.floor(black + gain * (electrons + read * random.standard_normal(SHAPE)) + 0.5)
        sums.add(np.clip(value, 0, top).astype(np.uint16))
    return sums


def pattern(prnu=0.012, dsnu=4.0, seed=7):
    random = np.random.default_rng(seed)
    return 1.0 + prnu * random.standard_normal(SHAPE), dsnu * random.standard_normal(SHAPE)


def by_key(told):
    return {one.key: one for one in told}


def test_all_of_a_sensor_comes_back():
    fixed = pattern()
    dark = images(0.0, pattern=fixed, seed=1)
    lit = [images(light, pattern=fixed, seed=light) for light in (3000, 6500)]
    told = by_key(sensor_estimates("a", dark, lit))
    # the planted pattern has no shot noise of its own, which the estimate takes away: dsnu / sqrt(2 pi) e-^2
    read = np.sqrt(7.0**2 - 4.0 / np.sqrt(2.0 * np.pi))
    truth = {
        "errors.full_well_e": 11_000.0, "errors.read_noise_e": read, "sensor.black_dn": 4.0,
        "sensor.dsnu_e": 4.0, "sensor.prnu": 0.012,
    }  # fmt: skip
    for key, value in truth.items():
        one = told[key]
        assert abs(one.value - value) < 4.0 * one.sigma + 0.01 * value * (key == "sensor.dsnu_e"), (key, one)
        assert one.sigma < 0.02 * value
    assert told["sensor.hot_pixels"].value == told["sensor.dead_pixels"].value == 0.0


def test_a_lamp_that_flickers_is_no_photon_noise():
    dark, lit = images(0.0, seed=1), [images(5000.0, flicker=0.01, n=40, seed=2)]
    one = by_key(sensor_estimates("a", dark, lit))["errors.full_well_e"]
    assert abs(one.value - 11_000.0) < 4.0 * one.sigma


def test_twice_the_noise_is_seen():
    quiet, loud = (
        by_key(sensor_estimates("a", images(0.0, read=r, seed=4), [images(5000.0, read=r, seed=3)]))
        for r in (7.0, 14.0)
    )
    ratio = loud["errors.read_noise_e"].value / quiet["errors.read_noise_e"].value
    assert ratio == pytest.approx(2.0, rel=0.02)


def test_noise_below_rounding_by_the_normal_law():
    """At 8 bits 10 e- are 0.13 DN: one grey value in 15,000 is not the black level's."""
    dark, lit = images(0.0, bits=8, well=20_000.0, read=10.0, n=40, seed=5), [
        images(9000.0, bits=8, well=20_000.0, read=10.0, n=40, seed=6)
    ]  # fmt: skip
    told = by_key(sensor_estimates("a", dark, lit))
    one = told["errors.read_noise_e"]
    assert abs(one.value - 10.0) < 4.0 * one.sigma
    assert "normal law" in one.evidence
    assert isinstance(told["sensor.dsnu_e"], NotTold)
    values = np.rint(np.random.default_rng(8).normal(4.2, 0.3, 100_000)).astype(int)
    mean, sigma, own = normal_from_rounded(np.bincount(values, minlength=9))
    assert abs(mean - 4.2) < 0.02
    assert abs(sigma - 0.3) < 5.0 * own < 0.02


def test_noise_and_pattern_below_rounding_are_told_apart():
    """At 8 bits 24 e- of noise are 0.3 DN, 14 e- of DSNU 0.17: both make grey values, only noise changes them."""
    fixed = pattern(prnu=0.006, dsnu=14.0)
    form = {"bits": 8, "well": 20_000.0, "read": 24.0, "pattern": fixed}
    lit = [images(light, seed=light, **form) for light in (6000, 12_000)]
    told = by_key(sensor_estimates("a", images(0.0, n=24, seed=1, **form), lit))
    read = np.sqrt(24.0**2 - 14.0 / np.sqrt(2.0 * np.pi))
    truth = {"errors.full_well_e": 20_000.0, "errors.read_noise_e": read, "sensor.dsnu_e": 14.0, "sensor.prnu": 0.006}
    for key, value in truth.items():
        assert abs(told[key].value - value) < 3.5 * told[key].sigma < 0.08 * value, told[key]
    assert "normal law" in told["sensor.dsnu_e"].evidence


def test_the_temporal_share_of_rounded_values():
    """Against 200,000 pixels, each with its own offset; without offsets all is temporal, without noise nothing is."""
    random = np.random.default_rng(12)
    offset, noise = random.standard_normal(200_000), random.standard_normal((8, 200_000))
    for share in (1.0, 0.7, 0.3, 0.0):
        values = np.rint(5.3 + 0.4 * (np.sqrt(1.0 - share) * offset + np.sqrt(share) * noise))
        found = temporal_share(5.3, 0.4, float(values.var(axis=0, ddof=1).mean()))
        assert found == pytest.approx(share, abs=0.01)


def test_hot_and_dead_pixels_are_counted_and_left_out():
    factor, dark = pattern(dsnu=2.0)
    dark[5, 5:15] = 400.0
    factor[80, 20:40] = 0.0
    sums = images(0.0, pattern=(factor, dark), seed=9)
    told = by_key(sensor_estimates("a", sums, [images(6000.0, pattern=(factor, dark), seed=10)]))
    assert told["sensor.hot_pixels"].value * factor.size == pytest.approx(10)
    assert told["sensor.dead_pixels"].value * factor.size == pytest.approx(20)
    assert told["sensor.dsnu_e"].value == pytest.approx(2.0, rel=0.05)
    assert told["sensor.prnu"].value == pytest.approx(0.012, rel=0.05)


def test_what_lacks_is_named():
    none = by_key(sensor_estimates("a", None, [images(5000.0)]))
    assert "dark recording" in none["errors.read_noise_e"].reason
    assert "dark recording" in none["sensor.black_dn"].reason
    unlit = by_key(sensor_estimates("a", images(0.0), []))
    assert isinstance(unlit["sensor.black_dn"], ParameterEstimate)
    assert "lit recording" in unlit["errors.full_well_e"].reason
    # so bright that it saturates: no gain, but the saturation level
    bright = by_key(sensor_estimates("a", images(0.0), [images(30_000.0)]))
    assert "not saturated" in bright["errors.full_well_e"].reason
    assert bright["saturation_dn"].value == 4095
    # too dark to rise above the dark noise
    dim = by_key(sensor_estimates("a", images(0.0), [images(20.0, seed=2)]))
    assert "bright" in dim["errors.full_well_e"].reason


def test_losses_one_by_one_and_in_bursts():
    random = np.random.default_rng(11)
    single = set(np.flatnonzero(random.random(4000) > 0.02).tolist()) | {0, 3999}
    begins = np.flatnonzero(random.random(4000) < 0.004)
    hit = {int(b) + j for b in begins for j in range(5)}
    burst = set(range(4000)) - hit | {0, 3999}
    every = {"one": single, "burst": burst}
    there = arrived(every, {"one": {7}, "burst": set()})
    alone = by_key(loss_estimates("one", [there["one"]]))
    share = alone["delivery.dropped_share"]
    assert share.value == pytest.approx(1.0 - len(single) / 4000, abs=0.001)
    assert abs(share.value - 0.02) < 3.0 * share.sigma
    together = by_key(loss_estimates("burst", [there["burst"]]))
    assert together["delivery.burst_frames"].value == pytest.approx(5, abs=1)
    assert together["delivery.burst_share"].value == pytest.approx(1.0 - len(burst) / 4000)
    assert together["delivery.dropped_share"].value == 0.0


def test_means_and_roots():
    # closed forms: inverse-variance weights, and Birge's ratio of measurements that differ too much
    mean, sigma = weighted_mean([1.0, 3.0], [1.0, 2.0])
    assert mean == pytest.approx(1.4)
    assert sigma == pytest.approx(np.sqrt(0.8))
    assert weighted_mean([0.0, 10.0], [1.0, 1.0])[1] == pytest.approx(np.sqrt(0.5) * np.sqrt(50.0))
    assert root(4.0, 0.4) == pytest.approx((2.0, 0.1))
    assert root(-1.0, 0.25) == pytest.approx((0.0, 0.5))
