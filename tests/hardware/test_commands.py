"""Commands, replies and events over loopback sockets and a pseudo-terminal, on a clock of frames."""

import json
import os
import socket
import threading
import time
import tty
from contextlib import contextmanager

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from loopback import PATIENT_S, until

from hardware.driver import DeviceError
from hardware.onboard.commands import (
    CommandTable,
    EventTable,
    Program,
    ProgramRun,
    TargetTable,
    open_target,
    read_program,
)
from hardware.onboard.line_protocol import LONGEST_LINE, TcpLines, UdpLines
from mosca.errors import InputError


@contextmanager
def robot(answer=lambda line: f"did {line}", delay_s=0.0, answered=None):
    """A TCP server that notes each line with the host's time and answers it; yields (address, lines).

    ``answered``: an event that is set once an answer is out.
    """
    server = socket.create_server(("127.0.0.1", 0))
    heard = []

    def serve():
        try:
            peer, _ = server.accept()
        except OSError:
            return
        with peer, peer.makefile("rwb") as file:
            for line in file:
                heard.append((time.monotonic_ns(), line.decode().rstrip("\n")))
                time.sleep(delay_s)
                text = answer(heard[-1][1])
                if text is not None:
                    file.write(text.encode() + b"\n")
                    file.flush()
                    if answered is not None:
                        answered.set()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{server.getsockname()[1]}", heard
    finally:
        server.shutdown(socket.SHUT_RDWR)
        server.close()
        thread.join(2)


class Session:
    """A clock of frames, known from ``begins`` on, and what is written on it; ``until_s``: how far it goes."""

    def __init__(self, until_s=None):
        self.until_s, self.begin, self.written = until_s, None, []

    def begins(self):
        self.begin = time.monotonic_ns()
        return self

    def session_ns(self, host_ns):
        if self.begin is None:
            return None
        now = host_ns - self.begin
        return now if self.until_s is None else min(now, round(self.until_s * 1e9))

    def write(self, channel, time_ns, data):
        self.written.append((channel, time_ns, json.loads(json.dumps(data))))

    def of(self, channel):
        return [(t, d) for c, t, d in self.written if c == channel]


def program(address, commands, kind="tcp", reply_s=PATIENT_S, events=()):
    return Program(
        target=[TargetTable(name="robot", kind=kind, address=address, reply_s=reply_s)],
        event=[EventTable(**event) for event in events],
        program=[CommandTable(at_s=at, target="robot", command=command) for at, command in commands],
    )


def finished(run, session, n):
    until(lambda: len(session.written) >= n)
    run.close()


def started(session, given):
    run = ProgramRun(given, session.session_ns, session.write)
    run.start()
    return run


def test_command_and_reply_lie_on_the_frames_clock():
    session = Session().begins()
    commands = [(0.3, {"left": 100, "right": 80}), (0.2, "stop"), (0.4, "go")]
    with robot(delay_s=0.02) as (address, heard):
        run = started(session, program(address, commands))
        finished(run, session, 6)
    assert [line for _, line in heard] == ["stop", '{"left": 100, "right": 80}', "go"]
    sent = session.of("commands")
    assert [data["command"] for _, data in sent] == ["stop", {"left": 100, "right": 80}, "go"]
    for (time_ns, data), (host_ns, _), wanted_s in zip(sent, heard, (0.2, 0.3, 0.4), strict=True):
        assert time_ns == data["time_ns"] == data["host_ns"] - session.begin
        assert data["at_s"] == wanted_s
        assert 0 <= time_ns - wanted_s * 1e9 == pytest.approx(data["late_ms"] * 1e6, abs=1.0)
        assert host_ns - data["host_ns"] > -0.2e6  # the robot heard it after
    for (time_ns, data), (host_ns, line) in zip(session.of("replies"), heard, strict=True):
        assert data["line"] == f"did {line}"
        assert time_ns + session.begin - host_ns > 19e6
    assert run.sent == 3


def test_an_answer_in_json_is_data_and_none_is_told():
    session = Session().begins()
    with robot(lambda line: '{"battery": 11.9}') as (address, _), robot(lambda line: None) as (mute, _):
        both = Program(
            target=[
                TargetTable(name="robot", address=address, reply_s=PATIENT_S),
                TargetTable(name="mute", address=mute, reply_s=0.1),
            ],
            program=[
                CommandTable(at_s=0.1, target="robot", command="a"),
                CommandTable(at_s=0.2, target="mute", command="b"),
            ],
        )
        run = started(session, both)
        until(lambda: any("no answer" in note for note in run.notes))
        finished(run, session, 3)
    assert [d["data"] for _, d in session.of("replies")] == [{"battery": 11.9}]
    assert [note for note in run.notes if "late" not in note] == [
        "target 'mute': no answer to the command of 0.2 s within 0.1 s"
    ]


