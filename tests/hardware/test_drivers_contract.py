"""The contract of every driver, of any SDK: run over all that are installed."""

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from driven import DRIVEN, Driven, one_line, refused, wait_long_for_packets
from loopback import PATIENT_S

from hardware.driver import CameraDriver, DeviceError
from hardware.drivers import devices, open_camera


@pytest.fixture(scope="module", params=sorted(DRIVEN))
def driven(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driven]:
    with DRIVEN[request.param](tmp_path_factory.mktemp("driven")) as device:
        yield device


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    wait_long_for_packets(monkeypatch)


@pytest.fixture
def camera(driven: Driven) -> Iterator[CameraDriver]:
    camera = open_camera("left", driven.free)
    yield camera
    camera.close()


def test_arm_and_disarm_alternate_and_images_are_the_receivers_own(driven: Driven, camera: CameraDriver) -> None:
    report = camera.configure(driven.free)
    for _ in range(3):
        camera.arm()
        kept = []
        for _ in range(driven.frames):
            grabbed = camera.grab(PATIENT_S)
            assert grabbed is not None
            assert grabbed.note == ""
            assert grabbed.image is not None
            assert grabbed.image.shape == (report.height, report.width)
            assert grabbed.image.dtype == (np.uint8 if report.bit_depth == 8 else np.uint16)
            assert grabbed.exposure_ns == report.exposure_ns
            assert (grabbed.device_ns is not None) == camera.capabilities.device_clock
            kept.append((grabbed, grabbed.image.copy()))
        host = [grabbed.host_ns for grabbed, _ in kept]
        assert host == sorted(host)
        assert host[-1] <= time.monotonic_ns()
        blocks = [grabbed.block_id for grabbed, _ in kept]
        # a camera that runs free waits for no machine that is held up: numbers may be missing, none comes twice
        assert (np.diff(blocks) >= 1).all()
        camera.disarm()
        camera.disarm()
        # buffers that were used again would show here
        assert all(np.array_equal(grabbed.image, then) for grabbed, then in kept)


def test_silence_is_none_within_the_timeout(driven: Driven, camera: CameraDriver) -> None:
    camera.configure(driven.silent)
    camera.arm()
    for timeout_s in (0.2, 0.0):
        begin = time.monotonic()
        # frames that a file, or a slow rate, still has
        while driven.driver in ("webcam", "gentl") and camera.grab(timeout_s) is not None:
            begin = time.monotonic()
        if driven.driver not in ("webcam", "gentl"):
            assert camera.grab(timeout_s) is None
        assert time.monotonic() - begin > 0.7 * timeout_s


def test_closed_twice_and_then_nothing_goes(driven: Driven) -> None:
    camera = open_camera("left", driven.free)
    camera.configure(driven.free)
    camera.arm()
    assert camera.grab(PATIENT_S) is not None
    camera.close()
    camera.close()
    camera.disarm()
    assert dict(camera.statistics()) == {}
    for forbidden in (
        camera.arm,
        lambda: camera.grab(0.1),
        camera.software_trigger,
        lambda: camera.configure(driven.free),
    ):
        with refused("closed", "camera 'left'"):
            forbidden()


def test_states_that_do_not_go_together(driven: Driven, camera: CameraDriver) -> None:
    camera.configure(driven.free)
    with pytest.raises(DeviceError, match="not armed"):
        camera.grab(0.1)
    camera.arm()
    camera.arm()
    with pytest.raises(DeviceError, match="disarm"):
        camera.configure(driven.free)
    with refused("software", "camera 'left'"):
        camera.software_trigger()


def test_the_report_is_what_the_device_took_and_read_only(driven: Driven, camera: CameraDriver) -> None:
    report = camera.configure(driven.free)
    assert (report.width, report.height, report.bit_depth) == (160, 120, 8)
    assert report.serial == driven.free.serial
    assert report.settings
    with pytest.raises(TypeError):
        report.settings["Width"] = 3  # type: ignore[index]


def test_an_unknown_feature_is_refused_in_one_line(driven: Driven, camera: CameraDriver) -> None:
    with refused("no feature 'Exposition'", "camera 'left'"):
        camera.configure(driven.with_(features={"Exposition": 3}))


def test_a_wrong_value_is_refused_in_one_line(driven: Driven, camera: CameraDriver) -> None:
    with pytest.raises(DeviceError) as caught:
        camera.configure(driven.with_(**driven.wrong))
    key, value = next(iter(driven.wrong.items()))
    number = value if isinstance(value, float) else max(value)
    one_line(caught.value, "camera 'left'", key, f"{number:.10g}")
    # and the device can be set again
    camera.configure(driven.free)


def test_a_pixel_format_that_is_not_there_is_refused(driven: Driven, camera: CameraDriver) -> None:
    with refused("Mono9", "camera 'left'", "pixel_format", "Mono8"):
        camera.configure(driven.with_(pixel_format="Mono9"))


def test_a_trigger_that_is_not_there_is_refused(driven: Driven, camera: CameraDriver) -> None:
    with refused("Line9", "camera 'left'", "trigger"):
        camera.configure(driven.with_(trigger="Line9"))


def test_a_device_opens_once_and_again_after_it_was_closed(driven: Driven) -> None:
    first = open_camera("left", driven.free)
    with refused("open already as camera 'left'", "camera 'right'"):
        open_camera("right", driven.free)
    first.close()
    open_camera("right", driven.free).close()


def test_a_missing_device_is_named_with_those_that_are_there(driven: Driven) -> None:
    if driven.driver == "webcam":
        wanted, there = {"address": "nowhere.mkv"}, "nowhere.mkv"
    else:
        wanted, there = {"serial": "no such serial"}, driven.free.serial
    with refused("camera 'left'", there, next(iter(wanted.values()))):
        open_camera("left", driven.with_(**wanted))


def test_devices_lists_it(driven: Driven) -> None:
    found = devices(driven.driver, driven.producer)
    if driven.driver != "webcam":
        for _ in range(60):  # a busy machine may answer later than is listened for
            if driven.free.serial not in [device.serial for device in found]:
                found = devices(driven.driver, driven.producer)
        assert driven.free.serial in [device.serial for device in found]
    assert all(device.driver == driven.driver for device in found)


def test_closing_from_another_thread_ends_a_waiting_grab(driven: Driven) -> None:
    camera = open_camera("left", driven.silent)
    camera.configure(driven.silent)
    camera.arm()
    ended: list[object] = []

    def grab() -> None:
        try:
            while camera.grab(2 * PATIENT_S) is not None:
                pass
            ended.append(None)
        except DeviceError as error:
            ended.append(error)

    thread = threading.Thread(target=grab)
    thread.start()
    time.sleep(0.2)
    camera.close()
    thread.join(PATIENT_S)
    assert not thread.is_alive()
    assert len(ended) == 1
