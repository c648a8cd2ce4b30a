"""Capture with simulated cameras: whole, with gaps, too slow, interrupted."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from functools import partial
from pathlib import Path

import capture_rig
import numpy as np
import pytest
from capture_rig import Line, ctrl_c, openers, write_rig
from click.testing import CliRunner
from fake_rig import pulse_in
from mcap.reader import make_reader

from hardware.driver import Device, DeviceError
from mosca.errors import InputError
from mosca.recording import RecordingWriter, open_recording
from scenarios.cli import capture as cli_capture
from scenarios.cli import rig as cli_rig
from scenarios.lab import capture as work
from scenarios.lab import devices as devices_module
from scenarios.lab.capture import CaptureRequest, capture
from scenarios.lab.devices import describe_devices
from scenarios.lab.recorder import LostSets
from scenarios.run.priority import NICE

SMALL = (64, 48)
NAMES = ("a", "b", "c")
PROGRAM = str(Path(capture_rig.__file__))


def picture(camera, pulse):
    image = np.random.default_rng([ord(camera), pulse]).integers(0, 9, (SMALL[1], SMALL[0])).astype(np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(pulse).tobytes(), np.uint8)
    return image


def small(line):
    return openers(line, {name: partial(picture, name) for name in NAMES}, SMALL)


@pytest.fixture
def rig(tmp_path):
    return write_rig(tmp_path / "rig.toml", NAMES, SMALL)


def test_each_frame_is_in_the_recording_bit_for_bit_with_its_stamps(tmp_path, rig):
    line, out = Line(), tmp_path / "take"
    before = threading.active_count()
    outcome = capture(CaptureRequest(rig, out, frames=60), None, *small(line))
    assert threading.active_count() == before
    assert outcome.whole
    assert outcome.pulses == 60
    assert line.armed_when_started == dict.fromkeys(NAMES, True)
    with open_recording(out) as recording:
        frames = list(recording)
        assert recording.notes == ()
        assert recording.rig_toml_text == rig.read_text()
        clock = list(recording.channel("clock"))
        account = [data for _, data in recording.channel("account")]
        trigger = [data for _, data in recording.channel("trigger")]
    for name in NAMES:
        mine = [f for f in frames if f.camera == name]
        assert [pulse_in(f) for f in mine] == list(range(60))
        assert [f.index for f in mine] == list(range(60))
        for frame in mine:
            np.testing.assert_array_equal(frame.image, picture(name, pulse_in(frame)))
            assert frame.time_ns == pytest.approx(pulse_in(frame) * 1e7, abs=1e5)
    assert trigger == [{"pulses": line.made}]
    assert account[-1]["cameras"]["b"]["driver"]["exposed"] >= 60
    stamps = [data["cameras"].get("b", {"index": [], "device_ns": [], "host_ns": []}) for _, data in clock]
    device = {i: d for s in stamps for i, d in zip(s["index"], s["device_ns"], strict=True)}
    host = {i: h for s in stamps for i, h in zip(s["index"], s["host_ns"], strict=True)}
    assert {i: device[i] - line.begin_ns - 5_000_000_000 for i in range(60)} == {i: i * 10_000_000 for i in range(60)}
    with open(out / "recording.mcap", "rb") as file:
        messages = make_reader(file).iter_messages(topics=["/camera/b/frame"], log_time_order=False)
        assert {m.sequence: m.publish_time for _, _, m in messages} == {i: host[i] for i in range(60)}
    for _, data in clock:  # the pulses' clock: session time of an instant of this machine's
        assert data["session_ns"] == pytest.approx(data["host_ns"] - line.begin_ns, abs=2e7)
        assert data["utc_ns"] == pytest.approx(time.time_ns(), abs=60e9)
    told = tomllib.loads((out / "recording.toml").read_text())
    assert told["capture"]["pulses"] == 60
    assert told["capture"]["device"]["a"]["serial"] == "a"
    assert told["camera"][1]["frames"] == {"ok": 60, "dropped": 0, "corrupt": 0}


def test_what_a_camera_missed_is_counted(tmp_path, rig):
    line = Line(misses={"a": {7, 8}}, spoilt={"c": {20}})
    outcome = capture(CaptureRequest(rig, tmp_path / "take", seconds=0.5), None, *small(line))
    assert not outcome.whole
    assert outcome.pulses == 50
    assert (outcome.cameras["a"].frames, outcome.cameras["a"].dropped) == (48, 2)
    assert (outcome.cameras["c"].frames, outcome.cameras["c"].failed) == (49, 1)
    assert outcome.cameras["b"].dropped == outcome.cameras["b"].failed == 0
    with open_recording(tmp_path / "take") as recording:
        failed = [f for f in recording if f.status == "corrupt"]
    assert [(f.camera, round(f.time_ns / 1e7), f.note) for f in failed] == [("c", 20, "spoilt")]


def test_a_machine_that_is_too_slow_loses_whole_frame_sets_and_says_so(tmp_path, rig, monkeypatch):
    pack, line = RecordingWriter.pack, Line()

    def slow(self, frame):
        # nothing is packed while the first 70 pulses pass
        while line.made < 70:
            time.sleep(0.001)
        return pack(self, frame)

    monkeypatch.setattr(RecordingWriter, "pack", slow)
    room = 6 * len(NAMES) * SMALL[0] * SMALL[1]
    outcome = capture(CaptureRequest(rig, tmp_path / "take", frames=120, waiting_bytes=room), None, *small(line))
    assert not outcome.whole
    assert 0 < outcome.lost < 120
    assert any(f"{outcome.lost} frame sets were lost whole" in note for note in outcome.notes)
    with open_recording(tmp_path / "take") as recording:
        frames = list(recording)
        lost = [data for _, data in recording.channel("account")][-1]["lost_sets"]
    there = {name: [pulse_in(f) for f in frames if f.camera == name] for name in NAMES}
    assert there["a"] == there["b"] == there["c"] == sorted(there["a"])
    assert outcome.lost == 120 - len(there["a"])
    missing = {pulse for first, last in lost for pulse in range(first, last + 1)}
    assert missing == set(range(120)) - set(there["a"])
    assert outcome.cameras["a"].frames == len(there["a"])
    assert outcome.cameras["a"].dropped == 0


def test_lost_sets_are_named_in_ranges():
    lost = LostSets()
    for first, last in ((3, 3), (4, 4), (9, 11), (20, 20)):
        lost.add(first, last)
    assert (lost.count, lost.text(), lost.text(1)) == (6, "3-4, 9-11, 20", "3-4 and 2 more")


def test_a_camera_that_cannot_be_opened_leaves_no_folder(tmp_path, rig):
    def missing(name, settings):
        raise DeviceError(f"camera '{name}': not there")

    with pytest.raises(DeviceError, match="camera 'a': not there"):
        capture(CaptureRequest(rig, tmp_path / "take"), None, missing)
    assert not (tmp_path / "take").exists()


def test_cameras_that_go_away_end_nothing(tmp_path, rig):
    line = Line(gone_at=30)
    outcome = capture(
        CaptureRequest(rig, tmp_path / "take", frames=1000),
        ctrl_c(lambda: len(line.asked_in_vain) == 3),
        *small(line),
    )
    assert outcome.stopped
    assert sum("does not answer" in note for note in outcome.notes) >= 3
    with open_recording(tmp_path / "take") as recording:
        assert {pulse_in(f) for f in recording} == set(range(31))


def test_ctrl_c_ends_in_order(tmp_path, rig):
    line = Line()
    outcome = capture(CaptureRequest(rig, tmp_path / "take"), ctrl_c(lambda: line.made > 60), *small(line))
    assert outcome.stopped
    assert outcome.whole
    assert 20 < outcome.pulses <= line.made
    assert sorted(p.name for p in (tmp_path / "take").iterdir()) == ["recording.mcap", "recording.toml"]
    assert tomllib.loads((tmp_path / "take" / "recording.toml").read_text())["capture"]["stopped_by_hand"]


@pytest.mark.parametrize(("misses", "code"), [({}, 0), ({"b": {5}}, 1)])
def test_the_verb_tells_and_its_exit_code_says_whether_anything_is_missing(tmp_path, rig, monkeypatch, misses, code):
    line = Line(misses=misses)
    opener, trigger = small(line)
    monkeypatch.setattr(work, "capture", partial(capture, opener=opener, trigger_opener=trigger))
    out = str(tmp_path / "take")
    result = CliRunner().invoke(cli_capture.capture, ["--rig", str(rig), "--out", out, "--frames", "30"])
    assert result.exit_code == code, result.output
    assert "30 pulses, 0 frame sets lost" in result.output
    assert [line.split()[0] for line in result.output.splitlines()[:4]] == ["camera", *NAMES]


def kill_at(tmp_path, wait_s, mode="", caught_up=False):
    """Start a capture of 4 x 656 x 491 (``small``: 164 x 123) at 100 Hz and kill it after ``wait_s``.

    ``caught_up``: only once what was grabbed until then has reached the file, however long this machine takes.
    Returns how much older the last whole frame set of the file is than the last frame grabbed, and than the kill [s].
    """
    out = tmp_path / f"take{wait_s:.4f}"
    newest = tmp_path / "newest"
    command = [sys.executable, PROGRAM, str(tmp_path / "big.toml"), str(out), str(newest)]
    process = subprocess.Popen(command + ([mode] if mode else []))
    try:
        part = out / "recording.mcap.part"
        deadline = time.monotonic() + 600
        while not (part.exists() and part.stat().st_size > 30_000):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(wait_s)
        grabbed_ns = int(np.fromfile(newest, np.int64)[0]) if caught_up else 0
        while caught_up and last_whole_ns(arrivals(part, "frames")) < grabbed_ns:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        killed_ns = time.monotonic_ns()
        process.send_signal(signal.SIGKILL)
        process.wait()
    with open_recording(out) as recording:
        arrived = arrivals(part, recording.holds)
        if mode == "detections":
            pulses = [frame_set.pulse for frame_set, _ in recording.detection_sets()]
            assert pulses == list(range(len(pulses)))
        else:
            frames = [(f.camera, f.index) for f in recording if f.status == "ok"]
            for name in "abcd":
                indices = [index for camera, index in frames if camera == name]
                assert indices == list(range(len(indices)))
        assert "its writer did not finish" in recording.notes[0]
        for kept in recording.waiting():
            arrived.setdefault(kept.frame.index, {})[kept.frame.camera] = kept.host_ns
    shutil.rmtree(out)
    last_ns = last_whole_ns(arrived)
    assert last_ns >= grabbed_ns
    return (int(np.fromfile(newest, np.int64)[0]) - last_ns) / 1e9, (killed_ns - last_ns) / 1e9


def last_whole_ns(arrived):
    """Return when the last frame of the newest whole frame set came [ns]; 0 where there is none."""
    whole = [index for index, times in arrived.items() if len(times) == 4]
    return max(arrived[max(whole)].values()) if whole else 0


def arrivals(part, holds):
    """Return index -> camera -> the host's time at which its frame came."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, Message
    from mcap.stream_reader import StreamReader, breakup_chunk

    ends = "/frame" if holds == "frames" else "/detections"
    cameras, found = {}, {}
    with open(part, "rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        while True:
            try:
                record = next(records)
            except (StopIteration, McapError, ValueError):
                return found
            for one in breakup_chunk(record) if isinstance(record, Chunk) else [record]:
                if isinstance(one, Channel) and one.topic.endswith(ends):
                    cameras[one.id] = one.topic.split("/")[2]
                elif isinstance(one, Message) and one.channel_id in cameras:
                    found.setdefault(one.sequence, {})[cameras[one.channel_id]] = one.publish_time


def check_kills(tmp_path, waits, mode=""):
    # time in which a busy machine does not run the capture at all is not the file's: the first figure counts
    lags = [kill_at(tmp_path, wait, mode) for wait in waits]
    print("missing [ms] of what was grabbed / until the kill:")
    print(" ".join(f"{1e3 * lag:.0f}/{1e3 * wall:.0f}" for lag, wall in lags))
    assert all(lag < 0.1 for lag, _ in lags), lags


@pytest.fixture
def quiet_folder(tmp_path):
    """A folder in memory where there is one: other programs' use of the disk is not what is tested."""
    if not Path("/dev/shm").is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="mosca-kill-") as folder:
        yield Path(folder)


