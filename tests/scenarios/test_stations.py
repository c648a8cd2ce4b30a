"""Stations give what a local run gives; calibrations travel; the verbs, over a real engine on loopback."""

import socket
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from station_scene import NAMES, RATE, SIZE, Scene, rig

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from fake_rig import Fake, FakeDriver, FakeLine
from memory_transport import Exchange
from needs import needs_module

from hardware.settings import read_hardware
from hardware.transport import Trust, open_transport
from hardware.transport.merger import MergeSettings
from hardware.transport.receiver import Receiver
from hardware.transport.sender import Sender
from hardware.transport.signed import read_key
from hardware.transport.station_state import ReceiverSettings
from hardware.trigger import External
from mosca.data.files.rig_file import rig_toml, write_rig
from mosca.data.rig import Rig
from mosca.data.tracks import table
from mosca.errors import InputError
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.pipeline import PipelineSettings, run
from mosca.recording import RecordingWriter
from scenarios.cli.station import rig_of
from scenarios.commands.reconstruct import BackgroundSpec, recorded_backgrounds
from scenarios.lab import station as station_module
from scenarios.lab import station_source, station_verbs
from scenarios.lab.merge import all_whole, calibrated_rig, run_merged, summary_lines
from scenarios.lab.station import PulseCount, run_station
from scenarios.lab.station_background import Backgrounds
from scenarios.lab.station_source import PacedRecording, RigOfStation
from scenarios.lab.station_verbs import detect_on_station

PULSES = 90
"""More than after which lessons are taken up seldom."""
WHOLE = rig()
SETTINGS = PipelineSettings(lookahead=0)
PATIENT = ReceiverSettings(
    MergeSettings(deadline_s=60.0, oldest_s=60.0), silence_s=60.0, start_wait_s=60.0, queued=10_000
)
COLUMNS = ("xy_px", "covariance_px2", "diameter_px", "peak", "elongation", "flags")


@pytest.fixture(autouse=True)
def _all_frames_are_looked_at(monkeypatch):
    """However far a busy machine falls behind."""
    monkeypatch.setattr(station_module, "BACKLOG_S", 60.0)
    monkeypatch.setattr(station_source, "LATE_S", 60.0)


def stations(faults=None):
    """Run two stations over an engine in memory; return the receiver's sets and account."""
    exchange = Exchange()
    sizes = dict.fromkeys(NAMES, SIZE)
    with Receiver(exchange.open(), ("A", "B"), sizes, RATE, PATIENT) as here:
        threads = []
        for name, cameras in (("A", WHOLE.cameras[:2]), ("B", WHOLE.cameras[2:])):
            source = PacedRecording(Scene(cameras, PULSES, faults=faults))
            sender = source.gate.sender = Sender(exchange.open(), name, source.cameras)
            arguments = (source, sender, SETTINGS.detection, source.arrival_ns)
            threads.append(threading.Thread(target=run_station, args=arguments))
        for thread in threads:
            thread.start()
        sets = list(here)
        for thread in threads:
            thread.join()
    return sets, here


def same(a, b):
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in COLUMNS)


def test_a_local_run_mends_images_that_something_cuts():
    """From pixels, which stations do not send: with ``match.mend`` a local run gives other points than stations."""
    settings = replace(SETTINGS, match=replace(SETTINGS.match, mend=False))
    plain = list(run(Scene(WHOLE.cameras, PULSES, cut=NAMES[1:]), WHOLE, settings))
    mended = list(run(Scene(WHOLE.cameras, PULSES, cut=NAMES[1:]), WHOLE, SETTINGS))
    assert any(not np.array_equal(a.points.xyz, b.points.xyz) for a, b in zip(mended, plain, strict=True))


