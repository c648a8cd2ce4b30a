"""The pylon driver on the camera emulator that the pypylon wheel brings."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from driven import pictures, refused
from needs import needs_module

from hardware.driver import CameraDriver
from hardware.drivers import open_camera
from hardware.settings import CameraHardware
from mosca.data.arrays import Array

SERIALS = ("0815-0000", "0815-0001", "0815-0002", "0815-0003")
FRAMES = 40


def emulated(serial: str, folder: Path | None = None, **more: object) -> CameraHardware:
    features = {"TestImageSelector": "Off", "ImageFileMode": "On", "ImageFilename": str(folder)}
    settings = {
        "driver": "pylon",
        "serial": serial,
        "trigger": "Software",
        "exposure_us": 800.0,
        "gain_db": 0.0,
        "window": (0, 0, 656, 491),
        "features": features if folder else {},
        **more,
    }
    return CameraHardware.model_validate(settings)


def write_folder(folder: Path, images: list[Array]) -> Path:
    folder.mkdir()
    for number, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{number:04d}.tiff"), image)
    return folder


@pytest.fixture
def one(tmp_path: Path) -> Iterator[CameraDriver]:
    needs_module("pypylon.pylon", "pylon")
    settings = emulated(SERIALS[0])
    camera = open_camera("a", settings)
    yield camera
    camera.close()


def test_four_cameras_bit_for_bit_by_software_trigger(tmp_path: Path) -> None:
    needs_module("pypylon.pylon", "pylon")
    images = {serial: pictures(FRAMES, number) for number, serial in enumerate(SERIALS)}
    cameras: dict[str, CameraDriver] = {}
    try:
        for serial in SERIALS:
            settings = emulated(serial, write_folder(tmp_path / serial, images[serial]))
            cameras[serial] = open_camera(serial, settings)
            report = cameras[serial].configure(settings)
            assert report.exposure_ns == 800_000
            assert report.settings["TriggerSource"] == "Software"
            assert report.settings["TriggerMode"] == "On"
        for camera in cameras.values():
            camera.arm()
        wrong = 0
        for number in range(FRAMES):
            fired = {serial: camera.software_trigger() for serial, camera in cameras.items()}
            for serial, camera in cameras.items():
                grabbed = camera.grab(60.0)
                assert grabbed is not None
                assert grabbed.block_id == number
                assert grabbed.device_ns is None
                assert grabbed.host_ns > fired[serial]
                wrong += not np.array_equal(grabbed.image, images[serial][number])
        assert wrong == 0
        for camera in cameras.values():
            assert camera.grab(0.05) is None
            counts = camera.statistics()
            assert counts["Statistic_Total_Buffer_Count"] == FRAMES
            assert counts["Statistic_Failed_Buffer_Count"] == 0
    finally:
        for camera in cameras.values():
            camera.close()


def test_forced_failures_come_with_their_ids_and_are_counted(one: CameraDriver) -> None:
    one.configure(emulated(SERIALS[0]))
    one.arm()
    one.features.write("ForceFailedBufferCount", 5)  # type: ignore[attr-defined]
    one.features.execute("ForceFailedBuffer")  # type: ignore[attr-defined]
    came = []
    for _ in range(12):
        one.software_trigger()
        came.append(one.grab(60.0))
    assert [grabbed.block_id for grabbed in came if grabbed] == list(range(12))
    failed = [grabbed for grabbed in came if grabbed and grabbed.image is None]
    assert [grabbed.block_id for grabbed in failed] == [0, 1, 2, 3, 4]
    assert all(grabbed.note.startswith("FAILED") for grabbed in failed)
    assert one.statistics()["failed_results"] == 5
    assert one.statistics()["Statistic_Failed_Buffer_Count"] == 5


def test_no_software_trigger_is_lost_though_they_come_as_fast_as_can_be(one: CameraDriver) -> None:
    one.configure(emulated(SERIALS[0], window=(0, 0, 64, 64)))
    one.arm()
    for _ in range(25):
        one.software_trigger()
    came = [one.grab(60.0) for _ in range(25)]
    assert [grabbed.block_id for grabbed in came if grabbed] == list(range(25))
    assert one.grab(0.05) is None


def test_the_emulator_says_what_it_cannot(one: CameraDriver) -> None:
    can = one.capabilities
    assert (can.device_clock, can.hardware_trigger, can.scheduled_action, can.ptp) == (False,) * 4
    assert can.software_trigger
    assert can.window
    # the list of its trigger sources has Line1, and nothing would ever raise it
    with refused("never fire", "camera 'a'", "Line1"):
        one.configure(emulated(SERIALS[0], trigger="Line1"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gain_db": 99.0}, ("Gain (gain_db)", "99", "0 to 48")),
        ({"window": (0, 0, 656, 5000)}, ("Height (window)", "5000", "1 to 4096")),
        ({"pixel_format": "Mono12p"}, ("PixelFormat (pixel_format)", "Mono12p", "Mono12")),
        ({"features": {"Widht": 3}}, ("Widht", "did you mean 'Width'")),
        ({"features": {"ReverseX": 3}}, ("ReverseX", "true, false")),
        ({"features": {"TriggerMode": "On"}}, ("TriggerMode", "trigger")),
        ({"features": {"SensorWidth": 3}}, ("SensorWidth", "lets nobody write")),
        ({"features": {"TestImageSelector": "Testimage99"}}, ("TestImageSelector", "Testimage1")),
    ],
)
def test_refusals_name_feature_value_and_what_is_allowed(
    one: CameraDriver, change: dict[str, object], words: tuple[str, ...]
) -> None:
    with refused("camera 'a'", *words):
        one.configure(emulated(SERIALS[0], **change))


@pytest.mark.parametrize(
    ("pixel_format", "bits"),
    [("Mono10", 10), ("Mono12", 12), ("Mono16", 16), ("BayerRG8", 8), ("BayerGB12", 12), ("RGB8Packed", 8)],
)
def test_other_pixel_formats_come_as_mono(one: CameraDriver, pixel_format: str, bits: int) -> None:
    # the emulator's test image 1 is a ramp of 8 bits, stretched to the format's; grey in all colours
    shape = {"window": (0, 0, 65, 33), "features": {"TestImageSelector": "Testimage1"}}
    one.configure(emulated(SERIALS[0], **shape))
    one.arm()
    one.software_trigger()
    first = one.grab(60.0)
    one.disarm()
    report = one.configure(emulated(SERIALS[0], pixel_format=pixel_format, **shape))
    assert report.bit_depth == bits
    one.arm()
    one.software_trigger()
    grabbed = one.grab(60.0)
    assert grabbed is not None
    assert first is not None
    assert grabbed.image is not None
    assert first.image is not None
    assert grabbed.image.dtype == (np.uint8 if bits == 8 else np.uint16)
    # a mean over neighbours of a ramp by one a pixel is the ramp, but where it wraps and at the borders
    expected = first.image.astype(np.int64) << (bits - 8)
    if pixel_format.startswith("Bayer"):
        assert np.array_equal(grabbed.image[1:-1, 1:-1], expected[1:-1, 1:-1])
    else:
        assert np.array_equal(grabbed.image, expected)
