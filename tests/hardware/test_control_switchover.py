"""Control switchover: a camera whose program was killed is taken over at once, one whose program runs never.

The emulated devices' side is spoken to byte by byte: numbers are those of the standard, not of the code.
"""

import contextlib
import io
import logging
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from array_source import ArraySource
from driven import refused
from loopback import Hand, free_address
from needs import needs_aravis

from hardware.drivers import camera_control, control_switchover, open_camera
from hardware.emulate.serve import Served, served
from hardware.settings import CameraHardware

pytest.importorskip("fcntl", reason="without flock nothing tells whether the last controller runs")

CAPABILITY, HEARTBEAT, KEY, CCP, STREAM_PORT = 0x934, 0x938, 0x95C, 0xA00, 0xD00
CAN_SWITCH = 1 << 21
EXCLUSIVE, CONTROL, SWITCHABLE = 1, 2, 6
DENIED, NO_REGISTER = 0x8006, 0x8003
LONG_MS = 600_000
"""A heartbeat that no test waits for, and that no pause of this machine outlasts."""
WAITED_MS = 20_000
"""One that is short enough to be waited for."""
HOLDS = """
import sys
from hardware.drivers import gige, open_camera
from hardware.settings import CameraHardware
gige.HEARTBEAT_MS = int(sys.argv[2])
settings = CameraHardware(driver="gige", address=sys.argv[1], trigger="Off")
camera = open_camera("held", settings)
camera.configure(settings)
camera.arm()
print("held", flush=True)
for line in sys.stdin:
    print("grabbed" if camera.grab(60.0) else "nothing", flush=True)
"""


@pytest.fixture(autouse=True)
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder of keys."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "mosca/control_keys"


@pytest.fixture
def up() -> Iterator[Served]:
    with served(ArraySource(1, 8), first_address=free_address(), loop=True, switchover=True) as found:
        yield found


@pytest.fixture
def settings(up: Served) -> CameraHardware:
    needs_aravis()
    return CameraHardware(driver="gige", address=str(up.devices[0].identity.address.ip), trigger="Off")


