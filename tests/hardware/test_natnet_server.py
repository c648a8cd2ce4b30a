"""The NatNet server before its clients: well-behaved, slow, dead and malicious ones."""

import random
import socket
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from natnet_clients import (
    PATIENT_S,
    PERIOD_S,
    PlainClient,
    body,
    listening,
    read_by,
    server,
    take,
    take_frames,
    until,
    witness,
)

from hardware.streams.content import TakeFrames
from hardware.streams.natnet.settings import NatNetSettings
from hardware.streams.play import StreamPlayer, looped
from hardware.streams.values import StreamFrame
from mosca.errors import InputError

GROUP = "239.255.42.98"
COMMANDS = struct.Struct("<f")


def send(served, number=1, time_s=0.0):
    now = served.clock_ns()
    served.send(StreamFrame(number, time_s), now, now)


def test_a_client_connects_and_asks_everything():
    model = take_frames(seconds=0.02).model
    about = {"version": (3, 0), "name": "twin", "server_version": (1, 2, 3, 4), "rate_hz": 50.0}
    with server(model, **about) as served, PlainClient(served.command_port) as client:
        info = client.of(1)[0][0]
        assert info[:5] == b"twin\0"
        assert len(info) == 279
        assert tuple(info[256:264]) == (1, 2, 3, 4, 3, 0, 0, 0)
        assert struct.unpack_from("<QH?4s", info, 264) == (10**7, served.data_port, False, bytes(4))
        assert client.ask(2, b"FrameRate\0", 3) == struct.pack("<f", 50.0)
        assert client.ask(2, b"UnitsToMillimeters\0", 3) == struct.pack("<f", 1000.0)
        assert client.ask(2, b"UpAxis\0", 3) == struct.pack("<i", 2)
        assert client.ask(2, b"AnalogSamplesPerMocapFrame\0", 3) == struct.pack("<i", 0)
        unknown = client.ask(2, b"TestRequest\0", 100)
        assert len(unknown) == 264
        assert unknown[:5] == b"twin\0"
        assert client.ask(4, b"", 5)[:4] == struct.pack("<I", len(model))
        before = served.clock_ns() // 100
        asked, now = struct.unpack("<QQ", client.ask(12, struct.pack("<Q", 77), 13))
        assert asked == 77
        assert before <= now <= served.clock_ns() // 100
        send(served, 5)
        until(lambda: len(client.frames) == 1)
        client.send(6)  # the newest frame again
        until(lambda: len(client.frames) == 2)
        assert [one.number for one in client.frames] == [5, 5]
        client.send(10)
        client.send(9)  # disconnects
        until(lambda: served.counts["disconnect"] == 1)
        send(served, 6)
        assert served.connected() == 0
        (account,) = served.clients()
        assert (account.address, account.sent, account.dropped) == (client.address, 1, 0)
        assert account.left == "disconnected"
        assert served.counts["keep alive"] == 1
        assert served.counts["garbage"] == 0


def test_discovery_makes_no_client():
    with server() as served, PlainClient(served.command_port, connect=False) as stranger:
        assert len(stranger.ask(14, bytes(264), 1)) == 279
        assert served.connected() == 0


def test_the_recorded_discovery_and_connection_are_answered(data_dir):
    folder = data_dir / "natnet"
    if not folder.is_dir():
        pytest.skip("no recorded NatNet traffic")
    with server(version=(3, 0)) as served, PlainClient(served.command_port, connect=False) as client:
        for name in ("discovery", "connect", "requestmodeldef", "echorequest"):
            client.raw((folder / f"{name}_packet_v3.bin").read_bytes())
        until(lambda: len(client.messages) == 4)
        kinds = sorted(data[0] for data, _ in client.messages)
        assert kinds == [1, 1, 5, 13]


