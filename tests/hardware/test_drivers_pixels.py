"""Unpacking and the mono rule, against bit strings written out, other libraries' tables, and OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from needs import needs_module

from hardware.drivers.blocks import PERIOD, BlockIds
from hardware.drivers.pixels import FORMATS, bayer_to_mono, luma, whole_image
from mosca.data.arrays import Array

MOSAICS = {"GR": "GRBG", "RG": "RGGB", "GB": "GBRG", "BG": "BGGR"}


def packed(values: list[int], name: str) -> bytes:
    """Write pixels as the standards draw them: bit by bit."""
    if name.endswith("p"):
        # PFNC: all bits of all pixels in one row, least significant first, cut into bytes
        bits = "".join(format(value, f"0{FORMATS[name].bits}b")[::-1] for value in values)
        bits += "0" * (-len(bits) % 8)
        return bytes(int(bits[k : k + 8][::-1], 2) for k in range(0, len(bits), 8))
    if name.endswith("Packed"):
        # GigE Vision: high 8 bits of the first, a byte of both pixels' low bits, high 8 bits of the second
        low_bits = FORMATS[name].bits - 8
        out = bytearray()
        for first, second in zip(values[::2], [*values[1::2], 0], strict=False):
            low = (first & (2**low_bits - 1)) | (second & (2**low_bits - 1)) << 4
            out += bytes((first >> low_bits, low, second >> low_bits))
        return bytes(out)
    return np.array(values, "<u2").tobytes()


@pytest.mark.parametrize("name", ["Mono10p", "Mono12p", "Mono10Packed", "Mono12Packed", "Mono12", "Mono16"])
@given(data=st.data())
def test_packed_pixels_are_unpacked(name: str, data: st.DataObject) -> None:
    width = data.draw(st.integers(1, 13))
    height = data.draw(st.integers(1, 5))
    top = 2 ** FORMATS[name].bits - 1
    values = data.draw(st.lists(st.integers(0, top), min_size=width * height, max_size=width * height))
    buffer = np.frombuffer(packed(values, name), np.uint8)
    image, note = whole_image(buffer, FORMATS[name].code, width, height)
    assert note == ""
    assert image is not None
    assert image.dtype == np.uint16
    assert image.tolist() == np.reshape(values, (height, width)).tolist()


def test_a_pixel_by_hand() -> None:
    # 0xABC and 0x123 as Mono12p, and as Mono12Packed
    for name, buffer in (("Mono12p", b"\xbc\x3a\x12"), ("Mono12Packed", b"\xab\x3c\x12")):
        image, _ = whole_image(np.frombuffer(buffer, np.uint8), FORMATS[name].code, 2, 1)
        assert image is not None
        assert image.tolist() == [[0xABC, 0x123]]


@pytest.mark.parametrize("name", ["Mono8", "Mono12", "Mono12p", "RGB8"])
def test_lines_may_have_padding(name: str) -> None:
    rng = np.random.default_rng(5)
    line = 6 * FORMATS[name].bits_in_memory // 8
    plain = rng.integers(0, 256, (4, line), dtype=np.uint8)
    padded = np.pad(plain, ((0, 0), (0, 3)), constant_values=77).ravel()
    expected, _ = whole_image(plain.ravel(), FORMATS[name].code, 6, 4)
    # some devices leave the last line's padding out
    for buffer in (padded, padded[:-3]):
        image, note = whole_image(buffer, FORMATS[name].code, 6, 4, line_padding=3)
        assert note == ""
        assert np.array_equal(image, expected)


def test_the_codes_are_the_conventions() -> None:
    needs_module("harvesters.core", "gentl")
    pfnc = needs_module("harvesters.util.pfnc", "gentl")
    checked = 0
    for name, pixel_format in FORMATS.items():
        if name in pfnc.dict_by_names:
            assert pfnc.dict_by_names[name] == pixel_format.code, name
            checked += 1
    assert checked >= 40


def test_what_is_not_whole_is_no_image() -> None:
    buffer = np.zeros(99, np.uint8)
    assert whole_image(buffer, FORMATS["Mono8"].code, 10, 10) == (None, "SIZE_MISMATCH 99 of 100 bytes")
    assert whole_image(buffer, 0x01080099, 3, 3) == (None, "PIXEL_FORMAT_UNKNOWN 0x01080099")


@pytest.mark.parametrize("name", ["Mono8", "Mono16", "Mono12p", "RGB8", "BayerRG8", "YUV422_8"])
def test_the_image_is_nobody_elses(name: str) -> None:
    buffer = np.full(400, 9, np.uint8)
    image, _ = whole_image(buffer, FORMATS[name].code, 10, 10)
    assert image is not None
    before = image.copy()
    buffer[:] = 200
    assert np.array_equal(image, before)


@given(mosaic=hnp.arrays(np.uint16, st.tuples(st.integers(2, 9), st.integers(2, 9)), elements=st.integers(0, 4095)))
def test_bayer_is_the_weighted_mean_of_nine(mosaic: Array) -> None:
    # OpenCV's filter with the same kernel and border, in floating point
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16.0
    expected = cv2.filter2D(mosaic.astype(np.float64), -1, kernel, borderType=cv2.BORDER_REFLECT_101)
    assert np.array_equal(bayer_to_mono(mosaic, 12), np.floor(expected + 0.5))
    deep = mosaic * np.uint16(16)
    assert np.abs(bayer_to_mono(deep, 16) - 16.0 * expected).max() <= 0.5


@pytest.mark.parametrize("colours", sorted(MOSAICS))
def test_bayer_weighs_colours_alike_at_every_place_and_border(colours: str) -> None:
    # one colour of light fills its own pixels of the mosaic
    places = np.array(list(MOSAICS[colours])).reshape(2, 2)
    for colour, weight in (("R", 0.25), ("G", 0.5), ("B", 0.25)):
        mosaic = np.tile(np.where(places == colour, 200, 0).astype(np.uint8), (4, 5))
        image, _ = whole_image(mosaic.ravel(), FORMATS[f"Bayer{colours}8"].code, 10, 8)
        assert np.array_equal(image, np.full((8, 10), 200 * weight))


def test_bayer_keeps_the_centroid_of_a_marker() -> None:
    rows, columns = np.mgrid[0:40, 0:50].astype(float)
    for place in ((18.3, 22.7), (19.0, 23.5), (20.6, 21.1)):
        blob = 3800.0 * np.exp(-((rows - place[0]) ** 2 + (columns - place[1]) ** 2) / (2 * 2.0**2))
        raw = np.round(blob).astype(np.uint16)
        mono = bayer_to_mono(raw, 12).astype(float)
        for axis in (rows, columns):
            before = (axis * raw).sum() / raw.sum()
            after = (axis * mono).sum() / mono.sum()
            # rounding of the counts is all that is left; a mean over 2 x 2 would move it by 0.5
            assert after == pytest.approx(before, abs=2e-3)


@given(colours=hnp.arrays(np.uint8, (7, 5, 3)))
def test_luma_is_opencvs(colours: Array) -> None:
    expected = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)
    assert np.array_equal(luma(*np.moveaxis(colours, 2, 0)), expected)
    image, _ = whole_image(colours.ravel(), FORMATS["RGB8"].code, 5, 7)
    assert np.array_equal(image, expected)
    image, _ = whole_image(np.ascontiguousarray(colours[..., ::-1]).ravel(), FORMATS["BGR8"].code, 5, 7)
    assert np.array_equal(image, expected)
    alpha = np.dstack((colours, np.full((7, 5), 33, np.uint8)))
    image, _ = whole_image(alpha.ravel(), FORMATS["RGBa8"].code, 5, 7)
    assert np.array_equal(image, expected)


def test_grey_stays_as_it_was_and_yuv_gives_its_y() -> None:
    grey = np.arange(256, dtype=np.uint8)
    assert np.array_equal(luma(grey, grey, grey), grey)
    buffer = np.array([10, 1, 20, 2, 30, 3, 40, 4], np.uint8)
    for name, expected in (("YUV422_8", [10, 20, 30, 40]), ("YUV422_8_UYVY", [1, 2, 3, 4])):
        image, _ = whole_image(buffer, FORMATS[name].code, 4, 1)
        assert image is not None
        assert image.tolist() == [expected]


@given(first=st.integers(1, PERIOD), steps=st.lists(st.integers(1, 2000), max_size=200))
def test_sixteen_bit_block_ids_are_unwrapped(first: int, steps: list[int]) -> None:
    ids, true = BlockIds(), first
    assert ids.unwrapped(first) == first
    for step in steps:
        true += step
        # counts 1 to 65535, then 1 again
        assert ids.unwrapped((true - 1) % PERIOD + 1) == true


def test_block_ids_that_do_not_wrap() -> None:
    ids = BlockIds()
    assert [ids.unwrapped(raw) for raw in (65534, 65535, 1, 65535, 2)] == [65534, 65535, 65536, 65535, 65537]
    # a device that begins anew is left to who groups the frames
    again = BlockIds()
    assert [again.unwrapped(raw) for raw in (1, 2, 500, 1, 2)] == [1, 2, 500, 1, 2]
    # 64-bit ids, from 0
    wide = BlockIds()
    assert [wide.unwrapped(raw) for raw in (0, 65535, 65536, 200000)] == [0, 65535, 65536, 200000]
