"""``mosca replay`` and ``mosca live --stream``: what a client gets, what is told, and wrong inputs."""

import re
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import MOSCA, refusal
from tiny_scenario import write_tiny

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from natnet_clients import PATIENT_S, PlainClient, body, take, until, witness
from natnet_witness import natnet

from hardware.streams.natnet.settings import NatNetSettings
from mosca.data.joint_motion import JointMotion
from mosca.formats.bodies.bodies_csv import write_bodies_csv
from mosca.formats.bodies.body_file import write_bodies
from mosca.formats.joints.joints_csv import write_joints_csv
from mosca.formats.tracks.tracks_file import write_tracks
from scenarios.commands.live import run_live_command
from scenarios.commands.live_sources import LiveOptions
from scenarios.lab.replay import ReplayRequest, replay_tracks

FREE = NatNetSettings(command_port=0, data_port=0, forget_s=1e6, settle_s=1e6)
"""However long a computer stalls, a client is kept, and no take begins before the client has had its answers."""


@pytest.fixture
def run_folder(tmp_path):
    """A folder as of 'mosca run': 0.3 s at 100 Hz, 6 markers, the bodies drone and cup."""
    tracks, poses = take(seconds=0.3)
    write_tracks(tracks, tmp_path / "tracks.npz", 100.0)
    write_bodies_csv(poses, tmp_path / "bodies.csv")
    return tmp_path


class Replay:
    """A replay in a thread; ``port`` once it serves, ``lines`` once it is over."""

    def __init__(self, *requests):
        self.lines, self.told, self.port = None, [], None
        self._thread = threading.Thread(target=self._run, args=requests, daemon=True)
        self._thread.start()
        until(lambda: self.port is not None)

    def _run(self, work, request):
        self.lines = work(request, self._hear)

    def _hear(self, line):
        self.told.append(line)
        if found := re.search(r"commands at port (\d+)", line):
            self.port = int(found[1])

    def end(self):
        self._thread.join(PATIENT_S)
        assert self.lines is not None
        return self.lines


def test_a_run_folder_is_replayed_to_a_client_that_is_waited_for(run_folder):
    request = ReplayRequest(run_folder, (FREE,), wait=1, fault=("burst-loss=5@0.1",), seed=3)
    replay = Replay(replay_tracks, request)
    with PlainClient(replay.port) as client:
        until(lambda: len(client.frames) == 25)
        told = replay.end()
    numbers = [one.number - 1000 for one in client.frames]
    assert numbers == [k for k in range(30) if k not in range(10, 15)]
    assert replay.told[0].startswith("NatNet 3.1 at 127.0.0.1: commands at port ")
    assert replay.told[0].endswith("frames to each client; metres, z up")
    assert "30 frames at 100 Hz; 4 labels, bodies: drone, cup" in replay.told[1]
    assert told[0].startswith("30 frames in 0.")
    assert told[1].startswith(f"127.0.0.1:{client.address[1]}: 25 frames sent, 0 dropped")
    assert told[-1] == "fault burst-loss 5: 5 frames from 0.100 s to 0.140 s"


def test_bodies_are_found_by_their_definitions(tmp_path):
    """Three markers that stand as the body's do, moved and turned by a known pose."""
    natnet()
    tracks, _ = take(seconds=0.2, markers=3, labelled=0)
    cup = body("cup", "M0", "M1", "M2")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = np.array([0.5, -0.25, 1.0])
    xyz = np.tile(cup.positions @ turn.T + moved, (20, 1))
    write_tracks(replace(tracks, xyz=xyz), tmp_path / "take.npz", 100.0)
    write_bodies([cup], tmp_path / "bodies.toml")
    request = ReplayRequest(tmp_path / "take.npz", (FREE,), wait=1, bodies=tmp_path / "bodies.toml")
    replay = Replay(replay_tracks, request)
    served = type("Served", (), {"command_port": replay.port, "data_port": 1, "settings": FREE})
    with witness(served) as (_, frames, _models):
        until(lambda: len(frames) == 20)
        replay.end()
    for one in frames:
        (found,) = one.rigid_bodies
        assert found.tracking_valid
        np.testing.assert_allclose(found.pos, moved, atol=1e-6)
        np.testing.assert_allclose(np.abs(found.rot), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-6)
        assert [m.model_id for m in one.labeled_markers] == [1, 1, 1]


def test_joints_beside_the_tracks_are_a_skeleton(run_folder):
    """A pelvis turned by 90 degrees about z that carries a thigh: poses in the world and the tree of bones."""
    natnet()
    n, half = 30, np.sqrt(0.5)
    rotation = np.tile([[half, 0.0, 0.0, half], [1.0, 0.0, 0.0, 0.0]], (n, 1, 1))
    centre = np.tile([[1.0, 2.0, 0.9], [0.9, 2.0, 0.8]], (n, 1, 1))
    frame, none = 1000 + np.arange(n), np.zeros((n, 2, 3, 3))
    motion = JointMotion(frame, 5 * 10**9 + np.arange(n) * 10**7, ("pelvis", "l_hip"), centre, none, rotation, none)
    write_joints_csv(motion, run_folder / "joints.csv")
    # the second client comes once the first has the model: the take is over, and the server gone, after 0.3 s
    replay = Replay(replay_tracks, ReplayRequest(run_folder, (FREE,), wait=2))
    served = type("Served", (), {"command_port": replay.port, "data_port": 1, "settings": FREE})
    with witness(served) as (client, frames, models):
        client.request_modeldef()
        until(lambda: models)
        with PlainClient(replay.port):
            until(lambda: len(frames) == n)
            replay.end()
    assert ", 2 bones, bodies: drone, cup" in replay.told[1]
    (described,) = models[0].skeletons
    pelvis, thigh = described.rigid_body_descriptions
    assert [(one.name, one.id_num, one.parent_id) for one in (pelvis, thigh)] == [("pelvis", 1, 0), ("l_thigh", 2, 1)]
    # (-0.1, 0, -0.1) of the world in axes turned by 90 degrees
    np.testing.assert_allclose(thigh.pos, [0.0, 0.1, -0.1], atol=1e-6)
    (skeleton,) = frames[-1].skeletons
    root, leg = skeleton.rigid_bodies
    assert (skeleton.id_num, root.id_num, leg.id_num) == (1, 0x10001, 0x10002)
    np.testing.assert_allclose(leg.pos, [0.9, 2.0, 0.8], atol=1e-6)
    np.testing.assert_allclose(leg.rot, [0.0, 0.0, half, half], atol=1e-6)
    assert leg.tracking_valid


