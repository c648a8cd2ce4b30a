"""Ambient light: its map by hand, its levels, its changes from frame to frame."""

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from twin.cameras.sensor.background_light import Ambient, Backdrop, ambient_map
from twin.cameras.sensor.level_lookup import SPACING, LevelBank, level_bank
from twin.cameras.sensor.readout import dark_table, expose
from twin.cameras.sensor.sensor import Sensor

H, W = 120, 160


def light_of_pixels(light):
    """The light that the pixels really get, (H, W) or (1, 1) [electrons]."""
    return light.bank.levels_e[light.index]


def test_even_light_is_one_exact_level():
    sensor = Sensor(background_e=123.4)
    light = Ambient.of(sensor, *ambient_map(sensor, W, H, 1))
    assert light.index.shape == (1, 1)
    assert light.flat is None
    assert light_of_pixels(light)[0, 0] == 123.4
    none = np.zeros((H, W), dtype=np.float32)
    np.testing.assert_array_equal(expose(none, sensor, 7, light), expose(none, sensor, 7, dark_table(sensor)))
    # the same light as a map: the same level, the same bytes
    as_map = Ambient.of(sensor, np.full((H, W), 123.4))
    np.testing.assert_array_equal(expose(none, sensor, 7, as_map), expose(none, sensor, 7, light))


@given(
    mean=arrays(np.float64, (7, 9), elements=st.floats(-30.0, 60_000.0)),
    read_noise=st.floats(0.0, 60.0), dsnu=st.floats(0.0, 20.0), background=st.floats(0.0, 5_000.0),
)  # fmt: skip
@example(mean=np.zeros((7, 9)), read_noise=0.0, dsnu=0.075, background=0.0)  # four steps and a rounding error
@settings(deadline=None, max_examples=25)
def test_levels_are_near(mean, read_noise, dsnu, background):
    # half a spacing of the noise at the most, measured at the darker of the two, inside what the levels cover
    sensor = Sensor(read_noise_e=read_noise, dsnu_e=dsnu, background_e=background)
    bank = LevelBank(sensor, background)
    assert (np.diff(bank.levels_e) > 0).all()
    assert bank.levels_e[bank.anchor] == background
    level = bank.levels_e[bank.number(mean)]
    inside = (mean >= bank.levels_e[0]) & (mean <= bank.levels_e[-1])
    noise = np.sqrt(np.maximum(np.maximum(mean, level), 0.0) + max(read_noise, 1.0) ** 2)
    assert (np.abs(level - mean)[inside] <= 0.5 * 1.001 * SPACING * noise[inside] + 1e-6).all()
    assert (level[mean > bank.levels_e[-1]] == bank.levels_e[-1]).all()


def test_the_last_level_is_saturated_and_the_first_is_dark():
    for bits in (8, 10, 12):
        bank = level_bank(Sensor(bits=bits), 200.0)
        first, shares = bank.law(len(bank.levels_e) - 1)
        assert first + len(shares) - 1 == 2**bits - 1
        assert shares[-1] == 1.0
        assert bank.levels_e[0] == 0.0
        assert level_bank(Sensor(bits=bits), 200.0) is bank
    assert level_bank(Sensor(dsnu_e=5.0), 200.0).levels_e[0] == -40.0


def test_the_law_of_a_level_does_not_depend_on_those_made_before():
    # levels below 0 shift the edges of the counts; those above share what is computed for each edge
    sensor = Sensor(dsnu_e=5.0, read_noise_e=8.0)
    one, other = LevelBank(sensor, 200.0), LevelBank(sensor, 200.0)
    lowest = int(np.searchsorted(one.levels_e, 0.0, side="right"))
    one.make(np.arange(lowest))
    np.testing.assert_array_equal(one.law(lowest)[1], other.law(lowest)[1])


