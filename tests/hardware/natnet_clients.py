"""Clients of NatNet: a plain one that reads numbers and stamps alone, and the package ``natnet``."""

import select
import socket
import struct
import threading
import time
from contextlib import contextmanager

import numpy as np
from natnet_witness import natnet

from hardware.streams.content import TakeFrames
from hardware.streams.natnet.server import NatNetServer
from hardware.streams.natnet.settings import NatNetSettings
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks

PATIENT_S = 300.0
"""More than a busy computer needs to compile what a test renders."""
RATE_HZ = 100.0
PERIOD_S = 1 / RATE_HZ


def until(met, told=lambda: ""):
    """Wait until ``met()`` is true; ``told()`` says what there was instead."""
    deadline = time.monotonic() + PATIENT_S
    while not met():
        assert time.monotonic() < deadline, told()
        time.sleep(0.005)


def server(model=(), **settings):
    """Return a server on free ports of loopback, which lets no client go that a busy computer keeps silent."""
    return NatNetServer(model, NatNetSettings(**{"command_port": 0, "data_port": 0, "forget_s": 1e6, **settings}))


def listening(served, count=1):
    """Wait until so many clients get frames: an answer may reach a client before the server has noted that."""
    until(lambda: served.connected() == count)


def read_by(client, frames, most=50):
    """Yield frames, at most so many before what a client has read: its socket holds no more after a stall."""
    for k, frame in enumerate(frames):
        until(lambda k=k: len(client.messages) > k - most)
        yield frame


class Received:
    """One frame of data: number and stamps [s], and when it came (monotonic) [s]."""

    def __init__(self, message, came_ns):
        (self.number,) = struct.unpack_from("<I", message, 4)
        # time code, time stamp, three stamps, flags, tag: they stand at the end of 3.x and 4.0
        self.timestamp, *ticks = struct.unpack_from("<dQQQ", message, len(message) - 38)
        self.mid, self.received, self.transmit = (tick * 1e-7 for tick in ticks)
        self.came = came_ns * 1e-9


class PlainClient:
    """Sends commands, and keeps what it is sent."""

    def __init__(self, port, connect=True):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.socket.bind(("127.0.0.1", 0))
        self.address = self.socket.getsockname()
        self._to = ("127.0.0.1", port)
        self.messages = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        if connect:
            self.connect()

    def send(self, kind, payload=b""):
        self.raw(struct.pack("<HH", kind, len(payload)) + payload)

    def raw(self, data):
        self.socket.sendto(data, self._to)

    def connect(self):
        """Connect, again and again until there is an answer: a server may be starting."""
        before = len(self.of(1))
        deadline = time.monotonic() + PATIENT_S
        while len(self.of(1)) == before:
            assert time.monotonic() < deadline
            self.send(0, b"Ping\0")
            time.sleep(0.02)
        self.ask(12, bytes(8), 13)  # frames come once the server is done with it

    def of(self, kind):
        """Return (payload, time) of the messages of a kind."""
        return [(data[4:], came) for data, came in tuple(self.messages) if data[:2] == struct.pack("<H", kind)]

    def ask(self, kind, payload=b"", answer=None):
        """Return the payload of the next message of kind ``answer`` after sending one."""
        before = len(self.of(answer))
        self.send(kind, payload)
        until(lambda: len(self.of(answer)) > before)
        return self.of(answer)[before][0]

    @property
    def frames(self):
        return [Received(data, came) for data, came in tuple(self.messages) if data[:2] == b"\x07\0"]

    def close(self):
        self._stop.set()
        self._thread.join()
        self.socket.close()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def _read(self):
        while not self._stop.is_set():
            if select.select([self.socket], [], [], 0.05)[0]:
                try:
                    self.messages.append((self.socket.recv(65536), time.monotonic_ns()))
                except ConnectionRefusedError:
                    continue


@contextmanager
def witness(served, multicast=False):
    """Yield (client, frames, models) of the package natnet, which follows in a thread of its own."""
    frames, models = [], []
    group = served.settings.group or "239.255.42.99"
    ports = {"command_port": served.command_port, "data_port": served.data_port}
    client = natnet().NatNetClient("127.0.0.1", "127.0.0.1", group, use_multicast=multicast, **ports)
    client.on_data_frame_received_event.handlers.append(frames.append)
    client.on_data_description_received_event.handlers.append(models.append)
    client.connect(timeout=PATIENT_S)
    try:
        client.run_async()
        yield client, frames, models
    finally:
        client.shutdown()


def body(name, *markers):
    """Return a rigid body of three markers."""
    return RigidBody(name, markers, np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.05]]))


def take(seconds=1.0, markers=6, bodies=("drone", "cup"), rate_hz=RATE_HZ, labelled=4, start=1000):
    """Return tracks and poses: marker k at (k, t / 1000, 1), body b at (b, 2, t), for t frames after the first."""
    n = round(seconds * rate_hz)
    frame = np.repeat(np.arange(start, start + n), markers)
    track = np.tile(np.arange(markers), n)
    time_ns = np.round((frame - start) / rate_hz * 1e9).astype(np.int64) + 5_000_000_000
    names = np.array([f"M{k}" if k < labelled else "" for k in range(markers)])
    tracks = Tracks(
        frame, time_ns, track, names[track], np.column_stack([track, (frame - start) / 1000, np.ones(len(frame))]),
        np.tile(4e-8 * np.eye(3), (len(frame), 1, 1)), np.full(len(frame), 4), np.full(len(frame), 0.1),
        np.full(len(frame), "measured"),
    )  # fmt: skip
    m = len(bodies)
    at, which = np.repeat(np.arange(start, start + n), m), np.tile(np.arange(m), n)
    angle = (at - start) / 500
    quaternion = np.column_stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])
    poses = BodyPoses(
        at, np.round((at - start) / rate_hz * 1e9).astype(np.int64) + 5_000_000_000, np.array(bodies, np.str_)[which],
        quaternion, np.column_stack([which, np.full(len(at), 2.0), at - start]), np.zeros((len(at), 6, 6)),
        np.full(len(at), 3), np.full(len(at), 1e-4), np.full(len(at), "measured"),
    )  # fmt: skip
    return tracks, poses


def take_frames(**given):
    """Return the frames of ``take``."""
    return TakeFrames(*take(**given))
