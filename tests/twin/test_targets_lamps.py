"""Lamps and glows: when a lamp is lit, in exact arithmetic; who blinks what; what cannot be."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.data.lamp_codes import lamp_bits, lamp_code, m_sequence
from mosca.errors import InputError
from twin.scenes.cloud import build_cloud
from twin.scenes.emission import Blink, Glow, lit
from twin.scenes.scene import Scene
from twin.scenes.target_lamps import LAMP, build_light_marker, in_step, with_lamps, with_numbered_lamps

BOX = {"box_center_m": np.zeros(3), "box_size_m": np.ones(3)}


@pytest.fixture(scope="module")
def cloud() -> Scene:
    return build_cloud(duration_s=1.0, **BOX, n=5, rng=np.random.default_rng(0))


def test_lit_by_hand():
    blink = Blink((True, False, True, True), 0.5, 1.0)
    np.testing.assert_array_equal(lit(blink, 0.0, 5.0), [[1.0, 1.5], [2.0, 3.5], [4.0, 5.0]])
    np.testing.assert_array_equal(lit(blink, 1.25, 1.75), [[1.25, 1.5]])
    np.testing.assert_array_equal(lit(blink, 2.1, 3.4), [[2.1, 3.4]])
    assert lit(blink, 1.5, 2.0).shape == (0, 2)
    assert lit(blink, -9.0, 1.0).shape == (0, 2)  # dark before it starts
    assert lit(blink, 1.2, 1.2).shape == (0, 2)


blinks = st.builds(
    Blink, st.lists(st.booleans(), min_size=1, max_size=9).map(tuple), st.floats(1e-3, 3.0), st.floats(-5.0, 5.0)
)
instant = st.floats(-6.0, 9.0)


@given(blinks, instant, st.floats(0.0, 3.0))
def test_lit_is_exact(blink, t0, length):
    """Against rational arithmetic: all bits one by one, the edges as their doubles."""
    t1 = t0 + min(length, 40 * blink.bit_s)
    last = int((Fraction(t1) - Fraction(blink.start_s)) / Fraction(blink.bit_s)) + 2
    total = Fraction(0)
    for k in range(max(0, last - 60), max(0, last)):
        begin, end = (Fraction(blink.start_s + j * blink.bit_s) for j in (k, k + 1))
        if blink.bits[k % len(blink.bits)]:
            total += max(Fraction(0), min(end, Fraction(t1)) - max(begin, Fraction(t0)))
    found = lit(blink, t0, t1)
    assert sum((Fraction(b) - Fraction(a) for a, b in found), Fraction(0)) == total
    assert (found[:, 0] < found[:, 1]).all()
    assert (found[1:, 0] > found[:-1, 1]).all()
    assert ((t0 <= found) & (found <= t1)).all()


@given(blinks, instant, st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_windows_that_meet_add_up(blink, t0, first, second):
    t1 = t0 + min(first, 40 * blink.bit_s)
    t2 = t1 + min(second, 40 * blink.bit_s)

    def length(intervals):
        return sum((Fraction(b) - Fraction(a) for a, b in intervals), Fraction(0))

    assert length(lit(blink, t0, t1)) + length(lit(blink, t1, t2)) == length(lit(blink, t0, t2))


@given(
    st.floats(1.0, 2000.0),
    st.integers(1, 5),
    st.lists(st.booleans(), min_size=1, max_size=20),
    st.integers(0, 500),
    st.floats(0.0, 0.7),
    st.floats(0.0, 0.04),
)
def test_a_lamp_in_step_is_never_half_lit(rate, per_bit, bits, pulse, exposure, late):
    blink = in_step(bits, rate, per_bit)
    t0 = (pulse + late) / rate
    t1 = t0 + exposure / rate
    found = lit(blink, t0, t1)
    if bits[pulse // per_bit % len(bits)] and t1 > t0:
        np.testing.assert_array_equal(found, [[t0, t1]])
    else:
        assert len(found) == 0


def test_frames_of_a_numbered_lamp_say_its_number(cloud):
    scene = with_numbered_lamps(cloud, 100.0, names=("P4", "P2"))
    assert set(scene.glows) == {"P4", "P2"}
    for number, name in enumerate(("P4", "P2")):
        glow = scene.glows[name]
        assert glow.kind == "lamp"
        assert glow.blink is not None
        seen = tuple(len(lit(glow.blink, k / 100.0, k / 100.0 + 0.002)) == 1 for k in range(7, 7 + 16))
        assert lamp_code().find(seen)[0] == number
        assert seen[9:] + seen[:9] == lamp_bits(number)


def test_only_named_markers_become_lamps(cloud):
    first = with_lamps(cloud, {"P1": None}, Glow("lamp", strength=3.0, half_deg=20.0))
    both = with_lamps(first, {"P2": Blink((True, False), 0.01)})
    assert both.glows["P1"] == Glow("lamp", strength=3.0, half_deg=20.0)
    assert both.glows["P2"] == replace(LAMP, blink=Blink((True, False), 0.01))
    assert set(both.glows) == {"P1", "P2"}
    assert not cloud.glows
    assert both.model is cloud.model
    assert both.configuration_at is cloud.configuration_at


def test_lamps_that_cannot_be(cloud):
    with pytest.raises(InputError, match="marker 'P9': the scene has P1, P2, P3, P4, P5"):
        with_lamps(cloud, {"P9": None})
    many = build_cloud(duration_s=1.0, **BOX, n=76, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="76 lamps given; there are numbers for 75"):
        with_numbered_lamps(many, 100.0)
    with pytest.raises(InputError, match="frame_rate_hz = 0"):
        in_step((True,), 0.0)


def test_a_light_marker_tells_the_instant():
    scene = build_light_marker(duration_s=1.0, **BOX, rng=np.random.default_rng(0), bit_s=0.03, order=5)
    blink = scene.glows["light"].blink
    assert blink is not None
    assert blink.bits == m_sequence(5)
    t = 0.5
    bits = tuple(len(lit(blink, t + 0.03 * k, t + 0.03 * k + 1e-6)) == 1 for k in range(5))
    place = next(k for k in range(31) if (blink.bits * 2)[k : k + 5] == bits)
    assert -0.1 + 0.03 * place <= t < -0.1 + 0.03 * (place + 1)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Glow("neon"), "kind = 'neon' given; allowed: plain, retro, paper, lamp"),
        (lambda: Glow(strength=-0.1), "strength = -0.1 given"),
        (lambda: Glow(strength=float("nan")), "strength = nan given"),
        (lambda: Glow("retro", half_deg=0.0), "half_deg = 0 given"),
        (lambda: Glow("retro", half_deg=90.0), "half_deg = 90 given"),
        (lambda: Glow("retro", half_deg=float("nan")), "half_deg = nan given"),
        (lambda: Glow("retro", at_m=0.0), "at_m = 0 given"),
        (lambda: Glow(limb=1.1), "limb = 1.1 given"),
        (lambda: Glow(shade=-1.1), "shade = -1.1 given"),
        (lambda: Glow(shade_world=(0.0, 0.0, 0.0)), "a direction of 3 numbers"),
        (lambda: Glow(shade_world=(0.0, 1.0)), "a direction of 3 numbers"),  # type: ignore[arg-type]
        (lambda: Glow("retro", blink=Blink((True,), 1.0)), "only a lamp blinks"),
        (lambda: Blink((), 1.0), "at least one"),
        (lambda: Blink((True,), 0.0), "bit_s = 0 given"),
        (lambda: Blink((True,), 1.0, float("inf")), "start_s = inf given"),
        (lambda: lit(Blink((True,), 1.0), 1.0, 0.0), "t0 <= t1"),
        (lambda: lit(Blink((True,), 1.0), 0.0, float("inf")), "t0 <= t1"),
    ],
)
def test_what_cannot_be_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
