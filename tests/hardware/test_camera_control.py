"""A camera that another program holds, or held when it was killed."""

import logging
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import pytest
from array_source import ArraySource
from driven import refused
from loopback import Hand, free_address
from needs import needs_aravis

from hardware.drivers import camera_control, open_camera
from hardware.emulate.serve import Served, served
from hardware.settings import CameraHardware

CCP, HEARTBEAT, PRIMARY_PORT, PRIMARY_ADDRESS = 0xA00, 0x938, 0xA04, 0xA14
CONTROL, EXCLUSIVE = 2, 1
HOLDS = """
import sys
from hardware.drivers import gige, open_camera
from hardware.settings import CameraHardware
gige.HEARTBEAT_MS = 2000
camera = open_camera("held", CameraHardware(driver="gige", address=sys.argv[1], trigger="Off"))
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def up() -> Iterator[Served]:
    needs_aravis()
    with served(ArraySource(1, 8), first_address=free_address()) as found:
        yield found


@pytest.fixture
def settings(up: Served) -> CameraHardware:
    return CameraHardware(driver="gige", address=str(up.devices[0].identity.address.ip), trigger="Off")


@pytest.fixture
def hand(settings: CameraHardware) -> Iterator[Hand]:
    """Another program that controls the camera."""
    with closing(Hand(settings.address)) as made:
        assert made.write(CCP, CONTROL) == 0
        yield made


def test_after_a_kill_the_camera_is_waited_for(settings: CameraHardware, caplog: pytest.LogCaptureFixture) -> None:
    command = [sys.executable, "-c", HOLDS, settings.address]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        # while it runs it is named at once
        with refused("camera 'a'", "controlled by another program (127.0.0.1:", "of this machine, which runs"):
            open_camera("a", settings)
        process.kill()
        process.wait()
    with caplog.at_level(logging.WARNING):
        camera = open_camera("a", settings)
    with closing(camera):
        camera.configure(settings)
    assert "which has ended; it lets go after 2 s: waiting" in caplog.text


def test_a_program_of_another_machine_that_runs_is_told_after_the_wait(
    settings: CameraHardware, hand: Hand, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # its address is not this machine's: whether it runs shows only in its heartbeat
    assert hand.write(HEARTBEAT, 600) == 0
    monkeypatch.setattr(camera_control, "_alive", lambda holder: None)
    monkeypatch.setattr(camera_control.time, "sleep", lambda seconds: hand.read(CCP))
    with caplog.at_level(logging.WARNING), refused("camera 'a'", "which runs: it did not let go in 0.6 s"):
        open_camera("a", settings)
    assert "which may have ended; it lets go after 0.6 s: waiting" in caplog.text


def test_who_would_hold_it_for_too_long_or_lets_nobody_read_is_told_at_once(
    settings: CameraHardware, hand: Hand
) -> None:
    assert hand.write(HEARTBEAT, 600_000) == 0
    port = hand.port
    assert (hand.read(PRIMARY_ADDRESS), hand.read(PRIMARY_PORT)) == (0x7F000001, port)
    assert camera_control._alive(("127.0.0.1", port))
    hand.close()
    with refused(f"(127.0.0.1:{port})", "lets go 600 s after that has ended; close that and wait, or switch"):
        open_camera("a", settings)


def test_exclusive_access_is_told(settings: CameraHardware, hand: Hand) -> None:
    assert hand.write(CCP, EXCLUSIVE) == 0
    with refused("camera 'a'"):
        open_camera("a", settings)


def test_an_address_of_another_machine_tells_nothing() -> None:
    assert camera_control._alive(("192.0.2.1", 4000)) is None
