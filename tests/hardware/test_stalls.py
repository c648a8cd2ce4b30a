"""A machine that is held up for seconds: what lives is not called dead, what is there is not lost. By set clocks."""

import threading
import time

import numpy as np
import pytest
from array_source import ArraySource
from fake_rig import Fake, FakeDriver
from loopback import Hand, free_address
from needs import needs_module
from test_hardware_source import pulse_in, source

from hardware.driver import Capabilities, Grabbed
from hardware.emulate.pulse_generators import PulseBox, TriggerLine
from hardware.emulate.serve import served
from hardware.reorder_buffer import ReorderBuffer
from hardware.silence import LONGEST_POLL_S, POLL_S, PollingTime
from hardware.triggers.serial_box import SerialTrigger
from hardware.triggers.software import FRAME_TIMEOUT_S, MISSES_TO_IGNORE, SoftwareTrigger
from mosca.data.frames import Frame
from mosca.synchronisation import Assembly, assemble

SECOND = 1_000_000_000


def test_a_look_that_was_held_up_is_no_evidence_of_silence():
    polled = PollingTime()
    polled.timed_out(0, 100_000_000, None)
    polled.timed_out(100_000_000, 60 * SECOND, None)
    assert polled.idle_s == pytest.approx(POLL_S + LONGEST_POLL_S)
    assert polled.idle_after_end_s == 0
    polled.timed_out(5 * SECOND, 5 * SECOND + 1, 6 * SECOND)  # begun before the last pulse
    assert polled.idle_after_end_s == 0
    polled.timed_out(7 * SECOND, 7 * SECOND + 100_000_000, 6 * SECOND)
    assert polled.idle_after_end_s == pytest.approx(POLL_S)
    polled.frame_arrived()
    assert (polled.idle_s, polled.idle_after_end_s) == (0, 0)


def frame(camera, pulse, size=4):
    image = np.zeros((1, size), np.uint8)
    return Frame(camera, pulse, pulse, 0, image), Grabbed(pulse, pulse, pulse, 0, image)


def test_frames_wait_for_cameras_that_deliver_and_for_no_other():
    reorder = ReorderBuffer(("a", "b"), 40)

    def came(camera, pulse, expected="ab"):
        reorder.advance(camera, pulse)
        reorder.push(pulse, *frame(camera, pulse))
        return [(one.camera, one.index) for one, _ in reorder.release(expected)]

    assert came("a", 0) == []
    assert came("b", 0) == [("a", 0), ("b", 0)]
    assert [came("a", pulse) for pulse in (1, 2, 3)] == [[], [], []]
    assert came("b", 2) == [("a", 1), ("a", 2), ("b", 2)]  # b has no frame of pulse 1
    assert came("a", 4, "a") == [("a", 3), ("a", 4)]  # b was polled without result
    assert [came("a", pulse) for pulse in range(5, 15)] == [[]] * 10
    assert came("a", 15) == [("a", 5)]  # at most ten are buffered


class Held(FakeDriver):
    """A camera whose reader is stopped for the first 150 pulses."""

    def grab(self, timeout_s):
        while self.name == "b" and self.block and self.line.made < 150 and not self.line.ended.is_set():
            time.sleep(0.001)
        return super().grab(timeout_s)


def test_a_reader_that_stands_for_a_while_costs_its_camera_no_frame_set(tmp_path):
    fakes = {"a": Fake(), "b": Fake(offset_s=9)}
    assembly = Assembly()
    with source(tmp_path, fakes, 200, driver=Held, silence_s=0.5) as rig:
        sets = list(assemble(rig, rig.cameras, assembly=assembly))
    assert [s.pulse for s in sets] == list(range(200))
    assert all({pulse_in(f) for f in s.frames.values()} == {s.pulse} for s in sets)
    assert assembly.complete_sets == 200
    assert rig.statistics.notes == []


class Asked:
    """A camera that is triggered by software and counts how often."""

    capabilities = Capabilities(software_trigger=True)

    def __init__(self):
        self.fired, self.happened = 0, threading.Condition()

    def software_trigger(self):
        with self.happened:
            self.fired += 1
            self.happened.notify()
        return time.monotonic_ns()

    def wait_for(self, count):
        with self.happened:
            assert self.happened.wait_for(lambda: self.fired >= count, 60)


def look_in_vain(trigger, seconds, began_ns):
    """Tell a trigger of polled that were as long as they were meant to be, by a clock of their own."""
    for number in range(round(seconds / POLL_S)):
        at = began_ns + round(number * POLL_S * SECOND)
        trigger.poll_timed_out("a", at, at + round(POLL_S * SECOND))


def fired(trigger, camera, count):
    """Wait until pulse ``count`` was sent to the camera and its frame is awaited; return a time after that."""
    camera.wait_for(count)
    until = time.monotonic() + 60
    while (since_ns := trigger._fired_ns) is None:
        assert time.monotonic() < until
        time.sleep(0.001)
    return since_ns + 1


