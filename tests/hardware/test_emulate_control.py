"""The control channel over the network, spoken to byte by byte; whatever comes, the device lives on."""

import struct
import time

import numpy as np
import pytest
from array_source import ArraySource
from hypothesis import given, settings
from hypothesis import strategies as st
from loopback import Hand, free_address, until

from hardware.emulate.faults import Faults
from hardware.emulate.serve import Served, served
from mosca.errors import InputError

CCP, HEARTBEAT, VERSION, SCP, SCPS, SCDA = 0xA00, 0x938, 0x0, 0xD00, 0xD04, 0xD18
CONTROL, EXCLUSIVE = 2, 1
PATIENT_MS = 600_000
"""A heartbeat that no pause of this machine outlasts."""


@pytest.fixture
def up():
    with served(ArraySource(1, 8), first_address=free_address()) as found:
        yield found


@pytest.fixture
def hands(up):
    made = [Hand(str(up.devices[0].identity.address.ip)) for _ in range(2)]
    yield made
    for hand in made:
        hand.close()


def in_control(hand: Hand) -> None:
    assert hand.write(CCP, CONTROL) == 0
    assert hand.write(HEARTBEAT, PATIENT_MS) == 0


def address_of(up: Served, name: str) -> int:
    return up.devices[0].camera.registers.named(name).address


def test_discovery_says_who_it_is(up, hands):
    status, payload = hands[0].ask(0x02)
    assert (status, len(payload)) == (0, 0xF8)
    assert payload[0xD8:0xE8].rstrip(b"\0").decode() == f"TWIN{payload[0x24:0x28].hex().upper()}"
    assert payload[0x48:0x68].rstrip(b"\0") == b"Mosca"
    assert ".".join(map(str, payload[0x24:0x28])) == str(up.devices[0].identity.address.ip)


@pytest.mark.parametrize("everyone", ["255.255.255.255", "127.255.255.255"])
def test_a_broadcast_is_answered_by_each(up, everyone):
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        asker.bind(("127.0.0.1", 0))
        asker.settimeout(60.0)
        asker.sendto(struct.pack(">BBHHH", 0x42, 0x11, 2, 0, 1), (everyone, 3956))
        while asker.recvfrom(2048)[1][0] != str(up.devices[0].identity.address.ip):
            pass  # cameras of other tests answer too


def test_registers_can_be_read_together(hands):
    status, payload = hands[0].ask(0x80, struct.pack(">III", VERSION, 0x4, HEARTBEAT))
    assert (status, struct.unpack(">III", payload)) == (0, (0x00020000, 0x80000001, 3000))


def test_a_reading_that_fails_tells_what_was_read_before(hands):
    status, payload = hands[0].ask(0x80, struct.pack(">II", VERSION, 0x7000))
    assert (status, payload) == (0x8003, bytes.fromhex("00020000"))


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (0x04, b"", 0x8001),  # FORCEIP is not there
        (0x66, b"", 0x8001),
        (0x80, b"abc", 0x8002),
        (0x80, b"", 0x8002),
        (0x84, struct.pack(">IHH", 1, 0, 4), 0x8005),
        (0x84, struct.pack(">IHH", 0, 0, 3), 0x8005),
        (0x84, struct.pack(">IHH", 0, 0, 540), 0x8002),
        (0x84, b"ab", 0x8002),
        (0x86, struct.pack(">II", HEARTBEAT, 4000), 0x8006),
        (0x86, b"", 0x8002),
    ],
)
def test_errors_have_the_standards_status(hands, command, payload, status):
    assert hands[0].ask(command, payload)[0] == status


def test_a_wrong_length_is_told(hands):
    hands[0].send(bytes.fromhex("42 01 0080 0008 0009 00000000"))
    assert hands[0].receive() == bytes.fromhex("800e 0000 0000 0009")


def test_only_the_one_in_control_writes(hands):
    one, two = hands
    assert one.write(HEARTBEAT, PATIENT_MS) == 0x8006
    assert one.write(CCP, CONTROL) == 0
    assert one.write(HEARTBEAT, PATIENT_MS) == 0
    assert two.read(HEARTBEAT) == PATIENT_MS
    assert two.write(HEARTBEAT, 3000) == 0x8006
    assert two.write(CCP, CONTROL) == 0x8006
    assert two.read(CCP) == CONTROL
    assert one.write(CCP, 0) == 0
    assert two.write(CCP, CONTROL) == 0
    assert two.write(VERSION, 1) == 0x8004
    assert two.write(0x7000, 1) == 0x8003


