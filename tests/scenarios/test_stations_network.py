"""Two stations on PCs of their own (network namespaces): delays, a cut cable, a killed station."""

import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from namespaces import TRUST, needs_namespaces, pcs

HARDWARE = Path(__file__).resolve().parent.parent / "hardware"
sys.path.insert(0, str(HARDWARE))
from needs import needs_module  # noqa: E402
from ready_station import SIZE, pulse_in  # noqa: E402

from hardware.transport import open_transport  # noqa: E402
from hardware.transport.merger import MergeSettings  # noqa: E402
from hardware.transport.receiver import Receiver  # noqa: E402
from hardware.transport.station_state import ReceiverSettings  # noqa: E402

CAMERAS = {"A": ("a1", "a2", "a3", "a4"), "B": ("b1", "b2", "b3", "b4")}
SIZES = {name: SIZE for names in CAMERAS.values() for name in names}
RATE = 100.0
LONG = 12_000
"""More pulses than a test needs, however slow the machine: it ends its stations once it has seen enough."""
TARGETS = 50
STATION = HARDWARE / "ready_station.py"


@pytest.fixture
def two_pcs():
    needs_module("zenoh", "stations")
    needs_namespaces()
    with pcs(2) as made:
        yield dict(zip("AB", made, strict=True))


@contextmanager
def programs():
    running = []
    try:
        yield running
    finally:
        for program in running:
            program.kill()
            program.communicate()


@contextmanager
def listening(two_pcs, silence_s):
    """Open a receiver that is so patient that a busy machine changes nothing but delays."""
    endpoints = [pc.endpoint for pc in two_pcs.values()]
    settings = ReceiverSettings(
        MergeSettings(deadline_s=60.0, oldest_s=60.0), silence_s, start_wait_s=60.0, queued=2 * LONG
    )
    with Receiver(open_transport(listen=endpoints, trust=TRUST), ("A", "B"), SIZES, settings=settings) as here:
        yield here


def opened(pc, name, pulses):
    """Start a station's program; returns when it is ready."""
    program = pc.start(
        STATION, name, pc.endpoint, ",".join(CAMERAS[name]), pulses, RATE, TARGETS,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdout.readline() == "ready\n"
    return program


def say(program, line):
    program.stdin.write(f"{line}\n")
    program.stdin.flush()


def both(two_pcs, running, pulses=LONG):
    """Start both stations on one line of pulses; returns when its pulse 0 is [ns]."""
    running += [opened(two_pcs[name], name, pulses) for name in "AB"]
    start = time.monotonic_ns() + 500_000_000
    for program in running:
        say(program, f"{start} 0")
    return start


def ended(programs):
    """End stations after what is under way; returns how many pulses each of them has sent."""
    for program in programs:
        say(program, "end")
    sent = [int(program.stdout.readline()) for program in programs]
    assert [program.wait() for program in programs] == [0] * len(programs)
    return sent


def read(stream, sets, met):
    """Read sets until ``met`` is true."""
    for merged in stream:
        sets.append(merged)
        if met():
            return
    pytest.fail("the stations ended before")


def happened(here, *kinds):
    return [event for event in here.events if event.station == "B" and event.kind in kinds]


def check(sets, here):
    """All pulses, each of one instant, and never without A, which has no fault.

    Return False where a busy machine paused A so long that it was reported silent.
    """
    steady = not any(e.station == "A" and e.kind == "silent" for e in here.events)
    pulses = [s.pulse for s in sets]
    assert pulses == (list(range(len(sets))) if steady else sorted(set(pulses)))
    for merged in sets:
        assert {pulse_in(found) for found in merged.detections.values()} == {merged.pulse % 600}
        assert not steady or set(CAMERAS["A"]) <= set(merged.detections)
    return steady


def whole(sets):
    return not any(s.missing for s in sets)


def test_detections_of_two_pcs_are_merged(two_pcs):
    """How soon, ``tests/benchmarks/bench_stations.py`` measures; here each pulse is whole and of one instant."""
    with programs() as running, listening(two_pcs, silence_s=60.0) as here:
        both(two_pcs, running, 300)
        sets = list(here)
        assert [program.wait() for program in running] == [0, 0]
        for name in "AB":  # the stations' clocks are 10^12 ns and more off
            offset, now = sum(name.encode()) * 10**12, time.monotonic_ns()
            assert abs(here.to_local(name, now + offset) - now) < 0.5e9 / RATE
    assert check(sets, here)
    assert len(sets) == 300
    assert whole(sets), [(s.pulse, dict(s.missing)) for s in sets if s.missing]


def test_a_cable_out_is_survived_and_its_cost_stated(two_pcs):
    """Out until that is noticed: for 1.5 s and more."""
    with programs() as running, listening(two_pcs, silence_s=1.5) as here:
        both(two_pcs, running)
        sets, stream = [], iter(here)
        read(stream, sets, lambda: len(sets) == 200)
        steady = not happened(here, "silent")
        two_pcs["B"].cut()
        read(stream, sets, lambda: happened(here, "silent"))
        two_pcs["B"].mend()
        read(stream, sets, lambda: happened(here, "back"))
        read(stream, sets, lambda: whole(sets[-50:]))
        seen = len(sets)
        _, sent = ended(running)
        sets += stream
    steady &= check(sets[:seen], here)
    assert whole(sets[:200]) or not steady
    assert any(set(s.missing) == set(CAMERAS["B"]) for s in sets)
    # every message of B is in a set, or counted where it went
    station, merge = here.statistics.stations["B"], here.statistics.merge
    parts = [merge.cameras[name] for name in CAMERAS["B"]]
    assert station.received + station.lost == 4 * sent
    assert sum(c.merged + c.late + c.aged for c in parts) == station.received
    for count in parts:
        assert count.away + count.lost == merge.sets - count.merged


def test_a_killed_station_is_reported_survived_and_taken_back(two_pcs):
    with programs() as running, listening(two_pcs, silence_s=1.5) as here:
        start = both(two_pcs, running)
        sets, stream = [], iter(here)
        read(stream, sets, lambda: len(sets) == 200)
        steady = not happened(here, "silent")
        killed_ns = time.monotonic_ns()
        running[1].send_signal(signal.SIGKILL)
        read(stream, sets, lambda: happened(here, "silent"))
        again = opened(two_pcs["B"], "B", LONG)
        running.append(again)
        say(again, f"{start} {round((time.monotonic_ns() - start) * 1e-9 * RATE) + 20}")
        read(stream, sets, lambda: happened(here, "back"))
        read(stream, sets, lambda: whole(sets[-50:]))
        seen = len(sets)
        ended([running[0], again])
        sets += stream
    steady &= check(sets[:seen], here)
    assert whole(sets[:200]) or not steady
    assert any(set(s.missing) == set(CAMERAS["B"]) for s in sets)
    assert all(event.time_ns > killed_ns for event in happened(here, "silent"))
    assert [event.text for event in happened(here, "back")][:1] == ["has started again"]
    assert here.statistics.stations["B"].starts == 2
    # no set has waited in vain: nothing waits for a station that has nothing to send yet
    assert all(here.statistics.merge.cameras[name].lost == 0 for name in CAMERAS["B"])