def test_a_software_trigger_waits_for_a_frame_as_long_as_nobody_has_looked_for_it():
    camera = Asked()
    trigger = SoftwareTrigger({"a": camera}, 1000.0)
    trigger.start()
    try:
        at = fired(trigger, camera, 1)
        trigger.poll_timed_out("a", at, at + 3600 * SECOND)  # held up for an hour
        trigger.poll_timed_out("a", at - SECOND, at + SECOND)  # begun before the pulse
        look_in_vain(trigger, FRAME_TIMEOUT_S - 2 * POLL_S - LONGEST_POLL_S, at)
        assert camera.fired == 1
        trigger.frame_arrived("a", at)
        for pulse in range(2, 2 + MISSES_TO_IGNORE):
            look_in_vain(trigger, FRAME_TIMEOUT_S + POLL_S, fired(trigger, camera, pulse))
        # not waited for any more
        camera.wait_for(2 + MISSES_TO_IGNORE + 20)
    finally:
        trigger.stop()


def test_a_software_trigger_does_not_wait_for_a_camera_that_is_gone():
    gone, there = Asked(), Asked()
    trigger = SoftwareTrigger({"a": gone, "b": there}, 100.0)
    trigger.start()
    try:
        at = fired(trigger, there, 1)
        trigger.camera_lost("a")
        for count in range(1, 20):
            trigger.frame_arrived("b", fired(trigger, there, count))
        there.wait_for(20)
        assert gone.fired == 1  # asked no more: its command would hold up the others
        trigger.poll_timed_out("a", at, at + SECOND)  # it answers again
        trigger.frame_arrived("b", at)
        gone.wait_for(2)
    finally:
        trigger.stop()


class Slow:
    """On the line: takes its time with the first pulse, until the line is being stopped."""

    def __init__(self):
        self.heard, self.begun, self.go = [], threading.Event(), threading.Event()

    def pulse(self, number, time_ns):
        self.heard.append(number)
        self.begun.set()
        assert self.go.wait(60)


class Clock:
    """Replaces the module ``time``."""

    def __init__(self):
        self.now_ns = SECOND

    def monotonic_ns(self):
        return self.now_ns


def test_a_line_that_is_behind_makes_the_pulses_that_were_due_before_it_was_stopped(monkeypatch):
    clock, camera = Clock(), Slow()
    monkeypatch.setattr("hardware.emulate.pulse_generators.time", clock)
    line = TriggerLine([camera])
    line.start(100.0)
    assert camera.begun.wait(60)
    clock.now_ns = line.first_ns + 95_000_000  # pulses 0 to 9 are due, 0 was made
    stopping = threading.Thread(target=line.stop)
    stopping.start()
    assert line._stop.wait(60)
    camera.go.set()
    stopping.join()
    assert camera.heard == list(range(10))


def test_a_device_that_was_stalled_does_not_end_its_client_s_control(monkeypatch):
    with served(ArraySource(1, 2), first_address=free_address()) as up:
        device = up.devices[0]
        hand = Hand(str(device.identity.address.ip))
        control, privilege = device.control, device.camera.privilege
        control.close()  # its own checks would be among those below
        begin = time.monotonic_ns()
        privilege.ask(("127.0.0.1", hand.port), 2, begin)

        def looked(*at_s):
            for one in at_s:
                control.check_heartbeat(begin + round(one * SECOND))
            return privilege.holder is not None

        assert looked(0.0, 10.0, 10.4, 10.8, 11.2, 11.6, 11.9)  # asleep for ten seconds: the client was, too, perhaps
        privilege.heartbeat(("127.0.0.1", hand.port), begin + round(11.9 * SECOND))
        assert looked(*np.arange(12.0, 14.8, 0.4))
        assert not looked(*np.arange(14.8, 15.6, 0.4))  # awake, and nothing was heard for 3 s
        hand.close()


def test_a_pulse_box_that_is_behind_makes_the_pulses_that_were_due_before_it_was_stopped():
    camera, told = Slow(), []
    with PulseBox(camera.pulse) as box:
        box.answer("F 100000")
        box.answer("S 1")
        assert camera.begun.wait(60)
        due = time.monotonic() + 0.095  # pulses 0 to 9
        while time.monotonic() < due:
            time.sleep(0.001)
        stopping = threading.Thread(target=lambda: told.append(box.answer("S 0")))
        stopping.start()
        camera.go.set()
        stopping.join()
        assert camera.heard == list(range(len(camera.heard)))
        assert len(camera.heard) >= 10
        assert told == [f"S 0 {len(camera.heard)}"]


class Late(PulseBox):
    """Its pulses begin at once, its answer to that comes late."""

    def answer(self, line):
        told = super().answer(line)
        while line == "S 1" and self.made < 100:
            time.sleep(0.001)
        return told


def test_when_pulses_began_is_known_though_the_answer_came_late():
    needs_module("serial", "serial")
    seen = []
    with Late(lambda number, time_ns: seen.append(time_ns)) as box:
        trigger = SerialTrigger(box.port, 115200, 100.0)
        start_ns = trigger.start()
        trigger.close()
    # half-way between question and answer would be half a second off, half of one quick ping is not
    assert abs(start_ns - seen[0]) < 200_000_000