@pytest.mark.parametrize(("version", "up"), [((3, 0), "z"), ((3, 1), "y"), ((4, 0), "z"), ((4, 1), "y")])
def test_the_witness_gets_every_frame_and_value(version, up):
    tracks, poses = take(seconds=0.3, markers=8, labelled=5)
    owner = body("cup", "M0", "M1", "M2")
    frames = TakeFrames(tracks, poses, [owner], up)
    with server(frames.model, version=version) as served, witness(served) as (client, got, models):
        client.request_modeldef()
        until(lambda: models)
        listening(served)
        StreamPlayer(served).play(frames, PERIOD_S)
        until(lambda: len(got) == len(frames))
    assert [one.prefix.frame_number for one in got] == list(range(1000, 1030))
    turn = np.eye(3) if up == "z" else np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    numbers = {one.name: one.id_num for one in models[0].rigid_bodies}
    assert numbers == {"cup": 1, "drone": 2}
    sets = {one.name: one.marker_names for one in models[0].marker_sets}
    assert sets == {"cup": ("M0", "M1", "M2"), "markers": ("M3", "M4"), "all": ("M0", "M1", "M2", "M3", "M4")}
    (described,) = [one for one in models[0].rigid_bodies if one.name == "cup"]
    np.testing.assert_array_equal([m.pos for m in described.markers], owner.positions.astype("f4"))
    for k, one in enumerate(got):
        rows = tracks.frame == 1000 + k
        expected = (tracks.xyz[rows] @ turn.T).astype("f4")
        np.testing.assert_array_equal([m.pos for m in one.labeled_markers], expected)
        ids = [(m.model_id, m.marker_id) for m in one.labeled_markers]
        assert ids == [(1, 1), (1, 2), (1, 3), (3, 1), (3, 2), (0, 6), (0, 7), (0, 8)]
        assert [m.unlabeled for m in one.labeled_markers] == [False] * 5 + [True] * 3
        assert all(m.point_cloud_solved and not m.occluded for m in one.labeled_markers)
        np.testing.assert_allclose([m.residual for m in one.labeled_markers], 2e-4, rtol=1e-6)
        np.testing.assert_array_equal(one.unlabeled_marker_pos, expected[5:])
        by_set = {s.model_name: s.marker_pos_list for s in one.marker_sets}
        np.testing.assert_array_equal(by_set["all"], expected[:5])
        np.testing.assert_array_equal(by_set["markers"], expected[3:5])
        for b in one.rigid_bodies:
            row = np.flatnonzero((poses.frame == 1000 + k) & (poses.body == {1: "cup", 2: "drone"}[b.id_num]))[0]
            np.testing.assert_array_equal(b.pos, (turn @ poses.position[row]).astype("f4"))
            assert b.tracking_valid
            assert b.marker_error == np.float32(1e-4)
            # the body's markers are where the pose puts them
            w, _, _, z = poses.quaternion[row]
            angle = 2 * np.arctan2(z, w)
            about_z = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
            np.testing.assert_allclose(rotation(b.rot), turn @ about_z, atol=1e-6)
        assert one.suffix.timestamp == pytest.approx(5.0 + k * PERIOD_S, abs=1e-9)
        assert one.suffix.stamp_camera_mid_exposure <= one.suffix.stamp_data_received <= one.suffix.stamp_transmit
    mid = np.array([one.suffix.stamp_camera_mid_exposure for one in got]) * 1e-7
    np.testing.assert_allclose(np.diff(mid), PERIOD_S, atol=1e-6)