def test_exclusive_access_keeps_others_from_reading(hands):
    one, two = hands
    assert one.write(CCP, EXCLUSIVE) == 0
    assert two.ask(0x80, struct.pack(">I", HEARTBEAT))[0] == 0x8006
    assert two.ask(0x84, struct.pack(">IHH", 0x48, 0, 32))[0] == 0x8006
    assert two.read(CCP) == EXCLUSIVE
    assert two.ask(0x02)[0] == 0


def test_a_write_of_several_tells_how_far_it_came(hands):
    hands[0].write(CCP, CONTROL)
    writes = (HEARTBEAT, PATIENT_MS + 1, VERSION, 1, HEARTBEAT, PATIENT_MS)
    status, payload = hands[0].ask(0x82, struct.pack(">IIIIII", *writes))
    assert (status, payload) == (0x8004, bytes.fromhex("0000 0001"))
    assert hands[0].read(HEARTBEAT) == PATIENT_MS + 1


class Ahead:
    """Replaces the module ``time``: this machine's clock plus an offset."""

    def __init__(self) -> None:
        self.by_s = 0

    def monotonic_ns(self) -> int:
        return time.monotonic_ns() + self.by_s * 10**9


def test_control_is_lost_with_the_heartbeat(up, hands, monkeypatch):
    one, two = hands
    ahead = Ahead()
    monkeypatch.setattr("hardware.emulate.control.time", ahead)
    one.write(CCP, CONTROL)
    assert one.write(HEARTBEAT, 300_000) == 0
    one.write(SCP, 4000)
    one.write(address_of(up, "AcquisitionStart"), 1)
    for _ in range(4):  # any command is a sign of life
        ahead.by_s += 200
        one.read(VERSION)
    assert up.devices[0].camera.armed
    ahead.by_s += 301
    until(lambda: two.read(CCP) == 0)
    assert two.read(SCP) == 0
    assert not up.devices[0].camera.armed
    assert one.write(HEARTBEAT, 500) == 0x8006


def test_an_answer_that_was_lost_is_given_again_without_doing_it_twice(up, hands):
    one = hands[0]
    in_control(one)
    datagram = struct.pack(">BBHHHII", 0x42, 1, 0x82, 8, 999, address_of(up, "TriggerSoftware"), 1)
    for _ in range(3):
        one.send(datagram)
        assert one.receive() == bytes.fromhex("0000 0083 0004 03e7 0000 0001")
    assert up.devices[0].camera.counts["triggers"] == 1


def test_no_answer_where_none_is_wanted(hands):
    hands[0].send(struct.pack(">BBHHHI", 0x42, 0, 0x80, 4, 5, VERSION))
    assert hands[0].receive(0.2) is None


def test_nothing_is_sent_where_the_stream_goes_nowhere(up, hands):
    one = hands[0]
    in_control(one)
    one.write(SCDA, 0xFFFFFFFF)
    one.write(SCP, 9)
    one.write(SCPS, 0x80000000 | 1500)
    assert up.devices[0].counts()["packets_unsent"] == 1


def packets_of_one_frame(up: Served, one: Hand) -> list[bytes | None]:
    """Take control and let the camera run free for one frame; return leader, 3072 bytes in 3, and trailer."""
    in_control(one)
    one.write(SCDA, 0x7F000001)
    one.write(SCP, one.port)
    one.write(address_of(up, "AcquisitionMode"), 1)
    one.write(address_of(up, "AcquisitionStart"), 1)
    return [one.receive() for _ in range(5)]


def test_packets_asked_for_again(up, hands):
    one = hands[0]
    packets = packets_of_one_frame(up, one)
    assert [struct.unpack(">I", p[4:8])[0] for p in packets] == [
        0x01000000, 0x03000001, 0x03000002, 0x03000003, 0x02000004,
    ]  # fmt: skip
    image = np.frombuffer(b"".join(p[8:] for p in packets[1:4]), np.uint8)
    assert image.size == 48 * 64
    one.send(struct.pack(">BBHHHHHII", 0x42, 0, 0x40, 12, 77, 0, 1, 2, 3))
    assert [one.receive(), one.receive()] == packets[2:4]
    one.send(struct.pack(">BBHHHHHII", 0x42, 0, 0x40, 12, 78, 0, 40, 1, 9))
    assert one.receive() == bytes.fromhex("800c 0028 03000001")
    assert one.receive(0.1) is None


