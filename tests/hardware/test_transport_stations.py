"""Stations and the one that merges, over an engine in memory: starts, deaths, returns, lies and rubbish."""

import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import pytest
from loopback import until
from memory_transport import Exchange
from ready_station import SIZE, infos, play, pulse_in

from hardware.transport.merger import MergeSettings
from hardware.transport.receiver import Receiver
from hardware.transport.sender import Sender
from hardware.transport.station_state import ReceiverSettings
from mosca.errors import InputError

RATE = 100.0
CAMERAS = {"A": ("a1", "a2"), "B": ("b1", "b2")}
SIZES = {name: SIZE for names in CAMERAS.values() for name in names}
LONG = 12_000
"""More pulses than a test needs: it ends its stations once it has seen enough."""
# a busy machine must not make a test fail
PATIENT = ReceiverSettings(
    MergeSettings(deadline_s=60.0, oldest_s=60.0), silence_s=60.0, start_wait_s=60.0, clock_s=0.05, queued=LONG
)
NOTICING = replace(PATIENT, silence_s=1.0)


class Station:
    """A sender with ready detections in a thread."""

    def __init__(self, exchange, name, start_ns, pulses=80, first=0, offset_s=0.0, ppm=0.0, cameras=None):
        begin = time.monotonic_ns()

        def clock():
            now = time.monotonic_ns()
            return now + round(offset_s * 1e9 + (now - begin) * ppm * 1e-6)

        cameras = CAMERAS[name] if cameras is None else cameras
        self.transport = exchange.open()
        self.sender = Sender(self.transport, name, infos(cameras, RATE), f"# rig of {name}", clock)
        self._dead, self.sent = False, 0

        def run():
            if pulses < LONG and name in CAMERAS:
                # as real ones do: a short run could end before its clock was queried
                self.sender.set_state("armed")
                assert self.sender.ordered(60.0)
            self.sent = play(self.sender, cameras, pulses, RATE, start_ns, 3, first, lambda: self._dead)

        self._thread = threading.Thread(target=run)
        self._thread.start()

    def end(self):
        self._thread.join()
        self.sender.close()

    def finish(self):
        """End after what is under way."""
        self._dead = True
        self.end()

    def die(self):
        """End as a killed process does: without a word."""
        self._dead = True
        self.transport.die()
        self._thread.join()
        self.sender.close()


GIVE_UP_S = 300.0
"""Far beyond what any of these takes: then what is read has ended, and the test fails instead of waiting for ever."""


@contextmanager
def receiver(exchange, stations=("A", "B"), settings=PATIENT, cameras=SIZES, rate=None):
    with Receiver(exchange.open(), stations, cameras, rate, settings, rig="# all") as here:
        late = threading.Timer(GIVE_UP_S, here.stop)
        late.start()
        try:
            yield here
        finally:
            late.cancel()


def soon():
    return time.monotonic_ns() + 300_000_000


def read(stream, sets, met):
    """Read sets until ``met`` is true."""
    for merged in stream:
        sets.append(merged)
        if met():
            return
    pytest.fail("the stations ended before")


def whole(sets):
    return not any(s.missing for s in sets)


def texts(here, station):
    return [event.text for event in here.events if event.station == station]


def test_two_stations_with_clocks_of_their_own_merge_pulse_by_pulse():
    exchange, start = Exchange(), soon()
    with receiver(exchange) as here:
        stations = [
            Station(exchange, "A", start, offset_s=5e5, ppm=60),
            Station(exchange, "B", start, offset_s=-90, ppm=-60),
        ]
        for station in stations:
            threading.Thread(target=station.end).start()
        sets = list(here)
    assert [s.pulse for s in sets] == list(range(80))
    for merged in sets:
        assert list(merged.detections) == list(SIZES)
        assert {pulse_in(found) for found in merged.detections.values()} == {merged.pulse}
        assert merged.time_ns == merged.pulse * 10_000_000
    assert here.statistics.merge.complete == 80
    assert [s.lost for s in here.statistics.stations.values()] == [0, 0]
    assert all(s.clock_error_ns < 1e9 for s in here.statistics.stations.values())
    assert here.rigs(1.0) == {"A": "# rig of A", "B": "# rig of B"}


