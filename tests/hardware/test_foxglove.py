"""The Foxglove server before a plain websocket client: channels, values, stamps, faults."""

import json
import struct
import sys
from contextlib import ExitStack

import numpy as np
import pytest
from natnet_clients import PATIENT_S, take_frames, until
from needs import needs_module

from hardware.streams.foxglove_server import FoxgloveServer, FoxgloveSettings
from mosca.errors import InputError

START = 1000


class Client:
    """Subscribes to topics by the protocol's JSON; messages come as an opcode, a number, a time stamp and data."""

    def __init__(self, port, *topics):
        connect = needs_module("websockets.sync.client", package="websockets").connect
        protocol = needs_module("websockets.typing", package="websockets").Subprotocol("foxglove.sdk.v1")
        self._open = ExitStack()
        made = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], open_timeout=PATIENT_S)
        self._socket = self._open.enter_context(made)
        self.channels = {}
        while not set(topics) <= self.channels.keys():
            told = json.loads(self._socket.recv(PATIENT_S))
            if told["op"] == "advertise":
                self.channels |= {one["topic"]: one for one in told["channels"]}
        asked = [{"id": k, "channelId": self.channels[topic]["id"]} for k, topic in enumerate(topics)]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        self.topics = topics

    def read(self, count):
        """Return (topic, stamp [ns], data) of the next messages."""
        found = []
        while len(found) < count:
            data = self._socket.recv(PATIENT_S)
            if isinstance(data, bytes) and data[0] == 1:
                number, stamp = struct.unpack_from("<IQ", data, 1)
                found.append((self.topics[number], stamp, data[13:]))
        return found

    def close(self):
        self._open.close()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()


def server(frames):
    needs_module("foxglove", "foxglove")
    return FoxgloveServer(frames.model, frames.names, FoxgloveSettings(port=0))


def length_delimited(data, wanted):
    """Return the parts of a protocol buffer's message that have a field's number; a reader of the wire format."""
    found, at = [], 0

    def varint():
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(data):
        key = varint()
        kind = key & 7
        size = {0: 0, 1: 8, 5: 4}.get(kind)
        if kind == 0:
            varint()
            continue
        size = varint() if size is None else size
        if key >> 3 == wanted and kind == 2:
            found.append(data[at : at + size])
        at += size
    return found


def test_a_client_reads_clouds_scene_and_numbers():
    frames = take_frames(seconds=0.2)
    with server(frames) as served, Client(served.port, "/markers", "/frame", "/tf") as client:
        until(lambda: served.connected() == 1 and sum(served.listener._subscribed.values()) == 3)
        mids = []
        for one in frames:
            mids.append(served.clock_ns())
            served.send(one, mids[-1], mids[-1])
        got = client.read(60)
        assert {name: one["schemaName"] for name, one in client.channels.items() if name != "/frame"}.items() >= {
            ("/markers", "foxglove.PointCloud"), ("/bodies", "foxglove.PosesInFrame"),
            ("/scene", "foxglove.SceneUpdate"), ("/tf", "foxglove.FrameTransforms"),
        }  # fmt: skip
        assert "Foxglove: 20 frames, 1 clients subscribed" in served.lines()
    numbers = [json.loads(data) for topic, _, data in got if topic == "/frame"]
    assert [one["frame"] for one in numbers] == list(range(START, START + 20))
    clouds = [(stamp, data) for topic, stamp, data in got if topic == "/markers"]
    # one clock, whatever its epoch: stamps differ as the exposures do
    stamps = np.array([stamp for stamp, _ in clouds])
    np.testing.assert_array_equal(stamps - stamps[0], np.array(mids) - mids[0])
    for k, (_, data) in enumerate(clouds):
        (points,) = length_delimited(data, 6)  # foxglove.PointCloud: data
        xyz = np.frombuffer(points, "<f4").reshape(6, 5)[:, :3]
        np.testing.assert_allclose(np.sort(xyz[:, 0]), np.arange(6))
        np.testing.assert_allclose(xyz[:, 1], k / 1000, atol=1e-6)
    (first,) = [data for topic, _, data in got if topic == "/tf"][:1]
    names = [length_delimited(one, 3)[0].decode() for one in length_delimited(first, 1)]
    assert names == ["drone", "cup"]


def test_it_returns_at_its_port_and_is_silent_while_the_line_is_lost():
    frames = take_frames(seconds=0.03)
    (first, *_) = frames
    with server(frames) as served:
        port = served.port
        with Client(port, "/frame") as client:
            until(lambda: served.connected() == 1)
            served.set_line(0, True)
            served.send(first, 0, 0)
            served.set_line(0, False)
            served.send(first, 10**9, 0)
            ((_, stamp, _),) = client.read(1)
            assert stamp == 10**9 + served._day_minus_host_ns
        served.shut()
        assert served.connected() == 0
        served.start()
        assert served.port == port
        with Client(port, "/frame") as client:
            until(lambda: served.connected() == 1)
            served.send(first, 0, 0)
            assert len(client.read(1)) == 1


def test_a_port_that_is_taken_is_one_line():
    frames = take_frames(seconds=0.02)
    with (
        server(frames) as served,
        pytest.raises(InputError, match=rf"127.0.0.1:{served.port}: .*a free port") as error,
    ):
        FoxgloveServer(frames.model, frames.names, FoxgloveSettings(port=served.port))
    assert "\n" not in str(error.value)


def test_without_foxglove_it_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    frames = take_frames(seconds=0.02)
    with pytest.raises(InputError, match=r"--stream foxglove: .*pip install 'mosca-testbench\[foxglove\]'$"):
        FoxgloveServer(frames.model, frames.names)
