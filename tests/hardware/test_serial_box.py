"""The serial pulse generator against its emulation behind a pseudo-terminal."""

import os
import pty
import threading
import time
import tty
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from needs import needs_module

from hardware.driver import DeviceError
from hardware.emulate.pulse_generators import PulseBox
from hardware.triggers import pulse_protocol
from hardware.triggers.pulse_protocol import Ping, fit_pulses, pulses_at_ping, pulses_made
from hardware.triggers.serial_box import SerialTrigger


@pytest.fixture
def trigger_at():
    """Return what opens a pulse generator at a port, as a context."""
    needs_module("serial", "serial")

    @contextmanager
    def opened(port, rate_hz):
        trigger = SerialTrigger(port, 115200, rate_hz)
        yield trigger
        trigger.close()

    return opened


def test_pulses_begin_stop_and_are_counted(trigger_at):
    seen = []
    with (
        PulseBox(lambda number, time_ns: seen.append((number, time_ns))) as box,
        trigger_at(box.port, 250.0) as trigger,
    ):
        before = time.monotonic_ns()
        start_ns = trigger.start()
        after = time.monotonic_ns()
        while box.made < 200:
            time.sleep(0.01)
        trigger.stop()
        made = box.made
        time.sleep(0.05)
        assert box.made == made == trigger.report()["pulses"]
    assert [number for number, _ in seen] == list(range(made))
    # pulse 0 began where start() says, to half a round trip
    assert abs(seen[0][1] - start_ns) <= (after - before) / 2 + 1e3
    assert abs((seen[-1][1] - seen[0][1]) / (made - 1) - 4e6) < 1e4


def test_the_fit_follows_the_box_s_quartz(trigger_at):
    with PulseBox(drift_ppm=400) as box, trigger_at(box.port, 100.0) as trigger:
        before = time.monotonic_ns()
        trigger.start()
        after = time.monotonic_ns()
        while len(trigger.pings) < 14:
            time.sleep(0.05)
        fit, pings = trigger.fit(), trigger.pings
    # as certain as its answers were quick
    half_ns = max(sorted(ping.round_trip_ns for ping in pings)[: len(pings) // 2 + 1])
    span_ns = pings[-1].host_ns - pings[0].host_ns
    assert before - 2 * half_ns - 1e6 < fit.first_ns < after + 2 * half_ns + 1e6
    assert abs(fit.period_ns / 1e7 * (1 + 400e-6) - 1) < 2e-4 + 4 * half_ns / span_ns
    assert fit.rms_ns < half_ns + 1e6


def test_slow_answers_do_not_disturb_the_fit():
    quick = [Ping(5_000 + 10_000_000 * k, float(k), 100_000) for k in range(10)]
    slow = [Ping(5_000 + 10_000_000 * k + 4_000_000, float(k), 8_000_000) for k in range(10)]
    fit = fit_pulses([*quick, *slow])
    assert fit.first_ns == pytest.approx(5_000, abs=2)
    assert fit.period_ns == pytest.approx(1e7, rel=1e-12)
    assert fit.pings == 10
    assert np.isclose(fit.rms_ns, 0, atol=1e-3)
    assert fit_pulses(quick[:3]) is None


def test_lines_of_the_protocol_are_read_or_refused():
    assert pulses_made("S 0 1234") == 1234
    assert pulses_made("S 0") is pulses_made("S 0 x") is None
    assert pulses_at_ping("P 7 12 2500", 7, 100.0) == 12.25
    assert pulses_at_ping("P 8 12 2500", 7, 100.0) is pulses_at_ping("E what", 7, 100.0) is None


def test_a_port_that_is_not_there_and_a_box_that_is_another():
    needs_module("serial", "serial")
    with pytest.raises(DeviceError, match="cannot be opened"):
        SerialTrigger("/dev/no-such-port", 115200, 100.0)
    master, slave = pty.openpty()
    tty.setraw(slave)
    answer = threading.Thread(target=lambda: (os.read(master, 64), os.write(master, b"hello\n")))
    answer.start()
    with pytest.raises(DeviceError, match="answers 'hello'"):
        SerialTrigger(os.ttyname(slave), 115200, 100.0)
    answer.join()
    os.close(master)
    os.close(slave)


def test_a_rate_that_the_box_does_not_take_is_refused():
    needs_module("serial", "serial")
    with PulseBox() as box, pytest.raises(DeviceError, match=r"rate_hz = 5e\+06 given"):
        SerialTrigger(box.port, 115200, 5e6)


def test_the_box_answers_anything_with_one_line():
    with PulseBox() as box:

        @given(st.text(max_size=40))
        def any_text(line):
            answer = box.answer(line)
            assert answer
            assert "\n" not in answer

        any_text()


@pytest.mark.parametrize("rest", ["x y", "12 x", "² 3", "-1 5", "9" * 5000 + " 1", "\ufffd \ufffd"])
def test_garbage_in_an_answer_is_one_ping_less_and_no_error(rest):
    assert pulse_protocol.pulses_at_ping(f"P 7 {rest}", 7, 100.0) is None
    assert pulse_protocol.pulses_at_ping("P 7 12 5000", 7, 100.0) == 12.5


def test_a_box_that_is_pulled_out_is_told_and_can_be_closed():
    needs_module("serial", "serial")
    box = PulseBox()
    trigger = SerialTrigger(box.port, 115200, 100.0)
    trigger.start()
    box.close()
    with pytest.raises(DeviceError, match="is gone"):
        trigger.stop()
    trigger.close()
    trigger.close()
