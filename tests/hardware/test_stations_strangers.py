"""A stranger among the stations: forged and repeated messages are refused, counted and told; own sets are whole."""

import threading
import time
from dataclasses import replace

import pytest
from loopback import until
from memory_transport import Exchange
from needs import needs_module
from ready_station import infos
from test_transport_engines import free_endpoint
from test_transport_stations import LONG, PATIENT, SIZES, Station, read, soon, texts, whole

from hardware.transport import Trust, open_transport
from hardware.transport.listener import Listener
from hardware.transport.messages import DetectionMessage, pack_clock, pack_detections, pack_health, unpack_detections
from hardware.transport.receiver import Receiver
from hardware.transport.sender import Sender
from hardware.transport.signed import FORGED, REPLAYED, SignedTransport, read_key, write_key
from mosca.data.detections import Detections
from mosca.errors import InputError

KEY, OTHER_KEY = bytes(32), bytes(31) + b"\1"
TOPIC = "mosca/A/a1/detections"


class SignedExchange(Exchange):
    """All ends share a key; ``stranger`` gives one that has none."""

    def open(self):
        return SignedTransport(super().open(), KEY)

    def stranger(self):
        return super().open()


def ends_of(exchange, pulses=60):
    start = soon()
    return [Station(exchange, name, start, pulses) for name in "AB"]


def ended(stations):
    for station in stations:
        threading.Thread(target=station.end).start()


def message_of(transport_data, **changes):
    return pack_detections(replace(unpack_detections(transport_data), **changes))


def test_one_forged_message_does_not_silence_a_station_that_has_no_key():
    """Fails where any message may begin a start: the station's own are then those of an earlier one."""
    exchange = Exchange()
    other, heard = exchange.open(), []
    other.subscribe(TOPIC, lambda key, data: heard.append(data))
    with Receiver(exchange.open(), ("A", "B"), SIZES, None, PATIENT) as here:
        stations = ends_of(exchange, LONG)
        out, stream = [], iter(here)
        read(stream, out, lambda: len(out) == 30)
        genuine = heard[-1]
        other.publish(TOPIC, message_of(genuine, epoch=1))
        other.publish(TOPIC, message_of(genuine, pulse=1 << 40))
        stations_health = stations[0].sender.health()
        other.publish("mosca/A/health", pack_health(replace(stations_health, epoch=2, state="ended")))
        seen = len(out)
        read(stream, out, lambda: len(out) == seen + 60)
        counts = here.statistics.stations["A"]
        until(lambda: counts.unconfirmed == 1)
        assert counts.stale == 0
        assert counts.starts == 1
        assert counts.spoilt == 1
        assert "speaks with two voices: do two stations have this name?" in texts(here, "A")
        assert "sends pulses that are not due yet; they are left out" in texts(here, "A")
        here.stop()
        list(stream)
        for station in stations:
            station.finish()
    assert [s.pulse for s in out] == list(range(len(out)))
    assert whole(out)


def test_an_earlier_start_that_answers_again_is_taken_back():
    """A forged answer of a clock begins a start; when only the station answers again, its messages count again."""
    exchange = Exchange()
    settings = replace(PATIENT, silence_s=0.3)
    with Receiver(exchange.open(), ("A",), {"a1": SIZES["a1"]}, None, settings) as here:
        sender = Sender(exchange.open(), "A", infos(("a1",), 100.0))
        until(lambda: here.statistics.stations["A"].starts == 1)
        genuine = sender._transport._answers["mosca/A/clock"]
        sender._transport._answers["mosca/A/clock"] = lambda _: bytes(8) + genuine(b"")[8:]
        until(lambda: here.statistics.stations["A"].starts == 2)
        sender._transport._answers["mosca/A/clock"] = genuine
        until(lambda: here.statistics.stations["A"].starts == 3)
        assert here._listener.states["A"].epoch == sender.epoch
        here.stop()
        sender.close()


def test_without_the_key_nothing_is_taken_and_own_sets_are_whole():
    exchange = SignedExchange()
    forger, heard = exchange.stranger(), []
    forger.subscribe(TOPIC, lambda key, data: heard.append(data))
    with Receiver(exchange.open(), ("A", "B"), SIZES, None, PATIENT) as here:
        stations = ends_of(exchange)
        until(lambda: heard)
        genuine = heard[0]
        changed = bytearray(genuine)
        changed[-1] ^= 1
        moved = ("mosca/A/a2/detections", genuine)
        wrong_key = SignedTransport(exchange.stranger(), OTHER_KEY)
        for data in (b"", b"MO", bytes(changed), genuine[48:]):
            forger.publish(TOPIC, data)
        forger.publish(*moved)
        wrong_key.publish("mosca/A/health", b"MO")
        forger.publish("mosca/nobody/health", b"?")
        ended(stations)
        sets = list(here)
    assert [s.pulse for s in sets] == list(range(60))
    assert whole(sets)
    assert here.statistics.stations["A"].forged == 6
    assert here.statistics.stations["B"].forged == 0
    assert here.statistics.strangers == 1
    assert texts(here, "A").count(f"a message in its name {FORGED}; refused") == 1


