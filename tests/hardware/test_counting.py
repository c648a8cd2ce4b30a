"""Pulses of triggered cameras without time stamps: right where they can be known, else an alarm."""

from dataclasses import replace

import numpy as np
import pytest
from fake_rig import Fake, FakeDriver
from seeds import seeds
from test_hardware_source import pulse_in, source
from test_numbering import Rig, stream

from hardware.driver import Grabbed
from hardware.pulse_numbers.numbering import PulseNumbers
from scenarios.build.frame_sources import device_notes

NAMES = ["c0", "c1", "c2", "c3"]
PERIOD_NS = 10_000_000
START_NS = 7_000_000_000


def without_stamps(rows, names, late_ns=lambda name, pulse: 0):
    """Return rows of ``stream`` with cameras ``names`` stampless, each frame later by ``late_ns``, in order."""
    out, last = [], dict.fromkeys(NAMES, 0)
    for ns, name, pulse, buffer in rows:
        host_ns = last[name] = max(ns + late_ns(name, pulse), last[name])
        stamp = None if name in names else buffer.device_ns
        out.append((host_ns, name, pulse, replace(buffer, host_ns=host_ns, device_ns=stamp)))
    return sorted(out, key=lambda row: row[0])


def numbered(rows, **settings):
    """Return the numbering, and (camera, pulse, true pulse, how it was found) of all rows."""
    numbers = PulseNumbers(NAMES, 100.0, **settings)
    truth = {id(buffer): pulse for _, _, pulse, buffer in rows}
    out = [one for _, name, _, buffer in rows for one in numbers.take(name, buffer)] + list(numbers.rest())
    assert len(out) == len(rows)
    return numbers, [(one.camera, one.pulse, truth[id(one.buffer)], one.found) for one in out]


def check_never_silent(numbers, out, names):
    """A frame with a wrong pulse is known to be uncertain, and its camera is named."""
    for camera, pulse, true, found in out:
        if pulse != true:
            assert found == "arrival", (camera, pulse, true)
            assert any(note.startswith(f"{camera}: has no time stamps") for note in numbers.notes)
    assert not [one for one in out if one[0] not in names and one[1] != one[2]]


@pytest.mark.parametrize("start_ns", [None, START_NS], ids=["began somewhen", "start known"])
@pytest.mark.parametrize("names", [["c1"], NAMES], ids=["one of four", "all"])
@pytest.mark.parametrize("seed", seeds(2, 6))
def test_a_take_without_gaps_is_numbered_right_and_that_is_certain(seed, names, start_ns):
    numbers, out = numbered(without_stamps(stream(Rig(pulses=1000), seed), names), start_ns=start_ns)
    assert [one for one in out if one[1] != one[2]] == []
    assert {found for camera, _, _, found in out if camera in names} == {"count"}
    assert numbers.notes == []


@pytest.mark.parametrize("names", [["c1"], NAMES], ids=["one of four", "all"])
@pytest.mark.parametrize("seed", seeds(1, 3))
def test_frames_lost_on_the_link_show_in_the_counter(seed, names):
    _, out = numbered(without_stamps(stream(Rig(pulses=1000, lost=0.01), seed), names))
    first = min(true for _, _, true, _ in out)
    assert [one for one in out if one[1] != one[2] - first] == []
    assert {found for camera, _, _, found in out if camera in names} == {"count"}


@pytest.mark.parametrize("names", [["c1"], NAMES], ids=["one of four", "all"])
@pytest.mark.parametrize("seed", seeds(1, 3))
def test_a_missed_trigger_is_found_by_the_arrivals_and_said_to_be_uncertain(seed, names):
    rows = stream(Rig(pulses=1500, stalls=0.0), seed)
    misses = {(name, pulse) for name in names for pulse in (300, 301, 700, 1100)}
    rows = [row for row in rows if row[1:3] not in misses]
    # a camera that missed a trigger goes on with the next number
    rows = [
        (ns, name, k, replace(b, block_id=b.block_id - sum(m == name and at < k for m, at in misses)))
        for ns, name, k, b in rows
    ]
    numbers, out = numbered(without_stamps(rows, names))
    if names == ["c1"]:
        assert [one for one in out if one[1] != one[2]] == []
    check_never_silent(numbers, out, names)
    for name in names:
        assert all(one[3] == "count" for one in out if one[0] == name and one[2] < 295)
        assert all(one[3] == "arrival" for one in out if one[0] == name and one[2] > 300)
        assert (
            sum(note.startswith(f"{name}: has no time stamps; by its arrivals it missed") for note in numbers.notes)
            == 1
        )
        assert numbers.relocks[name] == 3 or names == NAMES


@pytest.mark.parametrize("periods", [0.45, 0.7, 1.0, 1.6, 2.3])
def test_a_camera_that_is_slower_than_the_others_is_not_known(periods):
    rows = without_stamps(
        stream(Rig(pulses=600), 2), ["c1"], lambda name, _: round((name == "c1") * periods * PERIOD_NS)
    )
    numbers, out = numbered(rows)
    check_never_silent(numbers, out, ["c1"])
    assert {found for camera, _, _, found in out if camera == "c1"} == {"arrival"}
    (note,) = numbers.notes
    assert note.startswith("c1: has no time stamps")
    assert "is not known; use trigger = 'Software', a lower rate_hz" in note


