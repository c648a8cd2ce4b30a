"""An emulated camera without a network: registers, triggers, clock, supply."""

from ipaddress import IPv4Interface
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.emulate.acquisition import LOCKING_NS, ClockJump, EmulatedClock, PendingImage, Shutter, common_ns
from hardware.emulate.camera import RESET_AFTER_NS, EmulatedCamera
from hardware.emulate.faults import FAULTLESS, FaultDraws, Faults
from hardware.emulate.features import BOOTSTRAP
from hardware.emulate.gige_vision import ActionCommand, Refused, Status
from hardware.emulate.identity import Identity
from hardware.emulate.registers import Register, RegisterFile
from mosca.errors import InputError

MS = 1_000_000


class Time:
    """Replaces the module of this name: time passes under the test's control."""

    def __init__(self) -> None:
        self._now_ns = 3 * 10**12

    def monotonic_ns(self) -> int:
        return self._now_ns

    def sleep(self, seconds: float) -> None:
        self._now_ns += round(seconds * 1e9)


time = Time()


@pytest.fixture(scope="module", autouse=True)
def _time_is_the_tests():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hardware.emulate.camera.time", time)
        patch.setattr("hardware.emulate.acquisition.time", time)
        yield


WHO = Identity("cam0", "S1", IPv4Interface("127.0.0.9/8"), 64, 48, 12, 100.0, 1000.0, 500.0)


class NoStream:
    """Replaces the stream's socket."""

    source_port = 5000

    def __init__(self) -> None:
        self.fired: list[int] = []

    def fire_test_packet(self, size, to) -> None:
        self.fired.append(size)

    def fragment(self, may) -> None:
        pass

    def forget(self) -> None:
        pass


def camera(faults: Faults = FAULTLESS, first_block: int = 1) -> EmulatedCamera:
    return EmulatedCamera(WHO, NoStream(), faults, FaultDraws(faults, WHO.serial), first_block)


def register(one: EmulatedCamera, name: str) -> Register:
    return one.registers.named(name)


def put(one: EmulatedCamera, **values: float) -> None:
    for name, value in values.items():
        where = register(one, name)
        one.registers.write(where.address, where.encode(value))


def shots(one: EmulatedCamera) -> list[PendingImage]:
    found = []
    while isinstance(shot := one.next_image(), PendingImage):
        found.append(shot)
    return found


def armed(source: int = 1, **more) -> EmulatedCamera:
    one = camera(**more)
    put(one, TriggerMode=1, TriggerSource=source, AcquisitionStart=1)
    return one


# registers


@pytest.mark.parametrize(
    ("address", "length", "status"),
    [
        (0x0001, 4, Status.BAD_ALIGNMENT),
        (0x0000, 3, Status.BAD_ALIGNMENT),
        (0x7000, 4, Status.INVALID_ADDRESS),
        (0x0000, 0x40, Status.INVALID_ADDRESS),
        (0x0944, 4, Status.ACCESS_DENIED),
        (2**32 - 4, 4, Status.INVALID_ADDRESS),
    ],
)
def test_readings_that_are_refused(address, length, status):
    with pytest.raises(Refused) as refusal:
        camera().registers.read(address, length)
    assert refusal.value.status == status


@pytest.mark.parametrize(
    ("address", "data", "status"),
    [
        (0x0000, b"abcd", Status.WRITE_PROTECT),
        (0xF0000, b"abcd", Status.WRITE_PROTECT),
        (0x7000, b"abcd", Status.INVALID_ADDRESS),
        (0x0938, b"ab", Status.BAD_ALIGNMENT),
        (0x0938, b"\0\0\0\1", Status.INVALID_PARAMETER),
    ],
)
def test_writes_that_are_refused(address, data, status):
    with pytest.raises(Refused) as refusal:
        camera().registers.write(address, data)
    assert refusal.value.status == status


def test_half_of_a_long_number_is_not_written():
    one = camera()
    with pytest.raises(Refused):
        one.registers.write(register(one, "ExposureTime").address, b"\0\0\0\0")