def test_a_repeated_message_is_refused_once_and_again():
    exchange = SignedExchange()
    forger, heard = exchange.stranger(), []
    forger.subscribe("mosca/A/*", lambda key, data: heard.append((key, data)))
    with Receiver(exchange.open(), ("A", "B"), SIZES, None, PATIENT) as here:
        stations = ends_of(exchange)
        until(lambda: len(heard) > 20)
        recorded = heard[:20]
        for _ in range(2):
            for key, data in recorded:
                forger.publish(key, data)
        ended(stations)
        sets = list(here)
    assert len(sets) == 60
    assert whole(sets)
    assert here.statistics.stations["A"].forged == 40
    assert f"a message in its name {REPLAYED}; refused" in texts(here, "A")


def test_a_recorded_session_is_no_station():
    """All messages are signed, and new to this receiver: but nobody confirms their start."""
    exchange = SignedExchange()
    forger, heard = exchange.stranger(), []
    forger.subscribe("mosca/A/*", lambda key, data: heard.append((key, data)))
    with Receiver(exchange.open(), ("A", "B"), SIZES, None, PATIENT) as here:
        ended(ends_of(exchange, 30))
        list(here)
    recorded = list(heard)
    with Receiver(exchange.open(), ("A", "B"), SIZES, None, PATIENT) as here:
        for key, data in recorded:
            forger.publish(key, data)
        stations = ends_of(exchange)
        ended(stations)
        sets = list(here)
    assert [s.pulse for s in sets] == list(range(60))
    assert whole(sets)
    assert here.statistics.stations["A"].starts == 1
    assert here.statistics.stations["A"].unconfirmed > 0


def test_messages_of_another_start_do_not_make_a_dead_station_look_present():
    """It is present as long as its confirmed start is heard; 25 messages/s recorded earlier change nothing."""
    dead_ns, events = 10**9, []
    listener = Listener(("A",), {"a1": SIZES["a1"]}, 100.0, replace(PATIENT, silence_s=0.5), 0, events.append)
    for now_ns in range(0, 4 * 10**9, 20_000_000):
        if now_ns < dead_ns:
            listener.take("clock", "A", (pack_clock(7, now_ns), now_ns, now_ns), now_ns)
        if now_ns % 40_000_000 == 0:
            recorded = DetectionMessage(
                "A", 5, 0, now_ns // 40_000_000, 0, 0, now_ns, now_ns, "detected", Detections.none("a1")
            )
            listener.take("message", "A", pack_detections(recorded), now_ns)
        listener.check(now_ns)
    assert [(event.kind, event.time_ns) for event in events if event.kind in ("appeared", "silent", "back")] == [
        ("appeared", 0),
        ("silent", dead_ns + 500_000_000),  # the check at 0.98 s was the last that had heard it
    ]


def test_a_flood_of_forged_messages_costs_no_set():
    exchange = SignedExchange()
    forger, over = exchange.stranger(), threading.Event()

    def flood():
        while not over.is_set():
            for _ in range(20):
                forger.publish(TOPIC, bytes(3000))
            time.sleep(0.001)

    with Receiver(exchange.open(), ("A", "B"), SIZES, None, PATIENT) as here:
        thread = threading.Thread(target=flood)
        thread.start()
        ended(ends_of(exchange))
        sets = list(here)
        over.set()
        thread.join()
    assert [s.pulse for s in sets] == list(range(60))
    assert whole(sets)
    assert here.statistics.stations["A"].forged > 100
    assert here.statistics.overrun == 0


