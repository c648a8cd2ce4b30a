"""Aravis grabs from the emulated cameras, bit for bit."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Collection
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from aravis_client import RETENTION_US, SUCCESS, Aravis, Client, Image
from array_source import ArraySource, picture
from loopback import PATIENT_S, free_address
from needs import needs_aravis
from paced import PERIOD_NS, make_pulses

from hardware.emulate.serve import Served, served

FULL = (491, 656)


@pytest.fixture(autouse=True)
def _aravis():
    needs_aravis()


@contextmanager
def rig(source: ArraySource, trigger: str = "Line1", packet_bytes: int = 8000, retention_us=RETENTION_US, **options):
    """Yield the served cameras and their clients, armed."""
    with ExitStack() as stack:
        up = stack.enter_context(served(source, first_address=free_address(), **options))
        clients = []
        for device in up.devices:
            clients.append(Client(str(device.identity.address.ip)))
            stack.callback(clients[-1].close)
        for client in clients:
            if trigger:
                client.trigger_on(trigger)
            client.arm(packet_bytes=packet_bytes, retention_us=retention_us)
        yield up, clients


def grab_all(
    clients: list[Client], count: int, up: Served | None = None, missing: Collection[int] = ()
) -> list[list[Image]]:
    """Return up to ``count`` images of each client, taken at the same time; ends when one has been silent.

    ``up``: the pulses are made here, at the pace of who grabs; of those that are ``missing`` no image comes.
    """
    found: list[list[Image]] = [[] for _ in clients]

    def work(k: int) -> None:
        while len(found[k]) < count and (image := clients[k].grab(PATIENT_S)) is not None:
            found[k].append(image)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(clients))]
    for thread in threads:
        thread.start()
    if up is not None:
        make_pulses(
            up,
            count + len(missing),
            lambda: min(map(len, found)),
            lambda number: number - sum(one < number for one in missing),
        )
    for thread in threads:
        thread.join()
    return found


def equal(image: Image, camera: int, number: int, shape=(48, 64)) -> bool:
    return image.status == SUCCESS and np.array_equal(image.pixels, picture(camera, number, shape))


def test_cameras_are_discovered():
    with served(ArraySource(3, 2), first_address=free_address()) as up:
        wanted = {(str(d.identity.address.ip), d.identity.serial) for d in up.devices}
        found: set[tuple[str, str]] = set()
        for _ in range(60):  # a busy machine may answer later than Aravis listens
            if not wanted <= found:
                found |= set(Aravis().discovered())
        assert wanted <= found


def test_the_feature_tree_is_read_and_set():
    with served(ArraySource(1, 2, depth=12), first_address=free_address()) as up:
        client = Client(str(up.devices[0].identity.address.ip))
        assert [client.text(n) for n in ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber")] == [
            "Mosca", "Twin", up.devices[0].identity.serial,
        ]  # fmt: skip
        assert (client.text("PixelFormat"), client.integer("PayloadSize")) == ("Mono12", 64 * 48 * 2)
        client.set(ExposureTime=812.34, Gain=3.5, AcquisitionFrameRate=50.0, PtpEnable=True)
        assert [client.real(n) for n in ("ExposureTime", "Gain", "AcquisitionFrameRate")] == [812.34, 3.5, 50.0]
        client.execute("TimestampLatch")
        first = client.integer("TimestampLatchValue")
        client.execute("GevTimestampControlLatch")
        assert client.integer("GevTimestampValue") > first > 0
        with pytest.raises(RuntimeError):
            client.set(Width=4000)
        client.close()


def test_dropped_frames_are_not_sent_and_corrupt_ones_fail():
    troubles = {(0, 5): "dropped", (0, 9): "corrupt"}
    with rig(ArraySource(1, 20, troubles=troubles), retention_us=1_000_000) as (up, clients):
        (images,) = grab_all(clients, 19, up, {5})
        assert [image.frame_id for image in images] == [*range(1, 6), *range(7, 21)]
        assert [k for k, image in zip([*range(5), *range(6, 20)], images, strict=True) if image.status] == [9]
        assert (up.devices[0].counts()["dropped"], up.devices[0].counts()["corrupt"]) == (1, 1)


def test_a_window_of_twelve_bits_and_its_highest_eight():
    with served(ArraySource(1, 5, depth=12), first_address=free_address()) as up:
        client = Client(str(up.devices[0].identity.address.ip))
        client.set(Width=30, Height=20, OffsetX=8, OffsetY=11)
        client.trigger_on("Line1")
        whole = picture(0, 0, (48, 64), 12)[11:31, 8:38]
        for wanted, pixel_format in ((whole, "Mono12"), ((whole >> 4).astype(np.uint8), "Mono8")):
            client.set(PixelFormat=pixel_format)
            client.arm(packet_bytes=1500)
            up.pulse(0, time.monotonic_ns())
            image = client.grab(PATIENT_S)
            client.disarm()
            assert image is not None
            assert image.pixels.dtype == wanted.dtype
            assert np.array_equal(image.pixels, wanted)
        client.close()


def test_software_triggers():
    with rig(ArraySource(2, 30), trigger="Software") as (_, clients):
        for number in range(30):
            for k, client in enumerate(clients):
                client.execute("TriggerSoftware")
                image = client.grab(PATIENT_S)
                assert image is not None
                assert equal(image, k, number)


def test_a_camera_runs_free():
    # its rate is tried with a set clock; here a machine that is held up may lose frames, and shifts none
    with rig(ArraySource(1, 200), trigger="", loop=True, ahead=200) as (_, clients):
        (images,) = grab_all(clients, 30)
        ids = [image.frame_id for image in images]
        assert len(ids) == 30
        assert (np.diff(ids) >= 1).all()
        assert (np.diff([image.device_ns for image in images]) >= PERIOD_NS * np.diff(ids)).all()
        assert all(equal(image, 0, (image.frame_id - 1) % 200) for image in images)


def long_run(seconds: int, faults: dict) -> tuple[dict, list[dict]]:
    """Grab from a process that serves four cameras at 100 Hz; return what it counted, and what each client did."""
    pulses, kept = seconds * 100, 200
    address = free_address()
    script = Path(__file__).with_name("serve_arrays.py")
    wanted = [[picture(k, n, FULL) for n in range(kept)] for k in range(4)]
    command = [sys.executable, str(script), address, str(pulses), json.dumps(faults)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout.readline() == "ready\n"
        first = address.rsplit(".", 1)[0]
        clients = [Client(f"{first}.{k + 1}") for k in range(4)]
        seen: list[dict] = [{"pulses": [], "wrong": 0} for _ in clients]

        def work(k: int) -> None:
            begun = None
            # longer than Aravis waits for a packet: later frames are held back meanwhile
            while (image := clients[k].grab(30.0)) is not None:
                begun = image.device_ns if begun is None else begun
                pulse = round((image.device_ns - begun) / PERIOD_NS)
                same = image.status == SUCCESS and np.array_equal(image.pixels, wanted[k][pulse % kept])
                seen[k]["pulses"].append(pulse)
                seen[k]["wrong"] += not same

        for client in clients:
            client.trigger_on("Line1")
            client.arm(buffers=150)
        threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
        server.stdin.write("start\n")
        server.stdin.flush()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for client, own in zip(clients, seen, strict=True):
            own["statistics"] = client.statistics()
            client.close()
        server.stdin.write("end\n")
        server.stdin.flush()
        counted = json.loads(server.stdout.readline())
    return counted, seen


def overflows() -> int:
    """Return how many datagrams the kernel threw away because a program did not fetch them in time."""
    names, values = (line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line[:4] == "Udp:")
    return int(values[names.index("RcvbufErrors")])


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.01])
def test_a_minute_of_four_cameras(loss, capsys):
    before = overflows()
    counted, seen = long_run(60, {"packet_loss": loss})
    overflowed = overflows() > before
    with capsys.disabled():
        resent = [counts.get("packets_resent", 0) for counts in counted["counts"]]
        grabbed = [len(own["pulses"]) for own in seen]
        print(
            f"\nserver {counted['cores']:.2f} cores, {counted['pulses']} pulses, grabbed {grabbed}, resent {resent}"
        )
    for own in seen:
        assert own["wrong"] == 0
        missing = set(range(counted["pulses"])) - set(own["pulses"])
        # no packet is requested again of a frame without any; only a full kernel buffer loses those
        assert not missing or overflowed
        assert len(missing) < counted["pulses"] // 100
