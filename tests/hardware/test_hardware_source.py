"""The rig as a source of frames, over cameras that are simulated in the test."""

import threading

import numpy as np
import pytest
from fake_rig import SIZE, Fake, FakeDriver, FakeLine, picture, pulse_in, write_rig

from hardware.driver import DeviceError
from hardware.settings import read_hardware
from hardware.source import HardwareSource
from hardware.triggers.software import SoftwareTrigger
from mosca.data.frames import FrameSource
from mosca.errors import InputError
from mosca.synchronisation import Assembly, assemble

RATE = 100.0


def rig_file(tmp_path, names, more="", size=SIZE):
    return write_rig(tmp_path / "rig.toml", names, size, RATE, more)


def source(tmp_path, fakes, pulses=60, software=False, driver=FakeDriver, silence_s=None, **kwargs):
    line = FakeLine(RATE)
    path = rig_file(tmp_path, fakes, **kwargs)
    if silence_s is not None:
        path.write_text(path.read_text().replace("[hardware]\n", f"[hardware]\nsilence_s = {silence_s}\n", 1))
    return HardwareSource(
        read_hardware(path),
        pulses,
        lambda name, settings: driver(name, settings, fakes[name], line),
        (lambda rig, drivers: SoftwareTrigger(drivers, RATE)) if software else (lambda rig, drivers: line),
    )


def test_it_is_a_source_of_frames_and_each_set_is_of_one_pulse(tmp_path):
    fakes = {"a": Fake(ppm=40), "b": Fake(offset_s=50, ppm=-40), "c": Fake(misses=frozenset({9, 30, 31}))}
    assembly = Assembly()
    with source(tmp_path, fakes) as rig:
        assert isinstance(rig, FrameSource)
        sets = list(assemble(rig, rig.cameras, assembly=assembly))
    assert [s.pulse for s in sets] == list(range(60))
    for frame_set in sets:
        assert {pulse_in(f) for f in frame_set.frames.values()} == {frame_set.pulse}
        for name, frame in frame_set.frames.items():
            np.testing.assert_array_equal(frame.image, picture(name, frame_set.pulse))
            assert not frame.image.flags.writeable
    assert [s.pulse for s in sets if "c" not in s.frames] == [9, 30, 31]
    assert assembly.cameras["c"].dropped == 3
    assert assembly.cameras["a"].dropped == assembly.cameras["b"].dropped == 0
    assert rig.statistics.cameras["a"].driver["exposed"] >= 60


def test_failed_buffers_are_corrupt_frames(tmp_path):
    with source(tmp_path, {"a": Fake(), "b": Fake(spoilt=frozenset({20, 21}))}) as rig:
        frames = [f for f in rig if f.camera == "b"]
    assert [round(f.time_ns * RATE / 1e9) for f in frames if f.status == "corrupt"] == [20, 21]
    assert {f.note for f in frames if f.status == "corrupt"} == {"MISSING_PACKETS"}
    assert rig.statistics.cameras["b"].failed == 2
    indices = [f.index for f in frames]
    assert indices == sorted(set(indices))


def test_a_camera_that_goes_comes_back_at_the_right_pulse(tmp_path, monkeypatch):
    monkeypatch.setattr("hardware.camera_readers.REOPEN_S", 0.05)
    fakes = {"a": Fake(), "b": Fake(offset_s=1e4, gone=range(60, 100))}
    with source(tmp_path, fakes, pulses=200) as rig:
        frames = list(rig)
    of_b = [f for f in frames if f.camera == "b"]
    assert all(pulse_in(f) == round(f.time_ns * RATE / 1e9) for f in frames)
    assert not {pulse_in(f) for f in of_b} & set(range(60, 100))
    assert {pulse_in(f) for f in of_b} >= set(range(150, 200))
    assert rig.statistics.cameras["b"].reopened == 1
    assert any("does not answer" in note for note in rig.statistics.notes)
    assert any("answers again" in note for note in rig.statistics.notes)
    assert {pulse_in(f) for f in frames if f.camera == "a"} == set(range(200))
    indices = [f.index for f in of_b]
    assert indices == sorted(set(indices))


