"""Stations and the one that merges, over an engine in memory: starts, deaths, returns, lies and rubbish."""

import threading
import time
from contextlib import contextmanager

import pytest
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
# generous where a busy machine must not make a test fail
PATIENT = ReceiverSettings(
    MergeSettings(deadline_s=0.25, oldest_s=2.0), silence_s=0.4, start_wait_s=5.0, clock_s=0.05
)


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
        self._dead = False
        self._thread = threading.Thread(
            target=play, args=(self.sender, cameras, pulses, RATE, start_ns, 3, first, lambda: self._dead)
        )
        self._thread.start()

    def end(self):
        self._thread.join()
        self.sender.close()

    def die(self):
        """End as a killed process does: without a word."""
        self._dead = True
        self.transport.die()
        self._thread.join()
        self.sender.close()


@contextmanager
def receiver(exchange, stations=("A", "B"), settings=PATIENT, cameras=SIZES, rate=None):
    with Receiver(exchange.open(), stations, cameras, rate, settings, rig="# all") as here:
        yield here


def soon():
    return time.monotonic_ns() + 300_000_000


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
    assert here.account.merge.complete == 80
    assert [s.lost for s in here.account.stations.values()] == [0, 0]
    assert all(s.clock_error_ns < 5e6 for s in here.account.stations.values())
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
    with receiver(exchange) as here:
        a, b = Station(exchange, "A", start, 300), Station(exchange, "B", start, 300, offset_s=9)
        out = []
        reader = threading.Thread(target=lambda: out.extend(here))
        reader.start()
        time.sleep(max(0, (start - time.monotonic_ns()) * 1e-9) + 1.0)
        b.die()
        time.sleep(0.5)
        b = Station(
            exchange, "B", start, 300, first=170, offset_s=-4
        )  # another start, another clock, another count
        b.end()
        a.end()
        reader.join()
    assert [s.pulse for s in out] == list(range(300))
    for merged in out:
        assert {pulse_in(found) for found in merged.detections.values()} == {merged.pulse}
        assert {"a1", "a2"} <= set(merged.detections)
    missing = [s.pulse for s in out if s.missing]
    assert 60 < len(missing) < 140
    assert missing[-1] < 220
    assert texts(here, "B")[:2] == ["is here", "is gone: its program ended, or its network"]
    assert "has started again" in texts(here, "B")
    count = here.account.merge.cameras["b1"]
    assert count.away + count.lost == len(missing)
    assert (here.account.stations["B"].gone, here.account.stations["B"].starts) == (1, 2)


def test_a_cut_cable_is_told_and_what_it_cost_is_counted():
    exchange, start = Exchange(), soon()
    with receiver(exchange) as here:
        a, b = Station(exchange, "A", start, 250), Station(exchange, "B", start, 250, offset_s=9)
        out = []
        reader = threading.Thread(target=lambda: out.extend(here))
        reader.start()
        time.sleep(max(0, (start - time.monotonic_ns()) * 1e-9) + 0.7)
        b.transport.cut = True
        time.sleep(0.8)
        b.transport.cut = False
        b.end()
        a.end()
        reader.join()
    assert [s.pulse for s in out] == list(range(250))
    missing = sum("b1" in s.missing for s in out)
    assert 60 < missing < 100
    # lost on the way, or come back too late for a set that did not wait any more
    late = sum(here.account.merge.cameras[name].late for name in ("b1", "b2"))
    absent = sum(name in s.missing for s in out for name in ("b1", "b2"))
    assert here.account.stations["B"].lost + late == absent
    assert late <= 8
    assert any(text.startswith("is silent") for text in texts(here, "B"))
    assert any(text.startswith("is heard again after 0.") for text in texts(here, "B"))
    assert not any("pulse" in text for text in texts(here, "B"))


def test_a_station_that_holds_the_pulses_is_ordered_to_start_when_all_are_armed():
    exchange = Exchange()
    with receiver(exchange) as here:
        a = Sender(exchange.open(), "A", infos(CAMERAS["A"], RATE))
        a.say("holding")
        assert not a.ordered(0.6)
        b = Sender(exchange.open(), "B", infos(CAMERAS["B"], RATE))
        assert not a.ordered(0.3)  # it is still starting
        b.say("armed")
        assert a.ordered(3.0)
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
    assert here.account.stations["A"].spoilt == 50
    assert here.account.stations["B"].spoilt == 50
    assert sum(text.startswith("sends what cannot be read") for text in texts(here, "A")) <= 4


def test_two_stations_of_one_name_are_told():
    exchange, start = Exchange(), soon()
    with receiver(exchange) as here:
        stations = [
            Station(exchange, "A", start, 60),
            Station(exchange, "A", start, 60),
            Station(exchange, "B", start, 60),
        ]
        time.sleep(0.9)
        here.stop()
        list(here)
        for station in stations:
            station.end()
    assert "speaks with two voices: do two stations have this name?" in texts(here, "A")


def test_a_slow_reader_loses_whole_sets_and_is_told():
    exchange, start = Exchange(), soon()
    settings = ReceiverSettings(PATIENT.merge, clock_s=0.05, queued=5)
    with receiver(exchange, settings=settings) as here:
        stations = [Station(exchange, n, start, 60) for n in "AB"]
        for station in stations:
            station.end()
        time.sleep(0.5)
        sets = list(here)
    assert [s.pulse for s in sets] == list(range(55, 60))
    assert here.account.left_out == 55


@pytest.mark.parametrize("names", [(), ("A", "A"), ("a/b",), ("*",)])
def test_names_that_cannot_be_are_refused_in_one_line(names):
    exchange = Exchange()
    with pytest.raises(InputError, match="station"):
        Receiver(exchange.open(), names, SIZES)
    with pytest.raises(InputError, match="station"):
        Sender(exchange.open(), "a b", infos(("x",), RATE))
    with pytest.raises(InputError, match="camera name"):
        Sender(exchange.open(), "A", infos(("a/x",), RATE))
