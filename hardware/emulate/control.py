"""Control channel of a device (GVCP): receives commands, checks the privilege, and acknowledges.

Whatever arrives, the device keeps working: a datagram that is no command is not answered; an unknown or impossible
command is answered with the standard's status for it.
"""

import errno
import selectors
import socket
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Interface
from threading import Event, Thread

from hardware.emulate import gige_vision
from hardware.emulate.camera import EmulatedCamera
from hardware.emulate.features import BOOTSTRAP
from hardware.emulate.gige_vision import ACKNOWLEDGE, EXTENDED_ID, LARGEST_GVCP_PAYLOAD, Refused, Status
from hardware.emulate.identity import Identity
from hardware.emulate.registers import Client
from hardware.emulate.stream import Stream
from hardware.gvcp import GVCP_PORT, Command
from mosca.errors import InputError

TICK_S = 0.05
"""Interval at which heartbeat and supply are checked when nothing arrives."""
STALLED_NS, GRACE_NS = 500_000_000, 2_000_000_000
"""Stall of this thread after which it cannot judge heartbeats, and grace time that clients get then."""
DISCOVERY_BYTES = 0xF8
LARGEST_READ = LARGEST_GVCP_PAYLOAD - 4
ADDRESS = {register.name: register.address for register in BOOTSTRAP}
PRIVILEGE = ADDRESS["ControlPrivilege"]
LOOPBACK = "127.0.0.2 and the following"
REPEATABLE = (Command.WRITEREG, Command.WRITEMEM, Command.ACTION)


@dataclass(frozen=True)
class _Answered:
    """The last command with side effects and its acknowledgement, resent to a client that repeats the command."""

    client: Client
    datagram: bytes
    answer: bytes


