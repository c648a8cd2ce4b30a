"""The shutter by hand: exposure windows of rows, and the true mid-exposure from the time stamps."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.data.frames import Frame, StampEvent, mid_exposure_ns
from mosca.errors import InputError
from twin.cameras.exposure.shutter import (
    Exposure,
    Timing,
    check_timing,
    fastest_rate_hz,
    numbers_in,
    open_shutter,
    pulse_time_s,
)

RATE_HZ, EXPOSURE_S, ROWS = 100.0, 1e-3, 491
EVENTS: tuple[StampEvent, ...] = get_args(StampEvent)
EXACT = Timing(jitter_s=0.0)


def shot(timing: Timing, number: int = 0, name: str = "a", rows: int = ROWS, seed: int = 1) -> Exposure:
    return open_shutter(timing, name, number, RATE_HZ, EXPOSURE_S, seed, rows)


def stated_middle_s(exposure: Exposure, timing: Timing) -> float:
    """Return the mid-exposure that a reader works out of the frame, on the session clock by the clock's own law."""
    image = np.zeros((exposure.rows, 2), dtype=np.uint8)
    frame = Frame(
        "a", exposure.number, exposure.stamp_ns, exposure.exposure_ns, image,
        stamp_event=timing.stamp_event, row_time_ns=exposure.row_time_ns,
    )  # fmt: skip
    since = mid_exposure_ns(frame) - (round(timing.clock_offset_s * 1e9) if timing.clock != "session" else 0)
    return since * 1e-9 / (1.0 + (1e-6 * timing.clock_drift_ppm if timing.clock != "session" else 0.0))


# stamps


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("clock", ["session", "device", "host"])
@pytest.mark.parametrize("row_time_s", [0.0, 20e-6])
@pytest.mark.parametrize("strobe_s", [None, 2e-4])
@pytest.mark.parametrize("rate_hz", [None, 61.7])
def test_the_stamps_give_the_true_middle_back(
    event: StampEvent, clock: Any, row_time_s: float, strobe_s: float | None, rate_hz: float | None
) -> None:
    timing = Timing(
        jitter_s=0.0, skew_s=1.3e-3, rate_hz=rate_hz, offset_s=3e-3, drift_ppm=40.0, exposure_s=12e-3,
        row_time_s=row_time_s, strobe_s=strobe_s, strobe_delay_s=10e-3, stamp_event=event, clock=clock,
        clock_offset_s=1_790_000_000.25, clock_drift_ppm=-35.0, stamp_resolution_ns=8,
    )  # fmt: skip
    for number in (0, 1, 977):
        exposure = shot(timing, number)
        # a tick, a nanosecond of rounding, and 35 ppm of the 10 ms between event and middle
        off = stated_middle_s(exposure, timing) - exposure.middle_s
        assert -8e-9 - 2e-9 - 0.4e-6 < off < 2e-9 + 0.4e-6


@pytest.mark.parametrize("event", EVENTS)
def test_stamps_know_neither_jitter_nor_delay(event: StampEvent) -> None:
    steady = Timing(jitter_s=0.0, stamp_event=event, row_time_s=10e-6)
    shaky = replace(steady, jitter_s=50e-6, delay_s=2e-4)
    late = []
    for number in range(400):
        exposure = shot(shaky, number)
        assert exposure.stamp_ns == shot(steady, number).stamp_ns
        late.append(exposure.middle_s - stated_middle_s(exposure, shaky))
    # 400 draws: the mean is known to 2.5 us, the rms to 3.5 %
    assert np.mean(late) == pytest.approx(2e-4, abs=1e-5)
    assert np.std(late) == pytest.approx(50e-6, rel=0.15)


def test_stamps_tell_the_skew() -> None:
    exposure = shot(replace(EXACT, skew_s=2.5e-3), 7)
    assert exposure.start_s == pytest.approx(0.0725, abs=1e-15)
    assert exposure.stamp_ns == 72_500_000


def test_an_epoch_costs_no_nanosecond() -> None:
    timing = replace(EXACT, clock="device", clock_offset_s=1_790_000_000.0)
    first, later = shot(timing, 0), shot(timing, 12_345)
    assert first.stamp_ns == 1_790_000_000_000_000_000
    assert later.stamp_ns - first.stamp_ns == 123_450_000_000


def test_a_fast_clock_gains() -> None:
    timing = replace(EXACT, clock="device", clock_drift_ppm=100.0)
    assert shot(timing, 100_000).stamp_ns == 1_000_100_000_000


def test_stamps_are_whole_ticks_and_never_early() -> None:
    timing = replace(EXACT, clock="device", stamp_resolution_ns=1_000_000, skew_s=0.4e-3)
    assert [shot(timing, k).stamp_ns for k in range(3)] == [0, 10_000_000, 20_000_000]


def test_arrival_stamps_are_late_by_an_exponential_time() -> None:
    timing = replace(EXACT, clock="host", stamp_jitter_s=0.5e-3, stamp_event="readout")
    late = np.array([stated_middle_s(e, timing) - e.middle_s for e in (shot(timing, k) for k in range(3000))])
    assert late.min() > -2e-9
    # known to 1.8 %; the median of an exponential law is log 2 of its mean
    assert late.mean() == pytest.approx(0.5e-3, rel=0.08)
    assert late.std() == pytest.approx(0.5e-3, rel=0.12)
    assert np.median(late) == pytest.approx(0.5e-3 * np.log(2.0), rel=0.1)


# windows


def test_a_triggered_frame_by_hand() -> None:
    exposure = shot(EXACT, 3)
    assert (exposure.start_s, exposure.length_s) == (0.03, 1e-3)
    assert exposure.end_s == pytest.approx(0.031, abs=1e-15)
    assert exposure.middle_s == pytest.approx(0.0305, abs=1e-15)
    assert (exposure.exposure_ns, exposure.row_time_ns, exposure.stamp_ns) == (1_000_000, 0, 30_000_000)


