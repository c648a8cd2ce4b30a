"""Packers that work side by side keep the frames' order."""

import time

import numpy as np

from mosca.data.frames import CameraInfo, Frame
from mosca.recording import RecordingWriter, open_recording
from scenarios.lab.recorder import Recorder


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
            recorder.write_message("notes", pulse, {"pulse": pulse})
        recorder.close()
        recorder.close()
        assert recorder.failed is None
        assert recorder.behind == 0
    with open_recording(tmp_path / "take") as recording:
        assert [(f.camera, f.index) for f in recording] == [(n, p) for p in range(50) for n in "ab"]
        assert [d["pulse"] for _, d in recording.channel("notes")] == list(range(50))