def test_a_station_that_starts_one_pulse_off_is_found_out_and_counted_right():
    exchange, start = Exchange(), soon()
    with receiver(exchange) as here:
        stations = [Station(exchange, "A", start), Station(exchange, "B", start, first=1, offset_s=77)]
        for station in stations:
            threading.Thread(target=station.end).start()
        sets = list(here)
    assert dict(sets[0].missing) == {"b1": "not in time", "b2": "not in time"}
    for merged in sets[1:]:
        assert {pulse_in(found) for found in merged.detections.values()} == {merged.pulse}
        assert not merged.missing
    assert "counts from another pulse: its pulse 0 is pulse 1 of the session" in texts(here, "B")


def test_a_killed_station_is_told_and_survived_and_its_return_too():
    exchange, start = Exchange(), soon()
    with receiver(exchange, settings=NOTICING) as here:
        a, b = Station(exchange, "A", start, LONG), Station(exchange, "B", start, LONG, offset_s=9)
        out, stream = [], iter(here)
        read(stream, out, lambda: len(out) == 100)
        b.die()
        read(stream, out, lambda: any(text.startswith("is silent") for text in texts(here, "B")))
        # another start, another clock, another count
        first = round((time.monotonic_ns() - start) * 1e-9 * RATE) + 20
        b = Station(exchange, "B", start, LONG, first=first, offset_s=-4)
        read(stream, out, lambda: "has started again" in texts(here, "B"))
        read(stream, out, lambda: whole(out[-30:]))
        seen = len(out)
        a.finish()
        b.finish()
        out += stream
    assert [s.pulse for s in out[:seen]] == list(range(seen))
    for merged in out[:seen]:
        assert {pulse_in(found) % 600 for found in merged.detections.values()} == {merged.pulse % 600}
        assert {"a1", "a2"} <= set(merged.detections)
    assert whole(out[:100])
    assert any({"b1", "b2"} == set(s.missing) for s in out)
    assert texts(here, "B")[:3] == [
        "is here",
        "is silent for 1 s: its program or its network ended; it is not waited for",
        "has started again",
    ]
    count = here.statistics.merge.cameras["b1"]
    assert count.away + count.lost == sum("b1" in s.missing for s in out)
    assert (here.statistics.stations["B"].silent, here.statistics.stations["B"].starts) == (1, 2)


def test_a_cut_cable_is_told_and_what_it_cost_is_counted():
    exchange, start = Exchange(), soon()
    with receiver(exchange, settings=NOTICING) as here:
        a, b = Station(exchange, "A", start, LONG), Station(exchange, "B", start, LONG, offset_s=9)
        out, stream = [], iter(here)
        read(stream, out, lambda: len(out) == 70)
        b.transport.cut = True
        read(stream, out, lambda: any(text.startswith("is silent") for text in texts(here, "B")))
        b.transport.cut = False
        read(stream, out, lambda: any(text.startswith("is heard again after") for text in texts(here, "B")))
        read(stream, out, lambda: whole(out[-30:]))
        seen = len(out)
        b.finish()
        a.finish()
        out += stream
    assert [s.pulse for s in out] == list(range(len(out)))
    assert whole(out[:70])
    assert any({"b1", "b2"} == set(s.missing) for s in out[:seen])
    # each message is in a set, or lost on the way, or come too late for a set that did not wait any more
    station = here.statistics.stations["B"]
    counts = [here.statistics.merge.cameras[name] for name in ("b1", "b2")]
    assert station.lost > 0
    assert station.received + station.lost == 2 * b.sent
    assert sum(c.merged + c.late + c.aged for c in counts) == station.received
    assert not any("pulse" in text for text in texts(here, "B"))