def test_names_and_texts_are_read_in_pieces():
    one = camera()
    assert one.registers.read(0x48, 32).rstrip(b"\0") == b"Mosca"
    assert one.registers.read(0x4C, 4) == b"a\0\0\0"
    one.registers.write(0xE8, b"left")
    assert one.registers.read(0xE8, 16) == b"left".ljust(16, b"\0")


def test_overlapping_registers_are_a_mistake():
    with pytest.raises(ValueError, match="overlap"):
        RegisterFile([Register("A", 0, 8), Register("B", 4)], {}, lambda r, v: None, (0x100, b""))


def test_bootstrap_addresses_are_the_standards():
    # GigE Vision 2.0, table of bootstrap registers
    wanted = {"SerialNumber": 0xD8, "FirstURL": 0x200, "HeartbeatTimeout": 0x938, "ControlPrivilege": 0xA00}
    wanted |= {"StreamPort": 0xD00, "StreamPacketSize": 0xD04, "StreamDestination": 0xD18, "TimestampLatched": 0x948}
    there = {register.name: register.address for register in BOOTSTRAP}
    assert {name: there[name] for name in wanted} == wanted


@pytest.mark.parametrize(
    ("name", "value"),
    [("Width", 65), ("Width", 0), ("OffsetX", 1), ("ExposureTime", 0.5), ("ExposureTime", float("nan")),
     ("PixelFormat", 7), ("TriggerSource", 9), ("PtpEnable", 2), ("AcquisitionFrameRate", 1e6)],
)  # fmt: skip
def test_values_that_a_feature_cannot_take(name, value):
    with pytest.raises(Refused) as refusal:
        put(camera(), **{name: value})
    assert refusal.value.status == Status.INVALID_PARAMETER


def test_a_window_makes_room_for_its_offset_and_reads_out_faster():
    one = camera()
    assert one.registers.value("PayloadSize") == 64 * 48 * 2
    assert one.registers.value("AcquisitionFrameRateLimit") == pytest.approx(500.0)
    put(one, Width=32, Height=12, OffsetX=32, OffsetY=36)
    assert one.registers.value("OffsetXLimit") == 32
    assert one.registers.value("PayloadSize") == 32 * 12 * 2
    put(one, ExposureTime=100.0)
    assert one.registers.value("AcquisitionFrameRateLimit") == pytest.approx(2000.0)


def test_what_the_image_depends_on_is_locked_while_the_camera_acquires():
    one = armed()
    with pytest.raises(Refused) as refusal:
        put(one, Width=32)
    assert refusal.value.status == Status.ACCESS_DENIED
    put(one, AcquisitionStop=1)
    put(one, Width=32)


def test_packet_sizes_beyond_the_limits_are_cut_and_not_tested():
    stream = NoStream()
    one = EmulatedCamera(WHO, stream, FAULTLESS, FaultDraws(FAULTLESS, "S1"))
    put(one, StreamPort=4000, StreamDestination=0x7F000001)
    put(one, StreamPacketSize=0x80000000 | 9000)
    put(one, StreamPacketSize=0x80000000 | 65000)
    assert (stream.fired, one.packet_bytes) == ([9000], 16000)


# triggers


def test_a_trigger_during_an_exposure_is_ignored_in_silence():
    shutter = Shutter()
    assert shutter.open(0, 0, 5 * MS, 2 * MS) is not None
    assert shutter.open(1, 5 * MS - 1, 5 * MS, 2 * MS) is None
    assert shutter.open(2, 5 * MS, 5 * MS, 2 * MS) is not None


def test_a_pulse_has_its_number_whatever_became_of_those_before():
    one, now = armed(), time.monotonic_ns()
    one.pulse(0, now)
    one.pulse(1, now + 100_000)  # within the millisecond of exposure
    one.pulse(5, now + 10 * MS)
    found = shots(one)
    assert [(shot.exposure.number, shot.block) for shot in found] == [(0, 1), (5, 2)]
    assert found[1].device_ns - found[0].device_ns == 10 * MS
    assert (one.counts["ignored"], one.counts["exposures"], one.counts["pulses"]) == (1, 2, 3)


