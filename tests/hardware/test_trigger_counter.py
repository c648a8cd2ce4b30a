"""The camera's own count of trigger pulses: sent behind its images, and a witness of where pulses were lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from array_source import ArraySource, picture
from driven import one_line, wait_long_for_packets
from loopback import free_address
from needs import needs_aravis

from hardware.driver import DeviceError, Grabbed
from hardware.drivers import open_camera
from hardware.emulate.faults import FaultDraws, Faults
from hardware.emulate.serve import served
from hardware.pulse_numbers.numbering import PulseNumbers
from hardware.pulse_numbers.trigger_counter import TriggerCounter
from hardware.settings import CameraHardware, read_hardware
from hardware.source import HardwareSource
from hardware.trigger import External
from mosca.errors import InputError

SHAPE = (48, 64)
RATE = 100.0
PERIOD = 10_000_000


def buffer(pulse, count=None, block=None, late_ns=0, device_ns=None):
    """A frame of a camera whose clock is the pulses' clock, 3 s ahead."""
    host_ns = pulse * PERIOD + 2_000_000 + late_ns
    stamp = 3_000_000_000 + pulse * PERIOD if device_ns is None else device_ns
    return Grabbed(block, stamp, host_ns, 500_000, np.zeros((2, 2), np.uint8), triggers=count)


def witness(*steps):
    """A witness of frames (pulse, count, block)."""
    seen = TriggerCounter()
    for pulse, count, block in steps:
        seen.take(pulse, buffer(pulse, count, block))
    return seen


@pytest.mark.parametrize(
    ("steps", "told"),
    [
        ([(0, 1, 1), (1, 2, 2), (2, 3, 3)], (0, 0, 0)),
        ([(0, 1, 1), (3, 2, 2), (4, 3, 3)], (2, 0, 0)),  # two pulses on no line
        ([(0, 1, 1), (3, 4, 2), (4, 5, 3)], (0, 2, 0)),  # two that found it busy
        ([(0, 1, 1), (3, 3, 2), (4, 4, 3)], (1, 1, 0)),  # one of each
        ([(0, 1, 1), (1, 4, 2), (2, 5, 3)], (0, 0, 2)),  # a switch that bounced twice
        ([(0, 1, 1), (3, 4, 4), (4, 5, 5)], (0, 0, 0)),  # exposed, and lost on the network
        ([(0, 7, 7), (5, 1, 1), (6, 2, 2)], (0, 0, 0)),  # began anew: nothing is known of what was between
        ([(0, 1, None), (2, 3, None)], (0, 0, 0)),  # without frame counters the loss cannot be attributed
        ([(0, None, 1), (9, None, 2)], (0, 0, 0)),
    ],
)
def test_what_became_of_pulses_without_a_frame(steps, told):
    seen = witness(*steps)
    assert (seen.unreached, seen.ignored, seen.surplus) == told
    assert len(seen.notes("a")) == np.count_nonzero(told)


def test_it_is_said_in_words():
    (first, second) = witness((0, 1, 1), (3, 3, 2)).notes("left")
    assert first.startswith(
        "camera 'left': by its trigger counter 1 pulses did not reach it; check its trigger cable"
    )
    assert "1 pulses came while it could not expose" in second


def numbered(late_ns, count, **jump):
    """Pulses of two cameras; one misses pulses 60 to 62, and its next frame comes so late. Its pulses, and notes."""
    numbers, got = PulseNumbers(("a", "b"), RATE, 0), []
    for pulse in range(120):
        for name in "ab":
            if name == "b" and 60 <= pulse < 63:
                continue
            late = late_ns if name == "b" and pulse == 63 else 0
            own = pulse + 1 if count == "right" else pulse + 1 - 3 * (pulse >= 63)
            one = buffer(pulse, own if count and name == "b" else None, None, late, **jump)
            got += [n.pulse for n in numbers.take(name, one) if n.camera == "b"]
            if name == "b" and pulse == 63:
                at_once = bool(got) and got[-1] == 63
    got += [n.pulse for n in numbers.rest() if n.camera == "b"]
    return at_once, got, numbers


@pytest.mark.parametrize(
    ("late_ns", "count", "at_once"),
    [
        (0, None, True),
        (150_000_000, None, False),  # clock and arrival disagree: the next frames vote
        (150_000_000, "right", True),  # clock and counter agree
        (150_000_000, "other", False),  # the counter alone has no effect
    ],
)
def test_clock_and_counter_outweigh_a_late_arrival(late_ns, count, at_once):
    told, got, numbers = numbered(late_ns, count)
    assert told is at_once
    assert got == [p for p in range(120) if not 60 <= p < 63]
    assert numbers.trigger_counters["b"].unreached == (3 if count == "other" else 0)


def rig_file(path: Path, address: str, **hardware) -> Path:
    first = address.rsplit(".", 1)
    cameras = [
        {
            "name": f"cam{k}",
            "size": list(SHAPE[::-1]),
            "hardware": {
                "driver": "gige", "address": f"{first[0]}.{int(first[1]) + k}", "trigger_counter": True,
                "packet_bytes": 8000, **hardware,
            },
        }
        for k in range(2)
    ]  # fmt: skip
    path.write_text(tomli_w.dumps({"camera": cameras, "hardware": {"rate_hz": RATE}}))
    return path