def test_gradient_and_blob_by_hand():
    sensor = Sensor(background_e=100.0)
    look = Backdrop(gradient=(0.4, -0.2), blob_e=50.0, blob_xy=(0.25, 0.5), blob_radius=0.1)
    mean, flat = ambient_map(sensor, W, H, 1, backdrop=look)
    assert flat is None
    x, y = 40, 60  # pixel centres lie half a pixel beyond: 0.253125, 0.504167 of the image
    far2 = (0.5 / 160) ** 2 + (0.5 / 160) ** 2
    expected = 100 * (1 + 0.4 * (40.5 / 160 - 0.5) - 0.2 * (60.5 / 120 - 0.5)) + 50 * np.exp(-far2 / 0.02)
    assert mean[y, x] == pytest.approx(expected, rel=1e-12)
    assert mean[5, 159] - mean[5, 140] == pytest.approx(100 * 0.4 * 19 / 160, abs=1e-6)  # far from the blob


def test_vignetting_takes_its_share_at_the_corner():
    # cos^4: at half the way to the corner 1 / (1 + tan^2 / 4)^2 with tan^2 = 1 / sqrt(0.6) - 1
    sensor = Sensor(background_e=100.0)
    mean, flat = ambient_map(sensor, 2001, 1501, 1, vignetting=0.4)
    assert flat[750, 1000] == pytest.approx(1.0, abs=1e-6)
    assert flat[0, 0] == pytest.approx(0.6, abs=1e-3)
    assert flat[375, 500] == pytest.approx((1 + (1 / np.sqrt(0.6) - 1) / 4) ** -2, abs=1e-3)
    np.testing.assert_allclose(mean, 100 * flat)


def test_dust_is_soft_and_within_its_loss():
    sensor = Sensor()
    look = Backdrop(dust=12, dust_loss=0.3, dust_radius_px=8.0)
    _mean, flat = ambient_map(sensor, W, H, 5, backdrop=look)
    assert flat.max() == 1.0
    assert 1 - 0.3 * 2 < flat.min() < 0.95
    assert 0.02 < (flat < 1).mean() < 12 * np.pi * 12**2 / (W * H)
    assert np.abs(np.diff(flat, axis=1)).max() < 0.1
    np.testing.assert_array_equal(flat, ambient_map(sensor, W, H, 5, backdrop=look).flat)
    assert (flat != ambient_map(sensor, W, H, 6, backdrop=look).flat).any()


def test_fixed_patterns_have_their_sizes():
    sensor = Sensor(background_e=500.0, dsnu_e=6.0, prnu=0.02, hot_pixels=0.002, hot_e=800.0, dead_pixels=0.001)
    mean, flat = ambient_map(sensor, 1000, 800, 3, exposure_s=0.01)
    dead = flat == 0
    assert dead.mean() == pytest.approx(0.001, rel=0.15)
    assert (mean[dead] == 0).all()
    own = mean - 500.0 * flat
    hot = own > 60
    assert hot.mean() == pytest.approx(0.002 * np.exp(-60 / 800), rel=0.1)
    assert own[hot].mean() - 60 == pytest.approx(800, rel=0.1)
    usual = ~dead & ~hot
    assert own[usual & (own < 30)].std() == pytest.approx(6.0, rel=0.01)
    assert flat[usual].std() == pytest.approx(0.02, rel=0.01)
    assert flat[usual].mean() == pytest.approx(1.0, abs=1e-4)
    assert abs(np.corrcoef(own[usual], flat[usual])[0, 1]) < 0.005
    # each trait draws on its own: without the others the PRNU is the same, for another camera it is not
    alone = ambient_map(Sensor(prnu=0.02), 1000, 800, 3).flat
    np.testing.assert_array_equal(alone[~dead], flat[~dead])
    assert abs(np.corrcoef(ambient_map(Sensor(prnu=0.02), 1000, 800, 4).flat.ravel(), alone.ravel())[0, 1]) < 0.005


def test_dark_current_grows_with_the_exposure_and_passes_no_lens():
    sensor = Sensor(background_e=0.0, dark_current_e_per_s=5_000.0)
    assert ambient_map(sensor, W, H, 1, exposure_s=0.02).mean_e == pytest.approx(100.0)
    mean, _flat = ambient_map(sensor, W, H, 1, exposure_s=0.02, vignetting=0.5)
    np.testing.assert_allclose(mean, 100.0)