def test_pulses_before_the_start_and_for_other_sources_do_nothing():
    one = camera()
    one.pulse(0, time.monotonic_ns())
    put(one, TriggerMode=1, TriggerSource=0, AcquisitionStart=1)
    one.pulse(1, time.monotonic_ns())
    assert shots(one) == []
    assert one.counts["unarmed"] == 2


def test_block_numbers_wrap_to_one():
    one, now = armed(first_block=65534), time.monotonic_ns()
    for k in range(4):
        one.pulse(k, now + k * 10 * MS)
    assert [shot.block for shot in shots(one)] == [65534, 65535, 1, 2]


def test_the_falling_edge_comes_after_the_pulse():
    one = camera()
    put(one, TriggerMode=1, TriggerSource=1, TriggerActivation=1, AcquisitionStart=1)
    now = time.monotonic_ns()
    one.pulse(0, now)
    assert shots(one)[0].exposure.start_ns == now + 100_000


def test_software_triggers_are_counted_by_the_camera():
    one = armed(source=0)
    put(one, TriggerSoftware=1)
    put(one, TriggerSoftware=1)  # too early: ignored, but it counts
    time.sleep(0.005)
    put(one, TriggerSoftware=1)
    assert [shot.exposure.number for shot in shots(one)] == [0, 2]


def test_single_frame_stops_by_itself():
    one = camera()
    put(one, AcquisitionMode=1, TriggerMode=1, TriggerSource=0, AcquisitionStart=1)
    put(one, TriggerSoftware=1)
    assert not one.armed
    assert len(shots(one)) == 1


def test_free_running_keeps_its_rate():
    one = camera()
    put(one, AcquisitionFrameRate=100.0, AcquisitionStart=1)
    time.sleep(0.105)
    starts = [shot.exposure.start_ns for shot in shots(one)]
    assert len(starts) == 11
    assert {b - a for a, b in pairwise(starts)} == {10 * MS}


def test_actions_for_other_keys_are_not_for_this_camera():
    one = armed(source=2)
    put(one, ActionDeviceKey=5, ActionGroupKey=6, ActionGroupMask=0b110)
    assert one.act(ActionCommand(5, 6, 0b001, None)) == Status.SUCCESS
    assert one.act(ActionCommand(5, 7, 0b010, None)) == Status.SUCCESS
    assert shots(one) == []
    assert one.act(ActionCommand(5, 6, 0b010, None)) == Status.SUCCESS
    assert len(shots(one)) == 1


def test_a_scheduled_action_fires_at_its_time():
    one = armed(source=2)
    put(one, ActionGroupMask=1)
    time.sleep(0.01)
    assert one.act(ActionCommand(0, 0, 1, 1)) == Status.ACTION_LATE
    assert len(shots(one)) == 1
    due = one.clock.at(time.monotonic_ns()) + 30 * MS
    assert one.act(ActionCommand(0, 0, 1, due)) == Status.NO_REF_TIME
    assert 0.0 < one.next_image() <= 0.030
    time.sleep(0.035)
    (shot,) = shots(one)
    assert abs(shot.device_ns - due) < 1000


def test_too_many_scheduled_actions_are_refused():
    one = armed(source=2)
    put(one, ActionGroupMask=1)
    later = one.clock.at(time.monotonic_ns()) + 10**12
    answers = [one.act(ActionCommand(0, 0, 1, later)) for _ in range(17)]
    assert answers[-1] == Status.OVERFLOW
    assert Status.OVERFLOW not in answers[:-1]


# clock


@given(st.integers(0, 10**15), st.floats(-100, 100), st.integers(0, 10**12))
def test_a_clock_drifts_from_its_boot(booted, drift, elapsed):
    clock = EmulatedClock(booted, 1000, drift)
    assert clock.at(booted) == 1000
    assert abs(clock.at(booted + elapsed) - 1000 - elapsed * (1 + drift * 1e-6)) <= 1 + elapsed * 1e-12


def test_a_clock_jumps_once():
    clock = EmulatedClock(0, 0, 0.0, (ClockJump(100, 7),))
    assert [clock.at(t) for t in (99, 100, 101)] == [99, 107, 108]


