"""Strangers on the network of GigE Vision cameras: what they send is refused, named, and in no frame or setting."""

import logging
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from array_source import ArraySource, picture
from driven import fake_gige_camera, wait_long_for_packets
from needs import needs_aravis
from paced import PERIOD_NS
from test_drivers_emulated import opened

from hardware.driver import REFUSED, CameraDriver, Device, DeviceError, Grabbed
from hardware.drivers import gige, open_camera
from hardware.drivers.gige import STREAM_SOURCE_REGISTER, GigeCamera
from hardware.drivers.peer_socket import MOST_NAMED, udp_sockets
from hardware.emulate.gige_vision import MAXIMUM_BLOCK_ID
from hardware.emulate.serve import served
from hardware.emulate.stream import ImageLayout, image_packets
from hardware.gvcp import Command
from hardware.settings import CameraHardware

ADDRESS = "127.0.7.1"
STRANGER = "127.0.7.99"
SHAPE = (48, 64)
MONO8 = 0x01080001
FRAMES = 40


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    needs_aravis()
    wait_long_for_packets(monkeypatch)


@contextmanager
def stranger(address: str = STRANGER) -> Iterator[socket.socket]:
    """Yield the socket of a program at ``address`` that is no camera's."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind((address, 0))
        yield made


def own_sockets(before: set[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return the sockets that are new since ``before``."""
    return sorted(set(udp_sockets().values()) - before)


def run(disturb: Callable[[int, int], None]) -> tuple[list[Grabbed], dict[str, int]]:
    """Grab ``FRAMES`` pulses; ``disturb(pulse, port)`` is called before each with the port of the stream."""
    with served(ArraySource(1, FRAMES, SHAPE), first_address=ADDRESS) as devices:
        camera = opened(devices, "cam0")
        before = set(udp_sockets().values())
        camera.arm()
        ((_, port),) = own_sockets(before)
        came: list[Grabbed] = []
        first_ns = time.monotonic_ns()
        for pulse in range(FRAMES):
            disturb(pulse, port)
            due_ns = first_ns + pulse * PERIOD_NS
            time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
            devices.pulse(pulse, due_ns)
            grabbed = camera.grab(20.0)
            assert grabbed is not None
            came.append(grabbed)
        counts = dict(camera.statistics())
        camera.close()
    return came, counts


def refused_packets(counts: dict[str, int]) -> int:
    return sum(number for what, number in counts.items() if what.startswith(REFUSED))


def assert_own(came: list[Grabbed]) -> None:
    """Every frame is the camera's, whole, of its own pulse."""
    assert [g.block_id for g in came] == list(range(1, FRAMES + 1))
    for pulse, grabbed in enumerate(came):
        assert grabbed.image is not None, grabbed.note
        assert np.array_equal(grabbed.image, picture(0, pulse, SHAPE))


def test_forged_stream_packets_are_in_no_frame_and_named(caplog: pytest.LogCaptureFixture) -> None:
    layout = ImageLayout(MONO8, SHAPE[1], SHAPE[0])
    with stranger() as attack, caplog.at_level(logging.WARNING):
        sent = 0

        def forge(pulse: int, port: int) -> None:
            nonlocal sent
            # the frame to come, and others, each with another picture
            for block in (pulse + 1, pulse + 2, (pulse + 90) % MAXIMUM_BLOCK_ID):
                for packet in image_packets(block, 5, layout, picture(9, pulse, SHAPE), 1500):
                    attack.sendto(packet, ("127.0.0.1", port))
                    sent += 1

        came, counts = run(forge)
        name = "{}:{}".format(*attack.getsockname())
    assert_own(came)
    assert counts[f"{REFUSED} {name}"] > 0
    assert refused_packets(counts) == sent
    assert f"camera 'cam0', stream: packets from {name}, which is not the camera, are refused" in caplog.text


def test_a_flood_costs_no_frame_and_its_senders_are_counted() -> None:
    with stranger() as attack:
        sent = 0

        def flood(pulse: int, port: int) -> None:
            nonlocal sent
            for _ in range(300):
                attack.sendto(os.urandom(64), ("127.0.0.1", port))
                sent += 1

        came, counts = run(flood)
    assert_own(came)
    assert refused_packets(counts) == sent


def test_forged_answers_of_the_control_channel_change_no_value() -> None:
    with served(ArraySource(1, 1, SHAPE), first_address=ADDRESS) as devices, stranger() as attack:
        before = set(udp_sockets().values())
        camera = opened(devices, "cam0")
        assert isinstance(camera, GigeCamera)
        ((_, port),) = own_sockets(before)
        source = devices.device("cam0")._stream.source_port
        # all request ids there are, 100 at a time: what comes next is among them once
        for first in range(0, 1 << 16, 100):
            for number in range(first, min(first + 100, 1 << 16)):
                answer = struct.pack(">HHHHI", 0, Command.READREG + 1, 4, number, 0xBAD)
                attack.sendto(answer, ("127.0.0.1", port))
            assert camera._aravis.register(camera._device, STREAM_SOURCE_REGISTER) == source
        name = "{}:{}".format(*attack.getsockname())
        assert camera.statistics() == {}  # counts are those since it was armed
        camera.arm()
        assert camera.statistics()[f"{REFUSED} {name}"] > 100
        camera.close()


