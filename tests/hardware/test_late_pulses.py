"""Pulses that come late: frames keep their true times, or are said to be in doubt."""

import numpy as np
import pytest
from test_true_times import EXPOSURE_NS, MS, PERIOD_NS, RATE, Commanded, SetClock, run

from hardware.driver import ClockReading, DeviceReport, Grabbed
from hardware.frame_maker import FrameMaker
from hardware.pulse_numbers.camera_state import NumberedBuffer
from hardware.pulse_numbers.clock_model import ExposureStart
from hardware.pulse_numbers.numbering import PulseNumbers
from hardware.settings import HardwareTable, TriggerTable
from hardware.triggers.action import ActionTrigger

START_NS = 7_000_000_000
CLOCKS = {"a": 5_000_000_000_000, "b": 900_000_000}
ROUND_TRIP_NS = 100_000


def numbered(late_ns, readable=True, pulses=200):
    """Return (pulse, time [ns], true time [ns], how it was found) of all frames; ``late_ns``: pulse -> delay."""
    numbers, out, truth = PulseNumbers(list(CLOCKS), RATE, START_NS), [], {}

    def reading(name, at_ns):
        half_ns = ROUND_TRIP_NS // 2
        return ClockReading(at_ns + CLOCKS[name], at_ns - half_ns, at_ns + half_ns)

    for name in CLOCKS if readable else ():
        out += numbers.read(name, reading(name, START_NS - MS))
    for pulse in range(pulses):
        for name in CLOCKS:
            true_ns = START_NS + pulse * PERIOD_NS + late_ns.get(pulse, 0)
            arrived_ns = true_ns + EXPOSURE_NS + 2 * MS
            buffer = Grabbed(pulse + 1, true_ns + CLOCKS[name], arrived_ns, EXPOSURE_NS, None)
            truth[id(buffer)] = (buffer, true_ns - START_NS)
            out += numbers.take(name, buffer)
            if numbers.wants_reading(name) is not None:
                out += numbers.read(name, reading(name, arrived_ns + MS))
    out += numbers.rest()
    assert len(out) == 2 * pulses
    return [(one.pulse, one.pulse * PERIOD_NS + one.residual_ns, truth[id(one.buffer)][1], one.found) for one in out]


@pytest.mark.parametrize("readable", [True, False], ids=["clocks are read", "stamps alone"])
@pytest.mark.parametrize("share", [0.05, 0.12, 0.2, 0.3, 0.42, 0.5, 0.6, 0.9])
def test_a_late_pulse_of_a_line_keeps_its_time_and_moves_no_other(share, readable):
    rows = numbered({90: round(share * PERIOD_NS)}, readable)
    sure = [row for row in rows if row[3] != "arrival"]
    assert [row for row in sure if abs(row[1] - row[2]) > MS] == []
    assert len(sure) >= len(rows) - 2
    assert [row for row in sure if row[0] != round(row[2] / PERIOD_NS)] == []


def test_late_pulses_one_after_the_other_keep_their_times():
    rows = numbered({k: round(0.03 * (k - 60) * PERIOD_NS) for k in range(60, 75)})
    assert [row for row in rows if row[3] != "arrival" and abs(row[1] - row[2]) > MS] == []


def action(end_s=1.0, **more):
    clock = SetClock(end_s)
    trigger = ActionTrigger(TriggerTable(source="action", broadcast="127.0.0.1", **more), RATE, clock)
    begin_ns = trigger._grid.begin()
    trigger.run()
    return trigger, begin_ns


def exposed(at_ns, error_ns=100_000.0):
    return Grabbed(1, 1, at_ns + EXPOSURE_NS + MS, EXPOSURE_NS, None), ExposureStart(at_ns, error_ns)


def test_frames_of_action_commands_are_timed_by_their_cameras_clocks():
    trigger, begin_ns = action()
    for pulse, late_ns in ((0, 100_000), (7, 2_500_000), (8, 0), (50, 4_300_000)):
        found = trigger.pulse_of("a", *exposed(begin_ns + pulse * PERIOD_NS + late_ns))
        assert (found.pulse, found.residual_ns, found.certain) == (pulse, late_ns, True)
    late = trigger.pulse_of("a", *exposed(begin_ns + 20 * PERIOD_NS + 7_000_000))
    assert (late.pulse, late.certain) == (20, False)
    assert late.error_ns > 2_000_000
    assert round((late.pulse * PERIOD_NS + late.residual_ns) / PERIOD_NS) == 20
    # a frame of this camera whose time is not known, and one of a camera whose clock is not read
    buffer, _ = exposed(begin_ns + 31 * PERIOD_NS)
    assert not trigger.pulse_of("a", buffer).certain
    assert trigger.pulse_of("b", buffer) is None
    trigger.close()


def test_scheduled_action_commands_are_numbered_by_their_stamps():
    trigger, begin_ns = action(lead_ms=5.0)
    assert trigger.pulse_of("a", *exposed(begin_ns + 30 * PERIOD_NS)) is None
    assert trigger.pulse_at(begin_ns) is trigger.session_ns(begin_ns) is None
    trigger.close()


