"""``mosca twin serve``: its output, and a client that grabs the served frames."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from aravis_client import Client
from array_source import ArraySource, picture
from click.testing import CliRunner
from loopback import free_address, until
from needs import needs_aravis

from hardware.settings import read_hardware
from mosca.errors import InputError
from mosca.recording import RecordingWriter
from scenarios.cli.main import cli
from scenarios.lab.serve import InjectedFaults, ServeRequest, serve

SHAPE = (48, 64)


@pytest.fixture
def take(tmp_path) -> Path:
    """A recording of two cameras, 30 frames each."""
    source = ArraySource(2, 30)
    with RecordingWriter(tmp_path / "take", source.cameras) as writer:
        for frame in source:
            writer.write(frame)
    return tmp_path / "take"


def run(*arguments: str) -> str:
    result = CliRunner().invoke(cli, ["twin", "serve", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_it_says_who_answers_where_and_what_became_of_it(take, tmp_path):
    address, rig = free_address(), tmp_path / "rig.toml"
    said = run(str(take), "--address", address, "--seconds", "0.2", "--rig-out", str(rig))
    lines = said.splitlines()
    assert lines[0].split() == ["camera", "address", "serial", "size", "format", "exposure"]
    serial = "TWIN" + bytes(map(int, address.split("."))).hex().upper()
    assert lines[1].split() == ["cam0", address, serial, "64x48", "8", "bit", "1000", "us"]
    assert lines[4].split()[:2] == ["cam0", "0"]
    hardware = read_hardware(rig)
    assert [(c.driver, c.address, c.trigger) for c in hardware.cameras.values()] == [
        ("gige", address, "Line1"),
        ("gige", address[:-1] + "2", "Line1"),
    ]
    assert (hardware.shared.rate_hz, hardware.shared.trigger.source) == (100.0, "external")


@pytest.mark.parametrize(
    ("trigger", "camera", "source"),
    [("serial", "Line1", "serial"), ("Software", "Software", "software"), ("Action1", "Action1", "action")],
)
def test_the_rig_file_says_what_triggers(take, tmp_path, trigger, camera, source):
    rig = tmp_path / "rig.toml"
    run(str(take), "--address", free_address(), "--seconds", "0.1", "--rig-out", str(rig), "--trigger", trigger)
    hardware = read_hardware(rig)
    assert hardware.cameras["cam1"].trigger == camera
    assert hardware.shared.trigger.source == source
    assert (hardware.shared.trigger.port != "") == (trigger == "serial")


def test_a_rig_file_names_what_its_cameras_look_at(take, tmp_path):
    address = free_address()
    rig = tmp_path / "lab.toml"
    table = '[[camera]]\nname = "cam1"\nsize = [64, 48]\n[camera.hardware]\ndriver = "gige"\n'
    rig.write_text(f'{table}serial = "222"\naddress = "{address}"\n[twin]\nrecording = "take"\n')
    said = run(str(rig), "--seconds", "0.1")
    assert said.splitlines()[1].split()[:3] == ["cam1", address, "222"]
    rig.write_text(f'{table}serial = "222"\n[twin]\n')
    with pytest.raises(InputError, match="scenario = or recording ="):
        run(str(rig))
    rig.write_text(table.replace("64", "65") + '[twin]\nrecording = "take"\n')
    with pytest.raises(InputError, match="64x48"):
        run(str(rig))
    rig.write_text(table.replace("cam1", "left") + '[twin]\nrecording = "take"\n')
    with pytest.raises(InputError, match=r"'left'.*cam0, cam1"):
        run(str(rig))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--reboot", "cam0"], "CAMERA@SECONDS"),
        (["--reboot", "cam9@3"], "cam0, cam1"),
        (["--drift", "1e9"], "drift_ppm"),
        (["--address", "nowhere"], "IPv4"),
    ],
)
def test_what_cannot_be_is_told(take, options, said):
    with pytest.raises(InputError, match=said):
        run(str(take), *options)


class Clock:
    """Replaces the module ``time``: the test ends the time of serving."""

    sleep = staticmethod(time.sleep)

    def __init__(self) -> None:
        self.over = False

    def monotonic(self) -> float:
        return float(self.over)


def test_a_client_grabs_a_recording_twice_over(take, monkeypatch):
    needs_aravis()
    address, clock = free_address(), Clock()
    monkeypatch.setattr("scenarios.lab.serve.time", clock)
    request = ServeRequest(str(take), address, seconds=0.5, trouble=InjectedFaults(withhold=0.1, seed=2))
    ready, done = [], []
    server = threading.Thread(target=lambda: done.append(serve(request, None, ready.append)))
    server.start()
    until(lambda: ready)
    (up,) = ready
    halted, halt = threading.Event(), up.line.stop

    def stop():
        halt()
        halted.set()

    up.line.stop = stop  # what the server does once no camera is armed
    clients = [Client(address), Client(address[:-1] + "2")]
    grabbed = []
    for client in clients:
        client.trigger_on("Line1")
    for _ in range(2):
        pulses, withheld = (up.devices[1].counts().get(kind, 0) for kind in ("pulses", "withheld"))
        for client in clients:
            client.arm(64)
        until(lambda before=pulses: up.devices[1].counts().get("pulses", 0) == before + 30)
        wanted = 30 - (up.devices[1].counts().get("withheld", 0) - withheld)
        images = [clients[1].grab(60.0) for _ in range(wanted)]
        grabbed.append([image.pixels for image in images if image is not None])
        halted.clear()
        for client in clients:
            client.disarm()
        assert halted.wait(60)
    for client in clients:
        client.close()
    clock.over = True
    server.join()
    counts = done[0].devices[1].counts()
    assert counts["pulses"] == 60
    assert [len(found) for found in grabbed] == [30 - counts.get("withheld", 0) // 2] * 2
    assert all(np.array_equal(a, b) for a, b in zip(*grabbed, strict=True))
    images = [picture(1, n, SHAPE) for n in range(30)]
    assert all(any(np.array_equal(one, image) for image in images) for one in grabbed[0])
