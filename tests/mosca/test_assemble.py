"""Every frame lands in its true pulse, or is counted; the truth is written into the frame's image."""

import random
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.errors import InputError
from mosca.synchronisation import Assembly, AssemblySettings, PulseClock, assemble

PERIOD_NS = 10_000_000


def image_of(pulse: int) -> np.ndarray:
    return np.full((2, 2), (pulse + 1000) % 2**16, np.uint16)


def true_pulse(frame: Frame) -> int:
    assert frame.image is not None
    return int(frame.image[0, 0]) - 1000


def camera_infos(n: int) -> tuple[CameraInfo, ...]:
    return tuple(CameraInfo(f"c{k}", 2, 2, 8, 100.0) for k in range(n))


def shot(camera: int, pulse: int, jitter_ns: float = 0, status: str = "ok", index: int | None = None) -> Frame:
    image = image_of(pulse) if status == "ok" else None
    start = round(pulse * PERIOD_NS + jitter_ns) - 500_000
    at = pulse if index is None else index
    return Frame(f"c{camera}", at, start, 1_000_000, image, status)


def run(frames: Iterable[Frame], n: int, **kept: int) -> tuple[list[FrameSet], Assembly]:
    counts = Assembly()
    sets = list(assemble(iter(frames), camera_infos(n), AssemblySettings(**kept), counts))
    return sets, counts


def check_true(sets: list[FrameSet]) -> int:
    """Check that no set mixes pulses and that numbers keep step with the truth; return the first true pulse."""
    firsts = {true_pulse(f) - s.pulse for s in sets for f in s.frames.values()}
    assert len(firsts) <= 1
    assert [s.pulse for s in sets] == list(range(len(sets)))
    return firsts.pop() if firsts else 0


def test_complete_sets_come_out_at_once() -> None:
    counts = Assembly()
    pulled = 0

    def frames() -> Iterable[Frame]:
        nonlocal pulled
        for pulse in range(20):
            for camera in range(4):
                pulled += 1
                yield shot(camera, pulse)

    for k, frame_set in enumerate(assemble(frames(), camera_infos(4), assembly=counts)):
        assert pulled == max(8, 4 * (k + 1))
        assert frame_set.pulse == k
        assert frame_set.time_ns == k * PERIOD_NS
        assert list(frame_set.frames) == ["c0", "c1", "c2", "c3"]
    assert (counts.frames, counts.sets, counts.complete_sets, counts.empty_sets) == (80, 20, 20, 0)


def test_time_is_the_median_mid_exposure() -> None:
    frames = [shot(c, p, jitter_ns=(c - 1) ** 3 * 1000) for p in range(6) for c in range(4)]
    sets, _ = run(frames, 4)
    # Jitters -1, 0, 1, 8 us: the median of an even number is the mean of the middle two.
    assert [s.time_ns for s in sets] == [p * PERIOD_NS + 500 for p in range(6)]


def test_dropped_frames_are_gaps() -> None:
    frames = [shot(c, p) for p in range(30) for c in range(3) if not (c == 1 and p in (0, 7, 8, 29))]
    sets, counts = run(frames, 3)
    assert check_true(sets) == 0
    assert [s.pulse for s in sets if "c1" not in s.frames] == [0, 7, 8, 29]
    assert counts.cameras["c1"].dropped == 4
    assert counts.complete_sets == 26


def test_a_pulse_without_any_frame_is_an_empty_set() -> None:
    sets, counts = run([shot(c, p) for p in range(30) for c in range(2) if p not in (10, 11, 12)], 2)
    assert check_true(sets) == 0
    assert len(sets) == 30
    assert [s.pulse for s in sets if not s.frames] == [10, 11, 12]
    assert [s.time_ns for s in sets] == [p * PERIOD_NS for p in range(30)]
    assert counts.empty_sets == 3