def test_resends_are_refused_on_demand():
    faults = {"cam0": Faults(resend_refused=1.0)}
    with served(ArraySource(1, 8), first_address=free_address(), faults=faults) as up:
        one = Hand(str(up.devices[0].identity.address.ip))
        packets_of_one_frame(up, one)
        one.send(struct.pack(">BBHHHHHII", 0x42, 0, 0x40, 12, 77, 0, 1, 2, 3))
        assert one.receive() == bytes.fromhex("800c 0001 03000002")
        assert up.devices[0].counts()["resends_refused"] == 1
        one.close()


def test_action_commands_reach_cameras_by_broadcast(up, hands):
    one = hands[0]
    in_control(one)
    one.write(address_of(up, "ActionGroupMask"), 1)
    status, _ = one.ask(0x100, struct.pack(">III", 0, 0, 1))
    assert status == 0
    assert one.ask(0x100, struct.pack(">II", 0, 0))[0] == 0x8002
    late = one.ask(0x100, struct.pack(">IIIQ", 0, 0, 1, 1), flags=0x81)
    assert late[0] == 0x8016
    until(lambda: up.devices[0].camera.counts["triggers"] == 2)


COMMANDS = st.sampled_from([0x02, 0x04, 0x40, 0x80, 0x82, 0x84, 0x86, 0x100])
ADDRESSES = st.one_of(st.sampled_from([0xA00, 0xD00, 0xD04, 0xD18, 0x10000, 0xF0000]), st.integers(0, 0x100800))
PAYLOADS = st.one_of(
    st.binary(max_size=40),
    st.tuples(ADDRESSES, st.integers(0, 2**32 - 1)).map(lambda pair: struct.pack(">II", *pair)),
    st.tuples(ADDRESSES, st.integers(0, 600)).map(lambda pair: struct.pack(">IHH", pair[0], 0, pair[1])),
)


def command(code: int, flags: int, payload: bytes, cut: int) -> bytes:
    return struct.pack(">BBHHH", 0x42, flags, code, len(payload), 7) + payload[: len(payload) - cut]


@pytest.fixture(scope="module")
def victim():
    with served(ArraySource(1, 8), first_address=free_address()) as found:
        yield found


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=80), st.builds(command, COMMANDS, st.integers(0, 255), PAYLOADS, st.integers(0, 3))
        ),
        max_size=6,
    )
)
def test_any_bytes_leave_the_device_alive(victim, datagrams):
    control, client = victim.devices[0].control, ("127.0.0.1", 1000)
    control.answer(command(0x82, 1, struct.pack(">II", CCP, CONTROL), 0), client)
    for datagram in datagrams:
        for broadcast in (False, True):
            answer = control.answer(datagram, client, broadcast)
            assert len(answer) in (0, *range(8, 549))
    # exclusive access, and a reset, are commands like others
    control.answer(command(0x82, 1, struct.pack(">II", CCP, 0), 0), client)
    until(lambda: victim.devices[0].camera.linked(time.monotonic_ns()))
    hand = Hand(str(victim.devices[0].identity.address.ip))
    try:
        assert hand.read(VERSION) == 0x00020000
    finally:
        hand.close()


def test_noise_on_the_port_leaves_the_device_alive(up, hands):
    noise = np.random.default_rng(1)
    for _ in range(25):
        for _ in range(20):  # not more than fit into its socket's buffer
            hands[0].send(noise.bytes(int(noise.integers(0, 600))))
        assert hands[1].read(VERSION) == 0x00020000


# putting cameras on the network


def test_an_address_that_is_taken_is_told():
    address = free_address()
    with served(ArraySource(1, 2), first_address=address), pytest.raises(InputError, match="already serves"):
        served(ArraySource(1, 2), first_address=address)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"first_address": "203.0.113.7"}, "not to be had on this machine"),
        ({"first_address": "seven"}, "an IPv4 address is wanted"),
        ({"addresses": {"nobody": "127.0.0.9"}}, "'nobody' given; the source has cam0, cam1"),
        ({"addresses": {"cam0": "127.9.9.9", "cam1": "127.9.9.9"}}, "given twice"),
        ({"ahead": 0}, "at least 1 pulse"),
    ],
)
def test_what_cannot_be_served_is_told_in_one_line(options, said):
    with pytest.raises(InputError, match=said) as error:
        served(ArraySource(2, 2), **{"first_address": free_address(), **options})
    assert "\n" not in str(error.value)


def test_everything_ends_with_close():
    import threading

    before = threading.active_count()
    up = served(ArraySource(2, 4), first_address=free_address())
    up.start()
    up.close()
    up.close()
    assert threading.active_count() == before
