"""Lamps identified by their blink codes: every number, missed and stray samples, points that are no lamp."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from track_points import made_tracks

from mosca.data.lamp_codes import LAMP_NUMBERS, lamp_bits
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.labelling.blinking_leds import BlinkSettings, label_lamps, lamp_numbers


def tracks_lit(lit: dict[int, list[int]], status: str = "measured") -> Tracks:
    pairs = sorted((f, t) for t, frames in lit.items() for f in frames)
    n = len(pairs)
    return made_tracks(*zip(*pairs, strict=True), np.zeros((n, 3)), status=np.full(n, status))


def shown(number: int, frames: range, start: int = 0, per_bit: int = 1) -> list[int]:
    bits = lamp_bits(number)
    return [f for f in frames if bits[((f - start) // per_bit) % 16]]


def test_every_lamp_within_two_rounds() -> None:
    tracks = tracks_lit({100 + k: shown(k, range(7, 7 + 48)) for k in range(LAMP_NUMBERS)})
    expected = {100 + k: k for k in range(LAMP_NUMBERS)}
    assert lamp_numbers(tracks, BlinkSettings(in_step=True)) == expected
    assert lamp_numbers(tracks) == expected
    assert label_lamps(tracks).label[0].startswith("lamp/")
    named = label_lamps(tracks, {3: "head"})
    assert set(named.label[named.track == 103]) == {"head"}
    assert set(named.label[named.track != 103]) == {""}


@settings(max_examples=60, deadline=None)
@given(
    number=st.integers(0, LAMP_NUMBERS - 1),
    start=st.integers(0, 47),
    per_bit=st.integers(1, 3),
    seed=st.integers(0, 1000),
)
def test_missed_and_stray_samples(number: int, start: int, per_bit: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = range(10, 10 + 96 * per_bit)
    lit = [f for f in shown(number, frames, start, per_bit) if rng.random() > 0.05]
    lit += [f for f in frames if rng.random() < 0.005 and f not in lit]
    other = shown((number + 1) % LAMP_NUMBERS, frames, start, per_bit)
    tracks = tracks_lit({5: lit, 6: other})
    given = BlinkSettings(frames_per_bit=per_bit)
    pulses = np.array(frames)
    if start % per_bit == 0:
        assert lamp_numbers(tracks, given, pulses)[5] == number
    else:  # the bits do not begin at pulse 0: identified or not, but never wrongly
        assert lamp_numbers(tracks, given, pulses).get(5, number) == number


def test_lost_frame_sets_are_no_dark_bits() -> None:
    frames = [f for f in range(64) if f % 7]
    lit = {k: [f for f in shown(k, range(64)) if f in frames] for k in (3, 40)}
    assert lamp_numbers(tracks_lit(lit), pulses=np.array(frames)) == {3: 3, 40: 40}


def test_what_is_no_lamp_gets_no_number() -> None:
    rng = np.random.default_rng(0)
    always = list(range(200))
    random = [f for f in range(200) if rng.random() < 0.6]
    short = shown(5, range(14))
    assert lamp_numbers(tracks_lit({0: always, 1: random, 2: short})) == {}
    # two lamps one after the other on one track: neither
    swapped = shown(8, range(100)) + shown(9, range(100, 200))
    assert lamp_numbers(tracks_lit({0: always, 1: swapped})) == {}
    # filled samples have no information on the light
    assert lamp_numbers(tracks_lit({1: shown(8, range(100))}, "filled")) == {}
    assert lamp_numbers(Tracks.none()) == {}


@pytest.mark.parametrize("bad", [{"frames_per_bit": 0}, {"missed": 0.0}, {"stray": 0.6}, {"odds": 1.0}])
def test_settings_out_of_range(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match="blink"):
        BlinkSettings(**bad)
