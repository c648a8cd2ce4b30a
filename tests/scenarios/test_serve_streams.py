"""``mosca twin serve --stream``: GigE cameras and streams of the same instants, on one clock."""

import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import MOSCA, mosca, mosca_alone, refusal
from heard_server import Heard
from tiny_scenario import write_tiny

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from loopback import free_address
from lsl_inlets import inlet, lsl
from natnet_clients import PATIENT_S, PlainClient, until, witness
from natnet_witness import natnet
from needs import needs_aravis

from hardware.drivers import open_camera
from hardware.settings import CameraHardware
from hardware.streams.fault_line import FaultLine
from hardware.streams.faults import ordered_faults
from hardware.streams.lsl.outlets import LslSettings
from hardware.streams.natnet.settings import NatNetSettings
from mosca.data.rotations import rotation_from_quaternion
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.tracks.tracks_file import read_tracks
from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.lab.serve import ServeRequest, serve
from scenarios.lab.serve_streams import PulsedStream, true_frames
from scenarios.spec.scenario import load_scenario

TICK_S = 1e-7
"""Of NatNet's stamps."""


class Clock:
    """Replaces the module ``time`` of the server: the test ends the time of serving."""

    sleep = staticmethod(time.sleep)

    def __init__(self):
        self.over = False

    def monotonic(self):
        return float(self.over)


def truth_of(path):
    """Return the truth as the twin logs it while it renders, and the scene."""
    spec = load_scenario(path)
    scene = build_scene(spec, path.parent)
    with twin_source(spec, scene, virtual_cameras(spec, true_rig(spec, path.parent)), 1) as source:
        list(source)
        return spec, scene, source.truth()


def grabbed_by(camera, exposures):
    """Return the frames of a camera: all that it exposed, or those that came until none does for a while.

    A busy computer may lose one on its way.
    """
    found = []
    while len(found) < exposures() and (one := camera.grab(5.0)) is not None:
        found.append(one)
    return found


def test_cameras_and_streams_agree_in_number_stamp_and_place(tmp_path, monkeypatch):
    needs_aravis()
    lsl()
    path, clock, ready, told = write_tiny(tmp_path), Clock(), [], []
    monkeypatch.setattr("scenarios.lab.serve.time", clock)
    settings = NatNetSettings(command_port=0, data_port=0, forget_s=1e6)
    name = f"serve{time.monotonic_ns()}"
    request = ServeRequest(str(path), free_address(), seconds=0.5, streams=(settings, LslSettings(name)))
    done = []
    worker = threading.Thread(target=lambda: done.append(serve(request, None, ready.append, told.append)))
    worker.start()
    with ExitStack() as stack:
        until(lambda: told)
        (up,) = ready
        port = int(told[0].partition("commands at port ")[2].partition(",")[0])
        client = stack.enter_context(PlainClient(port))
        markers = inlet(f"{name}_markers")
        cameras = {}
        for device in up.devices:
            who = device.identity
            settings = CameraHardware(driver="gige", address=str(who.address.ip), exposure_us=who.exposure_us)
            cameras[who.name] = open_camera(who.name, settings)
            stack.callback(cameras[who.name].close)
            cameras[who.name].configure(settings)
        for camera in cameras.values():
            camera.arm()
        until(lambda: all(device.counts().get("pulses", 0) == 30 for device in up.devices))
        until(lambda: len(client.frames) == 30)
        grabbed = {
            device.identity.name: grabbed_by(
                cameras[device.identity.name], lambda device=device: device.counts()["exposures"]
            )
            for device in up.devices
        }
        samples = [markers.pull_sample(PATIENT_S) for _ in range(30)]
        images = {(name, p): up.store.frame(name, p).image for name in cameras for p in range(30)}
    clock.over = True
    worker.join()
    mid = {one.number: one.mid for one in client.frames}
    assert sorted(mid) == list(range(30))
    np.testing.assert_allclose(np.diff([mid[k] for k in range(30)]), 0.01, atol=2 * TICK_S)
    compared = dict.fromkeys(cameras, 0)
    for device in up.devices:
        who = device.identity
        for one in (one for one in grabbed[who.name] if one.image is not None):
            (pulse,) = [p for p in range(30) if np.array_equal(images[who.name, p], one.image)]
            middle_s = device.camera.clock.when(one.device_ns) * 1e-9 + who.exposure_us * 5e-7
            assert abs(middle_s - mid[pulse]) < 1e-6
            compared[who.name] += 1
    assert min(compared.values()) > 0, compared
    _, _, truth = truth_of(path)
    stamps = [stamp for _, stamp in samples]
    assert [int(values[-1]) for values, _ in samples] == list(range(30))
    np.testing.assert_allclose(stamps, [mid[k] for k in range(30)], atol=1e-3)
    values = np.array([values for values, _ in samples])[:, :-1].reshape(30, 8, 4)
    by_label = np.argsort(truth.names)
    np.testing.assert_allclose(values[..., :3], truth.xyz[:, by_label], atol=1e-6)
    assert any(line.startswith("stream: 30 frames") for line in told)