def test_after_a_kill_all_but_the_last_frame_sets_is_there(quiet_folder):
    # full frames and a tenth of a second on a machine of its own: the slow test
    for wait_s in np.random.default_rng(1).uniform(0.2, 0.7, 2):
        kill_at(quiet_folder, wait_s, "small", caught_up=True)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["", "detections"])
def test_after_twenty_kills_each_recording_opens(quiet_folder, mode):
    check_kills(quiet_folder, np.random.default_rng(2).uniform(0.1, 2.0, 20), mode)


FIRST = """
import os
from scenarios.run.priority import SESSION, before_others
def priorities():
    session = SESSION.read_text().split()[-1] if SESSION.exists() else "none"
    return f"{os.getpriority(os.PRIO_PROCESS, 0)} {session}"
print(priorities())
with before_others() as allowed:
    print(allowed)
    with before_others():
        print(priorities())
print(priorities())
"""


def test_a_capture_goes_before_others_and_back_again():
    command = [sys.executable, "-c", FIRST]  # in a session of its own: others of this one may be raised just now
    done = subprocess.run(command, capture_output=True, text=True, check=True, start_new_session=True)
    usual, allowed, raised, after = done.stdout.splitlines()
    wanted = " ".join(nice if nice == "none" else str(min(int(nice), NICE)) for nice in usual.split())
    assert raised == (wanted if allowed == "True" else usual)
    assert after == usual


