"""Commands to a subject, its replies, and external events, all on the clock of the frames.

A program file (TOML) lists commands with their times, and the sources of events::

    [[target]]
    name = "robot"
    kind = "tcp"                    # or "serial"
    address = "192.168.7.30:7000"   # serial: its port, e.g. /dev/ttyUSB0, and baud = 115200
    reply_s = 1.0                   # time-out of the reply; 0: none expected

    [[event]]
    name = "imu"
    kind = "udp"                    # datagrams received at address; "tcp": lines from that server
    address = "192.168.7.1:7001"     # of the interface that they come to
    sender = "192.168.7.30"         # whose datagrams are taken; without it everyone's, which the notes state

    [[program]]
    at_s = 1.0                      # from the first pulse on
    target = "robot"
    command = { left = 120, right = 80 }     # a table is sent as a line of JSON, a string as it is

Everything is lines of UTF-8, ended by a newline. The channels of the recording, each message with ``host_ns``, this
machine's monotonic time: ``commands`` (when sent), ``replies`` (when the line was complete), ``events`` (when
received). A line that is a JSON object is recorded as ``data``, any other as ``line``. Each target has a thread of
its own: a late reply delays only its own target's commands, and the delay is recorded (``late_ms``).
"""

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from hardware.driver import DeviceError
from hardware.onboard.line_protocol import Lines, SerialLines, TcpLines, UdpLines
from mosca.data.files.bounded import parse_json
from mosca.data.files.toml import NotNegative, Table, check, read_toml

LATE_MS = 5.0
"""A command that is sent later than this is noted."""
LOOK_S = 0.1

SessionNs = Callable[[int], int | None]
Write = Callable[[str, int, Mapping[str, Any]], None]


class TargetTable(Table):
    """``[[target]]``: whom commands go to."""

    name: str = Field(min_length=1)
    kind: Literal["tcp", "serial"] = "tcp"
    address: str = Field(min_length=1, description="host:port, or a serial port")
    baud: int = Field(115200, gt=0, description="serial: bits per second")
    reply_s: NotNegative = Field(1.0, description="how long an answer is waited for [s]; 0: none comes")


class EventTable(Table):
    """``[[event]]``: what is listened to."""

    name: str = Field(min_length=1)
    kind: Literal["udp", "tcp"] = "udp"
    address: str = Field(min_length=1, description="udp: host:port to listen at; tcp: host:port to connect to")
    sender: str | None = Field(None, description="udp: the address whose datagrams are taken; without it everyone's")

    @model_validator(mode="after")
    def _one_sender(self) -> "EventTable":
        if self.sender is None:
            return self
        if self.kind != "udp":
            raise ValueError(
                f"sender '{self.sender}' given with kind = \"tcp\", which connects to address; leave it out"
            )
        try:
            found = IPv4Address(self.sender)
        except ValueError:
            found = IPv4Address(0)
        if found.is_unspecified or found.is_multicast:
            raise ValueError(f"sender '{self.sender}' given; the sender's address is wanted, e.g. 192.168.7.30")
        return self


class CommandTable(Table):
    """``[[program]]``: one command."""

    at_s: NotNegative = Field(description="when it is sent, from the first pulse on [s]")
    target: str
    command: str | dict[str, Any]

    @model_validator(mode="after")
    def _one_line(self) -> "CommandTable":
        if isinstance(self.command, str) and ("\n" in self.command or not self.command):
            raise ValueError(f"command {self.command!r}: one line is wanted")
        return self


class Program(Table):
    """A program file."""

    FILE_KIND: ClassVar[str] = "program"

    target: list[TargetTable] = Field(default_factory=list)
    event: list[EventTable] = Field(default_factory=list)
    program: list[CommandTable] = Field(default_factory=list)

    @model_validator(mode="after")
    def _known(self) -> "Program":
        names = [table.name for table in self.target]
        if len(set(names)) < len(names):
            raise ValueError("target names must differ")
        for number, item in enumerate(self.program, 1):
            if item.target not in names:
                raise ValueError(
                    f"program {number}: target '{item.target}' is none of {', '.join(names) or '(none)'}"
                )
        return self


