"""Pulses that this computer sends are on their grid or skipped, and frames carry the times of their commands."""

import threading
import time

import numpy as np
import pytest
from fake_rig import Fake, FakeDriver
from test_hardware_source import pulse_in, source

from hardware.driver import Capabilities, DeviceError, Grabbed
from hardware.pulse_grid import LATEST_START, LATEST_TIME, HostClock, PulseGrid
from hardware.settings import TriggerTable
from hardware.triggers.action import ActionTrigger
from hardware.triggers.software import SoftwareTrigger
from scenarios.build.frame_sources import device_notes

MS = 1_000_000
RATE, PERIOD_NS = 100.0, 10 * MS
EXPOSURE_NS = MS


class SetClock(HostClock):
    """Time passes where somebody waits, or takes time; at ``end_ns`` the event that is waited for is set."""

    def __init__(self, end_s):
        self.at_ns = 1000
        self.end_ns = self.at_ns + round(end_s * 1e9)

    def now_ns(self):
        return self.at_ns

    def wait(self, event, seconds):
        self.at_ns += round(seconds * 1e9)
        if self.at_ns >= self.end_ns:
            event.set()
        return event.is_set()


class Commanded:
    """A camera that exposes in the middle of its command; ``takes_ms`` of the count of commands is its length."""

    capabilities = Capabilities(software_trigger=True)

    def __init__(self, name, clock, takes_ms, unplugged=lambda now_ns: False):
        self.name, self.clock, self.takes_ms, self.unplugged = name, clock, takes_ms, unplugged
        self.trigger, self.exposed_ns, self.buffers = None, [], []

    def software_trigger(self):
        clock, half_ns = self.clock, round(self.takes_ms(len(self.exposed_ns)) * MS / 2)
        if self.unplugged(clock.at_ns):
            clock.at_ns += 3000 * MS
            raise DeviceError(f"camera '{self.name}': no answer")
        clock.at_ns += half_ns
        at_ns = clock.at_ns
        clock.at_ns += half_ns
        # whole here a little after the answer; the next pulse waits for it
        self.exposed_ns.append(at_ns)
        self.buffers.append(Grabbed(None, None, clock.at_ns + EXPOSURE_NS, EXPOSURE_NS, None))
        self.trigger.frame_arrived(self.name, clock.at_ns + EXPOSURE_NS)
        return at_ns


def run(cameras, clock):
    """Make pulses in this thread until the clock ends; return the trigger and the pulses sent."""
    trigger = SoftwareTrigger(cameras, RATE, clock)
    for camera in cameras.values():
        camera.trigger = trigger
    trigger._grid.begin()
    trigger.run()
    return trigger, trigger.new_pulses()


def placed(trigger, camera):
    """Return (pulse number, stamp [ns], true time from pulse 0 on [ns]) of a camera's frames."""
    rows = []
    for buffer, exposed_ns in zip(camera.buffers, camera.exposed_ns, strict=True):
        found = trigger.pulse_of(camera.name, buffer)
        rows.append((found.pulse, found.pulse * PERIOD_NS + found.residual_ns, exposed_ns - 1000))
    return rows


@pytest.mark.parametrize("takes_ms", [2, 6, 14, 28], ids=lambda ms: f"{ms} ms")
def test_pulses_that_take_long_are_skipped_and_frames_have_their_true_times(takes_ms):
    clock = SetClock(4.0)
    camera = Commanded("a", clock, lambda count: takes_ms)
    trigger, pulses = run({"a": camera}, clock)
    rows = placed(trigger, camera)
    assert len(rows) == len(pulses) > 100
    for number, stamp_ns, true_ns in rows:
        # the command went out in the first part of the pulse's period, and the stamp lies within the command
        assert number * PERIOD_NS <= true_ns - takes_ms * MS / 2 <= (number + LATEST_START) * PERIOD_NS
        assert abs(stamp_ns - true_ns) <= max(takes_ms * MS / 2 - LATEST_TIME * PERIOD_NS, 0) + 1 + PERIOD_NS / 4
        assert round(stamp_ns / PERIOD_NS) == number
    assert rows[-1][1] - rows[0][1] == pytest.approx(rows[-1][2] - rows[0][2], abs=PERIOD_NS)
    missing = set(range(rows[-1][0] + 1)) - {number for number, _, _ in rows}
    assert trigger.skipped(rows[-1][0]) == len(missing)
    assert trigger.report()["skipped_pulses"] >= len(missing)
    assert bool(missing) == (takes_ms > 10)
    assert bool(trigger.notes()) == (takes_ms > 8)  # skipped, or answers later than the stamp may be


def test_each_pulse_has_the_host_times_of_its_commands():
    clock = SetClock(1.0)
    cameras = {n: Commanded(n, clock, lambda count: 1 + count % 3) for n in "ab"}
    trigger, pulses = run(cameras, clock)
    assert [one.number for one in pulses] == list(range(100))
    for one, a_ns, b_ns in zip(pulses, cameras["a"].exposed_ns, cameras["b"].exposed_ns, strict=True):
        assert one.nominal_ns == one.number * PERIOD_NS
        assert one.sent_ns < a_ns < b_ns < one.acknowledged_ns
        assert one.acknowledged_ns - one.sent_ns == 2 * (1 + one.number % 3) * MS
    for camera in cameras.values():
        assert all(abs(stamp_ns - true_ns) <= 1 for _, stamp_ns, true_ns in placed(trigger, camera))
    assert trigger.notes() == []