def test_a_machine_that_is_busy_for_less_than_a_vote_changes_nothing():
    rows = without_stamps(stream(Rig(pulses=1000), 3), NAMES, lambda _, pulse: 30_000_000 * (400 <= pulse < 420))
    numbers, out = numbered(rows)
    assert [one for one in out if one[1] != one[2]] == []
    assert numbers.notes == []


@pytest.mark.parametrize("names", [["c1"], NAMES], ids=["one of four", "all"])
@pytest.mark.parametrize("seed", seeds(1, 3))
def test_a_machine_that_is_busy_for_longer_is_never_silently_wrong(seed, names):
    rows = without_stamps(stream(Rig(pulses=1200), seed), names, lambda _, pulse: 30_000_000 * (400 <= pulse < 500))
    numbers, out = numbered(rows)
    check_never_silent(numbers, out, names)
    assert all(pulse == true for _, pulse, true, _ in out if not 400 <= true < 520)


@pytest.mark.parametrize("seed", seeds(1, 3))
def test_readers_of_other_cameras_that_are_late_change_nothing(seed):
    def late_ns(name, pulse):
        return 30_000_000 * (name != "c1" and 400 <= pulse < 500)

    numbers, out = numbered(without_stamps(stream(Rig(pulses=1200, stalls=0.0), seed), ["c1"], late_ns))
    assert [one for one in out if one[1] != one[2]] == []
    assert numbers.notes == []


@pytest.mark.parametrize("seed", seeds(1, 3))
def test_a_camera_that_began_anew_is_found_by_its_arrivals(seed):
    rows = without_stamps(stream(Rig(pulses=1000, reboot=True, stalls=0.0), seed), ["c2"])
    numbers, out = numbered(rows)
    assert [one for one in out if one[1] != one[2]] == []
    assert numbers.relocks["c2"] == 1
    assert [note.split(" (")[0] for note in numbers.notes] == [
        "c2: has no time stamps, and began anew; by its arrivals"
    ]


def test_a_count_of_pulses_shows_the_missed_ones():
    """The camera's own counter of pulses on its line (trigger_counter) counts those that it could not expose."""
    rows = [row for row in stream(Rig(pulses=600, stalls=0.0), 1) if row[1:3] not in {("c1", 200), ("c1", 333)}]
    rows = [
        (ns, name, k, replace(b, triggers=k + 5, block_id=b.block_id - (k > 200) - (k > 333)))
        for ns, name, k, b in without_stamps(rows, ["c1"])
    ]
    numbers, out = numbered(rows)
    assert [one for one in out if one[1] != one[2]] == []
    assert {found for camera, _, _, found in out if camera == "c1"} == {"count"}
    assert numbers.trigger_counters["c1"].ignored == 2


def test_a_file_that_is_played_is_counted_at_whatever_pace():
    numbers, out = PulseNumbers(["v"], 100.0, played=["v"]), []
    for k, host_ns in enumerate(np.cumsum(np.random.default_rng(0).exponential(3e7, 300)).astype(int)):
        out += numbers.take("v", Grabbed(k + 1, None, int(host_ns), 0, None))
    out += numbers.rest()
    assert [one.pulse for one in out] == list(range(300))
    assert {one.found for one in out} == {"played"}
    assert numbers.notes == []


def test_a_failed_first_frame_is_of_the_first_pulse():
    """A camera with stamps whose first buffer came without: the one after it is of pulse 1."""
    rows = stream(Rig(pulses=300, stalls=0.0), 4)
    rows = [(ns, n, k, replace(b, device_ns=None) if (n, k) == ("c0", 0) else b) for ns, n, k, b in rows]
    _, out = numbered(rows)
    assert [one for one in out if one[1] != one[2]] == []


class Far(FakeDriver):
    """Its frames are here 7 ms later."""

    def grab(self, timeout_s):
        buffer = super().grab(timeout_s)
        return None if buffer is None else replace(buffer, host_ns=buffer.host_ns + 7_000_000)


@pytest.mark.parametrize("clocks", [(False, False), (True, False)], ids=["no camera has stamps", "one has"])
def test_frames_of_a_rig_without_stamps_are_of_their_pulses(tmp_path, clocks):
    fakes = {name: Fake(clock=clock) for name, clock in zip("ab", clocks, strict=True)}
    with source(tmp_path, fakes, pulses=80) as rig:
        frames = list(rig)
    assert sorted({round(f.time_ns / PERIOD_NS) for f in frames}) == list(range(80))
    assert all(pulse_in(f) == round(f.time_ns / PERIOD_NS) for f in frames)
    assert rig.statistics.notes == []
    assert rig.statistics.cameras["b"].unproven == 0


def test_a_rig_whose_pulses_are_not_known_says_so(tmp_path):
    fakes = {"a": Fake(), "b": Fake(clock=False)}

    def driver(name, *given):
        return (Far if name == "b" else FakeDriver)(name, *given)

    with source(tmp_path, fakes, pulses=80, driver=driver) as rig:
        frames = [frame for frame in rig if frame.camera == "b"]
    assert rig.statistics.cameras["b"].unproven >= len(frames) > 0
    assert rig.statistics.cameras["a"].unproven == 0
    assert device_notes(rig)["unproven"].endswith(f"{rig.statistics.cameras['b'].unproven} of camera 'b'")
    (note,) = rig.statistics.notes
    assert note.startswith("camera b: has no time stamps, and its frames came 0.70 periods after those of pulse 0")