def test_a_late_answer_is_not_taken_for_the_next_ones():
    session, told, answered = Session(until_s=0.3).begins(), threading.Event(), threading.Event()

    def answer(line):
        return f"did {line}" if line == "one" and told.wait(PATIENT_S) else None

    with robot(answer, answered=answered) as (address, heard):
        commands = [(0.1, "one"), (0.5, "two")]
        run = started(session, program(address, commands, reply_s=0.05))
        until(lambda: any("no answer to the command of 0.1 s" in note for note in run.notes))
        told.set()
        assert answered.wait(PATIENT_S)
        session.until_s = None
        finished(run, session, 3)
    replies = [data for _, data in session.of("replies")]
    assert replies[0]["unasked"]
    assert replies[0]["line"] == "did one"
    assert len(replies) == 1
    assert len(heard) == 2


def test_a_slow_target_makes_its_own_commands_late_and_says_so():
    session = Session().begins()
    with robot(delay_s=0.2) as (address, _):
        run = started(session, program(address, [(0.1, "one"), (0.15, "two")]))
        finished(run, session, 4)
    assert session.of("commands")[1][1]["late_ms"] > 100
    assert any("the command of 0.15 s went" in note for note in run.notes)


def test_a_serial_target_over_a_pseudo_terminal():
    ours, theirs = os.openpty()
    tty.setraw(ours)
    port = os.ttyname(theirs)

    def serve():
        line = b""
        while not line.endswith(b"\n"):
            line += os.read(ours, 100)
        os.write(ours, b"ok " + line.replace(b"\n", b"\r\n"))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    target = open_target(TargetTable(name="arm", kind="serial", address=port, reply_s=PATIENT_S))
    try:
        before = time.monotonic_ns()
        reply = target.send("home 1")
        assert reply.text == "ok home 1"
        assert before <= reply.sent_ns <= reply.came_ns <= time.monotonic_ns()
    finally:
        target.close()
        target.close()
        thread.join(2)
        os.close(ours)
        os.close(theirs)


def test_events_come_by_udp_and_tcp_and_wait_for_the_clock():
    session = Session()
    server = socket.create_server(("127.0.0.1", 0))
    listening = UdpLines("probe", "127.0.0.1:0")  # a free port, and then ours
    port = listening.port
    listening.close()
    tables = (
        {"name": "imu", "kind": "udp", "address": f"127.0.0.1:{port}"},
        {"name": "log", "kind": "tcp", "address": f"127.0.0.1:{server.getsockname()[1]}"},
    )
    run = ProgramRun(Program(event=[EventTable(**t) for t in tables]), session.session_ns, session.write)
    peer, _ = server.accept()
    run.start()
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sent = []
    with server, peer, sender:
        for number in range(8):
            if number == 4:
                until(lambda: run.events == 8)  # they came before
                session.begins()
            sent.append(time.monotonic_ns())
            sender.sendto(json.dumps({"ax": number}).encode(), ("127.0.0.1", port))
            peer.sendall(f"line {number}\npart".encode() if number == 3 else f"line {number}\n".encode())
        finished(run, session, 16)
    imu = [(t, d) for t, d in session.of("events") if d["source"] == "imu"]
    log = [d["line"] for _, d in session.of("events") if d["source"] == "log"]
    assert [d["data"]["ax"] for _, d in imu] == list(range(8))
    assert log[:4] == [f"line {n}" for n in range(4)]
    assert log[4] == "partline 4"
    for (time_ns, data), sent_ns in zip(imu, sent, strict=True):
        assert time_ns == data["host_ns"] - session.begin
        assert data["host_ns"] - sent_ns > -0.2e6
    assert imu[0][0] < 0  # before the first pulse, and kept
    assert imu[-1][0] > 0
    assert run.events == 16


def sent_from(address, port, *lines):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((address, 0))
        for line in lines:
            sender.sendto(line.encode(), ("127.0.0.1", port))


def heard_at(address, **table):
    """A run that listens to datagrams at ``address``, and the port."""
    session = Session().begins()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    given = EventTable(name="imu", kind="udp", address=f"{address}:{port}", **table)
    run = ProgramRun(Program(event=[given]), session.session_ns, session.write)
    run.start()
    return run, session, port


def test_datagrams_of_strangers_are_refused_and_counted():
    run, session, port = heard_at("127.0.0.1", sender="127.0.9.2")
    sent_from("127.0.9.3", port, "forged 0")
    sent_from("127.0.9.2", port, "mine 0")
    for number in range(40):
        sent_from(f"127.0.8.{number + 1}", port, "forged 1")
    sent_from("127.0.9.2", port, "mine 1")
    until(lambda: run.events >= 2)
    run.close()
    run.close()
    assert [data["line"] for _, data in session.of("events")] == ["mine 0", "mine 1"]
    (note,) = run.notes
    assert note.startswith(
        "event 'imu': refused datagrams that are not of sender 127.0.9.2: of others (33), 127.0.9.3"
    )
    assert note.count("127.0.8.") == 7  # who is told by name is limited


