"""The serial pulse generator against its emulation behind a pseudo-terminal."""

import os
import pty
import threading
import time
import tty

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.driver import DeviceError
from hardware.emulate.pulse_box import PulseBox

serial_box = pytest.importorskip(
    "hardware.triggers.serial_box", reason="pyserial: pip install -e '.[serial]'"
)


def test_pulses_begin_stop_and_are_counted():
    seen = []
    with PulseBox(lambda number, time_ns: seen.append((number, time_ns))) as box:
        trigger = serial_box.SerialTrigger(box.port, 115200, 250.0)
        before = time.monotonic_ns()
        start_ns = trigger.start()
        after = time.monotonic_ns()
        while box.made < 200:
            time.sleep(0.01)
        trigger.stop()
        made = box.made
        time.sleep(0.05)
        assert box.made == made == trigger.report()["pulses"]
        trigger.close()
    assert [number for number, _ in seen] == list(range(made))
    # pulse 0 began where start() says, to half a round trip
    assert abs(seen[0][1] - start_ns) <= (after - before) / 2 + 1e3
    assert abs((seen[-1][1] - seen[0][1]) / (made - 1) - 4e6) < 1e4


def test_the_fit_follows_the_box_s_quartz():
    with PulseBox(drift_ppm=400) as box:
        trigger = serial_box.SerialTrigger(box.port, 115200, 100.0)
        before = time.monotonic_ns()
        trigger.start()
        after = time.monotonic_ns()
        while len(trigger._pings) < 14:
            time.sleep(0.05)
        fit, pings = trigger.fit(), list(trigger._pings)
        trigger.close()
    # as certain as its answers were quick
    half_ns = max(sorted(trip for _, _, trip in pings)[: len(pings) // 2 + 1])
    span_ns = pings[-1][0] - pings[0][0]
    assert before - 2 * half_ns - 1e6 < fit.first_ns < after + 2 * half_ns + 1e6
    assert abs(fit.period_ns / 1e7 * (1 + 400e-6) - 1) < 2e-4 + 4 * half_ns / span_ns
    assert fit.rms_ns < half_ns + 1e6


def test_a_port_that_is_not_there_and_a_box_that_is_another():
    with pytest.raises(DeviceError, match="cannot be opened"):
        serial_box.SerialTrigger("/dev/no-such-port", 115200, 100.0)
    master, slave = pty.openpty()
    tty.setraw(slave)
    answer = threading.Thread(target=lambda: (os.read(master, 64), os.write(master, b"hello\n")))
    answer.start()
    with pytest.raises(DeviceError, match="answers 'hello'"):
        serial_box.SerialTrigger(os.ttyname(slave), 115200, 100.0)
    answer.join()
    os.close(master)
    os.close(slave)


def test_a_rate_that_the_box_does_not_take_is_refused():
    with PulseBox() as box, pytest.raises(DeviceError, match=r"rate_hz = 5e\+06 given"):
        serial_box.SerialTrigger(box.port, 115200, 5e6)


@given(st.text(max_size=40))
def test_the_box_answers_anything_with_one_line(line):
    box = PulseBox.__new__(PulseBox)
    box._begin, box._rate_hz, box._made, box._speed = None, 100.0, 0, 1.0
    box._changed = threading.Condition()
    answer = box.answer(line)
    assert answer
    assert "\n" not in answer