def read_program(path: Path) -> Program:
    """Return the program in the file at ``path``; InputError names what is wrong."""
    return check(Program, read_toml(path), path)


@dataclass(frozen=True)
class Reply:
    """The result of a command: ``text`` None where no reply came until ``came_ns``; host times [ns]."""

    sent_ns: int
    came_ns: int
    text: str | None


class CommandTarget:
    """A target that takes lines and may answer each with a line."""

    def __init__(self, table: TargetTable, lines: Lines) -> None:
        self.table, self._lines = table, lines

    def send(self, command: str, on_sent: Callable[[int], None] | None = None) -> Reply:
        """Send ``command`` and wait for its answer; ``on_sent`` is called when it is sent. DeviceError."""
        sent_ns = time.monotonic_ns()
        self._lines.write(command)
        if on_sent is not None:
            on_sent(sent_ns)
        line = self._lines.read(self.table.reply_s) if self.table.reply_s > 0 else None
        if line is None:
            return Reply(sent_ns, time.monotonic_ns(), None)
        return Reply(sent_ns, line.came_ns, line.text)

    def unasked(self) -> list[tuple[int, str]]:
        """Return the lines that came without a command, with their times; late answers are among them."""
        lines = []
        while (line := self._lines.read(0.0)) is not None:
            lines.append((line.came_ns, line.text))
        return lines

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._lines.close()


def open_target(table: TargetTable) -> CommandTarget:
    """Connect to a target; DeviceError in one line where that fails."""
    where = f"target '{table.name}'"
    lines = TcpLines(where, table.address) if table.kind == "tcp" else SerialLines(where, table.address, table.baud)
    return CommandTarget(table, lines)


class EventSource:
    """A source of events; ``take`` waits for the next line."""

    def __init__(self, table: EventTable) -> None:
        self._where = f"event '{table.name}'"
        self.table = table
        self._udp = UdpLines(self._where, table.address, table.sender) if table.kind == "udp" else None
        self._lines: Lines = self._udp or TcpLines(self._where, table.address)

    def take(self, timeout_s: float) -> tuple[int, str] | None:
        """Return (host time [ns], line), or None when none came in time; DeviceError where the line is cut."""
        line = self._lines.read(timeout_s)
        return None if line is None else (line.came_ns, line.text)

    def notes(self) -> list[str]:
        """Return lines on whose datagrams were refused, or that everyone's were taken from a network."""
        if self._udp is None:
            return []
        if self.table.sender is None and not self._udp.on_loopback:
            return [
                f"{self._where}: took every program's datagrams at {self.table.address}; name the sender "
                '(sender = "192.168.7.30")'
            ]
        if strangers := self._udp.strangers:
            others = ", ".join(f"{host} ({count})" for host, count in strangers.most_common())
            return [f"{self._where}: refused datagrams that are not of sender {self.table.sender}: of {others}"]
        return []

    def close(self) -> None:
        """Stop listening; may be called twice."""
        self._lines.close()


