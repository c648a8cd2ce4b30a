"""Lines of text over TCP, UDP and serial ports, each stamped when it was complete."""

import os
import select
import socket
import time
from collections import Counter, deque
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Protocol

from hardware.driver import DeviceError

CONNECT_S = 3.0
LONGEST_LINE = 1 << 16
MOST_BYTES = 1 << 16
MOST_STRANGERS = 8
"""Most addresses whose refused datagrams are counted separately; any number of addresses may be forged."""


@dataclass(frozen=True)
class Line:
    """A line without its end, and this machine's monotonic time when it was complete [ns]."""

    text: str
    came_ns: int


class Lines(Protocol):
    """Two ends that exchange lines; all raise DeviceError in one line where the other end is gone."""

    def write(self, text: str) -> None:
        """Send ``text`` and an end of line."""
        ...

    def read(self, timeout_s: float) -> Line | None:
        """Return the next line, or None when none was complete within ``timeout_s``."""
        ...

    def close(self) -> None:
        """Disconnect; may be called twice."""
        ...


class _Cutter:
    """Splits received bytes into lines; a line longer than LONGEST_LINE is cut there."""

    def __init__(self) -> None:
        self._rest = b""
        self._lines: deque[Line] = deque()

    def take(self, data: bytes) -> None:
        now = time.monotonic_ns()
        *whole, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            whole, self._rest = [*whole, self._rest], b""
        self._lines += [_line(one, now) for one in whole if one.strip()]

    def next(self) -> Line | None:
        return self._lines.popleft() if self._lines else None


class TcpLines:
    """Lines to and from a TCP server at ``address`` (host:port)."""

    def __init__(self, where: str, address: str) -> None:
        self._where = f"{where} at {address}"
        self._cutter = _Cutter()
        try:
            self._socket = socket.create_connection(_host_port(where, address), CONNECT_S)
        except OSError as error:
            raise DeviceError(
                f"{self._where}: no connection ({error.strerror or error}); is it on, and is the address right?"
            ) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, text: str) -> None:
        """Send a line."""
        try:
            self._socket.settimeout(CONNECT_S)
            self._socket.sendall(text.encode() + b"\n")
        except OSError as error:
            raise self._gone(error) from None

    def read(self, timeout_s: float) -> Line | None:
        """Return the next line or None."""
        deadline = time.monotonic() + timeout_s
        while (line := self._cutter.next()) is None:
            left = deadline - time.monotonic()
            if not select.select([self._socket], [], [], max(left, 0.0))[0]:
                return None
            try:
                data = self._socket.recv(MOST_BYTES)
            except OSError as error:
                raise self._gone(error) from None
            if not data:
                raise DeviceError(f"{self._where}: hung up")
            self._cutter.take(data)
        return line

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def _gone(self, error: OSError) -> DeviceError:
        return DeviceError(f"{self._where}: is gone ({error.strerror or error})")


class UdpLines:
    """Lines that come in datagrams to ``address`` (host:port) of this machine.

    ``sender``: the numerical address whose datagrams are taken, None for all. ``strangers``: datagrams of others, by
    address, which were refused.
    """

    def __init__(self, where: str, address: str, sender: str | None = None) -> None:
        self._where, self._sender = f"{where} at {address}", sender
        self.strangers: Counter[str] = Counter()
        self._lines: deque[Line] = deque()
        host, port = _host_port(where, address)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                f"{self._where}: cannot listen ({error.strerror or error}); choose another address"
            ) from None

        bound, self.port = self._socket.getsockname()
        self.on_loopback = IPv4Address(bound).is_loopback

    def write(self, text: str) -> None:
        """Refuse: no program is at the other end."""
        raise DeviceError(f"{self._where}: listens only")

    def read(self, timeout_s: float) -> Line | None:
        """Return the next line or None; a datagram ends its last line."""
        if not self._lines and select.select([self._socket], [], [], timeout_s)[0]:
            data, (host, _) = self._socket.recvfrom(MOST_BYTES)
            now = time.monotonic_ns()
            if self._sender in (None, host):
                self._lines += [_line(one, now) for one in data.split(b"\n") if one.strip()]
            else:
                known = host in self.strangers or len(self.strangers) < MOST_STRANGERS
                self.strangers[host if known else "others"] += 1
        return self._lines.popleft() if self._lines else None

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


class SerialLines:
    """Lines over the serial port ``port``, 8 bits, no parity; where the system has termios (Linux, macOS)."""

    def __init__(self, where: str, port: str, baud: int) -> None:
        self._where = f"{where} at {port}"
        self._cutter = _Cutter()
        try:
            import termios
            import tty
        except ImportError:
            raise DeviceError(f"{self._where}: serial targets need Linux or macOS; use kind 'tcp'") from None
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise DeviceError(f"{self._where}: baud {baud} is none that this system has, e.g. 115200")
        try:
            self._port = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise DeviceError(
                f"{self._where}: cannot be opened ({error.strerror}); check the cable and the rights"
            ) from None
        try:
            tty.setraw(self._port)
            settings = termios.tcgetattr(self._port)
            settings[4] = settings[5] = speed
            termios.tcsetattr(self._port, termios.TCSANOW, settings)
            termios.tcflush(self._port, termios.TCIOFLUSH)
        except termios.error as error:
            os.close(self._port)
            raise DeviceError(f"{self._where}: is no serial port ({error.args[-1]})") from None

    def write(self, text: str) -> None:
        """Send a line."""
        data = text.encode() + b"\n"
        deadline = time.monotonic() + CONNECT_S
        while data:
            if not select.select([], [self._port], [], max(deadline - time.monotonic(), 0.0))[1]:
                raise DeviceError(f"{self._where}: takes nothing any more")
            try:
                data = data[os.write(self._port, data) :]
            except OSError as error:
                raise DeviceError(f"{self._where}: is gone ({error.strerror})") from None

    def read(self, timeout_s: float) -> Line | None:
        """Return the next line or None."""
        deadline = time.monotonic() + timeout_s
        while (line := self._cutter.next()) is None:
            left = deadline - time.monotonic()
            if not select.select([self._port], [], [], max(left, 0.0))[0]:
                return None
            try:
                data = os.read(self._port, MOST_BYTES)
            except OSError as error:
                raise DeviceError(f"{self._where}: is gone ({error.strerror})") from None
            if not data:
                raise DeviceError(f"{self._where}: is gone (end of file)")
            self._cutter.take(data)
        return line

    def close(self) -> None:
        """Free the port."""
        if self._port >= 0:
            os.close(self._port)
            self._port = -1


def _line(data: bytes, came_ns: int) -> Line:
    return Line(data.decode(errors="replace").rstrip("\r"), came_ns)


def _host_port(where: str, address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 <= int(port) < 65536:
        raise DeviceError(f"{where}: address '{address}' given; host:port is wanted, e.g. 192.168.7.30:7000")
    return host, int(port)