def test_rows_open_one_after_the_other() -> None:
    exposure = shot(Timing(jitter_s=0.0, row_time_s=20e-6), 0, rows=11)
    assert exposure.span_s == pytest.approx(1.2e-3, abs=1e-15)
    middles = [exposure.row_middle_s(row) for row in range(11)]
    np.testing.assert_allclose(middles, 0.5e-3 + 20e-6 * np.arange(11), atol=1e-15)
    assert exposure.middle_s == pytest.approx(middles[5], abs=1e-15)


def test_a_cameras_own_strobe_moves_with_it() -> None:
    timing = Timing(jitter_s=30e-6, delay_s=1e-4, strobe_s=2e-4, strobe_delay_s=3e-4)
    for number in range(20):
        exposure = shot(timing, number)
        assert exposure.middle_s - exposure.start_s == pytest.approx(4e-4, abs=1e-12)
        assert exposure.exposure_ns == 200_000


def test_a_rigs_strobe_gives_all_cameras_one_middle() -> None:
    timing = Timing(jitter_s=30e-6, strobe_s=2e-4, strobe_delay_s=3e-4, strobe="rig")
    for number in range(20):
        one, other = (shot(replace(timing, delay_s=d), number, name) for name, d in (("a", 0.0), ("b", 1e-4)))
        assert one.start_s != other.start_s
        assert one.middle_s == pytest.approx(number / RATE_HZ + 4e-4, abs=1e-12)
        assert other.middle_s == pytest.approx(one.middle_s, abs=1e-12)
        assert one.exposure_ns == 1_000_000


def test_a_strobe_that_is_cut_by_the_shutter() -> None:
    # light from 0.9 to 1.3 ms, shutter to 1 ms: what counts is 0.9 to 1 ms
    cut = shot(Timing(jitter_s=0.0, strobe_s=4e-4, strobe_delay_s=9e-4, strobe="rig"))
    assert cut.middle_s == pytest.approx(0.95e-3, abs=1e-12)
    dark = shot(Timing(jitter_s=0.0, strobe_s=4e-4, strobe_delay_s=5e-3, strobe="rig"))
    assert dark.middle_s == pytest.approx(0.5e-3, abs=1e-12)


# free running


def test_free_running_by_hand() -> None:
    timing = Timing(jitter_s=0.0, rate_hz=50.0, offset_s=4e-3, drift_ppm=1000.0)
    # 50.05 frames/s from 4 ms on
    opens = [shot(timing, n).start_s for n in range(4)]
    np.testing.assert_allclose(opens, 4e-3 + np.arange(4) / 50.05, atol=1e-12)
    assert [list(numbers_in(timing, pulse, RATE_HZ)) for pulse in range(7)] == [[0], [], [1], [], [2], [], [3]]


@given(
    rate=st.floats(1.0, 1000.0),
    offset=st.floats(-0.5, 0.5),
    drift=st.floats(-1e4, 1e4),
    frame_rate=st.floats(5.0, 500.0),
)
def test_every_free_frame_comes_once(rate: float, offset: float, drift: float, frame_rate: float) -> None:
    timing = Timing(rate_hz=rate, offset_s=offset, drift_ppm=drift)
    numbers = [n for pulse in range(60) for n in numbers_in(timing, pulse, frame_rate)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))) if numbers else True
    end_s, true_rate = pulse_time_s(60, frame_rate), rate * (1 + 1e-6 * drift)
    begin_s = max(0.0, offset)
    assert abs(len(numbers) - max(0.0, (end_s - begin_s) * true_rate)) <= 1.0


def test_triggered_numbers_are_pulses() -> None:
    assert [list(numbers_in(EXACT, pulse, RATE_HZ)) for pulse in (0, 1, 77)] == [[0], [1], [77]]


# what cannot be


def test_fewer_rows_are_read_faster() -> None:
    assert fastest_rate_hz(500, 20e-6) == pytest.approx(100.0)
    assert fastest_rate_hz(250, 20e-6) == pytest.approx(200.0)
    assert fastest_rate_hz(250, 20e-6, 5e-3) == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("timing", "named"),
    [
        (Timing(rate_hz=0.0), "rate_hz = 0 "),
        (Timing(exposure_s=0.011), "exposure_s = 0.011 "),
        (Timing(exposure_s=-1.0), "exposure_s = -1 "),
        (Timing(row_time_s=21e-6), "row_time_s = 2.1e-05 "),
        (Timing(stamp_resolution_ns=0), "stamp_resolution_ns = 0"),
        (Timing(strobe_s=0.0), "strobe_s = 0 "),
        (Timing(strobe_s=2e-4, strobe_delay_s=9e-4), "strobe_delay_s = 0.0009"),
        (Timing(row_time_s=10e-6, strobe_s=2e-4, exposure_s=6e-3), "strobe_delay_s = 0,"),
        (Timing(strobe_s=2e-4, strobe="rig", rate_hz=50.0), "strobe = 'rig'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_named(timing: Timing, named: str) -> None:
    with pytest.raises(InputError, match=f"camera 'eye', timing: .*{named}"):
        check_timing(timing, "eye", ROWS, RATE_HZ, EXPOSURE_S)


def test_what_can_be_passes() -> None:
    rolling = Timing(row_time_s=10e-6, strobe_s=1e-3, strobe_delay_s=4.9e-3, exposure_s=6e-3)
    for timing in (Timing(), rolling, Timing(row_time_s=20e-6), Timing(rate_hz=1000.0)):
        check_timing(timing, "eye", ROWS, RATE_HZ, EXPOSURE_S)