def test_a_camera_that_does_not_tell_its_port_is_told_and_taken_by_its_address(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING), fake_gige_camera("FAKE9") as settings:
        wanted = settings(trigger="Software", exposure_us=10_000.0)
        camera = open_camera("a", wanted)
        camera.configure(wanted)
        before = set(udp_sockets().values())
        camera.arm()
        ((_, port),) = own_sockets(before)
        layout = ImageLayout(MONO8, SHAPE[1], SHAPE[0])
        with stranger() as attack:
            for block in (65400, 65401, 1):
                for packet in image_packets(block, 5, layout, picture(9, 0, SHAPE), 1500):
                    attack.sendto(packet, ("127.0.0.1", port))
        camera.software_trigger()
        grabbed = camera.grab(20.0)
        assert grabbed is not None
        assert grabbed.image is not None
        assert grabbed.device_ns != 5
        assert camera.statistics()["n_ignored_packets"] == 0
        camera.close()
    assert "does not tell its source port; packets from all ports of 127.0." in caplog.text


def test_invented_addresses_are_counted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    with served(ArraySource(1, 1, SHAPE), first_address=ADDRESS) as devices:
        camera: CameraDriver = opened(devices, "cam0")
        before = set(udp_sockets().values())
        camera.arm()
        ((_, port),) = own_sockets(before)
        for number in range(1, MOST_NAMED + 5):
            with stranger(f"127.0.8.{number}") as attack:
                attack.sendto(b"?", ("127.0.0.1", port))
        counts = {what: number for what, number in camera.statistics().items() if what.startswith(REFUSED)}
        assert len(counts) == MOST_NAMED + 1
        assert counts[f"{REFUSED} other addresses"] == 4
        camera.close()


@contextmanager
def answering(contents: list[bytes], also_at: str = "") -> Iterator[None]:
    """Answer each discovery by broadcast with ``contents``, and each that is sent to ``also_at`` with the first."""
    with ExitStack() as stack:
        sockets = []
        for place in ("255.255.255.255", "127.255.255.255", *([also_at] if also_at else [])):
            made = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            made.bind((place, 3956))
            sockets.append(made)
        attack = stack.enter_context(stranger())
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                for made in select.select(sockets, [], [], 0.05)[0]:
                    data, client = made.recvfrom(2048)
                    (number,) = struct.unpack_from(">H", data, 6)
                    direct = made is sockets[-1] and also_at
                    for content in contents[:1] if direct else contents:
                        answer = struct.pack(">HHHH", 0, Command.DISCOVERY + 1, len(content), number) + content
                        (made if direct else attack).sendto(answer, client)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def answer(address: str, serial: bytes, model: bytes = b"Rogue") -> bytes:
    """Return what a device says of itself: its address, model and serial number."""
    content = bytearray(248)
    content[12:16] = socket.inet_aton(address)  # its hardware address, so that all are different
    content[36:40] = socket.inet_aton(address)
    content[104 : 104 + len(model)] = model
    content[216 : 216 + len(serial)] = serial
    return bytes(content)


def test_malformed_and_forged_answers_to_a_discovery_are_no_cameras(caplog: pytest.LogCaptureFixture) -> None:
    with served(ArraySource(1, 1, SHAPE), first_address=ADDRESS) as devices, caplog.at_level(logging.WARNING):
        identity = devices.device("cam0").identity
        serial = identity.serial.encode()
        forged = [
            answer("127.0.7.98", b"GHOST"),
            answer(ADDRESS, b"OTHER"),
            answer("127.0.7.97", serial),
            answer("0.0.0.0", b"NOWHERE"),
            answer("127.0.7.96", b"\xff" * 16, b"\xff" * 32),
            b"",
            bytes(range(30)),
            bytes(500),
        ]
        with answering(forged):
            found = gige.devices()
            assert [one for one in found if one.address.startswith("127.0.7.")] == [
                Device("gige", identity.model, identity.serial, ADDRESS)
            ]
            for settings in ({"address": ADDRESS}, {"serial": identity.serial}):
                camera = open_camera("cam0", CameraHardware.model_validate({"driver": "gige", **settings}))
                assert camera.statistics() == {}
                camera.close()
    for told in (
        "Rogue GHOST at 127.0.7.98: answers to broadcasts, but nothing ",
        f"Rogue OTHER at {ADDRESS}: answers to broadcasts, but '{identity.serial}' at {ADDRESS} is what answers",
        f"Rogue {identity.serial} at 127.0.7.97: answers to broadcasts, but nothing ",
        "Rogue NOWHERE at 0.0.0.0: answers to broadcasts, but its address cannot be used",
    ):
        assert told in caplog.text


def test_a_serial_number_that_two_devices_tell_is_refused() -> None:
    with served(ArraySource(1, 1, SHAPE), first_address=ADDRESS) as devices:
        serial = devices.device("cam0").identity.serial
        with answering([answer("127.0.7.95", serial.encode())], also_at="127.0.7.95"):
            gige.devices()
            with pytest.raises(
                DeviceError, match=r"serial 'TWIN\w+' is told by devices at .*127.0.7.95.*address too"
            ):
                open_camera("cam0", CameraHardware(driver="gige", serial=serial))
            open_camera("cam0", CameraHardware(driver="gige", serial=serial, address=ADDRESS)).close()
