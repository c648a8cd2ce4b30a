"""Two stations on PCs of their own (network namespaces): delays, a cut cable, a killed station."""

import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from namespaces import needs_namespaces, pcs

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
def listening(two_pcs):
    """Open a receiver that is so patient that a busy machine changes nothing but delays."""
    endpoints = [pc.endpoint for pc in two_pcs.values()]
    patient = MergeSettings(deadline_s=0.4, oldest_s=0.6)
    settings = ReceiverSettings(patient, queued=10_000)  # the test reads them at its end
    with Receiver(open_transport(listen=endpoints), ("A", "B"), SIZES, settings=settings) as here:
        yield here


def opened(pc, name, pulses):
    """Start a station's program; returns when it is ready."""
    program = pc.start(
        STATION, name, pc.endpoint, ",".join(CAMERAS[name]), pulses, RATE, TARGETS,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdout.readline() == "ready\n"
    return program


def begin(program, start_ns, first=0):
    """Let it send from pulse ``first`` on."""
    program.stdin.write(f"{start_ns} {first}\n")
    program.stdin.flush()


def both(two_pcs, running, pulses):
    """Start both stations on one line of pulses; returns when its pulse 0 is [ns]."""
    running += [opened(two_pcs[name], name, pulses) for name in "AB"]
    start = time.monotonic_ns() + 500_000_000
    for program in running:
        begin(program, start)
    return start


def sleep_until(pulse, start_ns):
    time.sleep(max(start_ns * 1e-9 + pulse / RATE - time.monotonic(), 0))


def check_pulses(sets):
    pulses = [s.pulse for s in sets]
    assert pulses == sorted(set(pulses))
    for merged in sets:
        assert {pulse_in(found) for found in merged.detections.values()} <= {merged.pulse % 600}


def delays(sets):
    """From each frame's arrival at its station to its merged set [s], but for the start, which is held."""
    return np.array(
        [(s.merged_ns - at) * 1e-9 for s in sets if s.pulse >= 50 for at in s.arrived_ns.values()]
    )


def test_detections_of_two_pcs_are_merged(two_pcs):
    """How soon, ``tests/benchmarks/bench_stations.py`` measures; here each pulse is whole and of one instant."""
    with programs() as running, listening(two_pcs) as here:
        both(two_pcs, running, 300)
        sets = list(here)
        assert [program.wait(10) for program in running] == [0, 0]
        for name in "AB":  # the stations' clocks are 10^12 ns and more off
            offset, now = sum(name.encode()) * 10**12, time.monotonic_ns()
            assert abs(here.here(name, now + offset) - now) < 0.5e9 / RATE
    check_pulses(sets)
    assert [s.pulse for s in sets] == list(range(300))
    assert not any(s.missing for s in sets)
    print(f"99 % merged within {1e3 * np.quantile(delays(sets), 0.99):.1f} ms")


def test_a_cable_out_for_1500_ms_is_survived_and_its_cost_stated(two_pcs):
    with programs() as running, listening(two_pcs) as here:
        start = both(two_pcs, running, 800)
        sleep_until(200, start)
        two_pcs["B"].cut()
        time.sleep(1.5)
        two_pcs["B"].mend()
        sets = list(here)
    check_pulses(sets)
    assert [s.pulse for s in sets] == list(range(800))
    assert all(set(CAMERAS["A"]) <= set(s.detections) for s in sets)
    without = [s.pulse for s in sets if set(s.missing) & set(CAMERAS["B"])]
    assert 140 <= len(without) <= 500
    assert all(not s.missing for s in sets[:195])
    assert all(not s.missing for s in sets[-50:])
    told = [event.text for event in here.events if event.station == "B"]
    assert any(text.startswith("is silent") for text in told)
    assert any(text.startswith("is heard again") for text in told)
    # every message of B is in a set, or counted where it went
    station, merge = here.account.stations["B"], here.account.merge
    parts = [merge.cameras[name] for name in CAMERAS["B"]]
    assert station.received + station.lost == 4 * 800
    assert sum(c.merged + c.late + c.aged for c in parts) == station.received
    for count in parts:
        assert count.away + count.lost == merge.sets - count.merged


def test_a_killed_station_is_reported_survived_and_taken_back(two_pcs):
    with programs() as running, listening(two_pcs) as here:
        start = both(two_pcs, running, 800)
        sleep_until(200, start)
        killed_ns = time.monotonic_ns()
        running[1].send_signal(signal.SIGKILL)
        running[1].wait()
        again = opened(two_pcs["B"], "B", 800)
        running.append(again)
        first = max(400, round((time.monotonic_ns() - start) * 1e-9 * RATE) + 20)
        begin(again, start, first)
        sets = list(here)
    check_pulses(sets)
    assert [s.pulse for s in sets] == list(range(800))
    assert all(set(CAMERAS["A"]) <= set(s.detections) for s in sets)
    assert all(not s.missing for s in sets[:195])
    assert all(not s.missing for s in sets[-100:])
    events = [event for event in here.events if event.station == "B"]
    gone = next(event for event in events if event.kind in ("gone", "silent"))
    assert gone.time_ns > killed_ns
    assert any(event.kind == "gone" for event in events)
    assert any(event.text == "has started again" for event in events)
    assert here.account.stations["B"].starts == 2
    # nothing waits for a station that has nothing to send yet; a few sets may, until its death is known
    assert all(here.account.merge.cameras[name].lost < 60 for name in CAMERAS["B"])