@pytest.mark.parametrize(("address", "told"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_without_a_sender_everyone_is_taken_and_told_where_a_network_reaches_it(address, told):
    run, session, port = heard_at(address)
    sent_from("127.0.9.3", port, "anyone")
    until(lambda: run.events == 1)
    run.close()
    assert [data["line"] for _, data in session.of("events")] == ["anyone"]
    assert ["name the sender" in note for note in run.notes] == [True] * told


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"sender": "imu"}, "sender 'imu' given; the sender's address is wanted, e.g. 192.168.7.30"),
        ({"sender": "0.0.0.0"}, "the sender's address is wanted"),
        ({"sender": "10.0.0.3", "kind": "tcp"}, 'with kind = "tcp", which connects to address; leave it out'),
    ],
)
def test_a_sender_that_cannot_be_is_told(tmp_path, given, text):
    path = tmp_path / "program.toml"
    lines = [f'{key} = "{value}"' for key, value in {"name": "imu", "address": "10.0.0.1:7001", **given}.items()]
    path.write_text("\n".join(["[[event]]", *lines]))
    with pytest.raises(InputError, match=text) as error:
        read_program(path)
    assert "\n" not in str(error.value)


def test_a_target_that_hangs_up_is_told_and_its_commands_are_counted():
    session = Session().begins()
    server = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{server.getsockname()[1]}"
    run = ProgramRun(program(address, [(0.1, "a"), (0.2, "b")]), session.session_ns, session.write)
    peer, _ = server.accept()
    peer.close()
    server.close()
    run.start()
    until(lambda: run.notes)
    run.close()
    assert any("hung up" in note or "is gone" in note for note in run.notes)
    assert any("2 commands were not sent" in note for note in run.notes)


def test_what_is_not_there_is_one_line():
    server = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{server.getsockname()[1]}"
    server.close()
    first = UdpLines("event 'a'", "127.0.0.1:0")
    taken = f"127.0.0.1:{first.port}"
    with pytest.raises(DeviceError, match=r"event 'b' at .* cannot listen"):
        UdpLines("event 'b'", taken)
    first.close()
    for kind, where, text in (
        ("tcp", address, "no connection"),
        ("tcp", "nowhere", "host:port is wanted"),
        ("serial", "/dev/null", "is no serial port"),
        ("serial", "/dev/mosca-none", "cannot be opened"),
    ):
        with pytest.raises(DeviceError, match=text) as error:
            open_target(TargetTable(name="robot", kind=kind, address=where))
        assert "target 'robot'" in str(error.value)
        assert "\n" not in str(error.value)


def test_a_program_file_is_read_and_its_errors_are_one_line(tmp_path):
    path = tmp_path / "program.toml"
    path.write_text(
        '[[target]]\nname = "robot"\naddress = "10.0.0.3:7000"\n'
        '[[event]]\nname = "imu"\naddress = "0.0.0.0:7001"\n'
        '[[program]]\nat_s = 1.0\ntarget = "robot"\ncommand = { left = 100 }\n'
    )
    read = read_program(path)
    assert read.program[0].command == {"left": 100}
    assert (read.target[0].kind, read.event[0].kind) == ("tcp", "udp")
    for wrong, text in (
        ('target = "robto"', "'robto' is none of robot"),
        ("at_s = -1.0", "at_s"),
        ('command = "a\\nb"', "one line is wanted"),
    ):
        key = wrong.split(" = ")[0]
        body = path.read_text()
        old = next(line for line in body.splitlines() if line.startswith(f"{key} = "))
        spoilt = tmp_path / "spoilt.toml"
        spoilt.write_text(body.replace(old, wrong))
        with pytest.raises(InputError, match=text) as error:
            read_program(spoilt)
        assert "\n" not in str(error.value)
        assert "spoilt.toml" in str(error.value)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.binary(max_size=60), max_size=6))
def test_any_bytes_are_lines(parts):
    server = socket.create_server(("127.0.0.1", 0))
    lines = TcpLines("target 'x'", f"127.0.0.1:{server.getsockname()[1]}")
    peer, _ = server.accept()
    got = []
    with server, peer:
        for part in parts:
            peer.sendall(part)
        peer.sendall(b"\nend\n")
        while not got or got[-1] != "end":
            line = lines.read(PATIENT_S)
            assert line is not None
            got.append(line.text)
    lines.close()
    wanted = [one for one in (b"".join(parts) + b"\nend\n").split(b"\n") if one.strip()]
    assert got == [one.decode(errors="replace").rstrip("\r") for one in wanted]


def test_a_line_without_an_end_is_cut():
    server = socket.create_server(("127.0.0.1", 0))
    lines = TcpLines("target 'x'", f"127.0.0.1:{server.getsockname()[1]}")
    peer, _ = server.accept()
    with server, peer:
        sender = threading.Thread(target=peer.sendall, args=(b"x" * (3 * LONGEST_LINE),))
        sender.start()
        line = lines.read(PATIENT_S)
        assert line is not None
        assert LONGEST_LINE < len(line.text) <= 2 * LONGEST_LINE
        lines.close()
        try:
            sender.join(5)
        finally:
            peer.close()