def test_a_camera_that_cannot_be_configured_again_is_closed_before_the_next_try(tmp_path, monkeypatch):
    monkeypatch.setattr("hardware.camera_readers.REOPEN_S", 0.05)
    opened, open_then = [], []

    class Stubborn(FakeDriver):
        def __init__(self, *given):
            super().__init__(*given)
            open_then.append(sum(not driver.closed for driver in opened))
            opened.append(self)

        def configure(self, settings):
            if 2 <= len(opened) <= 3:  # the first time, and once more, that it is opened again
                raise DeviceError("camera 'a': Gain was refused")
            return super().configure(settings)

    with source(tmp_path, {"a": Fake(gone=range(20, 22))}, driver=Stubborn) as rig:
        list(rig)
    assert open_then == [0] * len(open_then)
    assert len(opened) >= 4
    assert all(driver.closed for driver in opened)
    assert rig.statistics.cameras["a"].reopened == 1


def test_a_take_is_logged_with_its_losses_and_nothing_is_printed(tmp_path, monkeypatch, caplog, capfd):
    monkeypatch.setattr("hardware.camera_readers.REOPEN_S", 0.05)
    fakes = {"a": Fake(), "b": Fake(gone=range(20, 40))}
    with caplog.at_level("DEBUG", "mosca.hardware"), source(tmp_path, fakes, pulses=80) as rig:
        list(rig)
    logged = {
        level: [r.getMessage() for r in caplog.records if r.levelname == level] for level in ("INFO", "WARNING")
    }
    assert logged["WARNING"] == rig.statistics.notes
    for text in ("camera 'b': fake, serial b, opened", "trigger 'external' started at 100 Hz", "rig.toml: closed"):
        assert any(text in line for line in logged["INFO"])
    summary = next(line for line in logged["INFO"] if line.startswith("camera 'b'") and "frames" in line)
    assert "1 reopened" in summary
    assert capfd.readouterr() == ("", "")


def test_clocks_that_can_be_read_number_frames_though_answers_fail(tmp_path, monkeypatch):
    """Gaps, a camera that is lost and found, and two answers of three that do not come."""
    monkeypatch.setattr("hardware.camera_readers.REOPEN_S", 0.05)
    fakes = {
        "a": Fake(ppm=40, readable=True, misses=frozenset({3, 9, 30, 31, 120})),
        "b": Fake(offset_s=1e4, readable=True, gone=range(60, 100)),
        "c": Fake(offset_s=-5, ppm=-40, readable=True, misses=frozenset({0})),
    }
    with source(tmp_path, fakes, pulses=200) as rig:
        frames = list(rig)
    assert all(pulse_in(f) == round(f.time_ns * RATE / 1e9) for f in frames)
    assert {pulse_in(f) for f in frames if f.camera == "a"} == set(range(200)) - fakes["a"].misses
    assert {pulse_in(f) for f in frames if f.camera == "c"} == set(range(1, 200))
    assert rig.statistics.cameras["b"].reopened == 1


def test_software_trigger_pairs_cameras_without_a_clock(tmp_path):
    fakes = {n: Fake(clock=False, software=True) for n in "ab"}
    with source(tmp_path, fakes, software=True, pulses=40) as rig:
        sets = list(assemble(rig, rig.cameras))
    # pictures count the commands: those of skipped pulses were not sent
    sent = {name: commands.numbers for name, commands in rig._trigger._commands.items()}
    for one in sets:
        shown = {sent[name][pulse_in(frame)] for name, frame in one.frames.items()}
        assert shown <= {round(one.time_ns * RATE / 1e9)}


class Gone(FakeLine):
    """A pulse generator that is pulled out after its last pulse."""

    def stop(self):
        begun = self._thread is not None
        super().stop()
        if begun or self.made:
            raise DeviceError("pulse generator at nowhere: is gone; plug it in and start again")


