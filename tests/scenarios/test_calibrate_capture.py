"""A rig calibrated from what its own devices filmed: cameras on the network before a test field, captured."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import MOSCA, mosca_alone
from test_calibrate_verbs import FIELD, recorded, scenario

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))

from loopback import free_address
from needs import needs_aravis, needs_module

from mosca.calibration.quality.compare_rigs import compare_rigs
from mosca.data.files.rig_file import read_rig
from mosca.data.files.target_text import target_toml
from mosca.recording import open_recording
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.session.scenes import target_session


def mosca(*words: object) -> str:
    """Run the command line in a process of its own, as a user does; its output. It must succeed."""
    done = mosca_alone(*words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_capture_of_devices_is_calibrated_as_the_images_themselves_are(tmp_path):
    needs_aravis()
    needs_module("serial", "serial")
    spec = scenario(**FIELD)
    truth = true_rig(spec, tmp_path)
    session = target_session(spec, spec.calibration)
    field = recorded(tmp_path / "filmed", spec, session, virtual_cameras(spec, truth)).target
    (tmp_path / "field.toml").write_text(target_toml(field))
    served, take = tmp_path / "served.toml", tmp_path / "take"
    words = ["twin", "serve", tmp_path / "filmed", "--rig-out", served, "--trigger", "serial"]
    words += ["--address", free_address(), "--rate", "10", "--seconds", "120"]
    with subprocess.Popen([*MOSCA, *map(str, words)], stdout=subprocess.DEVNULL) as server:
        try:
            deadline = time.monotonic() + 60
            while not served.exists():
                assert server.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            mosca("capture", "--rig", served, "--out", take, "--frames", session.pulses)
        finally:
            server.terminate()
    with open_recording(tmp_path / "filmed") as filmed, open_recording(take) as captured:
        pictures = {(f.camera, round(f.time_ns * spec.calibration.rate_hz / 1e9)): f.image for f in filmed}
        frames = list(captured)
    assert len(frames) == len(pictures) == 3 * session.pulses
    for frame in frames:
        np.testing.assert_array_equal(frame.image, pictures[frame.camera, round(frame.time_ns / 1e8)])
    for source in ("filmed", "take"):
        out = tmp_path / f"{source}.toml"
        told = mosca(
            "calibrate", tmp_path / source, "--target", tmp_path / "field.toml", "--out", out,
            "--pixel-pitch-mm", "0.0099",
        )  # fmt: skip
        assert "scale from the test field's marks" in told
    found = read_rig(tmp_path / "take.toml")
    # a camera's body shakes by 0.03 px at each of 12 exposures
    assert max(one.rms_px for one in compare_rigs(truth, found, align="none").cameras) < 0.1
    same = compare_rigs(read_rig(tmp_path / "filmed.toml"), found, align="none")
    assert max(one.rms_px for one in same.cameras) < 1e-6