def test_extra_light_is_as_if_it_had_been_there():
    # one level apart at most (float32 and the halves between two levels), nearly all the same
    sensor = Sensor(bits=12, prnu=0.02, dead_pixels=0.01)
    mean, flat = ambient_map(sensor, W, H, 8, vignetting=0.2)
    extra = np.random.default_rng(0).uniform(0, 500, (H, W))
    with_extra = Ambient.of(sensor, mean, flat).with_extra(extra)
    at_once = Ambient.of(sensor, mean + flat * extra, flat)
    apart = np.abs(with_extra.index.astype(int) - at_once.index)
    assert apart.max() <= 1
    assert (apart > 0).mean() < 1e-3
    assert (light_of_pixels(with_extra)[flat == 0] == 0).all()
    # nothing extra: the very levels of before; and the light without extra is kept
    np.testing.assert_array_equal(Ambient.of(sensor, mean, flat).with_extra(np.zeros((H, W))).index,
                                  Ambient.of(sensor, mean, flat).index)  # fmt: skip
    np.testing.assert_array_equal(with_extra.with_extra(extra).index, with_extra.index)


def test_one_number_more_for_all_pixels():
    sensor = Sensor()
    even = dark_table(sensor).with_extra(40.0)
    assert even.index.shape == (1, 1)
    assert light_of_pixels(even)[0, 0] == pytest.approx(240.0, abs=0.5 * SPACING * np.sqrt(340))
    spread = Ambient.of(sensor, np.full((H, W), 200.0)).with_extra(40.0)
    assert (spread.index == even.index[0, 0]).all()


def test_a_coarse_map_is_stretched_as_opencv_stretches():
    sensor = Sensor(bits=12, read_noise_e=1.0, background_e=0.0)
    coarse = np.random.default_rng(3).uniform(50, 400, (6, 8)).astype(np.float32)
    stretched = cv2.resize(coarse, (W, H), interpolation=cv2.INTER_LINEAR)
    got = light_of_pixels(Ambient.of(sensor, 0.0, shape=(H, W)).with_extra(coarse))
    assert np.abs(got - stretched).max() < 0.51 * SPACING * np.sqrt(401) + 0.05


def test_a_window_is_a_part_of_the_whole():
    sensor = Sensor(prnu=0.01, dsnu_e=3.0)
    whole = Ambient.of(sensor, *ambient_map(sensor, W, H, 8))
    part = whole.window(30, 20, 64, 40)
    np.testing.assert_array_equal(part.index, whole.index[20:60, 30:94])
    np.testing.assert_array_equal(part.flat, whole.flat[20:60, 30:94])
    extra = np.random.default_rng(0).uniform(0, 500, (H, W))
    np.testing.assert_array_equal(
        part.with_extra(extra[20:60, 30:94]).index, whole.with_extra(extra).index[20:60, 30:94]
    )
    assert dark_table(sensor).window(30, 20, 64, 40).shape == (40, 64)
    with pytest.raises(ValueError, match="leaves the image"):
        whole.window(100, 20, 64, 40)


def test_a_dead_pixel_shows_nothing_and_a_hot_one_glows():
    sensor = Sensor(bits=12, hot_pixels=0.01, hot_e=3_000.0, dead_pixels=0.01, read_noise_e=5.0)
    mean, flat = ambient_map(sensor, W, H, 2)
    light = np.full((H, W), 6_000.0, dtype=np.float32)
    image = expose(light, sensor, 1, Ambient.of(sensor, mean, flat))
    assert (image[flat == 0] < 64 + 6 * 5 * sensor.gain_dn_per_e + 1).all()
    dark = expose(0 * light, sensor, 1, Ambient.of(sensor, mean, flat))
    assert (dark[mean > 2_000] > 64 + 300).all()


def test_mistakes_are_named():
    sensor = Sensor()
    with pytest.raises(ValueError, match="mean_e: -1"):
        Ambient.of(sensor, -1.0)
    with pytest.raises(ValueError, match=r"flat: shape \(3, 4\) given"):
        Ambient.of(sensor, np.full((4, 3), 5.0), np.ones((3, 4)))
    with pytest.raises(ValueError, match=r"extra_e: shape \(5, 3\) given, \(4, 3\) at most"):
        Ambient.of(sensor, np.full((4, 3), 5.0)).with_extra(np.zeros((5, 3)))