def test_late_frames_within_the_window_are_used_and_beyond_it_counted() -> None:
    frames = [shot(c, p) for p in range(40) for c in range(2)]
    late = frames.pop(21)  # camera 1, pulse 10
    for delay, used in ((9, True), (11, False)):
        moved = frames[: 20 + delay] + [late] + frames[20 + delay :]
        sets, counts = run(moved, 2, open_pulses=5)
        check_true(sets)
        assert ("c1" in sets[10].frames) is used
        assert counts.cameras["c1"].late == (0 if used else 1)
        assert counts.cameras["c1"].dropped == 0
        assert counts.cameras["c1"].reordered == (1 if used else 0)


def test_one_camera_alone_may_deliver_out_of_order() -> None:
    frames = [shot(0, p) for p in range(30)]
    frames[12], frames[13] = frames[13], frames[12]
    frames.insert(22, frames.pop(18))
    sets, counts = run(frames, 1)
    assert check_true(sets) == 0
    assert [s.pulse for s in sets if not s.frames] == []
    assert (counts.cameras["c0"].reordered, counts.cameras["c0"].late) == (2, 0)


def test_doubled_frames_are_ignored_even_after_their_set() -> None:
    frames = [shot(c, p) for p in range(20) for c in range(2)]
    twice = [*frames[:11], frames[10], *frames[11:], frames[4]]
    sets, counts = run(twice, 2)
    assert check_true(sets) == 0
    assert all(len(s.frames) == 2 for s in sets)
    assert counts.cameras["c0"].doubled == 2
    assert "c0, frame 5" in counts.notes["doubled"]


def test_corrupt_frames_are_counted_and_absent() -> None:
    frames = [shot(c, p, status="corrupt" if (c, p) == (1, 4) else "ok") for p in range(9) for c in range(2)]
    sets, counts = run(frames, 2)
    assert check_true(sets) == 0
    assert list(sets[4].frames) == ["c0"]
    assert (counts.cameras["c1"].corrupt, counts.cameras["c1"].dropped) == (1, 0)


def test_sets_with_a_frame_in_doubt_are_not_complete() -> None:
    frames = [shot(c, p) for p in range(12) for c in range(2)]
    frames[9] = replace(frames[9], note="its time is known to 3.0 ms")
    sets, counts = run(frames, 2)
    assert (len(sets), counts.sets, counts.complete_sets) == (12, 12, 11)
    assert [(c.delivered, c.unproven) for c in counts.cameras.values()] == [(12, 0), (12, 1)]
    assert len(sets[4].frames) == 2  # it is used all the same


def test_a_frame_said_to_be_dropped_does_not_hold_the_set_up() -> None:
    frames = [shot(c, p, status="dropped" if (c, p) == (1, 9) else "ok") for p in range(12) for c in range(2)]
    given_out: list[int] = []

    def watched() -> Iterable[Frame]:
        for k, frame in enumerate(frames):
            if k == 20:
                assert given_out[-1] == 9
            yield frame

    counts = Assembly()
    for frame_set in assemble(watched(), camera_infos(2), assembly=counts):
        given_out.append(frame_set.pulse)
    assert counts.cameras["c1"].dropped == 1


def test_sets_go_on_when_a_camera_dies() -> None:
    sets, counts = run([shot(c, p) for p in range(200) for c in range(3) if c != 2 or p < 50], 3)
    assert check_true(sets) == 0
    assert len(sets) == 200
    assert counts.cameras["c2"].dropped == 150


def test_a_missed_trigger_shifts_nothing_though_the_counter_has_no_gap() -> None:
    missed = [shot(1, p, index=p if p < 20 else p - 1) for p in range(40) if p != 20]
    other = [shot(0, p) for p in range(40)]
    sets, counts = run(sorted(missed + other, key=lambda f: f.time_ns), 2)
    assert check_true(sets) == 0
    assert [s.pulse for s in sets if len(s.frames) < 2] == [20]
    assert counts.cameras["c1"].counter_jumps == 1
    assert "went on by 1, its time by 2 pulses" in counts.notes["counter_jumps"]


