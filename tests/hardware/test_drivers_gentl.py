"""The GenTL driver on the software producer that the genicam wheel ships."""

import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from driven import refused, viky
from needs import needs_module

from hardware.driver import CameraDriver, DeviceError
from hardware.drivers import devices, open_camera
from hardware.settings import CameraHardware

USUAL = signal.getsignal(signal.SIGINT)


def software_camera(serial: str = "0", **more: object) -> CameraHardware:
    settings = {
        "driver": "gentl",
        "serial": serial,
        "producer": viky(),
        "trigger": "Off",
        "window": (0, 0, 656, 491),
        "features": {"AcquisitionFrameRate": 100.0},
        **more,
    }
    return CameraHardware.model_validate(settings)


@pytest.fixture
def camera() -> Iterator[CameraDriver]:
    needs_module("harvesters.core", "gentl")
    camera = open_camera("a", software_camera())
    yield camera
    camera.close()


def test_frames_come_in_order_at_the_rate_that_was_set(camera: CameraDriver) -> None:
    report = camera.configure(software_camera())
    assert report.settings["AcquisitionFrameRate"] == pytest.approx(100.0)
    camera.arm()
    grabbed = [camera.grab(60.0) for _ in range(60)]
    ids = np.array([g.block_id for g in grabbed if g is not None])
    assert len(ids) == 60
    assert ids[0] == 1
    # a machine with other work may lose frames; their numbers never repeat
    assert (np.diff(ids) >= 1).all()
    assert all(g is not None and g.image is not None and g.image.shape == (491, 656) for g in grabbed)
    # the ball moves over a dark ground
    first, last = grabbed[0], grabbed[-1]
    assert first is not None
    assert last is not None
    assert not np.array_equal(first.image, last.image)
    assert last.host_ns > first.host_ns
    assert camera.statistics() == {"whole_buffers": 60, "incomplete_buffers": 0}


def test_colour_is_reduced_to_luma(camera: CameraDriver) -> None:
    camera.configure(software_camera(pixel_format="RGBa8"))
    camera.arm()
    grabbed = camera.grab(60.0)
    assert grabbed is not None
    assert grabbed.image is not None
    assert grabbed.image.shape == (491, 656)
    # this device's ball is red: the luma of pure red
    assert (255 * 9798 + 16384) >> 15 in np.unique(grabbed.image)


def test_two_cameras_of_one_producer_at_a_time(camera: CameraDriver) -> None:
    camera.configure(software_camera())
    camera.arm()
    other = open_camera("b", software_camera("2"))
    try:
        other.configure(software_camera("2"))
        other.arm()
        assert other.grab(60.0) is not None
        # another enumeration of the producer must not close open devices
        assert [device.serial for device in devices("gentl", viky())] == ["0", "1", "2"]
        assert camera.grab(60.0) is not None
    finally:
        other.close()
    assert camera.grab(60.0) is not None


def test_an_incomplete_buffer_is_told_and_counted(camera: CameraDriver) -> None:
    camera.configure(software_camera())
    camera.arm()
    # what harvesters calls when it throws an incomplete buffer away; the producer here never loses any
    acquirer = camera._acquirer  # type: ignore[attr-defined]
    acquirer._emit_callbacks(acquirer.Events.INCOMPLETE_BUFFER)
    # it is reported before the frames that came after it, even if many are queued
    came = [camera.grab(60.0) for _ in range(3)]
    assert [(g.note, g.image is None) for g in came if g is not None] == [
        ("INCOMPLETE", True), ("", False), ("", False),
    ]  # fmt: skip
    assert camera.statistics()["incomplete_buffers"] == 1


def test_ctrl_c_stays_the_programs(camera: CameraDriver) -> None:
    # harvesters would take it
    assert signal.getsignal(signal.SIGINT) is USUAL


def test_a_producer_that_is_none_is_refused_in_one_line(tmp_path: Path) -> None:
    needs_module("harvesters.core", "gentl")
    none = tmp_path / "none.cti"
    text = tmp_path / "text.cti"
    text.write_text("no library", encoding="utf-8")
    for path in (none, text):
        with refused("producer", "camera 'a'", str(path), "producer"):
            open_camera("a", software_camera(producer=str(path)))
    with pytest.raises(DeviceError, match="producer"):
        devices("gentl")