class ProgramRun:
    """A program that runs beside a capture. Opens all targets and event sources, or raises DeviceError.

    ``session_ns``: host time to the frames' clock, None until frames are numbered (``HardwareSource.session_ns``).
    ``write``: takes (channel, time on the frames' clock [ns], message), from any thread. ``notes``: what went wrong.
    """

    def __init__(self, program: Program, session_ns: SessionNs, write: Write) -> None:
        self.notes: list[str] = []
        self.sent, self.events = 0, 0
        self._program, self._session_ns, self._write = program, session_ns, write
        self._stop = threading.Event()
        self._early: deque[tuple[str, int, dict[str, Any]]] = deque()
        self._guard = threading.Lock()
        self._targets: list[CommandTarget] = []
        self._sources: list[EventSource] = []
        self._threads: list[threading.Thread] = []
        try:
            self._targets = [open_target(table) for table in program.target]
            self._sources = [EventSource(table) for table in program.event]
        except BaseException:
            self.close()
            raise

    def start(self) -> None:
        """Begin to wait for the frames' clock, to send and to listen."""
        for target in self._targets:
            items = sorted(
                (item for item in self._program.program if item.target == target.table.name),
                key=lambda item: item.at_s,
            )
            self._begin(f"commands {target.table.name}", partial(self._send_all, target, items))
        for source in self._sources:
            self._begin(f"events {source.table.name}", partial(self._listen, source))

    def close(self) -> None:
        """End sending and listening, write what is left; may be called twice."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        for target in self._targets:
            target.close()
        for source in self._sources:
            self.notes += source.notes()
            source.close()
        self._sources.clear()
        self._record(None)
        if self._early:
            self.notes.append(f"{len(self._early)} messages came before the first frames and are not recorded")
            self._early.clear()

    def _begin(self, name: str, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _send_all(self, target: CommandTarget, items: Sequence[CommandTable]) -> None:
        name = target.table.name
        for done, item in enumerate(items):
            if not self._wait_for(round(item.at_s * 1e9)):
                self.notes.append(f"target '{name}': {len(items) - done} commands were not sent, the take ended")
                return
            try:
                self._send(target, item)
            except DeviceError as error:
                self.notes.append(f"{error}; {len(items) - done} commands were not sent")
                return

    def _send(self, target: CommandTarget, item: CommandTable) -> None:
        name = target.table.name
        for came_ns, text in target.unasked():
            self._record(("replies", came_ns, {"target": name, "unasked": True, **_content(text)}))
        line = item.command if isinstance(item.command, str) else json.dumps(item.command)

        def sent(sent_ns: int) -> None:
            late_ms = ((self._session_ns(sent_ns) or 0) - item.at_s * 1e9) / 1e6
            sent = {"target": name, "at_s": item.at_s, "command": item.command, "late_ms": late_ms}
            if late_ms > LATE_MS:
                self.notes.append(f"target '{name}': the command of {item.at_s:g} s went {late_ms:.0f} ms late")
            self._record(("commands", sent_ns, sent))

        reply = target.send(line, sent)
        self.sent += 1
        if reply.text is not None:
            answer = {"target": name, "at_s": item.at_s, **_content(reply.text)}
            self._record(("replies", reply.came_ns, answer))
        elif target.table.reply_s > 0:
            self.notes.append(
                f"target '{name}': no answer to the command of {item.at_s:g} s within {target.table.reply_s:g} s"
            )

    def _wait_for(self, at_ns: int) -> bool:
        """Wait until ``at_ns`` on the frames' clock; return False when all ends before."""
        while not self._stop.is_set():
            now = self._session_ns(time.monotonic_ns())
            if now is not None and now >= at_ns:
                return True
            self._stop.wait(0.005 if now is None else min((at_ns - now) * 1e-9, LOOK_S))
        return False

    def _listen(self, source: EventSource) -> None:
        while not self._stop.is_set():
            try:
                event = source.take(LOOK_S)
            except DeviceError as error:
                self.notes.append(str(error))
                return
            if event is not None:
                self.events += 1
                self._record(("events", event[0], {"source": source.table.name, **_content(event[1])}))

    def _record(self, message: tuple[str, int, dict[str, Any]] | None) -> None:
        """Write a message, and those that had to wait until the frames' clock was known."""
        with self._guard:
            if message is not None:
                self._early.append(message)
            while self._early:
                channel, host_ns, data = self._early[0]
                time_ns = self._session_ns(host_ns)
                if time_ns is None:
                    return
                self._early.popleft()
                self._write(channel, time_ns, {"host_ns": host_ns, "time_ns": time_ns, **data})


def _content(line: str) -> dict[str, Any]:
    try:
        data = parse_json(line)
    except ValueError:
        return {"line": line}
    return {"data": data} if isinstance(data, dict) else {"line": line}