def test_true_bodies_lie_on_their_true_markers(tmp_path):
    """A drone: the pose carries the body's definition onto the markers that the twin logs."""
    path = write_tiny(tmp_path)
    path.write_text(path.read_text().replace('kind = "cloud"\nmarkers = 8\n', 'kind = "drone"\nspeed_mps = 0.2\n'))
    spec, scene, truth = truth_of(path)
    frames = true_frames(spec, scene, "z")
    (name,) = frames.body_names
    (body,) = [one for one in frames.model if getattr(one, "name", "") == name and hasattr(one, "positions")]
    columns = [truth.names.index(marker) for marker in body.markers]
    for k, one in enumerate(frames):
        (pose,) = one.bodies
        turn = rotation_from_quaternion(pose["quaternion"][[3, 0, 1, 2]].astype(float))
        placed = np.array(body.positions) @ turn.T + pose["position"]
        np.testing.assert_allclose(placed, truth.xyz[k, columns], atol=2e-6)
        assert one.number == k


def test_the_verb_serves_what_a_run_measured_beside_its_cameras(tmp_path):
    """'mosca run', 'mosca twin serve --tracks', 'mosca capture': frames of the stream are the run's, by pulse."""
    needs_aravis()
    natnet()
    path = write_tiny(tmp_path, cameras="[pipeline]\nbodies = true")
    path.write_text(path.read_text().replace('kind = "cloud"\nmarkers = 8\n', 'kind = "drone"\nspeed_mps = 0.2\n'))
    ran = mosca("run", "tiny.toml", "--out", "run", cwd=tmp_path)
    assert (tmp_path / "run/tracks.npz").is_file(), ran.stderr
    words = ["tiny.toml", "--rig-out", "served.toml", "--address", free_address(), "--stream", "natnet"]
    words += ["--tracks", "run", "--command-port", "0", "--data-port", "0"]
    with subprocess.Popen(
        [*MOSCA, "twin", "serve", *words], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as server:
        try:
            told = iter(server.stdout)
            port = next(int(found[1]) for line in told if (found := re.search(r"commands at port (\d+)", line)))
            served = SimpleNamespace(command_port=port, data_port=1, settings=NatNetSettings())
            with witness(served) as (_, got, _models):
                taken = mosca_alone(
                    "capture", "--rig", "served.toml", "--out", "take", "--frames", "20", cwd=tmp_path
                )
                server.send_signal(signal.SIGINT)
                account = "".join(told)
                sent = int(re.search(r"stream: (\d+) frames", account)[1])
                until(lambda: len(got) == sent, lambda: f"{len(got)} frames; {account}{taken.stderr}")
        finally:
            server.kill()
    tracks, poses = read_tracks(tmp_path / "run/tracks.npz"), read_bodies_csv(tmp_path / "run/bodies.csv")
    assert len(np.unique(poses.frame)) > 20
    numbers = [one.prefix.frame_number for one in got]
    assert numbers == list(range(numbers[0], numbers[0] + len(got)))
    for one in got:
        mine = tracks.frame == one.prefix.frame_number
        expected = sorted(tracks.xyz[mine].astype("f4").tolist())
        assert sorted([list(m.pos) for m in one.labeled_markers]) == expected
        (pose,) = np.flatnonzero(poses.frame == one.prefix.frame_number)
        np.testing.assert_array_equal(one.rigid_bodies[0].pos, poses.position[pose].astype("f4"))
        assert one.suffix.timestamp == pytest.approx(poses.time_ns[pose] * 1e-9, abs=1e-9)
    assert sent >= 20
    assert f"{sent} frames sent, 0 dropped" in account


def test_a_loop_begins_again_and_pulses_without_tracks_are_silent(tmp_path):
    spec, scene, _ = truth_of(write_tiny(tmp_path, duration_s=0.05))
    frames = {frame.number: frame for frame in true_frames(spec, scene, "z") if frame.number != 2}
    server = Heard()
    stream = PulsedStream(server, frames, 1_000_000, 5)
    now = time.monotonic_ns()
    for k in range(12):
        stream.pulse(k, now + k * 1000)
    stream.close()
    assert [number for number, *_ in server.heard] == [k for k in range(12) if k % 5 != 2]
    assert [one.mid_ns for _, one, _ in server.heard] == [now + k * 1000 + 500_000 for k in range(12) if k % 5 != 2]
    # nothing comes before its exposure is over
    assert all(one.received_ns >= one.mid_ns + 500_000 for _, one, _ in server.heard)
    assert server.heard[4][1].frame.timestamp_s == frames[0].timestamp_s
    assert stream.sent == 10


def test_faults_act_on_pulses_as_they_were_ordered(tmp_path):
    """Pulses 0.01 s apart: late ones in their order with true stamps, lost and doubled ones, swapped labels."""
    spec, scene, _ = truth_of(write_tiny(tmp_path, duration_s=0.4))
    frames = true_frames(spec, scene, "z")
    orders = ["latency=0.03@0.049+0.06", "duplicate=5@0.199+0.1", "burst-loss=3@0.299+0.04", "label-swap@0.359"]
    faults = FaultLine(ordered_faults(orders, None, 0), frames.model, frames.numbers)
    server = Heard()
    stream = PulsedStream(server, {frame.number: frame for frame in frames}, 1_000_000, None, faults, 0.01)
    now = time.monotonic_ns()
    for k in range(40):
        stream.pulse(k, now + k * 10_000_000)
    stream.close()
    numbers = [number for number, *_ in server.heard]
    twice = [24, 29]  # each fifth since 0.2 s
    assert numbers == sorted([*(k for k in range(40) if k not in (30, 31, 32)), *twice])
    assert [one.mid_ns for number, one, _ in server.heard] == [now + k * 10_000_000 + 500_000 for k in numbers]
    late = [at - one.received_ns for number, one, at in server.heard if 5 <= number <= 10]
    assert min(late) >= 30e6
    first = frames.names.numbers
    a, b = (first[label] for label in tuple(first)[:2])
    for number, one, _ in server.heard:
        ids = one.frame.markers["id"].tolist()
        assert (ids.index(a) > ids.index(b)) == (number >= 36)
    counts = [account.count for account in faults.accounts]
    assert counts == [6, 2, 3, 4]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("tiny.toml --stream natnet --trigger Software", "--trigger Software: excludes --stream, whose frames come"),
        ("tiny.toml --fault ghosts", "--fault ghosts: is of streams; give --stream natnet"),
        ("tiny.toml --stream natnet --fault ghost", "--fault ghost: NAME[=VALUE][@AT_S[+FOR_S]] is wanted"),
        ("tiny.toml --stream natnet --fault body-lost", "fault 'body-lost': 1 bodies are wanted; the stream's: none"),
        ("tiny.toml --tracks tiny.toml", "tiny.toml: is of streams; give --stream natnet"),
        ("tiny.toml --stream-address 127.0.0.1", "--stream-address 127.0.0.1: is of streams; give --stream natnet"),
        (
            "tiny.toml --stream lsl --multicast 239.1.1.1",
            "--multicast 239.1.1.1: is of streams; give --stream natnet",
        ),
        ("tiny.toml --stream natnet --port 1", "--port 1: is of streams; give --stream foxglove"),
        ("tiny.toml --stream natnet --tracks none", "none: no such file or folder; a file of tracks"),
    ],
)
def test_wrong_inputs(tmp_path, words, told):
    write_tiny(tmp_path)
    assert told in refusal("twin", "serve", *words.split(), cwd=tmp_path)