def test_a_pulse_generator_that_is_gone_at_the_end_costs_no_frame(tmp_path):
    line, fakes = Gone(RATE), {"a": Fake(), "b": Fake()}
    hardware = read_hardware(rig_file(tmp_path, fakes))
    opener = lambda name, settings: FakeDriver(name, settings, fakes[name], line)  # noqa: E731
    rig = HardwareSource(hardware, 30, opener, lambda rig, drivers: line)
    frames = list(rig)
    assert {(f.camera, pulse_in(f)) for f in frames} == {(name, k) for name in "ab" for k in range(30)}
    assert rig.statistics.notes == ["pulse generator at nowhere: is gone; plug it in and start again"]


class Still(FakeLine):
    """Pulses that never begin."""

    def start(self):
        return None


class One(FakeLine):
    """A single pulse: not enough to count from."""

    def fire(self, number):
        return number == 0 and super().fire(number)


@pytest.mark.parametrize("kind", [Still, One])
def test_a_take_whose_pulses_do_not_come_ends_and_says_so(tmp_path, kind):
    line, fakes = kind(RATE), {"a": Fake(), "b": Fake()}
    path = rig_file(tmp_path, fakes)
    path.write_text(path.read_text().replace("[hardware]\n", "[hardware]\nwait_s = 0.5\n", 1))
    opener = lambda name, settings: FakeDriver(name, settings, fakes[name], line)  # noqa: E731
    with HardwareSource(read_hardware(path), 30, opener, lambda rig, drivers: line) as rig:
        frames = list(rig)
    assert len(frames) == (0 if kind is Still else 2)
    assert any("trigger 'external': no pulse came in 0.5 s; check" in note for note in rig.statistics.notes)


def test_a_silent_camera_is_told(tmp_path):
    fakes = {"a": Fake(), "b": Fake(misses=frozenset(range(10_000)))}
    with source(tmp_path, fakes, 300, silence_s=0.3) as rig:
        frames = list(rig)
    assert {f.camera for f in frames} == {"a"}
    assert sum("camera 'b': silent" in note for note in rig.statistics.notes) == 1


def test_leaving_early_frees_everything(tmp_path):
    before = threading.active_count()
    with source(tmp_path, {"a": Fake(), "b": Fake()}, pulses=None) as rig:
        for number, _ in enumerate(rig):
            if number == 30:
                break
    rig.close()
    assert threading.active_count() == before
    with pytest.raises(DeviceError, match="iterated before"):
        next(iter(rig))


def test_stop_from_another_thread_ends_it(tmp_path):
    enough = threading.Event()
    with source(tmp_path, {"a": Fake()}, pulses=None) as rig:
        other = threading.Thread(target=lambda: enough.wait() and rig.stop())
        other.start()
        for number, _ in enumerate(rig):
            if number == 20:
                enough.set()
        other.join()
    assert number >= 20


def test_a_device_of_another_size_or_one_that_is_missing_is_refused(tmp_path):
    with pytest.raises(DeviceError, match=r"camera 'a': frames of 32 x 24 px, the rig file says 64 x 48"):
        source(tmp_path, {"a": Fake()}, size=(64, 48))
    with pytest.raises(DeviceError, match="camera 'a': not there"):
        source(tmp_path, {"a": Fake(gone=range(10))})
    with pytest.raises(DeviceError, match="has no software trigger"):
        source(tmp_path, {"a": Fake()}, software=True)


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ('trigger = "line1"', "trigger"),
        ("exposure_us = -3", "exposure_us"),
        ("window = [0, 0, 0, 4]", "window"),
        ("expsure_us = 3", "did you mean 'exposure_us'"),
    ],
)
def test_wrong_settings_are_one_line(tmp_path, more, text):
    with pytest.raises(InputError, match=text) as error:
        read_hardware(rig_file(tmp_path, ["a"], more))
    assert "\n" not in str(error.value)
    assert "rig.toml" in str(error.value)
    assert "camera 'a'" in str(error.value)


def test_the_same_device_twice_is_refused(tmp_path):
    path = rig_file(tmp_path, ["a", "b"])
    path.write_text(path.read_text().replace('serial = "b"', 'serial = "a"'))
    with pytest.raises(InputError, match="cameras 'a' and 'b' name the same device"):
        read_hardware(path)