FULL = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from capture_rig import Line, dark_noise, openers, write_rig
if len(sys.argv) > 4:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[4]),) * 2)
from scenarios.lab.capture import CaptureRequest, capture
from mosca.errors import InputError
try:
    capture(CaptureRequest(Path(sys.argv[1]), Path(sys.argv[2])), None, *openers(Line()))
except InputError as error:
    print(error)
    sys.exit(2)
"""


def check_full(tmp_path, out, *limit):
    rig = write_rig(tmp_path / "big.toml", "abcd")
    folder = str(Path(PROGRAM).parent)
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(rig), str(out), folder, *limit],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert len(done.stdout.splitlines()) == 1
    assert done.stdout.startswith(f"{out}: cannot be written any more: ")
    assert done.stderr == ""
    assert [p.name for p in out.iterdir()] == ["recording.mcap.part"]
    with open_recording(out) as recording:
        frames = list(recording)
        assert "its writer did not finish" in recording.notes[0]
    written = (out / "recording.mcap.part").stat().st_size
    assert sum(f.image.nbytes for f in frames) > written  # packed, nearly all of it is frames
    assert min(sum(f.camera == name for f in frames) for name in "abcd") > len(frames) / 4 - 5


def test_a_file_that_may_not_grow_ends_it_with_one_line(tmp_path):
    check_full(tmp_path, tmp_path / "take", str(12_000_000))


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_full_disk_ends_it_with_one_line(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no tmpfs can be mounted here: {mounted.stderr.decode().strip()}")
    try:
        check_full(tmp_path, disk / "take")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_devices_are_listed_without_being_opened(tmp_path, rig):
    def look(driver, producer):
        if driver == "pylon":
            raise DeviceError("driver 'pylon': driver 'pylon' cannot be used (no module); pip install it")
        return [Device("gige", "Model", "a", "10.0.0.1")] if driver == "gige" else []

    lines, absent = describe_devices(rig, look)
    assert lines[0] == "gige: Model, serial a, at 10.0.0.1"
    assert "driver 'pylon': driver 'pylon' cannot be used (no module); pip install it" in lines
    assert "camera 'a': Model, serial a, is there" in lines
    assert sum("NOT FOUND" in line for line in lines) == len(absent) == 2


def test_a_camera_that_is_not_there_fails_the_check(rig, monkeypatch):
    monkeypatch.setattr(devices_module, "describe_devices", partial(describe_devices, list_devices=lambda *asked: []))
    result = CliRunner().invoke(cli_rig.rig, ["check", "--devices", str(rig)])
    assert isinstance(result.exception, InputError)
    assert "its cameras not found: a" in str(result.exception)
    assert "check cable, power and network" in str(result.exception)