def test_two_stations_give_the_detections_and_tracks_of_a_local_run_bit_for_bit():
    """Without ``match.mend``, since stations do not send the pixels that it needs."""
    settings = replace(SETTINGS, match=replace(SETTINGS.match, mend=False))
    faults = {("b1", 20): "dropped", ("b1", 21): "corrupt", ("a2", 40): "dropped"}
    local = list(run(Scene(WHOLE.cameras, PULSES, faults=faults), WHOLE, settings))
    sets, here = stations(faults)
    merged = list(run_merged(sets, WHOLE, SETTINGS))
    assert [s.frame_set.pulse for s in merged] == [s.frame_set.pulse for s in local] == list(range(PULSES))
    for ours, theirs in zip(merged, local, strict=True):
        assert ours.frame_set.time_ns == theirs.frame_set.time_ns
        assert list(ours.detections) == list(theirs.detections)
        assert all(same(ours.detections[name], theirs.detections[name]) for name in ours.detections)
        assert ours.points.xyz.tobytes() == theirs.points.xyz.tobytes()
    ours, theirs = table([s.samples for s in merged]), table([s.samples for s in local])
    assert len(ours) > 4 * PULSES
    for name in ("frame", "time_ns", "track", "xyz", "covariance"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert dict(sets[20].missing) == {"b1": "no frame"}
    assert dict(sets[21].missing) == {"b1": "corrupt"}
    lines = summary_lines(here.statistics)
    assert "camera 'b1' is missing in 2 sets: 2 without a frame" in lines
    assert not all_whole(here.statistics)


LAMP = np.rint(190 / (1 + np.exp((np.hypot(*np.mgrid[-7:8, -7:8]) - 3) / 0.35))).astype(np.uint8)


class Lit(Scene):
    """The scene before a small lamp that does not move."""

    def __iter__(self):
        for frame in super().__iter__():
            picture = frame.image.copy()
            picture[20:35, 30:45] = np.maximum(picture[20:35, 30:45], LAMP)
            yield replace(frame, image=picture)


def test_backgrounds_are_made_and_taken_off_as_in_a_local_run(tmp_path):
    """From the recording's first frames, bit for bit; without, the lamp is a target."""
    pulses = 50
    with RecordingWriter(tmp_path / "take", Lit(WHOLE.cameras, 1).cameras) as writer:
        for frame in Lit(WHOLE.cameras, pulses):
            writer.write(frame)
    spec = BackgroundSpec(kind="minimum", frames=30)
    made = recorded_backgrounds(tmp_path / "take", WHOLE, None, spec)
    local = list(run(Lit(WHOLE.cameras, pulses), WHOLE, SETTINGS, backgrounds=made))
    seen = {}
    for backgrounds in (Backgrounds(ready=made), Backgrounds(spec), Backgrounds()):
        exchange, told = Exchange(), []
        backgrounds.on_made = told.append
        with Receiver(exchange.open(), ("A",), dict.fromkeys(NAMES, SIZE), RATE, PATIENT) as here:
            source = PacedRecording(Lit(WHOLE.cameras, pulses))
            sender = source.gate.sender = Sender(exchange.open(), "A", source.cameras)
            thread = threading.Thread(
                target=run_station,
                args=(source, sender, SETTINGS.detection, source.arrival_ns),
                kwargs={"backgrounds": backgrounds},
            )
            thread.start()
            seen[len(told), backgrounds] = {s.pulse: s.detections for s in here}
            thread.join()
    ready, live, none = seen.values()
    assert all(same(ready[s.frame_set.pulse][n], s.detections[n]) for s in local for n in NAMES)
    assert min(live) >= 30  # frames of the initial background are not detected
    assert np.median([len(d["a1"]) for d in live.values()]) == np.median([len(d["a1"]) for d in ready.values()])
    assert np.median([len(d["a1"]) for d in none.values()]) != np.median([len(d["a1"]) for d in ready.values()])


class SharedLine(FakeLine):
    """One trigger cable; the trigger of the station that has the pulses."""

    def start(self):
        assert set(self.drivers) == {"a1", "b1", "b2"}
        assert all(driver.armed for driver in self.drivers.values())
        self.started_once = True
        return super().start()


@pytest.mark.parametrize("missed", [0, 1])
def test_rigs_on_one_trigger_cable_start_together_and_a_missed_pulse_is_found_out(tmp_path, missed):
    exchange, line, sets = Exchange(), SharedLine(RATE), []
    frames = {
        "a1": Fake(offset_s=3),
        "b1": Fake(misses=frozenset(range(missed))),
        "b2": Fake(misses=frozenset(range(missed))),
    }

    def station(name, cameras, source):
        path = tmp_path / f"{name}.toml"
        text = f'[hardware]\nrate_hz = {RATE}\n[hardware.trigger]\nsource = "{source}"\n'
        for camera in cameras:
            text += f'[[camera]]\nname = "{camera}"\nsize = [32, 24]\n'
            text += f'[camera.hardware]\ndriver = "gige"\nserial = "{camera}"\n'
        path.write_text(text)
        trigger = line if source == "software" else External()
        rig_of_it = RigOfStation(
            read_hardware(path), lambda n, s: FakeDriver(n, s, frames[n], line), lambda rig, drivers: trigger
        )
        sender = rig_of_it.gate.sender = Sender(exchange.open(), name, rig_of_it.cameras)
        run_station(
            rig_of_it, sender, SETTINGS.detection, rig_of_it.arrival_ns,
            lambda: len(sets) < 80, rig_of_it.stop,
        )  # fmt: skip

    # rigs hold their first frames until their pulses are known: these are old, and belong to the session all the same
    with Receiver(exchange.open(), ("A", "B"), dict.fromkeys(frames, (32, 24)), RATE, PATIENT) as here:
        # the one with the pulses is there first, and has to wait for the other's cameras
        first = threading.Thread(target=station, args=("A", ("a1",), "software"))
        first.start()
        time.sleep(0.5)
        assert line.made == 0
        second = threading.Thread(target=station, args=("B", ("b1", "b2"), "external"))
        second.start()
        for merged in here:
            sets.append(merged)
        first.join()
        second.join()
    assert len(sets) > 50
    assert [s.pulse for s in sets] == list(range(len(sets)))
    assert [(s.pulse, dict(s.missing)) for s in sets[missed:50] if s.missing] == []
    told = [e.text for e in here.events if e.kind == "place"]
    assert told == ["counts from another pulse: its pulse 0 is pulse 1 of the session"] * missed


def test_a_source_that_fails_is_told_to_the_others():
    class Failing(Scene):
        def __iter__(self):
            yield from list(super().__iter__())[:4]
            raise InputError("camera 'a1': is gone")

    exchange = Exchange()
    with Receiver(exchange.open(), ("A",), {"a1": SIZE}, RATE, PATIENT) as here:
        source = Failing(WHOLE.cameras[:1], 10)
        with pytest.raises(InputError, match="is gone"):
            run_station(source, Sender(exchange.open(), "A", source.cameras), SETTINGS.detection)
        list(here)
    assert [e.text for e in here.events if e.kind in ("note", "ended")] == ["camera 'a1': is gone", "has failed"]


def test_pulses_are_counted_over_gaps_and_drift():
    count = PulseCount(100.0)
    frames = list(Scene(WHOLE.cameras[:1], 3, 100.0))
    # 300 ppm of drift would be a pulse after 33 s if it were not followed
    at = [0, 1, 2, 5, 6, *range(7, 5000, 3)]
    assert [count.of(replace(frames[0], time_ns=round(k * 1e7 * (1 + 3e-4)))) for k in at] == at


def test_a_calibration_comes_from_the_station_that_has_it(tmp_path):
    text = rig_toml(Rig(WHOLE.cameras[2:]))
    path = tmp_path / "all.toml"
    bare = "".join(f'[[camera]]\nname = "{name}"\nsize = [320, 240]\n' for name in NAMES[2:])
    path.write_text(rig_toml(Rig(WHOLE.cameras[:2])) + bare)
    got, told = calibrated_rig(path, lambda: {"A": "[[camera]]\nname = 'a1'\nsize = [1, 1]\n", "B": text})
    for ours, camera in zip(got.cameras, WHOLE.cameras, strict=True):
        assert (ours.name, ours.lens) == (camera.name, camera.lens)
        np.testing.assert_allclose(ours.world_from_camera.rotation, camera.world_from_camera.rotation, atol=1e-14)
        assert ours.world_from_camera.translation.tolist() == camera.world_from_camera.translation.tolist()
    assert told == ["camera 'b1': calibration of station B", "camera 'b2': calibration of station B"]
    with pytest.raises(InputError, match=r"camera 'b1' is not calibrated, and no station"):
        calibrated_rig(path, lambda: {})
    with pytest.raises(InputError, match=r"rig file of station B: not valid TOML"):
        calibrated_rig(path, lambda: {"B": "?"})
    with pytest.raises(InputError, match=r"rig file of station B: not valid TOML: lists and tables stand more than"):
        calibrated_rig(path, lambda: {"B": "a = " + "[" * 100_000})


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def invoke(*arguments):
    from scenarios.cli.main import cli

    return CliRunner().invoke(cli, ["station", *map(str, arguments)])


def test_the_verbs_from_recordings_to_tracks(tmp_path, monkeypatch):
    needs_module("zenoh", "stations")
    monkeypatch.setattr(station_verbs, "ReceiverSettings", lambda merge: PATIENT)
    monkeypatch.setattr(station_verbs, "open_transport", partial(open_transport, jam_s=60.0))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    for name, cameras in (("A", WHOLE.cameras[:2]), ("B", WHOLE.cameras[2:])):
        source = Scene(cameras, PULSES)
        write_rig(Rig(cameras), tmp_path / f"{name}.toml")
        with RecordingWriter(tmp_path / name, source.cameras) as writer:
            for frame in source:
                writer.write(frame)
    bare = "".join(f'[[camera]]\nname = "{name}"\nsize = [320, 240]\n' for name in NAMES)
    (tmp_path / "all.toml").write_text(bare)
    out, results = tmp_path / "tracks.csv", {}
    assert invoke("key", tmp_path / "rig.key").exit_code == 0
    key = read_key(tmp_path / "rig.key")

    def detect(name):
        rig_path, recording = tmp_path / f"{name}.toml", tmp_path / name
        results[name] = detect_on_station(
            rig_path, name, [endpoint], recording, None, None, None, (), Trust(key), lambda line: None
        )

    def fetch():
        rig_of.callback("reconstruct", (endpoint,), tmp_path / "got.toml", tmp_path / "rig.key", insecure=False)

    threads = [threading.Thread(target=detect, args=(name,)) for name in "AB"] + [threading.Thread(target=fetch)]
    for thread in threads:
        thread.start()
    done = invoke(
        "reconstruct", "--rig", tmp_path / "all.toml", "--stations", "A,B", "--listen", endpoint, "--out", out,
        "--deadline-ms", "2000", "--key", tmp_path / "rig.key",
    )  # fmt: skip
    for thread in threads:
        thread.join()
    assert done.exit_code == 0, done.output
    assert f"{PULSES} sets merged, {PULSES} of them complete" in done.output
    assert "camera 'b2': calibration of station B" in done.output
    assert "ms (99 %) after the frames arrived" in done.output
    tracks = read_tracks_csv(out)
    assert len(np.unique(tracks.track)) == 5
    assert (tmp_path / "got.toml").read_text() == bare
    assert results["A"][0].startswith(f"station A: {2 * PULSES} frames, {2 * PULSES} looked at, ")