def test_answers_and_orders_are_signed_and_belong_to_their_query():
    exchange = SignedExchange()
    asker, station, stranger = exchange.open(), exchange.open(), exchange.stranger()
    asked = []

    def reply(question):
        asked.append(question)
        return b"answer"

    station.declare_queryable("mosca/A/clock", reply)
    assert asker.query("mosca/A/clock", b"question", 1.0) == b"answer"
    assert stranger.query("mosca/A/clock", b"question", 1.0) == b""
    assert asked == [b"question"]
    # a query that is sent again is not answered; an old answer is none to a new query
    recorded = {}
    genuine = station._inner._answers["mosca/A/clock"]

    def spying(data):
        if not recorded:
            recorded.update(query=data, answer=genuine(data))
        return recorded["answer"]

    station._inner._answers["mosca/A/clock"] = spying
    assert asker.query("mosca/A/clock", b"2", 1.0) == b"answer"
    assert genuine(recorded["query"]) == b""
    assert asker.query("mosca/A/clock", b"3", 1.0) is None
    assert asked == [b"question", b"2"]
    assert station.refused["A"] == 2
    assert asker.refused["A"] == 1


def test_over_the_network_too_a_stranger_changes_nothing():
    """The same attacks by the engine, from a program that reaches the port."""
    needs_module("zenoh", "stations")
    endpoint = free_endpoint()
    heard = []

    class Ends:
        def open(self):
            return open_transport(connect=[endpoint], jam_s=60.0, trust=Trust(KEY))

    here = open_transport(listen=[endpoint], jam_s=60.0, trust=Trust(KEY))
    here._inner.subscribe(TOPIC, lambda key, data: heard.append(data))
    with Receiver(here, ("A", "B"), SIZES, None, PATIENT) as receiver:
        forger = open_transport(connect=[endpoint], jam_s=60.0)
        stations = ends_of(Ends())
        until(lambda: heard)
        plain = message_of(heard[0][48:], epoch=3)
        until(lambda: forger.publish(TOPIC, plain) and receiver.statistics.stations["A"].forged > 0)
        for _ in range(200):
            assert forger.publish(TOPIC, heard[0])
            assert forger.publish(TOPIC, plain)
        until(lambda: here.refused["A"] > 400)
        ended(stations)
        sets = list(receiver)
        forger.close()
    assert [s.pulse for s in sets] == list(range(60))
    assert whole(sets)
    assert receiver.statistics.stations["A"].forged > 400
    assert {f"a message in its name {why}; refused" for why in (FORGED, REPLAYED)} <= set(texts(receiver, "A"))


def test_what_the_engine_itself_says_of_who_is_there_changes_nothing():
    """A stranger announces a station's presence to Zenoh and withdraws it: nobody asks for that."""
    needs_module("zenoh", "stations")
    endpoint = free_endpoint()
    here = open_transport(listen=[endpoint], trust=Trust(KEY))
    forger = open_transport(connect=[endpoint])
    watched = []
    with Receiver(here, ("A", "B"), SIZES, None, PATIENT) as receiver:
        here._inner._session.liveliness().declare_subscriber("mosca/**", watched.append)
        with Sender(open_transport(connect=[endpoint], trust=Trust(KEY)), "A", infos(("a1",), 100.0)):
            until(lambda: texts(receiver, "A") == ["is here"])
            for number in range(3):
                token = forger._session.liveliness().declare_token("mosca/A/alive")
                until(lambda seen=2 * number: len(watched) > seen)
                token.undeclare()
                until(lambda seen=2 * number + 1: len(watched) > seen)
            time.sleep(0.2)  # the receiver looks at its stations each 20 ms
            assert texts(receiver, "A") == ["is here"]
            assert receiver.statistics.stations["A"].silent == 0
        receiver.stop()
        forger.close()


def test_keys_are_made_once_and_read_or_refused(tmp_path):
    path = tmp_path / "rig.key"
    write_key(path)
    assert len(read_key(path)) == 32
    assert path.stat().st_mode & 0o077 == 0
    with pytest.raises(InputError, match="exists"):
        write_key(path)
    for text in ("", "no key", "00" * 31, "é" * 64):
        path.write_text(text)
        with pytest.raises(InputError, match=r"rig.key: is no key; one line of 64 hexadecimal digits"):
            read_key(path)
    with pytest.raises(InputError, match="No such file or directory; make a key with: mosca station key"):
        read_key(tmp_path / "none.key")


def test_what_is_not_detected_is_signed_too():
    """A station's ordinary words pass: the wrapper changes no byte of them."""
    exchange = SignedExchange()
    receiver, heard = exchange.open(), []
    receiver.subscribe("mosca/**", lambda key, data: heard.append((key, data)))
    with Sender(exchange.open(), "A", infos(("a1",), 100.0)) as sender:
        sender.send("a1", 0, 0, 0, 0, None, "no frame")
        sender.send("a1", 1, 0, 0, 0, Detections.none("a1"))
        until(lambda: len([key for key, _ in heard if key == TOPIC]) == 2)
    statuses = [unpack_detections(data).status for key, data in heard if key == TOPIC]
    assert statuses == ["no frame", "detected"]