@contextlib.contextmanager
def holder(settings: CameraHardware, heartbeat_ms: int = LONG_MS) -> Iterator[subprocess.Popen[str]]:
    """A program of its own that runs a take with the camera; killed in the end."""
    command = [sys.executable, "-c", HOLDS, settings.address, str(heartbeat_ms)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            killed(process)


def killed(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()


def grabs(process: subprocess.Popen[str]) -> bool:
    """Whether the take still gets frames."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return process.stdout.readline() == "grabbed\n"


def works(settings: CameraHardware) -> int:
    """Open the camera, grab a frame, and return what CCP shows meanwhile."""
    with closing(open_camera("a", settings)) as camera:
        camera.configure(settings)
        camera.arm()
        assert camera.grab(60.0) is not None
        with closing(Hand(settings.address)) as hand:
            return hand.read(CCP)


# the emulated devices


@pytest.fixture
def hands(up: Served) -> Iterator[list[Hand]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(closing(Hand(str(up.devices[0].identity.address.ip)))) for _ in range(3)]


def test_the_device_gives_control_to_who_knows_the_key(hands: list[Hand]) -> None:
    one, two, three = hands
    assert one.read(CAPABILITY) & CAN_SWITCH
    assert (one.write(CCP, CONTROL), one.write(KEY, 0x1234), one.write(HEARTBEAT, LONG_MS)) == (0, 0, 0)
    assert one.ask(0x80, KEY.to_bytes(4, "big"))[0] == DENIED  # write-only, for its controller too
    assert two.write(CCP, 0x1234_0002) == DENIED  # not before the controller allows it
    assert one.write(CCP, SWITCHABLE) == 0
    assert two.read(CCP) == SWITCHABLE  # the key reads as zero
    for wrong in (CONTROL, 0x1235_0002, 0x1234_0000, 0x1234_0004, 0):
        assert two.write(CCP, wrong) == DENIED
    assert two.write(KEY, 1) == DENIED
    assert two.write(CCP, 0x1234_0002) == 0
    assert (two.read(CCP), two.read(0xA04)) == (CONTROL, two.port)
    assert one.write(HEARTBEAT, LONG_MS) == DENIED
    assert three.write(CCP, 0x1234_0002) == DENIED  # the new controller does not allow it
    assert two.write(CCP, 0) == 0
    assert three.write(CCP, CONTROL) == 0


def test_exclusive_access_is_not_switched(hands: list[Hand]) -> None:
    one, two = hands[:2]
    assert (one.write(CCP, CONTROL), one.write(KEY, 7), one.write(CCP, SWITCHABLE | EXCLUSIVE)) == (0, 0, 0)
    assert two.write(CCP, 0x0007_0002) == DENIED
    assert two.read(CCP) == EXCLUSIVE | CONTROL


def test_devices_as_they_come_have_no_such_capability() -> None:
    with contextlib.ExitStack() as stack:
        plain = stack.enter_context(served(ArraySource(1, 2), first_address=free_address()))
        address = str(plain.devices[0].identity.address.ip)
        one, two = (stack.enter_context(closing(Hand(address))) for _ in range(2))
        assert not one.read(CAPABILITY) & CAN_SWITCH
        assert (one.write(CCP, SWITCHABLE), one.write(KEY, 7)) == (0, NO_REGISTER)
        assert one.read(CCP) == CONTROL
        assert (two.write(CCP, 0x0007_0002), two.write(CCP, CONTROL)) == (DENIED, DENIED)


# the driver


def test_after_a_kill_in_a_take_the_next_one_begins_at_once(
    up: Served, settings: CameraHardware, caplog: pytest.LogCaptureFixture
) -> None:
    # twice: who takes over allows to be taken over in turn
    for _ in range(2):
        with holder(settings) as process:
            killed(process)
            assert up.devices[0].camera.armed
            with caplog.at_level(logging.WARNING):
                assert works(settings) == SWITCHABLE
        assert "which has ended, and would let go after 600 s: taken over" in caplog.text
        assert "waiting" not in caplog.text
        caplog.clear()


def test_what_the_killed_take_left_running_is_stopped(up: Served, settings: CameraHardware) -> None:
    with holder(settings) as process:
        killed(process)
    with closing(Hand(settings.address)) as hand:
        assert hand.read(STREAM_PORT) != 0
    assert up.devices[0].camera.armed
    with closing(open_camera("a", settings)), closing(Hand(settings.address)) as hand:
        assert hand.read(STREAM_PORT) == 0
        assert not up.devices[0].camera.armed


def test_a_take_that_runs_is_not_disturbed(up: Served, settings: CameraHardware) -> None:
    with holder(settings) as process:
        before = up.devices[0].camera.privilege.holder
        for _ in range(3):
            with refused("camera 'a'", "controlled by another program (127.0.0.1:", "which runs; close that first"):
                open_camera("a", settings)
        assert up.devices[0].camera.privilege.holder == before
        assert grabs(process)


def test_a_take_that_stands_still_is_not_taken_over(up: Served, settings: CameraHardware) -> None:
    with holder(settings) as process:
        process.send_signal(signal.SIGSTOP)
        with refused("camera 'a'", "which runs; close that first"):
            open_camera("a", settings)
        process.send_signal(signal.SIGCONT)
        assert grabs(process)


@pytest.mark.parametrize("alive", [False, None])
def test_the_lock_of_a_process_that_runs_protects_it_too(
    up: Served, settings: CameraHardware, monkeypatch: pytest.MonkeyPatch, alive: bool | None
) -> None:
    # as if its port were not seen from here (another network namespace), or its address another machine's
    monkeypatch.setattr(camera_control, "_alive", lambda controller: alive)
    with holder(settings) as process:
        with refused("camera 'a'", "and lets go 600 s after that has ended"):
            open_camera("a", settings)
        assert grabs(process)


def test_a_program_of_another_machine_is_never_taken_over(
    up: Served, settings: CameraHardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the key is here and its lock is free, as with a home folder that machines share and flock does not reach
    monkeypatch.setattr(camera_control, "_alive", lambda controller: None)
    with holder(settings) as process:
        killed(process)
        with refused("camera 'a'", "and lets go 600 s after that has ended"):
            open_camera("a", settings)


KEPT = "4660 127.0.0.1 40000\n"


@pytest.mark.parametrize(
    ("kept", "key"),
    [
        (KEPT, 4660),
        ("65535 127.0.0.1 40000\n", 65535),
        ("4660 127.0.0.1 40001\n", None),
        ("4660 127.0.0.2 40000\n", None),
        ("0 127.0.0.1 40000\n", None),
        ("65536 127.0.0.1 40000\n", None),
        ("key 127.0.0.1 40000\n", None),
        (KEPT[:-3], None),
        (KEPT[:10], None),
        ("", None),
    ],
)
def test_a_key_is_its_controllers_and_whole(kept: str, key: int | None) -> None:
    assert control_switchover._key(io.StringIO(kept), ("127.0.0.1", 40000)) == key


@pytest.fixture
def brief(up: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera lets go as soon as somebody waits for it."""

    def sleep(seconds: float) -> None:
        up.devices[0].camera.release()

    monkeypatch.setattr(camera_control, "time", SimpleNamespace(monotonic=time.monotonic, sleep=sleep))


@pytest.mark.usefixtures("brief")
def test_with_a_wrong_key_the_heartbeat_is_waited_for(
    settings: CameraHardware, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with holder(settings, WAITED_MS) as process:
        killed(process)
    (file,) = keys.iterdir()
    key, rest = file.read_text().split(maxsplit=1)
    file.write_text(f"{int(key) % 0xFFFF + 1} {rest}")
    with caplog.at_level(logging.WARNING):
        assert works(settings) == SWITCHABLE
    assert "which has ended; it lets go after 20 s: waiting" in caplog.text
    assert "taken over" not in caplog.text


def test_another_program_that_was_killed_is_waited_for(settings: CameraHardware, keys: Path) -> None:
    # the camera of our key was closed, and is another program's now: one that has the same key, to make it hard
    works(settings)
    (file,) = keys.iterdir()
    with closing(Hand(settings.address)) as stranger:
        assert (stranger.write(CCP, CONTROL), stranger.write(HEARTBEAT, LONG_MS)) == (0, 0)
        assert (stranger.write(KEY, int(file.read_text().split()[0])), stranger.write(CCP, SWITCHABLE)) == (0, 0)
    with refused("camera 'a'", "and lets go 600 s after that has ended"):
        open_camera("a", settings)


@pytest.mark.parametrize(("drawn", "key"), [(0, "1"), (0xFFFE, "65535")])
def test_a_key_is_this_users_and_never_0(
    settings: CameraHardware, keys: Path, monkeypatch: pytest.MonkeyPatch, drawn: int, key: str
) -> None:
    # 0 is what programs without a key write
    bounds: list[int] = []
    secrets = SimpleNamespace(randbelow=lambda bound: bounds.append(bound) or drawn)
    monkeypatch.setattr(control_switchover, "secrets", secrets)
    works(settings)
    (file,) = keys.iterdir()
    assert (bounds, file.read_text().split()[0]) == ([0xFFFF], key)
    assert (file.stat().st_mode & 0o777, keys.stat().st_mode & 0o077) == (0o600, 0)


@pytest.mark.usefixtures("brief")
def test_without_a_place_for_the_key_cameras_open_and_are_waited_for(
    settings: CameraHardware, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keys.parent.write_text("in the way")
    with holder(settings, WAITED_MS) as process:
        killed(process)
    with caplog.at_level(logging.WARNING):
        assert works(settings) == CONTROL
    assert "it lets go after 20 s: waiting" in caplog.text


def test_a_camera_without_the_capability_gets_no_key(keys: Path) -> None:
    # that it is waited for after a kill: test_camera_control.py
    needs_aravis()
    with served(ArraySource(1, 8), first_address=free_address(), loop=True) as plain:
        address = str(plain.devices[0].identity.address.ip)
        assert works(CameraHardware(driver="gige", address=address, trigger="Off")) == CONTROL
    assert not keys.exists()
