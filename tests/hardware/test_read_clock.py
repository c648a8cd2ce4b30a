"""Pulse numbers from clock readings, on machines too busy for arrival times to be of use."""

from dataclasses import replace

import numpy as np
import pytest
from seeds import seeds
from test_numbering import Rig, stream, taken

from hardware.driver import ClockReading, Grabbed
from hardware.pulse_numbers.clock_sync import ClockReadings
from hardware.pulse_numbers.numbering import PulseNumbers

NAMES = ["c0", "c1", "c2", "c3"]


def busy(rig, seed, late_s):
    """Frames of ``rig``, each camera's late by its own ``late_s``, slowly changing; and clocks that can be read."""
    rng = np.random.default_rng(seed)
    rows = stream(rig, seed)
    clocks, last, moved = {}, dict.fromkeys(NAMES, 0), []
    for ns, name, pulse, b in rows:
        # the true clock: a stamp was of its pulse, 7 s after the start of this machine's clock
        clocks.setdefault(name, []).append((7_000_000_000 + pulse * 10_000_000, b.device_ns))
        own = late_s[NAMES.index(name)] * (1 + 0.5 * np.sin(pulse / 200)) + rng.exponential(0.3 * max(late_s))
        last[name] = max(ns + round(own * 1e9), last[name])
        moved.append((last[name], name, pulse, Grabbed(b.block_id, b.device_ns, last[name], 1_000_000, None, "no")))
    return sorted(moved, key=lambda row: row[0]), clocks


def shown(points, host_ns, answer_ns, rng):
    """Return the reading at ``host_ns`` of the clock through ``points`` (host, device)."""
    host, device = np.array(points).T
    k = int(np.clip(np.searchsorted(host, host_ns, side="right") - 1, 0, len(host) - 1))
    before = host_ns - round(rng.uniform(0, 1) * answer_ns)
    return ClockReading(int(device[k]) + host_ns - int(host[k]), before, before + answer_ns)


def numbered_busy(rig, seed, late_s, answer_ns=2_000_000, start_ns=None):
    """Number the frames, reading a clock whenever that is wanted; return (pulse, true pulse) of all, and how many."""
    rng = np.random.default_rng(seed + 1)
    rows, clocks = busy(rig, seed, late_s)
    truth = {id(b): pulse for _, _, pulse, b in rows}
    numbers = PulseNumbers(NAMES, rig.rate_hz, start_ns=start_ns)
    out = []
    for name in NAMES:
        out += numbers.read(name, shown(clocks[name], 6_990_000_000, answer_ns, rng))
    for ns, name, _, buffer in rows:
        out += numbers.take(name, buffer)
        wanted = numbers.wants_reading(name)
        if wanted is not None:
            out += numbers.read(name, shown(clocks[name], ns + 2 * answer_ns, answer_ns, rng))
    out += numbers.rest()
    return numbers, [(one.camera, one.pulse, truth[id(one.buffer)]) for one in out], len(rows)


@pytest.mark.parametrize("seed", seeds(1, 3))
@pytest.mark.parametrize(
    "rig",
    [
        Rig(pulses=1500, missed=0.01, lost=0.01),
        Rig(pulses=1500, missed=0.01, lost=0.01, reboot=True),
        Rig(pulses=1500, missed=0.002, jump_s=0.02),
        Rig(pulses=1500, missed=0.002, jump_s=-0.37),
    ],
    ids=["plain", "reboot", "clock set by two periods", "clock set back by whole periods"],
)
def test_frames_that_are_late_by_periods_get_their_pulse(rig, seed):
    """Cameras are late by 0 to 6 periods, each differently: arrivals do not identify pulses."""
    _, out, count = numbered_busy(rig, seed, (0.0, 0.02, 0.04, 0.06))
    assert len(out) == count
    first = min(true for _, _, true in out)
    wrong = [one for one in out if one[1] != one[2] - first]
    assert not wrong, (wrong[:5], len(wrong))


def test_a_take_that_ends_before_a_clock_was_read_again_believes_the_stamps():
    """Camera c1 misses a pulse, then its reader is held up until the take is over."""
    rows, clocks = busy(Rig(pulses=300), 5, (0.0, 0.0, 0.0, 0.0))
    rows = [row for row in rows if row[1:3] != ("c1", 270)]
    rows = [row for row in rows if row[1] != "c1" or row[2] < 271] + [
        (ns + 2_000_000_000, name, pulse, replace(b, host_ns=ns + 2_000_000_000))
        for ns, name, pulse, b in rows
        if name == "c1" and pulse > 270
    ]
    truth = {id(b): pulse for _, _, pulse, b in rows}
    numbers, rng, out = PulseNumbers(NAMES, 100.0), np.random.default_rng(0), []
    for name in NAMES:
        out += numbers.read(name, shown(clocks[name], 6_990_000_000, 100_000, rng))
    for _, name, _, b in rows:
        out += numbers.take(name, b)
    out += numbers.rest()
    assert len(out) == len(rows)
    assert [one.pulse for one in out] == [truth[id(one.buffer)] for one in out]
    assert not numbers.notes


def test_without_readings_such_arrivals_mislead():
    """The control."""
    rows, _ = busy(Rig(pulses=1500, missed=0.01, lost=0.01), 1, (0.0, 0.02, 0.04, 0.06))
    out = taken(PulseNumbers(NAMES, 100.0), rows)
    assert np.mean([pulse == true for _, pulse, true, _ in out]) < 0.8


def test_the_first_frames_are_numbered_when_all_cameras_have_one():
    """Nothing is held for votes: a capture that is killed soon after its start has its frames."""
    rows, clocks = busy(Rig(pulses=100), 3, (0.0, 0.0, 0.0, 0.0))
    numbers, rng, known = PulseNumbers(NAMES, 100.0), np.random.default_rng(0), []
    for name in NAMES:
        assert not list(numbers.read(name, shown(clocks[name], 6_990_000_000, 100_000, rng)))
    for _, name, _, buffer in rows[:8]:
        known += numbers.take(name, buffer)
    assert len(known) == 8


def test_stamps_that_count_something_else_are_left_to_the_votes():
    """The clock that can be read is not the stamps': pulses are voted as without."""
    rows, clocks = busy(Rig(pulses=400), 2, (0.0, 0.0, 0.0, 0.0))
    truth = {id(b): pulse for _, _, pulse, b in rows}
    numbers, rng, out = PulseNumbers(NAMES, 100.0), np.random.default_rng(0), []
    for name in NAMES:
        other = [(host, device // 7) for host, device in clocks[name]]
        out += numbers.read(name, shown(other, 6_990_000_000, 100_000, rng))
    for _, name, _, b in rows:
        out += numbers.take(name, b)
    out += numbers.rest()
    assert len(out) == len(rows)
    assert all(one.pulse == truth[id(one.buffer)] for one in out)


def test_a_slow_answer_does_not_replace_a_quick_one_and_a_contradiction_begins_anew():
    clock = ClockReadings()
    assert clock.at(5, 0) is None
    clock.take(ClockReading(1_000_000_000, 0, 100_000))
    clock.take(ClockReading(1_010_000_000, 8_000_000, 14_000_000))  # 11 ms give or take 3: it agrees
    assert clock.at(1_000_000_000, 0) == (50_000, 50_000)
    assert clock.checked_ns == 8_000_000
    clock.take(ClockReading(500, 20_000_000, 20_100_000))  # the clock began anew
    assert clock.at(500, 20_000_000)[0] == 20_050_000
    # a frame that was here before is of the clock as it ran then
    assert clock.at(1_001_000_000, 7_000_000)[0] == pytest.approx(1_050_000)
