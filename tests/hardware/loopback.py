"""Addresses on loopback that no other test uses at the same time, and a minimal client of the control protocol."""

import itertools
import os
import socket
import struct
import time

PATIENT_S = 60.0
"""For answers that come at once, however busy the machine is."""

_blocks = itertools.count()


def until(met) -> None:
    """Wait until ``met()`` is true."""
    deadline = time.monotonic() + PATIENT_S
    while not met():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def free_address() -> str:
    """Return an address of this process, followed by 200 free ones: 127.(20 to 239).x.1."""
    block = (os.getpid() * 64 + next(_blocks)) % (220 * 250)
    return f"127.{20 + block // 250}.{block % 250}.1"


class Hand:
    """A socket that sends commands written byte by byte."""

    def __init__(self, camera: str, own: str = "127.0.0.1") -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((own, 0))
        self._socket.settimeout(PATIENT_S)
        self._camera = (camera, 3956)
        self._number = 0
        self.port = self._socket.getsockname()[1]

    def send(self, datagram: bytes) -> None:
        self._socket.sendto(datagram, self._camera)

    def receive(self, timeout_s: float = PATIENT_S) -> bytes | None:
        self._socket.settimeout(timeout_s)
        try:
            return self._socket.recv(65536)
        except TimeoutError:
            return None

    def ask(self, command: int, payload: bytes = b"", flags: int = 1) -> tuple[int, bytes]:
        """Return status and payload of the acknowledgement, whose command and number are checked."""
        self._number += 1
        self.send(struct.pack(">BBHHH", 0x42, flags, command, len(payload), self._number) + payload)
        answer = self.receive()
        assert answer is not None, f"no answer to 0x{command:04x}"
        status, acknowledged, length, number = struct.unpack_from(">HHHH", answer)
        assert (acknowledged, number, length) == (command + 1, self._number, len(answer) - 8)
        return status, answer[8:]

    def read(self, address: int) -> int:
        status, payload = self.ask(0x80, struct.pack(">I", address))
        assert status == 0, hex(status)
        return struct.unpack(">I", payload)[0]

    def write(self, address: int, value: int) -> int:
        """Return the status of a WRITEREG."""
        return self.ask(0x82, struct.pack(">II", address, value))[0]

    def close(self) -> None:
        self._socket.close()
