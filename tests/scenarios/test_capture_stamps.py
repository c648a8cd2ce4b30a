"""Raw stamps find their frames, whatever was left out between, while cameras go on."""

import threading
import time

import numpy as np

from hardware.driver import Capabilities, DeviceReport, Grabbed
from hardware.settings import CameraHardware
from mosca.data.frames import CameraInfo, Frame
from mosca.recording import RecordingWriter, open_recording
from scenarios.lab.recorder import Recorder
from scenarios.lab.stamps import Tap

SETTINGS = CameraHardware(driver="gige", serial="1")


class Endless:
    """A camera whose frames are ready."""

    capabilities = Capabilities(device_clock=True)

    def __init__(self):
        self.block = 0

    def configure(self, settings):
        return DeviceReport("m", "s", 2, 2, 8, 0)

    def grab(self, timeout_s):
        self.block += 1
        image = None if self.block % 7 == 0 else np.zeros((2, 2), np.uint8)
        return Grabbed(self.block, 10 * self.block, 100 * self.block, 0, image, "")


def frame_of(buffer):
    status = "ok" if buffer.image is not None else "corrupt"
    return Frame("a", buffer.block_id, 0, 0, buffer.image, status)


def test_each_frame_finds_its_stamp_and_what_was_left_out_is_passed_over():
    tap = Tap(lambda name, settings: Endless())
    camera = tap.open("a", SETTINGS)
    buffers = [camera.grab(0.1) for _ in range(20)]
    kept = [b for b in buffers if b.block_id not in (3, 4, 11)]
    for buffer in kept:
        stamp = tap.of(frame_of(buffer))
        assert (stamp.block_id, stamp.device_ns, stamp.host_ns) == (
            buffer.block_id,
            10 * buffer.block_id,
            100 * buffer.block_id,
        )
    assert tap.of(frame_of(buffers[0])) is None
    assert tap.of(Frame("b", 0, 0, 0, np.zeros((2, 2), np.uint8))) is None


def test_cameras_go_on_while_stamps_are_looked_up():
    tap = Tap(lambda name, settings: Endless())
    camera = tap.open("a", SETTINGS)
    came, over = [], threading.Event()

    def grab():
        while not over.is_set():
            came.append(camera.grab(0.1))

    thread = threading.Thread(target=grab)
    thread.start()
    try:
        done, deadline = 0, time.monotonic() + 0.5
        while time.monotonic() < deadline:
            if done < len(came):
                buffer, came[done] = came[done], None
                assert tap.of(frame_of(buffer)).block_id == buffer.block_id
                done += 1
    finally:
        over.set()
        thread.join()
    assert done > 100


def test_two_packers_keep_the_order(tmp_path, monkeypatch):
    pack = RecordingWriter.pack

    def uneven(self, frame):
        time.sleep(0.004 * (frame.index % 3))
        return pack(self, frame)

    monkeypatch.setattr(RecordingWriter, "pack", uneven)
    cameras = [CameraInfo(name, 4, 4, 8, 100.0) for name in "ab"]
    image = np.zeros((4, 4), np.uint8)
    with RecordingWriter(tmp_path / "take", cameras) as writer:
        recorder = Recorder(writer, cameras, workers=2)
        for pulse in range(50):
            for name in "ab":
                assert recorder.take(Frame(name, pulse, pulse * 10_000_000, 0, image), 7)
            recorder.tell("notes", pulse, {"pulse": pulse})
        recorder.close()
        recorder.close()
        assert recorder.failed is None
        assert recorder.behind == 0
    with open_recording(tmp_path / "take") as recording:
        assert [(f.camera, f.index) for f in recording] == [(n, p) for p in range(50) for n in "ab"]
        assert [d["pulse"] for _, d in recording.channel("notes")] == list(range(50))