def test_a_station_that_holds_the_pulses_is_ordered_to_start_when_all_are_armed():
    exchange = Exchange()
    with receiver(exchange) as here:
        a = Sender(exchange.open(), "A", infos(CAMERAS["A"], RATE))
        a.set_state("holding")
        assert not a.ordered(0.6)
        b = Sender(exchange.open(), "B", infos(CAMERAS["B"], RATE))
        assert not a.ordered(0.3)  # it is still starting
        b.set_state("armed")
        assert a.ordered(60.0)
        a.close()
        b.close()
        assert list(here) == []


def test_cameras_that_do_not_belong_are_told_and_ignored():
    exchange, start = Exchange(), soon()
    sizes = {"a1": SIZE, "b1": (1, 1), "b2": SIZE}
    with receiver(exchange, cameras=sizes) as here:
        stations = [
            Station(exchange, "A", start, 40),
            Station(exchange, "B", start, 40, cameras=("b1", "b2", "a1")),
            Station(exchange, "C", start, 40, cameras=("c1",)),
        ]
        for station in stations:
            threading.Thread(target=station.end).start()
        sets = list(here)
    assert {name for s in sets for name in s.detections} == {"a1", "b2"}
    told = " ".join(texts(here, "A") + texts(here, "B"))
    assert "camera 'a2' is not in the rig" in told
    assert "camera 'b1' has images of 656 x 491, the rig file says 1 x 1" in told
    assert "camera 'a1' is station '" in told
    assert texts(here, "C") == ["is none of the stations that were named; it is not listened to"]


def test_rubbish_is_counted_and_told_once():
    exchange, start = Exchange(), soon()
    other = exchange.open()
    with receiver(exchange) as here:
        stations = [Station(exchange, "A", start, 40), Station(exchange, "B", start, 40)]
        for k in range(50):
            other.publish("mosca/A/a1/detections", bytes(k))
            other.publish("mosca/B/health", b"MO\x01\x02{")
            other.publish("mosca/nobody/x/detections", b"?")
        for station in stations:
            threading.Thread(target=station.end).start()
        sets = list(here)
    assert len(sets) == 40
    assert here.statistics.stations["A"].spoilt == 50
    assert here.statistics.stations["B"].spoilt == 50
    assert sum(text.startswith("sends what cannot be read") for text in texts(here, "A")) <= 4


def test_two_stations_of_one_name_are_told():
    exchange, start = Exchange(), soon()
    with receiver(exchange) as here:
        stations = [Station(exchange, name, start, LONG) for name in ("A", "A", "B")]
        until(lambda: "speaks with two voices: do two stations have this name?" in texts(here, "A"))
        here.stop()
        list(here)
        for station in stations:
            station.finish()
    assert "speaks with two voices: do two stations have this name?" in texts(here, "A")


def test_a_slow_reader_loses_whole_sets_and_is_told():
    exchange, start = Exchange(), soon()
    settings = replace(PATIENT, queued=5)
    with receiver(exchange, settings=settings) as here:
        stations = [Station(exchange, n, start, 60) for n in "AB"]
        for station in stations:
            station.end()
        until(lambda: here.statistics.left_out == 55)
        sets = list(here)
    assert [s.pulse for s in sets] == list(range(55, 60))
    assert here.statistics.left_out == 55


@pytest.mark.parametrize("names", [(), ("A", "A"), ("a/b",), ("*",)])
def test_names_that_cannot_be_are_refused_in_one_line(names):
    exchange = Exchange()
    with pytest.raises(InputError, match="station"):
        Receiver(exchange.open(), names, SIZES)
    with pytest.raises(InputError, match="station"):
        Sender(exchange.open(), "a b", infos(("x",), RATE))
    with pytest.raises(InputError, match="camera name"):
        Sender(exchange.open(), "A", infos(("a/x",), RATE))


def test_an_error_of_the_merging_thread_ends_the_run_with_its_traceback(monkeypatch):
    exchange = Exchange()

    def broken(self, now_ns):
        raise ZeroDivisionError("planted")

    monkeypatch.setattr("hardware.transport.merger.Merger.ready", broken)
    with Receiver(exchange.open(), ("A",), SIZES, RATE, PATIENT) as here:
        with pytest.raises(ZeroDivisionError, match="planted") as caught:
            list(here)
        assert any(entry.name == "broken" for entry in caught.traceback)