class LineOf(External):
    """The line of served devices, as an outside generator that this program starts and stops."""

    def __init__(self, devices):
        self._devices = devices

    def start(self):
        self._devices.start(RATE)
        return None

    def stop(self):
        self._devices.line.stop()

    close = stop

    def report(self):
        return {"pulses": self._devices.device("cam1").counts()["pulses"]}


def test_withheld_pulses_are_told_from_those_that_the_camera_ignored(tmp_path, monkeypatch):
    """Device cam0 misses a fifth of its pulses, others at each address; the counter values of its frames show it."""
    needs_aravis()
    wait_long_for_packets(monkeypatch)
    address, pulses = free_address(), 150
    rig = read_hardware(rig_file(tmp_path / "rig.toml", address, exposure_us=500.0))
    faults = Faults(withheld=0.2, seed=5)
    with (
        served(ArraySource(2, 300, SHAPE), first_address=address, faults={"cam0": faults}) as devices,
        HardwareSource(rig, pulses, trigger_opener=lambda rig, drivers: LineOf(devices)) as source,
    ):
        got = {"cam0": {}, "cam1": {}}
        for frame in source:
            got[frame.camera][round(frame.time_ns / PERIOD)] = frame.image
        account, notes = source.statistics, source.statistics.notes
        counts, serial = devices.device("cam0").counts(), devices.device("cam0").identity.serial
    for name, images in got.items():
        whole = {pulse: image for pulse, image in images.items() if image is not None}
        assert len(whole) > 0.8 * len(images)
        for pulse, image in whole.items():
            np.testing.assert_array_equal(image, picture(int(name[3]), pulse, SHAPE))
    luck = FaultDraws(faults, serial)
    withheld = [k for k in range(counts["pulses"]) if luck.withheld(k)]
    inside = [k for k in withheld if min(got["cam0"]) < k]
    # pulses after the last one wanted were counted too
    assert sum(k < max(got["cam0"]) for k in inside) <= account.cameras["cam0"].unreached <= len(inside)
    assert account.cameras["cam0"].unreached > 5  # 30 are expected; one draw in a hundred million has so few
    assert account.cameras["cam1"].unreached == 0
    assert any("camera 'cam0': by its trigger counter" in note and "did not reach it" in note for note in notes)


def test_pulses_that_found_the_camera_busy_are_counted_as_such(tmp_path):
    """Exposures of 15 ms at 100 Hz: every other pulse is ignored, which no time stamp or frame counter shows."""
    needs_aravis()
    address = free_address()
    rig = read_hardware(rig_file(tmp_path / "rig.toml", address, exposure_us=15_000.0))
    with (
        served(ArraySource(2, 200, SHAPE), first_address=address) as devices,
        HardwareSource(rig, 100, trigger_opener=lambda rig, drivers: LineOf(devices)) as source,
    ):
        assert all(report.settings["ChunkEnable"] for report in source.reports.values())
        frames = sum(frame.camera == "cam0" for frame in source)
        account = source.statistics.cameras["cam0"]
    assert 20 < frames <= 51
    assert account.unreached == 0
    assert frames - 2 <= account.ignored <= account.whole + 2


def test_images_are_the_same_with_and_without_chunks():
    needs_aravis()
    address = free_address()
    settings = CameraHardware(driver="gige", address=address, exposure_us=500.0, trigger_counter=True)
    with served(ArraySource(1, 40, SHAPE), first_address=address) as devices:
        camera = open_camera("cam0", settings)
        try:
            assert camera.capabilities.trigger_counter
            for on in (True, False):
                camera.configure(replace_counter(settings, on))
                camera.arm()
                devices.start(50.0)
                got = [one for _ in range(20) if (one := camera.grab(60.0)) is not None]
                devices.line.stop()
                camera.disarm()
                assert len(got) == 20
                for number, one in enumerate(got):
                    np.testing.assert_array_equal(one.image, picture(0, number, SHAPE))
                assert [one.triggers for one in got] == ([*range(1, 21)] if on else [None] * 20)
        finally:
            camera.close()


def replace_counter(settings, on):
    chosen = settings.model_copy(update={"trigger_counter": on})
    return chosen if on else chosen.model_copy(update={"features": {"ChunkModeActive": False}})


def test_a_camera_without_such_a_chunk_is_refused(monkeypatch):
    needs_aravis()
    from hardware.drivers import configure

    monkeypatch.setattr(configure, "COUNTER_CHUNKS", {"Triggerinputcounter": "ChunkTriggerinputcounter"})
    address = free_address()
    settings = CameraHardware(driver="gige", address=address, trigger_counter=True)
    with served(ArraySource(1, 2, SHAPE), first_address=address):
        camera = open_camera("cam0", settings)
        try:
            with pytest.raises(DeviceError) as caught:
                camera.configure(settings)
        finally:
            camera.close()
    one_line(caught.value, "camera 'cam0'", "trigger_counter", "CounterValue", "Leave it out")


@pytest.mark.parametrize("more", [{"driver": "webcam", "trigger": "Off"}, {"driver": "gige", "trigger": "Software"}])
def test_only_pulses_of_a_line_are_counted(tmp_path, more):
    path = rig_file(tmp_path / "rig.toml", "127.0.0.9", **more)
    with pytest.raises(InputError, match="trigger_counter counts the pulses of a line"):
        read_hardware(path)


def test_a_buffer_keeps_its_count_when_it_is_changed():
    assert replace(buffer(3, 9), note="late").triggers == 9
