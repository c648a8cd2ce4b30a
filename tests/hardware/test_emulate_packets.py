"""Bytes on the wire against the standard's layout, computed independently."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.emulate import gige_vision, stream
from hardware.emulate.gige_vision import PIXEL_FORMATS, Refused

LAYOUT = stream.ImageLayout(PIXEL_FORMATS["Mono8"], 4, 3, 2, 1)


def test_a_small_image_byte_by_byte():
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    packets = [bytes(p) for p in stream.image_packets(0x1234, 0x0102030405060708, LAYOUT, pixels, 36 + 8)]
    leader = bytes.fromhex(
        "0000 1234 01000000"  # status, block, format leader, packet 0
        "0000 0001 0102030405060708"  # reserved, image, time
        "01080001 00000004 00000003 00000002 00000001 0000 0000"  # Mono8, 4 x 3 at 2, 1, no padding
    )
    assert packets == [
        leader,
        bytes.fromhex("0000 1234 03000001 0001020304050607"),
        bytes.fromhex("0000 1234 03000002 08090a0b"),
        bytes.fromhex("0000 1234 02000003 0000 0001 00000003"),
    ]


def test_two_byte_pixels_are_little_endian():
    layout = stream.ImageLayout(PIXEL_FORMATS["Mono12"], 2, 1)
    packets = stream.image_packets(1, 0, layout, np.array([[0x0ABC, 0x0102]], np.uint16), 1500)
    assert bytes(packets[1])[8:] == bytes.fromhex("bc0a 0201")


@given(st.integers(1, 40), st.integers(1, 40), st.integers(576, 2000), st.booleans())
def test_payloads_are_the_image(height, width, size, wide):
    kind = np.uint16 if wide else np.uint8
    pixels = np.random.default_rng([height, width]).integers(0, 250, (height, width), kind)
    layout = stream.ImageLayout(PIXEL_FORMATS["Mono16" if wide else "Mono8"], width, height)
    packets = [bytes(p) for p in stream.image_packets(7, 1, layout, pixels, size)]
    assert b"".join(p[8:] for p in packets[1:-1]) == pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
    assert [struct.unpack(">I", p[4:8])[0] & 0xFFFFFF for p in packets] == list(range(len(packets)))
    assert all(len(p) + 28 == size for p in packets[1:-2])
    assert all(len(p) + 28 <= size for p in packets)


def test_a_test_packet_is_as_large_as_asked_for():
    assert len(stream.probe(1500)) == 1500 - 28


@pytest.mark.parametrize("datagram", ["", "42", "41 01 0080 0004 0007 00000a00", "42 01 0002 0000 0000"])
def test_what_is_no_command_is_none(datagram):
    assert gige_vision.parse(bytes.fromhex(datagram)) is None


def test_scheduled_and_plain_actions():
    keys = bytes.fromhex("00000001 00000002 00000004")
    plain = gige_vision.action(gige_vision.GvcpCommand(1, 0x100, 1, keys))
    assert plain == gige_vision.ActionCommand(1, 2, 4, None)
    later = gige_vision.action(gige_vision.GvcpCommand(0x81, 0x100, 1, keys + bytes.fromhex("0000000100000002")))
    assert later.at_ns == (1 << 32) + 2
    with pytest.raises(Refused):
        gige_vision.action(gige_vision.GvcpCommand(0x81, 0x100, 1, keys))


def test_requests_for_packets():
    wanted = gige_vision.resend(bytes.fromhex("0000 00ff 00000003 ff000009"))
    assert wanted == gige_vision.ResendRequest(255, 3, 9)
