"""Messages between stations: the documented layout, there and back bit for bit, and any other bytes refused."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.transport.messages import (
    DetectionMessage,
    HealthMessage,
    MessageError,
    StationCamera,
    pack_clock,
    pack_detections,
    pack_health,
    unpack_clock,
    unpack_detections,
    unpack_health,
)
from mosca.data.detections import MERGED, SATURATED, Detections


def detections(camera, n, seed=0):
    rng = np.random.default_rng(seed)
    covariance = rng.normal(size=(n, 2, 2))
    covariance = covariance @ covariance.transpose(0, 2, 1)
    covariance[:, 1, 0] = covariance[:, 0, 1]
    flags = rng.integers(0, 16, n).astype(np.uint8)
    return Detections(
        camera, rng.normal(size=(n, 2)), covariance, *rng.random((3, n)), flags, rng.random(n),
        rng.normal(size=(n, 2)), rng.random(n),
    )  # fmt: skip


def message(camera="left", n=3, **changed):
    fields = {
        "station": "A", "epoch": 2**63 + 5, "sequence": 7, "pulse": -2, "time_ns": 20_400_000, "exposure_ns": 800_000,
        "arrival_ns": 10**15 + 1, "sent_ns": 10**15 + 2, "status": "detected", "detections": detections(camera, n),
    }  # fmt: skip
    return DetectionMessage(**(fields | changed))


SCALARS = ("station", "epoch", "sequence", "pulse", "time_ns", "exposure_ns", "arrival_ns", "sent_ns", "status")
COLUMNS = (
    "xy_px", "covariance_px2", "diameter_px", "peak", "elongation", "flags", "diameter_sigma_px", "ellipticity",
    "ellipticity_sigma",
)  # fmt: skip


@given(st.integers(0, 40), st.text(min_size=1, max_size=30), st.integers(0, 2**32), st.integers(-(2**63), 2**63 - 1))
def test_there_and_back_bit_for_bit(n, camera, seed, pulse):
    sent = message(camera, pulse=pulse, detections=detections(camera, n, seed))
    got = unpack_detections(pack_detections(sent))
    assert [getattr(got, k) for k in SCALARS] == [getattr(sent, k) for k in SCALARS]
    assert got.detections.camera == camera
    for name in COLUMNS:
        a, b = getattr(got.detections, name), getattr(sent.detections, name)
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()
        assert not a.flags.writeable


def test_the_layout_is_the_documented_one():
    found = Detections(
        "le",
        [[1.5, 2.5], [3.0, 4.0]],
        [[[0.1, 0.2], [0.2, 0.3]], [[0.4, 0.5], [0.5, 0.6]]],
        [5.0, 6.0],
        [200.0, 255.0],
        [1.0, 1.25],
        [SATURATED, MERGED],
        [0.5, 0.75],
        [[0.125, -0.25], [0.0, 0.375]],
        [0.0625, 0.03125],
    )
    data = pack_detections(message(detections=found, station="AB"))
    assert data[:8] == b"MO\x03\x01\x00\x02\x02\x00"
    assert struct.unpack_from("<QQqqqqqQQ", data, 8) == (
        2**63 + 5, 7, -2, 20_400_000, 800_000, 10**15 + 1, 10**15 + 2, 2, len(data),
    )  # fmt: skip
    assert data[80:88] == b"ABle\0\0\0\0"
    assert struct.unpack_from("<24d", data, 88) == (
        1.5, 2.5, 3.0, 4.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 5.0, 6.0, 200.0, 255.0, 1.0, 1.25, 0.5, 0.75,
        0.125, -0.25, 0.0, 0.375, 0.0625, 0.03125,
    )  # fmt: skip
    assert data[280:] == b"\x01\x02"


def test_an_absent_frame_is_said():
    got = unpack_detections(pack_detections(message(status="corrupt", detections=Detections.none("left"))))
    assert (got.status, len(got.detections)) == ("corrupt", 0)


def refused(unpack, data):
    """Return the line by which ``data`` is refused, "" where it is a message."""
    try:
        unpack(data)
    except MessageError as error:
        return str(error)
    return ""


@given(st.binary(max_size=300))
def test_any_bytes_are_refused_in_one_line(data):
    assert refused(unpack_detections, data)
    assert all("\n" not in refused(unpack, data) for unpack in (unpack_detections, unpack_health, unpack_clock))


@given(st.integers(0, 300), st.integers(0, 255))
def test_a_changed_byte_is_a_message_or_an_error(place, value):
    data = bytearray(pack_detections(message()))
    data[place % len(data)] = value
    assert "\n" not in refused(unpack_detections, bytes(data))


@given(st.integers(0, 400))
def test_a_short_message_is_refused(length):
    data = pack_detections(message())
    with pytest.raises(MessageError):
        unpack_detections(data[: length % len(data)])


def test_another_version_says_what_to_do():
    data = bytearray(pack_detections(message()))
    data[2] = 4
    with pytest.raises(MessageError, match=r"version 4, this is version 3; install the same on all PCs"):
        unpack_detections(bytes(data))


def test_numbers_that_are_none_are_refused():
    bad = Detections("left", [[np.nan, 1.0]], np.eye(2)[None], [1.0], [1.0], [1.0])
    with pytest.raises(MessageError, match="not finite"):
        unpack_detections(pack_detections(message(detections=bad)))


def test_health_there_and_back_and_as_json():
    cameras = (StationCamera("left", 656, 491, 8, 100.0, 12),)
    sent = HealthMessage("A", 2**63 - 1, 5, "running", cameras, 1, 2, ("camera 'left': silent",))
    data = pack_health(sent)
    assert unpack_health(data) == sent
    assert json.loads(data[4:])["cameras"][0]["sent"] == 12
    # a later version may add fields
    more = data[:4] + json.dumps(json.loads(data[4:]) | {"temperature": 40}).encode()
    assert unpack_health(more) == sent


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)
    )
)
def test_any_json_is_health_or_refused(document):
    with pytest.raises(MessageError):
        unpack_health(b"MO\x01\x02" + json.dumps(document).encode())


def test_clock_there_and_back():
    assert unpack_clock(pack_clock(2**64 - 1, -5)) == (2**64 - 1, -5)
