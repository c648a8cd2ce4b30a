"""Merging without a network: completeness, deadlines, order, and every message accounted for."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.transport.merger import Arrived, Merger, MergeSettings
from mosca.data.detections import Detections

MS = 1_000_000
CAMERAS = ("a1", "a2", "b1", "b2")


def found(camera, pulse=0):
    return Detections(camera, [[float(pulse), 1.0]], np.eye(2)[None], [1.0], [1.0], [1.0])


def item(camera, pulse, received_ms, status="detected", age_ms=1):
    received = round(received_ms * MS)
    detections = found(camera, pulse) if status == "detected" else Detections.none(camera)
    arrival = received - age_ms * MS
    return Arrived(pulse, pulse * 10 * MS + len(camera), arrival, arrival, received, status, detections)


def merger(away=(), **settings):
    return Merger(CAMERAS, lambda camera: camera[0] in away, MergeSettings(**settings))


def test_a_complete_set_is_given_at_once_in_the_rigs_order():
    m = merger()
    for camera in ("b2", "a1", "b1"):
        m.take(item(camera, 0, 5))
    assert m.ready(6 * MS) == []
    m.take(item("a2", 0, 7))
    (merged,) = m.ready(7 * MS)
    assert list(merged.detections) == list(CAMERAS)
    assert (merged.pulse, merged.time_ns, merged.merged_ns, dict(merged.missing)) == (0, 2, 7 * MS, {})
    assert merged.arrived_ns["a2"] == 6 * MS


def test_an_incomplete_set_waits_for_its_deadline_and_names_what_is_missing():
    m = merger(deadline_s=0.03)
    for camera in CAMERAS[:3]:
        m.take(item(camera, 0, 5))
    assert m.next_deadline_ns() == 35 * MS
    assert m.ready(34 * MS) == []
    (merged,) = m.ready(35 * MS)
    assert dict(merged.missing) == {"b2": "not in time"}
    m.take(item("b2", 0, 40))
    count = m.statistics.cameras["b2"]
    assert (count.lost, count.late, m.statistics.complete) == (1, 1, 0)


def test_it_does_not_wait_for_what_cannot_come():
    m = merger()
    for camera in CAMERAS[:3]:
        m.take(item(camera, 0, 5))
    m.take(item("b2", 1, 6))  # messages of a camera come in order: pulse 0 of it was lost
    (merged,) = m.ready(6 * MS)
    assert dict(merged.missing) == {"b2": "not in time"}
    away = merger(away="b")
    for camera in ("a1", "a2"):
        away.take(item(camera, 0, 5))
    (merged,) = away.ready(5 * MS)
    assert dict(merged.missing) == {"b1": "station away", "b2": "station away"}


def test_a_frame_that_its_station_could_not_use_is_named():
    m = merger()
    for camera in CAMERAS[:3]:
        m.take(item(camera, 0, 5))
    m.take(item("b2", 0, 5, "corrupt"))
    (merged,) = m.ready(5 * MS)
    assert dict(merged.missing) == {"b2": "corrupt"}
    assert m.statistics.cameras["b2"].no_frame == 1


def test_old_messages_are_thrown_away():
    m = merger(oldest_s=0.25)
    m.take(item("a1", 0, 1000, age_ms=251))
    assert m.statistics.cameras["a1"].aged == 1
    assert m.ready(10**12) == []
    m.take(replace(item("a1", 0, 1000, age_ms=251), buffered=True))  # it waited for the start to be known
    assert m.statistics.cameras["a1"].aged == 1
    assert len(m.rest(10**12)) == 1


@given(st.data())
def test_every_set_comes_once_in_order_and_the_counts_add_up(data):
    m, sets, sent = merger(deadline_s=0.02, oldest_s=0.1), [], 0
    now = 0.0
    for _ in range(data.draw(st.integers(1, 60))):
        now += data.draw(st.sampled_from([0.0, 1.0, 7.0, 30.0]))
        camera = data.draw(st.sampled_from(CAMERAS))
        m.take(item(camera, data.draw(st.integers(0, 12)), now, age_ms=data.draw(st.sampled_from([1, 150]))))
        sent += 1
        sets += m.ready(round(now * MS))
    sets += m.rest(round(now * MS))
    pulses = [s.pulse for s in sets]
    assert pulses == sorted(set(pulses))
    counts = m.statistics.cameras.values()
    assert sum(c.merged + c.late + c.aged + c.doubled for c in counts) == sent
    assert all(c.merged + c.no_frame + c.away + c.lost == len(sets) for c in counts)
    if pulses:
        assert m.statistics.unseen == pulses[-1] - pulses[0] + 1 - len(pulses)
    for merged in sets:
        assert set(merged.detections) | set(merged.missing) == set(CAMERAS)
        assert all(d.xy_px[0, 0] == merged.pulse for d in merged.detections.values())