def test_a_clock_says_when_it_will_show_a_time():
    clock = EmulatedClock(time.monotonic_ns(), 5 * MS, 80.0)
    assert abs(clock.at(clock.when(10**12)) - 10**12) <= 2


def test_ptp_brings_clocks_together():
    now = time.monotonic_ns()
    one, two = (EmulatedClock(now, offset, drift, ptp_ns=now) for offset, drift in ((0, 50.0), (7 * MS, -50.0)))
    assert [one.ptp_status(now + t) for t in (0, LOCKING_NS - 1, LOCKING_NS)] == [
        "Listening",
        "Uncalibrated",
        "Slave",
    ]
    locked = now + LOCKING_NS
    assert one.at(locked) == two.at(locked) == common_ns(locked)
    assert one.offset_from_master(now) != 0
    assert one.offset_from_master(locked) == 0


def test_latched_ptp_and_time_stay_what_they_were():
    one = camera(Faults(clock_offset_ns=10**12))
    put(one, TimestampControl=2)
    assert 10**12 <= one.registers.value("TimestampLatched") < 10**12 + 10**9
    put(one, PtpEnable=1)
    assert one.registers.value("PtpStatus") == 4
    time.sleep(LOCKING_NS / 1e9)
    assert one.registers.value("PtpStatus") == 4
    put(one, PtpDataSetLatch=1)
    assert (one.registers.value("PtpStatus"), one.registers.value("PtpOffsetFromMaster")) == (9, 0)


# faults


def test_withheld_pulses_are_those_that_the_dice_say():
    faults = Faults(withheld=0.3, seed=4)
    draws = FaultDraws(faults, WHO.serial)
    one, now = armed(faults=faults), time.monotonic_ns()
    for k in range(25):
        one.pulse(k, now + k * 10 * MS)
    assert [shot.exposure.number for shot in shots(one)] == [k for k in range(25) if not draws.withheld(k)]
    assert 0 < one.counts["withheld"] < 25


def test_a_reboot_forgets_everything_and_the_clock_starts_anew():
    one = armed(faults=Faults(reboot_at_s=0.0, reboot_gone_s=0.05))
    before = time.monotonic_ns()
    one.pulse(0, before)
    assert not one.linked(before)
    assert not one.armed
    assert shots(one) == []
    time.sleep(0.06)
    now = time.monotonic_ns()
    assert one.linked(now)
    assert one.clock.at(now) < 100 * MS
    assert one.registers.value("TriggerMode") == 0
    put(one, TriggerMode=1, TriggerSource=1, AcquisitionStart=1)
    one.pulse(9, now)
    assert [(shot.block, shot.exposure.number) for shot in shots(one)] == [(1, 9)]
    assert one.counts["reboots"] == 1


def test_device_reset_goes_after_it_was_acknowledged():
    one = camera(Faults(reboot_gone_s=1.0))
    asked = time.monotonic_ns()
    put(one, DeviceReset=1)
    done = time.monotonic_ns()
    assert one.linked(asked + RESET_AFTER_NS - MS)  # the acknowledgement goes out
    assert not one.linked(done + RESET_AFTER_NS + MS)
    assert one.linked(done + RESET_AFTER_NS + 1100 * MS)


def test_a_pulled_cable_leaves_the_camera_working():
    one = armed(faults=Faults(silent_at_s=0.0, silent_for_s=0.05))
    assert not one.linked(time.monotonic_ns())
    assert one.armed
    time.sleep(0.06)
    assert one.linked(time.monotonic_ns())


def test_a_jump_comes_at_its_time():
    one = armed(faults=Faults(jump_at_s=0.02, jump_ns=10**9))
    now = time.monotonic_ns()
    one.pulse(0, now)
    one.pulse(1, now + 30 * MS)
    first, second = shots(one)
    assert second.device_ns - first.device_ns == 30 * MS + 10**9


@pytest.mark.parametrize(
    "wrong", [{"packet_loss": 1.5}, {"withheld": -0.1}, {"drift_ppm": 1e6}, {"reboot_at_s": -1.0}]
)
def test_faults_that_cannot_be(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        Faults(**wrong)