class Control:
    """Answers for ``camera`` on ``sockets``, the first of which is its own, until ``close``, which closes them."""

    def __init__(self, camera: EmulatedCamera, stream: Stream, sockets: Sequence[socket.socket]) -> None:
        self._camera, self._stream = camera, stream
        self._stop = Event()
        self._answered: _Answered | None = None
        self._checked_ns = self._judge_from_ns = 0
        self._handlers: dict[int, Callable[[gige_vision.GvcpCommand, Client], bytes]] = {
            Command.READREG: self._read_registers,
            Command.WRITEREG: self._write_registers,
            Command.READMEM: self._read_memory,
            Command.WRITEMEM: self._write_memory,
        }
        self._unicast, self._sockets = sockets[0], tuple(sockets)
        self._thread = Thread(target=self._run, name=f"gvcp {camera.identity.name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._stop.set()
        self._thread.join()
        for one in self._sockets:
            one.close()

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            for one in self._sockets:
                selector.register(one, selectors.EVENT_READ)
            while not self._stop.is_set():
                for key, _events in selector.select(TICK_S):
                    receiver = key.fileobj
                    assert isinstance(receiver, socket.socket)
                    self._receive(receiver)
                self.check_heartbeat(time.monotonic_ns())

    def check_heartbeat(self, now_ns: int) -> None:
        """End the control of a client whose heartbeat has timed out."""
        camera = self._camera
        camera.linked(now_ns)
        if now_ns - self._checked_ns > STALLED_NS:
            self._judge_from_ns = now_ns + GRACE_NS
        self._checked_ns = now_ns
        if now_ns < self._judge_from_ns:
            return
        with camera.changed:
            heartbeat = int(camera.registers.value("HeartbeatTimeout"))
            watched = not int(camera.registers.value("ControlConfiguration")) & 1
            if watched and camera.privilege.expired(now_ns, heartbeat):
                camera.release()

    def _receive(self, receiver: socket.socket) -> None:
        try:
            datagram, client = receiver.recvfrom(65536)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.ECONNREFUSED, errno.EINTR):
                return
            raise
        if not self._camera.linked(time.monotonic_ns()):
            return
        answer = self.answer(datagram, client, broadcast=receiver is not self._unicast)
        if answer:
            self._reply(answer, client)

    def _reply(self, answer: bytes, client: Client) -> None:
        try:
            self._unicast.sendto(answer, client)
        except OSError:
            # a sender that this address cannot reach, such as another network's or port 0, gets no answer
            self._camera.counts["unanswerable"] += 1

    def answer(self, datagram: bytes, client: Client, broadcast: bool = False) -> bytes:
        """Return the answer to ``datagram`` from ``client``; empty where there is none."""
        request = gige_vision.parse(datagram)
        if request is None or (broadcast and request.command not in (Command.DISCOVERY, Command.ACTION)):
            return b""
        repeated = self._answered
        if repeated is not None and (repeated.client, repeated.datagram) == (client, datagram):
            return repeated.answer
        with self._camera.changed:
            self._camera.privilege.heartbeat(client, time.monotonic_ns())
            answer = self._execute(request, client)
        if request.command in REPEATABLE:
            self._answered = _Answered(client, datagram, answer)
        return answer if request.flags & ACKNOWLEDGE else b""

    def _execute(self, request: gige_vision.GvcpCommand, client: Client) -> bytes:
        try:
            if request.command == Command.PACKETRESEND:
                return self._resend(request, client)
            if request.command == Command.DISCOVERY:
                return gige_vision.acknowledge(request, self._describe())
            if request.command == Command.ACTION:
                return gige_vision.acknowledge(request, status=self._camera.act(gige_vision.action(request)))
            handler = self._handlers.get(request.command)
            if handler is None:
                raise Refused(Status.INVALID_HEADER if request.command < 0 else Status.NOT_IMPLEMENTED)
            return handler(request, client)
        except Refused as refusal:
            return gige_vision.acknowledge(request, status=refusal.status)

    def _describe(self) -> bytes:
        """Return the answer to a discovery: the first 248 bytes of the registers, gaps as zeros."""
        registers = self._camera.registers
        found = bytearray(DISCOVERY_BYTES)
        for register in BOOTSTRAP:
            if register.address < DISCOVERY_BYTES:
                data = register.encode(registers.value(register.name))
                found[register.address : register.address + register.length] = data
        return bytes(found)

    def _read_registers(self, request: gige_vision.GvcpCommand, client: Client) -> bytes:
        found = b""
        try:
            for address in gige_vision.words(request.payload):
                if address != PRIVILEGE:
                    self._camera.privilege.check_read(client)
                found += self._camera.registers.read(address, 4)
        except Refused as refusal:
            # the acknowledgement holds what was read before
            return gige_vision.acknowledge(request, found, refusal.status)
        return gige_vision.acknowledge(request, found)

    def _write_registers(self, request: gige_vision.GvcpCommand, client: Client) -> bytes:
        done = 0
        try:
            for address, value in gige_vision.register_writes(request.payload):
                self._write(address, struct.pack(">I", value), client)
                done += 1
        except Refused as refusal:
            return gige_vision.acknowledge(request, struct.pack(">HH", 0, done), refusal.status)
        return gige_vision.acknowledge(request, struct.pack(">HH", 0, done))

    def _read_memory(self, request: gige_vision.GvcpCommand, client: Client) -> bytes:
        address, length = gige_vision.memory_range(request.payload)
        self._camera.privilege.check_read(client)
        if length > LARGEST_READ:
            raise Refused(Status.INVALID_PARAMETER)
        return gige_vision.acknowledge(
            request, struct.pack(">I", address) + self._camera.registers.read(address, length)
        )

    def _write_memory(self, request: gige_vision.GvcpCommand, client: Client) -> bytes:
        address, data = gige_vision.memory_write(request.payload)
        self._write(address, data, client)
        return gige_vision.acknowledge(request, struct.pack(">HH", 0, len(data)))

    def _write(self, address: int, data: bytes, client: Client) -> None:
        if address == PRIVILEGE and len(data) == 4:
            value = int.from_bytes(data, "big")
            if self._camera.privilege.ask(client, value, time.monotonic_ns(), self._camera.switchover_key):
                self._camera.release()
            return
        self._camera.privilege.check_write(client)
        self._camera.registers.write(address, data)

    def _resend(self, request: gige_vision.GvcpCommand, client: Client) -> bytes:
        to = self._camera.destination()
        holder = self._camera.privilege.holder
        if to is not None and holder is not None and client[0] in (holder[0], to[0]):
            if request.flags & EXTENDED_ID:
                raise Refused(Status.NOT_IMPLEMENTED)
            self._stream.resend(gige_vision.resend(request.payload), to)
        return b""


def control_sockets(identity: Identity) -> tuple[socket.socket, ...]:
    """Return the socket of the device's own control port, then those for broadcasts to it.

    Raises InputError where its address is not available, or serves another device.
    """
    address = identity.address
    unicast = _unicast(identity.name, address)
    everyone = dict.fromkeys(("255.255.255.255", str(address.network.broadcast_address)))
    return unicast, *(_bound(one, share=True) for one in everyone)


def check_address(name: str, address: IPv4Interface) -> None:
    """Raise InputError where camera ``name`` could not be served at ``address``; nothing stays open."""
    _unicast(name, address).close()


def _unicast(name: str, address: IPv4Interface) -> socket.socket:
    try:
        return _bound(str(address.ip), share=False)
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        reason = (
            f"already serves a camera (port {GVCP_PORT} is taken)" if taken else "is not to be had on this machine"
        )
        hint = "choose another first address" if taken else f"give the interface that address, or use {LOOPBACK}"
        raise InputError(f"camera '{name}': address {address.ip} {reason}; {hint}") from None


def _bound(address: str, share: bool) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if share:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.setblocking(False)
        made.bind((address, GVCP_PORT))
    except OSError:
        made.close()
        raise
    return made