def rotation(xyzw):
    """Return the matrix of a quaternion xyzw."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(xyzw).as_matrix()


def test_the_witness_reads_multicast():
    frames = take_frames(seconds=0.5)
    with server(frames.model, group=GROUP) as served, witness(served, multicast=True) as (_, got, _models):
        StreamPlayer(served).play(frames, PERIOD_S)
        until(lambda: len(got) == len(frames))
        assert served.clients()[0].sent == len(frames)
    assert [one.prefix.frame_number for one in got] == list(range(1000, 1050))


def test_the_witness_may_change_the_version():
    frames = take_frames(seconds=0.1)
    with server(frames.model, version=(4, 1)) as served, PlainClient(served.command_port) as client:
        assert client.ask(2, b"Bitstream,3.0\0", 3) == struct.pack("<i", 0)
        StreamPlayer(served).play(frames, PERIOD_S)
        until(lambda: len(client.frames) == len(frames))
        assert client.frames[3].number == 1003
        assert client.frames[3].timestamp == pytest.approx(5.03)
        assert served.clients()[0].version == (3, 0)
        assert client.ask(2, b"Bitstream,9.9\0", 100)


MOTIONCAPTURE = Path(__file__).parent / "motioncapture_client.py"


@pytest.mark.parametrize("group", [GROUP, None])
@pytest.mark.parametrize("version", [(3, 1), (4, 1)])
def test_motioncapture_reads_bodies(group, version):
    """In a process of its own: it blocks the interpreter while it waits."""
    pytest.importorskip("motioncapture", reason="motioncapture is not installed (mosca-testbench[bench])")
    frames = take_frames(seconds=30.0)
    with server(frames.model, group=group, version=version) as served:
        command = [sys.executable, str(MOTIONCAPTURE), str(served.command_port), "40"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            player = StreamPlayer(served)
            thread = threading.Thread(target=player.play, args=(looped(frames, PERIOD_S), PERIOD_S))
            thread.start()
            try:
                told, _ = process.communicate(timeout=PATIENT_S)
            finally:
                player.stop()
                thread.join()
                process.kill()
    rows = [line.split() for line in told.splitlines() if line.startswith("drone ")]
    assert len(rows) == 40
    places = np.array([row[1:4] for row in rows], float)
    # body 0 at (0, 2, frame): the number of the frame in the take, which is played again and again
    np.testing.assert_array_equal(places[:, :2], np.tile([0.0, 2.0], (40, 1)))
    assert np.diff(places[:, 2]).all()
    half = places[:, 2] / 500 / 2
    np.testing.assert_allclose([float(row[4]) for row in rows], np.cos(half), atol=1e-6)
    if group is None:
        account = served.clients()[0]
        assert account.to == (account.address[0], served.data_port)
        assert account.sent >= 40


def test_a_client_whose_ports_are_closed_is_let_go():
    with server() as served, PlainClient(served.command_port) as kept:
        dead = PlainClient(served.command_port)
        listening(served, 2)
        dead.close()

        def gone():
            send(served)
            return served.connected() == 1

        until(gone)
        told = {one.address: one for one in served.clients()}
        assert told[dead.address].left == "gone"
        assert told[kept.address].dropped == 0
        assert told[kept.address].left == ""


def test_a_silent_client_is_let_go_and_may_come_back():
    with server(forget_s=0.2) as served, PlainClient(served.command_port) as client:
        until(lambda: served.clients()[0].left)
        assert served.clients()[0].left == "silent"
        assert served.connected() == 0
        served.settings = replace(served.settings, forget_s=1e6)  # this computer may stall longer than the 0.2 s
        client.connect()
        listening(served)
        assert served.clients()[0].left == ""


def test_too_many_clients_are_refused():
    with server(most_clients=2) as served:
        clients = [PlainClient(served.command_port) for _ in range(2)]
        listening(served, 2)
        with PlainClient(served.command_port, connect=False) as one_more:
            one_more.send(0, b"Ping\0")
            until(lambda: served.counts["refused"] == 1)
            send(served)
            until(lambda: all(len(client.frames) == 1 for client in clients))
            assert one_more.messages == []
        for client in clients:
            client.close()


def test_a_slow_client_loses_frames_and_the_others_none():
    """One client never reads: its buffer in the kernel is full, and neither the server nor the other client waits."""
    frames = take_frames(seconds=0.5, markers=60)
    with server(frames.model) as served, PlainClient(served.command_port) as good:
        slow = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.bind(("127.0.0.1", 0))
        slow.sendto(struct.pack("<HH", 0, 0), ("127.0.0.1", served.command_port))
        listening(served, 2)
        StreamPlayer(served).play(frames, PERIOD_S)
        until(lambda: len(good.frames) == len(frames))
        slow.close()
    assert [one.number for one in good.frames] == list(range(1000, 1050))


class FullSocket:
    """A client's socket whose send buffer takes every second message."""

    def __init__(self, inner):
        self.inner, self.asked = inner, 0

    def send(self, data):
        self.asked += 1
        if self.asked % 2:
            raise BlockingIOError
        return self.inner.send(data)

    def fileno(self):
        return self.inner.fileno()

    def close(self):
        self.inner.close()


def test_frames_that_do_not_fit_are_counted_for_that_client_alone():
    with server() as served, PlainClient(served.command_port) as good, PlainClient(served.command_port) as slow:
        listening(served, 2)
        made = served._clients[slow.address]
        made.socket = FullSocket(made.socket)
        for k in range(10):
            send(served, k)
        until(lambda: len(good.frames) == 10 and len(slow.frames) == 5)
        told = {one.address: (one.sent, one.dropped) for one in served.clients()}
        assert told == {good.address: (10, 0), slow.address: (5, 5)}
        made.socket = made.socket.inner


