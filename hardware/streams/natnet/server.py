"""A NatNet server: a command port that anything may be sent to, and frames to all clients without waiting for any.

Unicast: frames go to the address from which a client sent CONNECT, until it disconnects or sends nothing for
``forget_s``. Where that port is closed, they go to the data port at the client's address: some clients listen there
(PyPI ``motioncapture`` 1.1) and close the other; where that is closed too, the client is gone.

Each client has a socket of its own, connected to it and bound to the command port: a client behind a slow line fills
its own send buffer alone, and a frame that does not fit is dropped and counted. Multicast: frames go to the group;
a sender cannot find out what becomes of them there.
"""

import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from hardware.streams.natnet import messages
from hardware.streams.natnet.messages import NS_PER_TICK, ClientCommand, FrameStamps, Version
from hardware.streams.natnet.settings import Address, ClientAccount, NatNetSettings, bound, free_port, sent_whole
from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import StreamModel
from mosca.errors import InputError

LARGEST_COMMAND = 2048
BURST = 100
"""Commands of one socket that are answered before the others have their turn."""
GONE = "gone"


class NatNetServer(StreamServer):
    """Serves ``model`` and the frames given to ``send`` until ``close``; a context manager.

    ``counts``: commands by kind, ``garbage`` among them.
    Raises InputError where the address or a port is not available, or the model does not fit in a datagram.
    """

    def __init__(self, model: StreamModel, settings: NatNetSettings | None = None) -> None:
        super().__init__()
        self.settings = settings or NatNetSettings()
        self.model = model
        self.counts: Counter[str] = Counter()
        self.too_large = 0
        self._last: Outgoing | None = None
        self._clients: dict[Address, _Client] = {}
        self._former: dict[Address, ClientAccount] = {}
        self._guard = threading.Lock()
        self._group = ClientAccount(("", 0), ("", 0), self.settings.version)
        try:
            for version in messages.VERSIONS:
                messages.model_message(model, version)
        except ValueError as error:
            raise InputError(f"NatNet model: {error}; stream fewer markers") from None
        self._ports: tuple[int, int] = self.settings.command_port, self.settings.data_port
        self._thread: threading.Thread | None = None
        self.start()

    @property
    def command_port(self) -> int:
        """Port that commands are sent to."""
        return self._ports[0]

    @property
    def data_port(self) -> int:
        """Port of the group that frames are sent to."""
        return self._ports[1]

    def clients(self) -> tuple[ClientAccount, ...]:
        """Return the accounts of all clients, those that left too; with multicast first that of the group."""
        with self._guard:
            unicast = (*self._former.values(), *(client.account for client in self._clients.values()))
        return (self._group, *unicast) if self.settings.group else unicast

    def connected(self) -> int:
        """Return how many clients there are that get frames; with multicast those that asked and were heard of."""
        now = time.monotonic()
        return sum(client.begins_s <= now for client in tuple(self._clients.values()))

    def encode(self, outgoing: Outgoing) -> None:
        """Encode a frame in the server's version; one that does not fit is counted where it is delivered."""
        with suppress(ValueError):
            _unstamped(outgoing, self.settings.version)

    def deliver(self, outgoing: Outgoing) -> None:
        """Send a prepared frame to everyone; never waits."""
        self._last = outgoing
        if self.lost or self._thread is None:
            return
        self.frames += 1
        try:
            if self.settings.group is not None:
                data = _message(outgoing, self.settings.version)
                self._group.count(sent_whole(self._data, data, self._group.to))
                return
            now = time.monotonic()
            there = [one for one in tuple(self._clients.values()) if one.begins_s <= now]
            versions = [one.account.version for one in there]  # a client may change it meanwhile
            made = {version: _message(outgoing, version) for version in set(versions)}
            # sent without a pause in between: a client that is woken first may take the processor from the next
            outcomes = [sent_whole(one.socket, made[own]) for one, own in zip(there, versions, strict=True)]
            for client, outcome in zip(there, outcomes, strict=True):
                client.account.count(outcome)
                if outcome is None:
                    self._refused(client)
        except ValueError:
            self.too_large += 1

    def start(self) -> None:
        """Open the ports and begin to answer; after ``shut`` on the same ports, with no clients."""
        where = self.settings
        self._commands = bound(where.address, self._ports[0], exclusive=True)
        try:
            if where.group is not None:
                self._data = bound(where.address, self._ports[1], exclusive=False)
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(where.address))
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
                data_port = self._data.getsockname()[1]
            else:  # nothing is bound there: a client on this machine may listen at it
                data_port = self._ports[1] or free_port(where.address)
        except (InputError, OSError) as error:
            self._commands.close()
            raise (
                error if isinstance(error, InputError) else InputError(f"{where.address}: {error.strerror}")
            ) from None
        self._ports = self._commands.getsockname()[1], data_port
        if where.group is not None:
            self._group.address = self._group.to = where.group, data_port
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._commands, selectors.EVENT_READ)
        self._wake, other = socket.socketpair()
        self._selector.register(other, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._listen, args=(other,), name="natnet", daemon=True)
        self._thread.start()

    def shut(self, why: str = "server restarted") -> None:
        """Leave the network and forget the clients; may be called twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._wake.close()
        thread.join()
        for address in tuple(self._clients):
            self._forget(address, why)
        self._selector.close()
        self._commands.close()
        if self.settings.group is not None:
            self._data.close()

    def where(self) -> str:
        """Return addresses, ports, units and axes as a line."""
        where = self.settings
        version = ".".join(map(str, where.version))
        to = f"frames to group {where.group}, port {self.data_port}" if where.group else "frames to each client"
        up = "xyz"[where.up_axis]
        return f"NatNet {version} at {where.address}: commands at port {self.command_port}, {to}; metres, {up} up"

    def lines(self) -> list[str]:
        """Return lines on what became of each client's frames, and on the commands that came."""
        lines = []
        for one in self.clients():
            if one.sent or one.dropped or one.to != one.address or self.settings.group is None:
                left = f", {one.left}" if one.left else ""
                lines.append(
                    f"{one.address[0]}:{one.address[1]}: {one.sent} frames sent, {one.dropped} dropped{left}"
                )
        if self.too_large:
            lines.append(f"{self.too_large} frames do not fit in a datagram and were left out; stream fewer markers")
        commands = ", ".join(f"{count} {name}" for name, count in sorted(self.counts.items()))
        return [*lines, f"commands: {commands or 'none'}"]

    def _listen(self, end: socket.socket) -> None:
        look = min(1.0, self.settings.forget_s / 4)
        swept = time.monotonic()
        with end:
            while True:
                for key, _ in self._selector.select(look):
                    if key.fileobj is end:
                        return
                    self._read(key.fileobj)  # type: ignore[arg-type]
                if time.monotonic() - swept >= look:
                    swept = time.monotonic()
                    self._sweep(swept)

    def _read(self, sock: socket.socket) -> None:
        for _ in range(BURST):
            try:
                datagram, sender = sock.recvfrom(LARGEST_COMMAND)
            except ConnectionRefusedError:
                for client in tuple(self._clients.values()):
                    if client.socket is sock:
                        self._refused(client)
                return
            except OSError:  # nothing more, or closed by the thread that sends
                return
            if self.lost:
                self.counts["not heard"] += 1
                continue
            command = messages.taken_apart(datagram)
            if command is None or not self._answer(command, sender):
                self.counts["garbage"] += 1

    def _answer(self, command: ClientCommand, sender: Address) -> bool:
        """Answer a command; False for one that no client sends."""
        where, client = self.settings, self._clients.get(sender)
        if client is not None:
            client.account.heard_s = time.monotonic()
            client.account.commands += 1
        match command.kind:
            case messages.CONNECT | messages.DISCOVER:
                known = command.kind == messages.DISCOVER or client is not None or self._take(sender)
                self.counts["connect" if known else "refused"] += 1
                info = messages.server_info(
                    where.name, where.server_version, where.version, self._ports[1], where.group
                )
                self._reply(info if known else b"", sender)
            case messages.REQUEST_MODEL:
                self.counts["model"] += 1
                self._reply(messages.model_message(self.model, self._version_of(sender)), sender)
            case messages.REQUEST_FRAME:
                self.counts["frame"] += 1
                if self._last is not None:
                    self._reply(_message(self._last, self._version_of(sender)), sender)
            case messages.ECHO:
                self.counts["echo"] += 1
                self._reply(messages.echo_answer(command.payload, self.clock_ns() // NS_PER_TICK), sender)
            case messages.KEEP_ALIVE:
                self.counts["keep alive"] += 1
            case messages.DISCONNECT:
                self.counts["disconnect"] += 1
                self._forget(sender, "disconnected")
            case messages.REQUEST:
                self._reply(self._requested(command.text, sender), sender)
            case _:
                return False
        if client is not None and command.kind != messages.CONNECT:
            client.begins_s = 0.0
        return True

    def _requested(self, text: str, sender: Address) -> bytes:
        """Return the answer to a request in words; recorded traffic and the SDK's examples show how these are."""
        where = self.settings
        values: Mapping[str, float | int] = {
            "FrameRate": float(where.rate_hz),
            "AnalogSamplesPerMocapFrame": 0,
            "UnitsToMillimeters": 1000.0,
            "UpAxis": where.up_axis,
            "TimelinePlay": 0,
            "TimelineStop": 0,
        }
        word, _, rest = text.partition(",")
        if word in values:
            self.counts["request"] += 1
            return messages.response(values[word])
        client = self._clients.get(sender)
        # only servers of version 4 change it, and only for unicast clients
        if word == "Bitstream" and where.version >= (4, 0) and where.group is None and client is not None:
            asked = next((one for one in messages.VERSIONS if rest.split(".")[:2] == [str(n) for n in one]), None)
            if asked is not None:
                self.counts["request"] += 1
                client.account.version = asked
                return messages.response(0)
        self.counts["unknown request"] += 1
        return messages.unrecognised(where.name, where.server_version, where.version)

    def _reply(self, data: bytes, to: Address) -> None:
        if not data:
            return
        try:
            self._commands.sendto(data, to)
        except OSError:
            self.counts["answers lost"] += 1

    def _version_of(self, sender: Address) -> Version:
        client = self._clients.get(sender)
        return self.settings.version if client is None else client.account.version

    def _take(self, sender: Address) -> bool:
        """Make a sender a client; False where there are too many."""
        with self._guard:
            if len(self._clients) >= self.settings.most_clients:
                return False
            try:
                own = bound(self.settings.address, self._ports[0], exclusive=False)
                own.connect(sender)
            except (OSError, InputError):
                return False
            former = self._former.pop(sender, None)
            account = former or ClientAccount(sender, sender, self.settings.version)
            account.to, account.left = sender, ""
            account.heard_s, account.version = time.monotonic(), self.settings.version
            account.commands += 1
            self._selector.register(own, selectors.EVENT_READ)
            self._clients[sender] = _Client(account, own, account.heard_s + self.settings.settle_s)
        return True

    def _forget(self, address: Address, why: str) -> None:
        with self._guard:
            client = self._clients.pop(address, None)
            if client is None:
                return
            client.account.left = why
            self._former[address] = client.account
            while len(self._former) > self.settings.most_clients:  # the oldest: memory stays as it is
                self._former.pop(next(iter(self._former)))
            self._selector.unregister(client.socket)
            client.socket.close()

    def _refused(self, client: "_Client") -> None:
        """Switch to the data port of a client whose port is closed; drop the client where that is closed, too."""
        account = client.account
        there = account.address[0], self._ports[1]
        with self._guard:
            if account.to != there and account.address in self._clients:
                account.to = there
                client.socket.connect(there)
                return
        self._forget(account.address, GONE)

    def _sweep(self, now: float) -> None:
        for address, client in tuple(self._clients.items()):
            listens = client.account.to == address
            if listens and now - client.account.heard_s > self.settings.forget_s:
                self._forget(address, "silent")


@dataclass(eq=False)
class _Client:
    account: ClientAccount
    socket: socket.socket
    begins_s: float


def _unstamped(outgoing: Outgoing, version: Version) -> bytes:
    made = outgoing.encoded.get(version)
    if made is None:
        made = outgoing.encoded[version] = messages.unstamped_frame(outgoing.frame, version)
    return made


def _message(outgoing: Outgoing, version: Version) -> bytes:
    """Return a frame's message, encoded once for each version; ValueError where it does not fit in a datagram."""
    times = (outgoing.mid_ns, outgoing.received_ns, outgoing.transmit_ns)
    stamps = FrameStamps(*(time_ns // NS_PER_TICK for time_ns in times))
    return messages.stamped(_unstamped(outgoing, version), stamps, version)