def test_an_unplugged_camera_costs_the_others_pulses_and_no_time():
    clock = SetClock(200.0)
    there = Commanded("a", clock, lambda count: 1)
    gone = Commanded("b", clock, lambda count: 1, lambda now_ns: 1e9 < now_ns < 60e9)
    trigger, _ = run({"b": gone, "a": there}, clock)
    rows = placed(trigger, there)
    assert all(abs(stamp_ns - true_ns) <= 1 for _, stamp_ns, true_ns in rows)
    assert rows[-1][2] > 199e9
    assert len(rows) > 0.9 * 20_000  # each try of 3 s is followed by 30 s without one
    assert placed(trigger, gone)[-1][2] > 199e9  # it was asked again
    assert trigger.skipped() + len({number for number, _, _ in rows}) >= 19_990
    assert any("skipped" in note for note in trigger.notes())
    assert any("no answer" in note for note in trigger.notes())


def test_cameras_that_come_last_are_not_triggered_in_the_next_period():
    clock = SetClock(1.0)
    cameras = {n: Commanded(n, clock, lambda count: 3) for n in "abc"}
    trigger, _ = run(cameras, clock)
    for camera in cameras.values():
        for number, stamp_ns, true_ns in placed(trigger, camera):
            assert round(stamp_ns / PERIOD_NS) == number
            assert abs(stamp_ns - true_ns) <= 1 or camera.name == "b"
    assert not cameras["c"].exposed_ns
    assert any("camera 'c': 100 pulses were not sent to it" in note for note in trigger.notes())


class Stalled(SetClock):
    """The machine does not run for 95 ms at 0.1 s, and for 7 ms at 0.5 s."""

    def wait(self, event, seconds):
        before_ns = self.at_ns
        super().wait(event, seconds)
        for at_ms, for_ms in ((100, 95), (500, 7)):
            if before_ns < at_ms * MS <= self.at_ns:
                self.at_ns += for_ms * MS
        return event.is_set()


def test_action_commands_are_on_the_grid_or_skipped():
    clock = Stalled(1.0)
    trigger = ActionTrigger(TriggerTable(source="action", broadcast="127.0.0.1"), RATE, clock)
    begin_ns = trigger._grid.begin()
    trigger.run()
    trigger.close()
    pulses = trigger.new_pulses()
    for one in pulses:
        assert 0 <= one.sent_ns - begin_ns - one.nominal_ns <= LATEST_START * PERIOD_NS
    numbers = [one.number for one in pulses]
    assert set(range(100)) - set(numbers) == {*range(10, 20), 50}
    assert len(set(numbers)) == len(numbers)
    assert trigger.skipped(100) == trigger.report()["skipped_pulses"] == 11
    assert "11 of 100 pulses were skipped, the first was 10" in trigger.notes(100)[0]


def test_no_pulse_is_made_once_it_was_stopped():
    grid, stop = PulseGrid(RATE, SetClock(1.0)), threading.Event()
    grid.begin()
    assert grid.await_next(stop) == 0
    stop.set()
    assert grid.await_next(stop) is None


class SlowToCommand(FakeDriver):
    """Its command takes three periods at least."""

    def software_trigger(self):
        at_ns = super().software_trigger()
        while time.monotonic_ns() - at_ns < 3 * PERIOD_NS:
            time.sleep(0.001)
        return at_ns


def test_skipped_pulses_are_an_alarm_of_the_source(tmp_path, caplog):
    fakes = {"a": Fake(clock=False, software=True)}
    with (
        caplog.at_level("WARNING", "mosca.hardware"),
        source(tmp_path, fakes, software=True, pulses=60, driver=SlowToCommand) as rig,
    ):
        frames = list(rig)
        session_ns = rig.session_ns(time.monotonic_ns())
        sent = {one.number: one for one in rig.new_pulses()}
    pulses = [round(f.time_ns / PERIOD_NS) for f in frames]
    assert [pulse_in(f) for f in frames] == list(range(len(frames)))  # the camera counts those it got
    assert pulses == sorted(set(pulses))
    assert np.diff(pulses).min() >= 3
    assert set(pulses) <= set(sent)
    assert all(one.sent_ns < one.acknowledged_ns for one in sent.values())
    skipped = rig.statistics.skipped_pulses
    unsent = rig.trigger_report()["unsent"].get("a", 0)  # this process did not run in between
    assert skipped <= 60 - len(frames) <= skipped + unsent
    assert session_ns >= 60 * PERIOD_NS
    assert any("pulses are skipped" in note for note in rig.statistics.notes)
    assert any(f"{skipped} of 60 pulses were skipped" in note for note in rig.statistics.notes)
    assert [r.getMessage() for r in caplog.records] == rig.statistics.notes
    told = device_notes(rig)  # in the record of a run
    assert told["skipped pulses"] == f"{skipped} pulses were skipped"
    assert set(rig.statistics.notes) < set(told.values())
