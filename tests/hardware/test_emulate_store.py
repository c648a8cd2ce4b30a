"""The frame store between a source and its cameras, and the trigger line."""

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from array_source import ArraySource, picture

from hardware.emulate.pulse_generators import TriggerLine
from hardware.emulate.store import FrameStore
from mosca.data.frames import Frame
from mosca.errors import InputError

SHAPE = (48, 64)


@pytest.fixture
def stores():
    made = []

    def make(source, *arguments, **options) -> FrameStore:
        made.append(FrameStore(source, *arguments, **options))
        made[-1].fill()
        return made[-1]

    yield make
    for store in made:
        store.close()


def same(store: FrameStore, camera: int, pulse: int, number: int) -> bool:
    frame = store.frame(f"cam{camera}", pulse)
    return frame is not None and np.array_equal(frame.image, picture(camera, number, SHAPE))


def test_a_source_that_fits_is_read_once(stores):
    source = ArraySource(2, 5)
    store = stores(source, 10)
    assert all(same(store, k, n, n) for k in range(2) for n in range(5))
    assert store.frame("cam0", 5) is None
    store.rewind()
    assert same(store, 1, 0, 0)
    assert (store.length, store.last_pulse, source.iterations) == (5, 4, 1)


def test_reading_ahead_ends_with_what_there_is():
    store, told = FrameStore(ArraySource(2, 5), 10), []
    store.fill(lambda *pulses: told.append(pulses))
    store.close()
    assert told[-1] == (5, 5)


def test_a_loop_begins_again(stores):
    store = stores(ArraySource(1, 5), 10, loop=True)
    assert same(store, 0, 13, 3)
    assert store.last_pulse is None


def test_a_long_source_is_read_while_pulses_pass(stores):
    source = ArraySource(2, 60)
    store = stores(source, 6)
    assert all(same(store, k, n, n) for n in range(60) for k in range(2))
    assert store.kept <= 2 * 13
    assert store.frame("cam0", 60) is None
    assert store.last_pulse == 59
    store.rewind()
    assert all(same(store, 0, n, n) for n in range(60))
    assert source.iterations == 2


def test_a_long_loop_goes_on(stores):
    store = stores(ArraySource(1, 20), 6, loop=True)
    assert all(same(store, 0, n, n % 20) for n in range(50))


def test_pulses_may_be_left_out_and_cameras_may_lag(stores):
    store = stores(ArraySource(2, 60), 6)
    assert same(store, 0, 40, 40)
    assert same(store, 1, 36, 36)
    assert store.frame("cam1", 3) is None


class Lossy(ArraySource):
    """Leaves frames of cam1 out and lets one come late."""

    def __iter__(self) -> Iterator[Frame]:
        frames = list(super().__iter__())
        late = next(f for f in frames if f.camera == "cam0" and f.index == 3)
        for frame in frames:
            if frame is late or (frame.camera == "cam1" and frame.index == 5):
                continue
            yield frame
            if frame.camera == "cam1" and frame.index == 4:
                yield late


def test_missing_and_late_frames_shift_nothing(stores):
    store = stores(Lossy(2, 40), 60)
    assert store.frame("cam1", 5) is None
    assert same(store, 0, 3, 3)
    assert same(store, 1, 6, 6)


class Captured(ArraySource):
    """A capture: cam1 missed pulses 3 and 4, which its own counter does not count; its time stamps have the gap."""

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            if frame.camera == "cam1" and frame.index in (3, 4):
                continue
            yield replace(frame, index=frame.index - 2 * (frame.camera == "cam1" and frame.index > 4))


def test_pulses_that_a_camera_missed_stay_a_gap(stores):
    store = stores(Captured(2, 20), 30)
    assert store.frame("cam1", 3) is None
    assert store.frame("cam1", 4) is None
    assert all(same(store, k, n, n) for k in range(2) for n in (0, 2, 5, 19))


class Counted(ArraySource):
    """Cameras with counters and clocks of their own, one of which lost its second frame."""

    def __init__(self) -> None:
        super().__init__(2, 30)
        self.cameras = tuple(replace(info, clock="device") for info in self.cameras)

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            late = 400_000 if frame.camera == "cam1" else 0
            if (frame.camera, frame.index) != ("cam1", 1):
                yield replace(frame, index=frame.index + 777 * (late > 0), time_ns=frame.time_ns + late + 10**12)


def test_frames_of_other_clocks_are_told_by_their_times(stores):
    store = stores(Counted(), 60)
    assert store.frame("cam1", 1) is None
    assert all(same(store, 1, n, n) for n in range(2, 30))


class Broken(ArraySource):
    def __iter__(self) -> Iterator[Frame]:
        yield from list(super().__iter__())[:3]
        raise InputError("take 7: cannot be read")


def test_what_a_source_says_is_passed_on():
    store = FrameStore(Broken(1, 9), 20)
    with pytest.raises(InputError, match="take 7"):
        store.fill()
    store.close()


class Bell:
    def __init__(self) -> None:
        self.heard: list[tuple[int, int, int]] = []

    def pulse(self, number: int, time_ns: int) -> None:
        self.heard.append((number, time_ns, time.monotonic_ns()))


def test_pulses_are_due_at_exact_times_and_never_early():
    bells = [Bell(), Bell()]
    line = TriggerLine(bells)
    line.start(400.0)
    while len(bells[1].heard) <= 50:
        time.sleep(0.01)
    line.stop()
    heard = bells[0].heard
    assert [h[:2] for h in heard] == [h[:2] for h in bells[1].heard]
    assert [h[0] for h in heard] == list(range(len(heard)))
    assert {b[1] - a[1] for a, b in pairwise(heard)} == {2_500_000}
    assert all(now >= due - 100_000 for _, due, now in heard)
    assert len(heard) > 50
    again = len(heard)
    time.sleep(0.02)
    assert len(heard) == again


def test_each_start_begins_with_pulse_0_and_ends_when_told():
    bell = Bell()
    line = TriggerLine([bell], ended=lambda number: number > 2)
    for _ in range(2):
        line.start(1000.0)
        while line.running:
            time.sleep(0.005)
    assert [h[0] for h in bell.heard] == [0, 1, 2, 0, 1, 2]


@pytest.mark.parametrize("rate", [0.0, -1.0, 1e6, float("nan")])
def test_rates_that_cannot_be(rate):
    with pytest.raises(InputError, match="trigger line"):
        TriggerLine([]).start(rate)
