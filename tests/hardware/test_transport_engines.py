"""What every engine does, the one in memory of the tests too, so that tests with it mean something."""

import socket
import threading

import pytest
from loopback import until
from memory_transport import Exchange
from needs import needs_module

from hardware.transport import open_transport
from hardware.transport.transport import EVERYTHING, TransportError


def free_endpoint():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"


@pytest.fixture(params=["memory", "zenoh"])
def ends(request):
    """Two ends that reach each other; the one that connects is there first."""
    if request.param == "memory":
        exchange = Exchange()
        made = exchange.open(), exchange.open()
    else:
        needs_module("zenoh", "stations")
        endpoint = free_endpoint()
        made = open_transport(connect=[endpoint]), open_transport(listen=[endpoint])
    yield made
    for end in made:
        end.close()
        end.close()


def test_what_is_published_arrives_in_order(ends):
    a, b = ends
    got = []
    b.subscribe(EVERYTHING, lambda key, data: got.append((key, data)))
    until(lambda: a.publish("mosca/A/health", b"?") and got)
    sent = [(f"mosca/A/{'le ft' if k % 2 else 'health'}/detections", bytes([k])) for k in range(60)]
    for key, data in sent:
        assert a.publish(key, data)
    until(lambda: sent[-1] in got)
    assert [one for one in got if one[1] != b"?"] == sent


def test_questions_are_answered_or_not(ends):
    a, b = ends
    a.declare_queryable("mosca/A/clock", lambda asked: asked + b"!")
    until(lambda: b.query("mosca/A/clock", b"12", 1.0) == b"12!")
    assert b.query("mosca/B/clock", b"", 0.3) is None


def test_nothing_is_taken_after_the_end(ends):
    a, _ = ends
    a.close()
    assert not a.publish("mosca/A/health", b"")
    assert a.query("mosca/A/clock", b"", 0.2) is None


def test_endpoints_that_cannot_be_are_one_line():
    needs_module("zenoh", "stations")
    taken = free_endpoint()
    first = open_transport(listen=[taken])
    try:
        for endpoints in ([taken], ["nonsense"], ["tpc/127.0.0.1:1"]):
            wanted = "another program listens there" if endpoints == [taken] else "endpoints look like tcp/"
            with pytest.raises(TransportError, match=wanted) as error:
                open_transport(listen=endpoints)
            assert "\n" not in str(error.value)
            assert ".rs:" not in str(error.value)
    finally:
        first.close()


def test_a_missing_engine_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "zenoh", None)
    monkeypatch.delitem(sys.modules, "hardware.transport.zenoh_engine", raising=False)
    with pytest.raises(TransportError, match=r"pip install 'mosca-testbench\[stations\]'"):
        open_transport(connect=["tcp/127.0.0.1:1"])


def test_no_threads_of_ours_are_left(ends):
    assert not [t for t in threading.enumerate() if t.name.startswith(("merge", "clock of", "station "))]