def test_a_live_run_is_streamed(tmp_path):
    """The drone of a small scenario, live: each frame set is a frame."""
    scenario = write_tiny(tmp_path, duration_s=0.4)
    options = LiveOptions(str(scenario), rate=20.0, queued=100, stream=(FREE,))
    found = []

    def hear(line):
        if at := re.search(r"commands at port (\d+)", line):
            found.append(PlainClient(int(at[1])))
            found[0].ask(12, bytes(8), 13)  # the server is done with what connected the client

    lines = run_live_command(options, hear)
    (client,) = found
    until(lambda: len(client.frames) == 40)
    client.close()
    numbers = [one.number for one in client.frames]
    assert numbers == list(range(numbers[0], numbers[0] + 40))
    mid = np.array([one.mid for one in client.frames])
    # 100 Hz, played at 20; the middle of an exposure is known by the schedule
    np.testing.assert_allclose(np.diff(mid), 0.05, atol=1e-5)
    np.testing.assert_allclose(np.diff([one.timestamp for one in client.frames]), 0.01, atol=1e-6)
    assert all(one.mid <= one.received <= one.transmit for one in client.frames)
    assert "stream: 40 frames" in lines
    assert f"stream: 127.0.0.1:{client.address[1]}: 40 frames sent, 0 dropped" in lines


def test_ctrl_c_ends_a_replay_with_its_account(run_folder):
    command = [*MOSCA, "replay", str(run_folder), "--loop", "--command-port", "0", "--data-port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            port = int(re.search(r"commands at port (\d+)", process.stdout.readline())[1])
            with PlainClient(port) as client:

                def more():
                    client.send(0, b"Ping\0")  # a client that a stall of 10 s kept silent is let go
                    return len(client.frames) > 40  # it goes on after the last

                until(more)
                process.send_signal(signal.SIGINT)
                out, errors = process.communicate(timeout=PATIENT_S)
        finally:
            process.kill()
    assert process.returncode == 0
    assert errors == ""
    numbers = [one.number for one in client.frames]
    # on a computer that stalls some are lost in the socket, or while the client was let go
    assert numbers == sorted(set(numbers))
    sent = int(re.search(rf"127.0.0.1:{client.address[1]}: (\d+) frames sent, 0 dropped", out)[1])
    assert len(numbers) <= sent


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("none.csv", "none.csv: no such file"),
        ("empty", "empty: holds no tracks.npz or tracks.csv; give a file of tracks or a run folder"),
        (". --fault latenz", "--fault latenz: NAME[=VALUE][@AT_S[+FOR_S]] is wanted"),
        (". --faults faults.toml", "faults.toml: key 'program[0].fault': 'latenz' given; "),
        (". --fault label-swap --bodies none.toml", "none.toml: no such file"),
        (". --multicast 10.0.0.1", "multicast group '10.0.0.1' given; 224.0.0.0 to 239.255.255.255"),
        (". --address 203.0.113.7", "203.0.113.7:1510: Cannot assign requested address; give an address of this"),
        (". --rate 2 --fast", "--rate 2: excludes --fast"),
        (". --protocol 2.9", "'2.9' is not one of"),
        (". --stream vrpn", "'vrpn' is not"),
        (". --stream lsl --wait 2", "--wait 2: LSL shows whether somebody listens, not how many; 0 or 1 is wanted"),
        (". --stream foxglove --data-port 0", "--data-port 0: is of streams; give --stream natnet"),
        (". --unlabelled 3", "--unlabelled 3: is of streams; give --stream lsl"),
        (". --joints none.csv", "none.csv"),
        (". --angles bodies.csv", "bodies.csv"),
    ],
)
def test_wrong_inputs_of_replay(run_folder, words, told):
    (run_folder / "empty").mkdir()
    (run_folder / "faults.toml").write_text('[[program]]\nfault = "latenz"\n')
    assert told in refusal("replay", *words.split(), cwd=run_folder)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--up y", "--up y: is of streams; give --stream natnet"),
        ("--command-port 0", "--command-port 0: is of streams; give --stream natnet"),
        ("--bodies b.toml", "--bodies b.toml: is of virtual objects; give --virtual SCENE.xml or --stream natnet"),
    ],
)
def test_options_of_a_stream_want_a_stream(tmp_path, words, told):
    assert told in refusal("live", "any_source", *words.split(), cwd=tmp_path)