def mutated(rng):
    """Return a datagram: a command, changed, cut, lengthened, or bytes drawn at random."""
    kind = rng.choice([0, 2, 4, 6, 9, 10, 12, 14, 100, 7, 5])
    text = rng.choice([b"Ping\0", b"FrameRate\0", b"Bitstream,3.0\0", b"", bytes(264)])
    data = bytearray(struct.pack("<HH", kind, len(text)) + text)
    for _ in range(rng.randrange(4)):
        match rng.randrange(3):
            case 0 if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
            case 1:
                del data[rng.randrange(len(data) + 1) :]
            case _:
                data += rng.randbytes(rng.randrange(300))
    return rng.randbytes(rng.randrange(1500)) if rng.random() < 0.2 else bytes(data)


def flood(served, rng, count):
    """Send so many mutated packets, no faster than they are read: what the kernel throws away is no test."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bad:
        bad.bind(("127.0.0.1", 0))
        bad.settimeout(0.02)
        to = ("127.0.0.1", served.command_port)
        for k in range(count):
            bad.sendto(mutated(rng), to)
            if k % 50 == 49:
                stamp = struct.pack("<Q", k)
                answer = b""
                end, asked = time.monotonic() + 30, 0.0
                while answer[:2] != b"\x0d\0" or answer[4:12] != stamp:
                    now = time.monotonic()
                    assert now < end, "the server does not answer"
                    if now - asked > 0.02:  # again: answers to garbage, and frames, may have filled this buffer
                        bad.sendto(struct.pack("<HH", 12, 8) + stamp, to)
                        asked = now
                    try:
                        answer = bad.recv(65536)
                    except (TimeoutError, ConnectionRefusedError):
                        answer = b""


def test_garbage_changes_nothing_for_others():
    """10,000 mutated packets beside a client: its frames come one by one, memory stays as it is."""
    rng = random.Random(7)
    frames = take_frames(seconds=1.0, markers=20)
    with server(frames.model) as served, PlainClient(served.command_port) as good:
        player = StreamPlayer(served)
        listening(served)
        endless = read_by(good, looped(frames, PERIOD_S))
        thread = threading.Thread(target=player.play, args=(endless, PERIOD_S))
        thread.start()
        flood(served, rng, 10_000)
        tracemalloc.start()
        flood(served, rng, 500)
        grown = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/hardware/streams/*")])
        tracemalloc.stop()
        player.stop()
        thread.join()
        until(lambda: len(good.frames) == player.played)
        assert served.counts["garbage"] > 500
        assert served.connected() <= 4
        assert len(served.clients()) <= 6
    numbers = [one.number for one in good.frames]
    assert numbers == list(range(1000, 1000 + len(numbers)))
    # half of it are the frames on their way; what kept a small object a packet would have 300 kB
    assert sum(one.size for one in grown.statistics("filename")) < 150_000


def test_a_frame_that_no_datagram_holds_is_counted_and_left_out():
    with server() as served, PlainClient(served.command_port) as client:
        listening(served)
        now = served.clock_ns()
        served.send(StreamFrame(1, 0.0, other=np.zeros((6000, 3), "f4")), now, now)
        send(served, 2)
        until(lambda: len(client.frames) == 1)
        assert served.too_large == 1
        assert client.frames[0].number == 2


def test_a_second_server_on_the_port_is_refused():
    with server() as served:
        with pytest.raises(InputError, match=f"127.0.0.1:{served.command_port}: "):
            server(command_port=served.command_port)
        with PlainClient(served.command_port), pytest.raises(InputError, match="no other server"):
            server(command_port=served.command_port)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"version": (2, 9)}, "3.0, 3.1, 4.0, 4.1 are spoken"),
        ({"group": "10.0.0.1"}, "224.0.0.0 to 239.255.255.255"),
        ({"group": "here"}, "224.0.0.0 to 239.255.255.255"),
    ],
)
def test_settings_that_cannot_be(given, told):
    with pytest.raises(InputError, match=told):
        NatNetSettings(**given)


@pytest.mark.parametrize("address", ["203.0.113.7", "nowhere.invalid"])
def test_an_address_that_is_not_here_is_told(address):
    with pytest.raises(InputError, match="give an address of this machine"):
        server(address=address)


def test_frames_wait_until_a_client_has_asked_its_questions():
    """One that takes the first message after its request of the model for the answer gets that answer."""
    model = take_frames(seconds=0.02).model
    with server(model, settle_s=1e6) as served, PlainClient(served.command_port, connect=False) as client:
        client.ask(0, b"Ping\0", 1)
        send(served, 1)
        client.ask(4, b"", 5)
        listening(served)
        send(served, 2)
        until(lambda: len(client.frames) == 1)
        assert [data[0] for data, _ in client.messages] == [1, 5, 7]
        assert client.frames[0].number == 2