@pytest.mark.parametrize("start_ns", [0, -35_000_000, 1_790_000_000_123_456_789])
@pytest.mark.parametrize("rate_error", [-1e-3, 0.0, 1e-3])
def test_a_wrong_nominal_rate_is_followed_over_long_runs_and_gaps(start_ns: int, rate_error: float) -> None:
    pulses = [p for p in range(6000) if not 4000 <= p < 4800]
    frames = [Frame("c0", p, start_ns + round(p * PERIOD_NS * (1 + rate_error)), 0, image_of(p)) for p in pulses]
    sets, counts = run(frames, 1)
    assert check_true(sets) == 0
    assert len(sets) == 6000
    assert counts.empty_sets == 800


def test_a_mad_stamp_is_stray_and_a_clock_that_was_set_is_an_error() -> None:
    frames = [shot(c, p) for p in range(30) for c in range(2)]
    sets, counts = run([*frames[:30], shot(0, 10**9), *frames[30:]], 2)
    assert len(sets) == 30
    assert counts.cameras["c0"].stray == 1
    with pytest.raises(InputError, match="split it there"):
        run(frames + [shot(c, 10**7 + p) for p in range(30) for c in range(2)], 2)


def test_unlike_rates_and_unknown_cameras_are_errors() -> None:
    infos = (CameraInfo("a", 2, 2, 8, 100.0), CameraInfo("b", 2, 2, 8, 50.0))
    with pytest.raises(InputError, match=r"'b' states 50 .* 'a' 100"):
        list(assemble([], infos))
    with pytest.raises(InputError, match="unknown camera 'c3'"):
        run([shot(3, 0)], 2)
    assert run([], 2)[0] == []


@pytest.mark.parametrize("seed", range(5))
def test_random_jitter_of_a_quarter_period(seed: int) -> None:
    rng = random.Random(seed)
    frames = [
        shot(c, p, rng.uniform(-0.25, 0.25) * PERIOD_NS) for p in range(2000) for c in range(3) if rng.random() > 0.1
    ]
    sets, counts = run(frames, 3)
    check_true(sets)
    assert sum(c.delivered for c in counts.cameras.values()) == len(frames)


@settings(max_examples=150, deadline=None)
@given(data=st.data(), n=st.integers(1, 4), seed=st.integers(0, 2**32), pulses=st.integers(1, 50))
def test_random_troubles_never_put_a_frame_into_a_wrong_pulse(
    data: st.DataObject, n: int, seed: int, pulses: int
) -> None:
    loss = data.draw(st.floats(0, 0.6))
    doubling = data.draw(st.floats(0, 0.3))
    jitter = data.draw(st.floats(0, 0.2)) * PERIOD_NS
    drift = data.draw(st.floats(-5e-4, 5e-4))
    spread = data.draw(st.sampled_from([0, 2, 6, 40]))
    rng = random.Random(seed)
    frames = []
    for p in range(pulses):
        for c in range(n):
            if rng.random() >= loss:
                status = rng.choices(["ok", "corrupt", "dropped"], [0.9, 0.05, 0.05])[0]
                wobble = rng.choice([-jitter, jitter, rng.uniform(-jitter, jitter)])
                frames.append(shot(c, p, drift * p * PERIOD_NS + wobble, status))
                if rng.random() < doubling:
                    frames.append(frames[-1])
    order = sorted(range(len(frames)), key=lambda k: k + rng.uniform(0, spread))
    sets, counts = run([frames[k] for k in order], n)
    check_true(sets)
    assert counts.frames == len(frames)
    assert counts.sets == len(sets)
    for name, count in counts.cameras.items():
        in_sets = [true_pulse(s.frames[name]) for s in sets if name in s.frames]
        assert len(set(in_sets)) == len(in_sets) == count.delivered
        before_first = count.delivered + count.corrupt + count.late + count.dropped - len(sets)
        assert before_first >= 0
        assert before_first <= count.late
        assert count.stray == 0
        if spread <= 2:
            assert count.late == 0
            assert set(in_sets) == {true_pulse(f) for f in frames if f.camera == name and f.status == "ok"}


def test_clock_follows_in_integers_far_from_zero() -> None:
    start = 1_790_000_000_000_000_001
    clock = PulseClock(1e7, [start, start + 10_000_000, start + 20_000_000])
    assert clock.expected_ns(clock.pulse_of(start + 50_000_000)) == start + 50_000_000
