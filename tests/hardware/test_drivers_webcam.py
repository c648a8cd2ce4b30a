"""The webcam driver, with video files instead of a webcam."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from driven import pictures, refused, write_video

from hardware.driver import DeviceError
from hardware.drivers import open_camera
from hardware.settings import CameraHardware


def played(path: Path, **more: object) -> CameraHardware:
    return CameraHardware.model_validate({"driver": "webcam", "address": str(path), "trigger": "Off", **more})


def test_a_lossless_grey_file_comes_bit_for_bit_each_time_from_its_beginning(tmp_path: Path) -> None:
    images = pictures(40, 3)
    write_video(tmp_path / "grey.mkv", images)
    settings = played(tmp_path / "grey.mkv")
    camera = open_camera("a", settings)
    report = camera.configure(settings)
    assert (report.width, report.height, report.model) == (656, 491, "video file")
    assert report.settings["CAP_PROP_FPS"] == 100.0
    for begun in range(2):
        camera.arm()
        if begun == 0:
            # left early: the next start is at the first frame again
            assert camera.grab(60.0) is not None
            camera.disarm()
            continue
        for number, image in enumerate(images, start=1):
            grabbed = camera.grab(60.0)
            assert grabbed is not None
            assert grabbed.block_id == number
            assert np.array_equal(grabbed.image, image)
        assert camera.grab(0.1) is None
        assert camera.statistics() == {"frames": 40, "overruns": 0}
    camera.close()


def test_colour_is_reduced_by_the_one_rule(tmp_path: Path) -> None:
    path = tmp_path / "colour.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    colours = np.zeros((48, 64, 3), np.uint8)
    colours[:, :32] = (200, 40, 10)
    colours[:, 32:] = (10, 90, 250)
    for _ in range(3):
        writer.write(colours)
    writer.release()
    # what OpenCV decodes, reduced by OpenCV
    capture = cv2.VideoCapture(str(path))
    there, decoded = capture.read()
    capture.release()
    assert there
    camera = open_camera("a", played(path))
    camera.configure(played(path))
    camera.arm()
    grabbed = camera.grab(60.0)
    camera.close()
    assert grabbed is not None
    assert np.array_equal(grabbed.image, cv2.cvtColor(decoded, cv2.COLOR_BGR2GRAY))


def test_what_a_webcam_cannot_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "grey.mkv", pictures(2, 3, 64, 48))
    camera = open_camera("a", played(tmp_path / "grey.mkv"))
    for change, words in (
        ({"trigger": "Line1"}, ("trigger = 'Line1'", "Off")),
        ({"pixel_format": "Mono12"}, ("Mono12", "Mono8")),
        ({"packet_bytes": 8000}, ("packet_bytes",)),
        ({"window": (8, 0, 32, 32)}, ("no offsets",)),
        ({"window": (0, 0, 32, 32)}, ("CAP_PROP_FRAME_WIDTH", "32", "64")),
        ({"exposure_us": 800.0}, ("exposure_us",)),
        ({"gain_db": 3.0}, ("gain_db",)),
        ({"features": {"CAP_PROP_NOPE": 1}}, ("CAP_PROP_NOPE",)),
        ({"features": {"CAP_PROP_FPS": "fast"}}, ("numbers",)),
    ):
        with refused("camera 'a'", *words):
            camera.configure(played(tmp_path / "grey.mkv", **change))
    camera.close()


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mkv"
    broken.write_bytes(b"no video")
    with refused("can read", "camera 'a'", "broken.mkv"):
        open_camera("a", played(broken))
    with pytest.raises(DeviceError, match="serial"):
        open_camera("a", CameraHardware(driver="webcam", serial="1", trigger="Off"))