class Early(Commanded):
    """Exposes as the command begins, which takes long: half-way through it is no good time."""

    def software_trigger(self):
        began_ns = self.clock.at_ns
        middle_ns = super().software_trigger()
        self.exposed_ns[-1] = began_ns
        return middle_ns


def test_software_triggers_are_timed_by_the_cameras_clock_where_that_is_more_precise():
    clock = SetClock(1.0)
    camera = Early("a", clock, lambda count: 4)
    trigger, _ = run({"a": camera}, clock)
    for k, (buffer, true_ns) in enumerate(zip(camera.buffers, camera.exposed_ns, strict=True)):
        blind = trigger.pulse_of("a", buffer)
        assert blind.residual_ns == true_ns + 2 * MS - 1000 - k * PERIOD_NS
        assert blind.error_ns >= 2 * MS
        read = trigger.pulse_of("a", buffer, ExposureStart(true_ns + 50_000.0, 100_000.0))
        assert (read.pulse, read.error_ns) == (k, 100_000)
        assert read.residual_ns == true_ns + 50_000 - 1000 - k * PERIOD_NS
        # a reading of a clock that was set since says impossible times
        assert trigger.pulse_of("a", buffer, ExposureStart(true_ns - 3e9, 100_000.0)) == blind


def frame_of(found, error_ns, image, **more):
    reports = {"a": DeviceReport("", "", 4, 2, 8, EXPOSURE_NS)}
    maker = FrameMaker(HardwareTable(rate_hz=RATE, **more), {"a": "exposure_start"}, reports)
    buffer = Grabbed(1, None, 1, EXPOSURE_NS, image, "" if image is not None else "MISSING_PACKETS")
    return maker.frame(NumberedBuffer("a", 3, 0.0, buffer, found, error_ns))


def test_frames_say_what_is_not_certain_unless_the_rig_accepts_it():
    image = np.zeros((2, 4), np.uint8)
    assert frame_of("clock", 0.0, image).doubt == ""
    assert frame_of("arrival", 0.0, image).doubt == "its pulse is known by its arrival alone"
    assert frame_of("trigger", 1.6e6, image).doubt == "its time is known to 1.6 ms"
    assert frame_of("trigger", 0.9e6, image).doubt == ""
    assert frame_of("trigger", 1.6e6, image, time_error_ms=2.0).doubt == ""
    assert frame_of("arrival", 0.0, image, accept_unproven=True).doubt == ""
    damaged = frame_of("arrival", 0.0, None)
    assert (damaged.doubt, damaged.note) == ("", "MISSING_PACKETS")


def test_the_time_of_a_frame_without_stamp_is_as_certain_as_its_arrival():
    """A late exposure arrives late, as does any frame of a busy machine; which it was nobody knows."""
    numbers, out = PulseNumbers(["a", "b"], RATE, START_NS), []
    late_ns = {("a", 120): 3 * MS, ("b", 120): 3 * MS, ("b", 150): 11 * MS}
    for pulse in range(200):
        for name in "ab":
            arrived_ns = START_NS + pulse * PERIOD_NS + late_ns.get((name, pulse), 0) + EXPOSURE_NS
            out += numbers.take(name, Grabbed(pulse + 1, None, arrived_ns, EXPOSURE_NS, None))
    out += numbers.rest()
    assert [one.pulse for one in out if one.camera == "b"] == list(range(200))
    for one in out:
        assert one.found == "count"
        assert one.error_ns == pytest.approx(late_ns.get((one.camera, one.pulse), 0), abs=MS / 10)


def test_a_frame_after_a_gap_keeps_the_time_of_its_stamp_though_readings_are_rough():
    """Camera a missed pulses; its clock ran on, and its stamps are better than a reading of a busy machine."""
    numbers, out, truth = PulseNumbers(list(CLOCKS), RATE, START_NS), [], {}

    def rough(name, at_ns, off_ns):
        return ClockReading(at_ns + off_ns + CLOCKS[name], at_ns - 2 * MS, at_ns + 2 * MS)

    for name, off_ns in (("a", -1_900_000), ("b", 1_900_000)):
        out += numbers.read(name, rough(name, START_NS - 3 * MS, off_ns))
    for pulse in range(200):
        for name in CLOCKS:
            if name == "a" and pulse in (90, 91, 120):
                continue
            true_ns = START_NS + pulse * PERIOD_NS
            buffer = Grabbed(pulse + 1, true_ns + CLOCKS[name], true_ns + EXPOSURE_NS + MS, EXPOSURE_NS, None)
            truth[id(buffer)] = buffer, pulse
            out += numbers.take(name, buffer)
            if numbers.wants_reading(name) is not None:
                out += numbers.read(name, rough(name, true_ns + 4 * MS, 1_900_000))
    out += numbers.rest()
    assert len(out) == 397
    assert all(one.pulse == truth[id(one.buffer)][1] for one in out)
    first = {"a": out[0].residual_ns, "b": out[0].residual_ns}
    assert max(abs(one.residual_ns - first[one.camera]) + one.error_ns for one in out) < MS / 10
    assert numbers.relocks == {"a": 0, "b": 0}
