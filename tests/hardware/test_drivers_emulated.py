"""The Aravis driver on our own GigE Vision devices: line triggers, lost packets, a restart, deeper pixels."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Event

import numpy as np
import pytest
from array_source import ArraySource, picture
from driven import grab_for, refused, wait_long_for_packets
from needs import needs_aravis
from paced import make_pulses

from hardware.driver import CameraDriver, Grabbed
from hardware.drivers import open_camera
from hardware.drivers.opened import release
from hardware.emulate.faults import Faults
from hardware.emulate.serve import Served, served
from hardware.settings import CameraHardware

# addresses of their own, for tests that run at the same time
FIRST_ADDRESS = "127.0.3.{}"
SIZE = (491, 656)
QUIET = 50
"""Grabs without a frame after which no more are waited for."""
NAMES = ("cam0", "cam1", "cam2", "cam3")


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    wait_long_for_packets(monkeypatch)


def opened(devices: Served, name: str, **more: object) -> CameraDriver:
    identity = devices.device(name).identity
    settings = CameraHardware.model_validate(
        {"driver": "gige", "address": str(identity.address.ip), "exposure_us": 800.0, **more}
    )
    camera = open_camera(name, settings)
    try:
        camera.configure(settings)
    except BaseException:
        camera.close()
        raise
    return camera


def account(
    devices: Served, number: int, grabbed: list[Grabbed], frames: int, shape: tuple[int, int], bits: int = 8
) -> None:
    """Assert that every exposure came once and in order, and that complete frames are their pulses' images.

    On a busy machine the devices drop pulses and report it, and a frame may come too late to be complete: one in
    fifty at most.
    """
    exposures = devices.device(f"cam{number}").counts()["exposures"]
    assert [g.block_id for g in grabbed] == list(range(1, exposures + 1))
    assert exposures > frames // 2
    pictures = [picture(number, pulse, shape, bits) for pulse in range(frames)]
    pulse_of = {image[0].tobytes(): pulse for pulse, image in enumerate(pictures)}
    whole = [g for g in grabbed if g.image is not None]
    pulses = [pulse_of[g.image[0].tobytes()] for g in whole if g.image is not None]
    assert (np.diff(pulses) > 0).all()
    assert all(np.array_equal(g.image, pictures[pulse]) for g, pulse in zip(whole, pulses, strict=True))
    assert all(g.note == "" for g in whole)
    assert len(grabbed) - len(whole) <= len(grabbed) // 50
    # the device's clock identifies those pulses, too
    stamps = np.array([g.device_ns for g in whole])
    assert np.array_equal(np.round(np.diff(stamps) / 1e7), np.diff(pulses))


def grab_all(camera: CameraDriver, wanted: Callable[[], int | None], came: list[Grabbed]) -> None:
    """Grab into ``came`` until ``wanted`` frames are here, which is None while pulses go on, or nothing comes."""
    quiet = 0
    while quiet < QUIET and wanted() != len(came):
        grabbed = camera.grab(0.2)
        if grabbed is not None:
            came.append(grabbed)
        quiet = 0 if grabbed is not None or wanted() is None else quiet + 1


def run_line(devices: Served, cameras: dict[str, CameraDriver], pulses: int) -> dict[str, list[Grabbed]]:
    """Arm all, give pulses on the line, grab all at a time."""
    for camera in cameras.values():
        camera.arm()
    came: dict[str, list[Grabbed]] = {name: [] for name in cameras}
    before = {name: exposures(devices, name) for name in cameras}
    over = Event()

    def wanted(name: str) -> int | None:
        return exposures(devices, name) - before[name] if over.is_set() else None

    with ThreadPoolExecutor(len(cameras)) as threads:
        work = [
            threads.submit(grab_all, camera, partial(wanted, name), came[name]) for name, camera in cameras.items()
        ]
        make_pulses(devices, pulses, lambda: min(map(len, came.values())))
        over.set()
        for one in work:
            one.result()
    return came


def exposures(devices: Served, name: str) -> int:
    return devices.device(name).counts().get("exposures", 0)


def test_four_cameras_at_100_hz_by_line_bit_for_bit() -> None:
    needs_aravis()
    with served(ArraySource(4, 150, SIZE), first_address=FIRST_ADDRESS.format(1)) as devices:
        cameras = {name: opened(devices, name, packet_bytes=8000) for name in NAMES}
        assert all(camera.capabilities.hardware_trigger for camera in cameras.values())
        assert all(camera.capabilities.ptp for camera in cameras.values())
        came = run_line(devices, cameras, 150)
        for number, name in enumerate(NAMES):
            account(devices, number, came[name], 150, SIZE)
        for camera in cameras.values():
            camera.close()


def test_lost_packets_are_sent_again() -> None:
    needs_aravis()
    faults = {"cam0": Faults(packet_loss=0.01, seed=3)}
    with served(ArraySource(1, 40, SIZE), first_address=FIRST_ADDRESS.format(11), faults=faults) as devices:
        camera = opened(devices, "cam0", packet_bytes=1500)
        grabbed = run_line(devices, {"cam0": camera}, 40)["cam0"]
        account(devices, 0, grabbed, 40, SIZE)
        counts = camera.statistics()
        assert counts["n_resent_packets"] > 20
        assert counts["n_resent_packets"] > 20 * counts["n_missing_packets"]
        camera.close()


def test_ids_go_on_over_the_16_bit_wrap() -> None:
    needs_aravis()
    with served(ArraySource(1, 60), first_address=FIRST_ADDRESS.format(12), first_block=65510) as devices:
        camera = opened(devices, "cam0")
        grabbed = run_line(devices, {"cam0": camera}, 60)["cam0"]
        exposures = devices.device("cam0").counts()["exposures"]
        assert exposures > 30
        assert [g.block_id for g in grabbed] == list(range(65510, 65510 + exposures))
        camera.close()


def test_a_windowed_readout_and_armed_again() -> None:
    needs_aravis()
    with served(ArraySource(1, 40, SIZE), first_address=FIRST_ADDRESS.format(13)) as devices:
        camera = opened(devices, "cam0", window=(128, 64, 256, 200))
        windows = {picture(0, k, SIZE)[64:264, 128:384].tobytes() for k in range(40)}
        for _ in range(2):
            grabbed = run_line(devices, {"cam0": camera}, 40)["cam0"]
            camera.disarm()
            devices.line.stop()
            # ids begin anew with each start, and none is taken for late
            assert [g.block_id for g in grabbed] == list(range(1, len(grabbed) + 1))
            assert len(grabbed) > 20
            shown = {g.image.tobytes() for g in grabbed if g.image is not None}
            assert len(shown) >= len(grabbed) - 1
            assert shown <= windows
        camera.close()


@pytest.mark.parametrize(("bits", "pixel_format"), [(12, "Mono12"), (16, "Mono16")])
def test_deeper_pixels(bits: int, pixel_format: str) -> None:
    needs_aravis()
    with served(ArraySource(1, 10, depth=bits), first_address=FIRST_ADDRESS.format(10 + bits)) as devices:
        camera = opened(devices, "cam0", pixel_format=pixel_format)
        grabbed = run_line(devices, {"cam0": camera}, 10)["cam0"]
        account(devices, 0, grabbed, 10, (48, 64), bits)
        camera.close()


def test_a_second_program_finds_it_taken() -> None:
    needs_aravis()
    with served(ArraySource(1, 2), first_address=FIRST_ADDRESS.format(40)) as devices:
        camera = opened(devices, "cam0")
        # another program's claim is not known to this one
        release(camera.device)  # type: ignore[attr-defined]
        with refused("another program", "camera 'cam0'", "127.0.3.40"):
            opened(devices, "cam0")
        camera.close()


def test_a_restart_of_the_camera_is_told_and_it_opens_again() -> None:
    needs_aravis()
    faults = {"cam0": Faults(reboot_at_s=0.5, reboot_gone_s=0.5)}
    with served(ArraySource(1, 400), first_address=FIRST_ADDRESS.format(41), faults=faults, loop=True) as devices:
        camera = opened(devices, "cam0")
        camera.arm()
        devices.start(100.0)
        with refused("stopped answering", "camera 'cam0'"):
            grab_for(camera, 120.0)
        camera.close()
        again = opened(devices, "cam0")
        again.arm()
        assert again.grab(60.0) is not None
        again.close()
