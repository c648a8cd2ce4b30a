"""Cameras that run free: each frame has its own instant, whatever the camera's rate, phase and clock."""

import numpy as np
import pytest

from hardware.driver import Capabilities, Grabbed
from hardware.pulse_numbers.free_running import FreeClock
from hardware.pulse_numbers.numbering import PulseNumbers
from hardware.settings import CameraHardware
from hardware.source import free_running
from mosca.data.frames import CameraInfo, Frame
from mosca.synchronisation import Assembly, AssemblySettings, assemble

RATE = 30.0
IMAGE = np.zeros((2, 2), np.uint8)


def arrivals(cameras, seconds=60.0, jitter_s=1e-3, stamped=False, restart_s=None):
    """Buffers in order of arrival with the true instants: camera -> (rate, phase [s], clock's drift [ppm])."""
    events = []
    for number, (name, (rate, phase, ppm)) in enumerate(cameras.items()):
        rng = np.random.default_rng(number)
        for k in range(int(seconds * rate)):
            at = phase + k / rate
            since = at if restart_s is None or at < restart_s else at - restart_s
            stamp = round(since * (1 + ppm * 1e-6) * 1e9) + 77_000_000_000
            late = 0.002 + rng.exponential(jitter_s) if stamped else 0.002
            host = round((at + 5.0 + late) * 1e9)
            events.append((host, name, at, Grabbed(k + 1, stamp if stamped else None, host, 0, IMAGE)))
    return sorted(events, key=lambda one: one[0])


def errors_s(events, cameras, free, played=()):
    """Camera -> how far its frames' times lie from the true instants [s], up to what all have in common."""
    numbers = PulseNumbers(tuple(cameras), RATE, free=free, played=played)
    true = {(name, buffer.block_id): at for _, name, at, buffer in events}
    placed = [one for _, name, _, buffer in events for one in numbers.take(name, buffer)] + list(numbers.rest())
    assert len(placed) == len(events)
    found = {name: [] for name in cameras}
    for one in placed:
        at = (one.pulse * numbers.period_ns + one.residual_ns) * 1e-9
        assert abs(one.residual_ns) <= 0.51 * numbers.period_ns or one.pulse == 0
        found[one.camera].append(at - true[one.camera, one.buffer.block_id])
    return {name: np.array(off) for name, off in found.items()}


CAMERAS = {"a": (30.0, 0.0, 0.0), "b": (29.5, 0.011, 40.0), "c": (30.2, 0.02, -60.0)}


def test_webcams_at_rates_of_their_own_keep_their_instants():
    """Counted frame by frame, camera b would be a second behind after a minute."""
    off = errors_s(arrivals(CAMERAS), CAMERAS, CAMERAS)
    for error in off.values():
        np.testing.assert_allclose(error, off["a"][0], atol=1e-6)


def test_counting_frames_would_not_do():
    """The control: the same frames, counted."""
    off = errors_s(arrivals(CAMERAS), CAMERAS, (), played=CAMERAS)
    assert np.ptp(off["b"]) > 0.9


@pytest.mark.parametrize("restart_s", [None, 20.0])
def test_a_camera_s_own_clock_takes_out_what_the_network_adds(restart_s):
    events = arrivals(CAMERAS, 40.0, jitter_s=4e-3, stamped=True, restart_s=restart_s)
    off = errors_s(events, CAMERAS, CAMERAS)
    for name, error in off.items():
        settled = error[100:500] if restart_s is not None else error[100:]
        assert np.std(settled) < 3e-4, name  # arrivals scatter by 4 ms
        assert abs(np.median(error) - np.median(off["a"])) < 5e-4
        assert np.quantile(np.abs(error - np.median(error)), 0.99) < 5e-3


def test_a_clock_that_was_set_is_found_again_at_once():
    clock = FreeClock(RATE)
    for k in range(10):
        assert clock.at(Grabbed(k, k * 10**7, k * 10**7 + 50, 0, IMAGE)) == k * 10**7 + 50
    assert clock.at(Grabbed(11, 3, 11 * 10**7 + 60, 0, IMAGE)) == 11 * 10**7 + 60


def test_sets_take_the_nearest_frames_and_what_is_left_over_is_counted():
    """A camera at 29.5 Hz beside pulses of 30: one pulse in 60 has none of its frames, no set an old one."""
    cameras = {"a": (30.0, 0.0, 0.0), "b": (29.5, 0.011, 0.0), "c": (30.5, 0.02, 0.0)}
    numbers, frames, true = PulseNumbers(tuple(cameras), RATE, free=cameras), [], {}
    for _, name, at, buffer in arrivals(cameras, 20.0):
        for one in numbers.take(name, buffer):
            time_ns = round(one.pulse * numbers.period_ns + one.residual_ns)
            frames.append(Frame(one.camera, one.buffer.block_id, time_ns, 0, IMAGE))
        true[name, buffer.block_id] = at
    infos = tuple(CameraInfo(name, 2, 2, 8, RATE) for name in cameras)
    account = Assembly()
    sets = list(assemble(frames, infos, AssemblySettings(), account))
    assert account.frames == len(frames)
    assert abs(len(sets) - 600) <= 2
    whole = [one for one in sets if len(one.frames) == 3]
    assert len(whole) >= 585
    for one in whole:
        at = [true[name, frame.index] for name, frame in one.frames.items()]
        assert max(at) - min(at) < 1 / RATE + 1e-3  # half a period before the pulse, half a period after it
    assert abs(account.cameras["b"].dropped - 10) <= 2
    assert abs(account.cameras["c"].doubled - 10) <= 2


class Silent:
    """A driver that never has a frame."""

    def __init__(self, real_time):
        self.capabilities = Capabilities(real_time=real_time)


@pytest.mark.parametrize(
    ("trigger", "real_time", "free"), [("Off", True, ["w"]), ("Off", False, []), ("Line1", True, [])]
)
def test_which_cameras_are_free_running(trigger, real_time, free):
    settings = CameraHardware(driver="gige", serial="1", trigger=trigger)
    assert free_running({"w": settings}, {"w": Silent(real_time)}) == free
