"""Light from targets to a camera: half angles, inverse squares and codes, by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.cameras.exposure.lighting import ALWAYS, glow_table, lit_during, target_light
from twin.scenes.emission import Blink, Glow

SIGNAL = 1000.0
FLAT, BALL = False, True


def electrons(glow: Glow, degrees: float, distance: float = 2.0, ball: bool = FLAT) -> float:
    """Electrons of a target at the origin facing +z, seen from ``degrees`` off its normal."""
    angle = math.radians(degrees)
    camera = distance * np.array([math.sin(angle), 0.0, math.cos(angle)])
    axis = np.array([[0.0, 0.0, 1.0]])
    table = glow_table([glow], np.array([ball]))
    return float(target_light(table, SIGNAL, np.zeros((1, 3)), axis, camera, np.eye(3)).electrons[0])


def test_a_plain_target_is_the_same_from_everywhere():
    for degrees, distance in ((0, 1), (60, 2), (89, 7), (150, 3)):
        assert electrons(Glow(strength=0.5), degrees, distance) == 500.0


@pytest.mark.parametrize("kind", ["retro", "lamp"])
@pytest.mark.parametrize("half", [15.0, 45.0, 60.0, 80.0])
def test_a_lobe_has_one_half_at_its_half_angle_and_nothing_at_90_degrees(kind, half):
    glow = Glow(kind, half_deg=half)
    assert electrons(glow, 0.0) == pytest.approx(1000.0, rel=1e-12)
    assert electrons(glow, half) == pytest.approx(500.0, rel=1e-12)
    assert electrons(glow, -half) == pytest.approx(500.0, rel=1e-12)
    assert electrons(glow, 90.0) == pytest.approx(0.0, abs=1e-1)
    assert electrons(glow, 90.001) == electrons(glow, 170.0) == 0.0


def test_half_at_60_degrees_is_the_cosine_and_half_at_45_its_square():
    assert electrons(Glow("lamp", half_deg=60.0), 30.0) == pytest.approx(1000 * math.sqrt(3) / 2, rel=1e-12)
    assert electrons(Glow("retro", half_deg=45.0), 30.0) == pytest.approx(750.0, rel=1e-12)


def test_ring_light_falls_with_the_square_of_the_distance_and_a_lamp_does_not_know_it():
    retro, lamp = Glow("retro", at_m=2.0), Glow("lamp", at_m=2.0)
    assert [electrons(retro, 0, d) for d in (1.0, 2.0, 4.0)] == pytest.approx([4000.0, 1000.0, 250.0], rel=1e-12)
    assert electrons(Glow("retro", at_m=None), 0, 4.0) == pytest.approx(1000.0)
    assert [electrons(lamp, 0, d) for d in (1.0, 4.0)] == pytest.approx([1000.0, 1000.0])
    assert [electrons(Glow("paper", at_m=2.0), 0, d) for d in (1.0, 4.0)] == [1000.0, 1000.0]


def test_a_tape_is_even_up_to_an_angle_and_ends_at_another():
    tape = Glow("retro", even_deg=50.0, half_deg=68.5)
    # a smooth step, 3 s^2 - 2 s^3, from 87 to 50 degrees: 27/32 at a quarter of the way, a half in the middle
    seen = [electrons(tape, angle) for angle in (0.0, 50.0, 59.25, 68.5, 77.75, 87.0, 89.0)]
    assert seen == pytest.approx([1000.0, 1000.0, 27000 / 32, 500.0, 5000 / 32, 0.0, 0.0], abs=1e-9)
    # of a ball all angles are seen at once: the renderer takes the law over
    assert electrons(tape, 80.0, ball=BALL) == pytest.approx(1000.0)


def test_a_tape_falls_with_the_observation_angle():
    # 0.04 m beside the lens, 2 m away: 0.02 rad; 1/e at 0.02 rad; at 4 m half the angle
    glow = Glow("retro", at_m=2.0, ring_m=0.04, lobe_deg=math.degrees(0.02))
    assert electrons(glow, 0.0, 2.0) == pytest.approx(1000.0)
    assert electrons(glow, 0.0, 4.0) == pytest.approx(1000.0 / 4 * math.exp(-0.25) / math.exp(-1.0))


def test_a_disc_under_a_ring_light_is_brighter_where_it_is_nearer():
    # turned by 45 degrees, 3 m ahead: its rim of 0.05 m comes nearer by 0.05 sin(45)
    axis = np.array([[math.sqrt(0.5), 0.0, -math.sqrt(0.5)]])
    place, ahead = np.array([[0.0, 0.0, 3.0]]), (np.zeros(3), np.eye(3))
    up = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5)])  # in the disc, away from the lens
    squared = [9.0 + 0.05**2 + side * 6.0 * 0.05 * math.sqrt(0.5) for side in (-1, 1)]
    for at_m, expected in ((2.0, (1 / squared[0] - 1 / squared[1]) * 9 / 2), (None, 0.0)):
        # Lambert's law would add the entrance angle: an even tape has none
        table = glow_table([Glow("retro", at_m=at_m, even_deg=80.0, half_deg=85.0)], np.array([FLAT]))
        light = target_light(table, SIGNAL, place, axis, *ahead, radius=np.array([0.05]))
        assert light.shade[0] @ up == pytest.approx(-expected, rel=1e-3, abs=1e-12)
        assert light.shade[0] @ axis[0] == pytest.approx(0.0, abs=1e-12)


def test_lamps_fall_off_the_cameras_axis():
    table = glow_table([Glow("retro", lamp_half_deg=60.0)], np.array([BALL]))
    x = 3.0 * math.tan(math.radians(30.0))
    light = target_light(table, SIGNAL, np.array([[x, 0.0, 3.0]]), np.eye(3)[2:], np.zeros(3), np.eye(3))
    assert light.electrons[0] == pytest.approx(SIGNAL * math.sqrt(3) / 2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "lamp", "even_deg": 20.0},
        {"kind": "retro", "even_deg": 50.0, "half_deg": 45.0},
        {"kind": "retro", "ring_m": 0.04},
        {"kind": "retro", "lamp_half_deg": 90.0},
    ],
)
def test_impossible_tapes_are_refused(wrong):
    with pytest.raises(ValueError, match=r"given|wanted"):
        Glow(**wrong)


def test_paper_is_even_in_front_and_dark_behind_but_a_ball_has_no_behind():
    assert electrons(Glow("paper"), 85.0) == 1000.0
    assert electrons(Glow("paper"), 95.0) == 0.0
    assert electrons(Glow("paper"), 120.0, ball=BALL) == 1000.0


def test_a_retro_ball_has_its_lobe_as_limb_darkening():
    glows = [Glow("retro", half_deg=60.0), Glow("retro", half_deg=75.0), Glow("retro", half_deg=30.0)]
    table = glow_table([*glows, Glow(limb=0.3), Glow("retro", half_deg=75.0, limb=0.5)], np.ones(5, dtype=bool))
    # brightness 1 - limb (1 - cos a): a half at 60 degrees with limb 1, at 75 degrees with 0.5 / (1 - 0.258819)
    lobe = 0.5 / (1 - 0.2588190451)
    np.testing.assert_allclose(table.limb, [1.0, lobe, 1.0, 0.3, 1 - 0.5 * (1 - lobe)], rtol=1e-9)
    assert electrons(glows[1], 130.0, ball=BALL) == 1000.0
    assert glow_table([glows[0]], np.array([FLAT])).limb[0] == 0.0


def test_shade_points_the_same_way_in_the_world():
    # a camera with its axis along +y: its x is the world's x, its y is down
    looking = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    table = glow_table([Glow(shade=0.4, shade_world=(0, 0, 5.0))], np.array([BALL]))
    light = target_light(table, SIGNAL, np.zeros((1, 3)), np.eye(3)[2:], np.array([0, -3.0, 0]), looking)
    np.testing.assert_allclose(light.shade, [[0.0, -0.4, 0.0]], atol=1e-15)


def when_lit(blink: Blink, opening: float, span: float) -> list[tuple[float, float]]:
    lit = lit_during(glow_table([Glow("lamp", blink=blink)], np.array([BALL])), opening, span)
    return [tuple(interval) for interval in (*lit.first, *lit.again_s)]


def test_a_code_by_hand():
    blink = Blink((True, False, True, True), 1e-3)
    assert when_lit(blink, 0.0, 4e-3) == [pytest.approx((0.0, 1e-3)), pytest.approx((2e-3, 4e-3))]
    assert when_lit(blink, 0.5e-3, 1e-3) == [pytest.approx((0.0, 0.5e-3))]
    assert when_lit(blink, 1.2e-3, 0.5e-3) == [(0.0, 0.0)]
    assert when_lit(blink, 2.2e-3, 1.5e-3) == [ALWAYS]
    # the code's end joins its beginning; before its start the lamp is dark
    assert when_lit(blink, 2.5e-3, 3e-3) == [pytest.approx((0.0, 2.5e-3))]
    assert when_lit(Blink((True,), 1e-3, start_s=5e-3), 0.0, 6e-3) == [pytest.approx((5e-3, 6e-3))]


@given(st.lists(st.booleans(), min_size=1, max_size=9), st.integers(1, 40), st.integers(0, 3000), st.integers(1, 400))
def test_light_of_a_code_is_its_share_of_the_span(bits, bit_us, opening_us, span_us):
    got = when_lit(Blink(tuple(bits), bit_us * 1e-6), opening_us * 1e-6, span_us * 1e-6)
    on = sum(bits[us // bit_us % len(bits)] for us in range(opening_us, opening_us + span_us))
    seconds = sum(min(b, span_us * 1e-6) - max(a, 0.0) for a, b in got)
    assert seconds == pytest.approx(on * 1e-6, abs=1e-11)


def test_a_lamp_that_shines_twice_is_given_twice():
    twice = Glow("lamp", blink=Blink((True, False), 1e-3))
    dark = Glow("lamp", blink=Blink((False,), 1e-3))
    table = glow_table([Glow("retro"), twice, Glow("lamp"), dark, Glow("paper")], np.ones(5, dtype=bool))
    lit = lit_during(table, 0.0, 5e-3, strobe_s=(1e-4, 2e-4))
    expected = [(1e-4, 2e-4), (0.0, 1e-3), ALWAYS, (0.0, 0.0), ALWAYS]
    np.testing.assert_allclose(lit.first, expected)
    assert lit.again.tolist() == [1, 1]
    np.testing.assert_allclose(lit.again_s, [(2e-3, 3e-3), (4e-3, 5e-3)])
    assert (lit_during(table, 0.0, 1e-4).first[0] == ALWAYS).all()
