"""The sensor's terms, its response, and what ``expose`` promises of its bytes."""

import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.cameras.sensor.background_light import Ambient
from twin.cameras.sensor.readout import dark_table, expose
from twin.cameras.sensor.sensor import Sensor

TYPES = {8: np.uint8, 10: np.uint16, 12: np.uint16}
CHECK_SUMS = {8: 2119964089, 10: 3354042383, 12: 2757769116}


def test_the_terms_of_a_data_sheet():
    # by hand: 12 bit, black 4 x 16 = 64, K = (4095 - 64) / 10000
    sensor = Sensor(full_well_e=10_000.0, bits=12, quantum_efficiency=0.5)
    assert (sensor.top, sensor.black) == (4095, 64.0)
    assert sensor.gain_dn_per_e == pytest.approx(0.4031)
    assert sensor.electrons(2_000.0) == 1_000.0
    assert sensor.photons(1_000.0) == 2_000.0


@given(bits=st.sampled_from([8, 10, 12]), linearity=st.floats(-0.2, 0.2), full_well=st.floats(2_000.0, 200_000.0))
def test_edges_are_the_response_turned_round(bits, linearity, full_well):
    sensor = Sensor(bits=bits, linearity=linearity, full_well_e=full_well)
    edges = sensor.edges_e()
    assert len(edges) == sensor.top
    assert (np.diff(edges) > 0).all()
    response = edges - linearity * np.maximum(edges, 0.0) ** 2 / full_well
    counts = sensor.black + sensor.gain_dn_per_e * response
    np.testing.assert_allclose(counts, np.arange(sensor.top) + 0.5, rtol=1e-12, atol=1e-9)


def test_a_response_that_folds_back_is_refused():
    with pytest.raises(ValueError, match=r"linearity: 0\.3 given"):
        expose(np.zeros((8, 8), dtype=np.float32), Sensor(linearity=0.3), 1)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_same_arguments_same_bytes_for_ever(bits):
    # check sums of frames as they were first made: the bytes hang on neither machine, thread nor version
    sensor = Sensor(bits=bits, linearity=0.02)
    light = np.zeros((60, 83), dtype=np.float32)
    light[10:20, 30:60] = np.linspace(0, 22_000, 300).reshape(10, 30)
    image = expose(light, sensor, 2**63 + 11, Ambient.of(sensor, np.full((60, 83), 200.0) + np.arange(83)))
    assert image.dtype == TYPES[bits]
    assert zlib.crc32(image.tobytes()) == CHECK_SUMS[bits]


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (7, 9), (16, 16)])
def test_any_size_and_a_prefix_is_a_prefix(shape):
    # a pixel's number is its index in the row-major image: an image of one row more begins like the one without
    sensor = Sensor(bits=12)
    light = np.linspace(0, 300, shape[0] * shape[1], dtype=np.float32).reshape(shape)
    longer = np.vstack([light, light[:1] + 50])
    np.testing.assert_array_equal(expose(longer, sensor, 5)[: shape[0]], expose(light, sensor, 5))


def test_threads_make_the_same_bytes_in_any_order():
    # new levels, by eight threads at once, and then again one after the other
    sensor = Sensor(bits=12, read_noise_e=11.0)
    base = Ambient.of(sensor, 100.0, shape=(64, 64))
    light = np.zeros((64, 64), dtype=np.float32)
    light[3, 3] = 900.0

    def frame(k: int) -> bytes:
        return expose(light, sensor, k, base.with_extra(20.0 * k + np.arange(64.0)[:, None] * np.ones(64))).tobytes()

    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(frame, range(12)))
    assert together == [frame(k) for k in reversed(range(12))][::-1]


def test_light_saturates_and_never_wraps():
    for bits in (8, 10, 12):
        sensor = Sensor(bits=bits, linearity=0.2)
        for level in (3e4, 1e6, 1e30, np.inf):
            image = expose(np.full((8, 8), level, dtype=np.float32), sensor, 3)
            assert (image == sensor.top).all()


def test_more_light_never_gives_less():
    # the same random numbers: counts rise with the light, pixel by pixel
    sensor = Sensor(bits=12)
    images = [expose(np.full((50, 50), e, dtype=np.float32), sensor, 9).astype(int) for e in (1, 5, 60, 900, 901)]
    for less, more in pairwise(images):
        assert (more >= less).all()


def test_the_factor_is_on_the_light():
    # twice the light at half the factor is the same light, to the byte
    sensor = Sensor(bits=12)
    half = Ambient.of(sensor, 200.0, np.full((20, 20), 0.5))
    light = np.full((20, 20), 3_000.0, dtype=np.float32)
    np.testing.assert_array_equal(expose(2 * light, sensor, 4, half), expose(light, sensor, 4))


def test_what_does_not_go_together_is_refused():
    sensor = Sensor()
    light = np.zeros((10, 12), dtype=np.float32)
    with pytest.raises(ValueError, match="another sensor"):
        expose(light, sensor, 1, dark_table(replace(sensor, bits=12)))
    with pytest.raises(ValueError, match=r"\(10, 12\) given.*\(12, 10\)"):
        expose(light, sensor, 1, Ambient.of(sensor, np.full((12, 10), 5.0)))
