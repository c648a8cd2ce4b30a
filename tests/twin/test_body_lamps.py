"""Lamps on worn cameras: isotropic, blinking by the code of their number."""

import numpy as np
import pytest

from mosca.data.lamp_codes import lamp_bits
from twin.cameras.exposure.lighting import lit_during, scene_glows, target_light
from twin.scenes.actor import BodyLamp, build_actor
from twin.scenes.emission import ALL_SIDES_DEG, Glow
from twin.scenes.target_lamps import in_step


def scene(*lamps: BodyLamp):
    return build_actor(
        duration_s=0.5, box_center_m=np.array([0.0, 0.0, 1.25]), box_size_m=np.array([2.5, 2.5, 2.5]),
        rng=np.random.default_rng(1), markers=30, lamps=lamps,
    )  # fmt: skip


def test_a_worn_lamp_blinks_its_number():
    made = scene(BodyLamp("lamp/a", "head", (0.0, 0.3, 0.2), 0.02, in_step(lamp_bits(7), 50.0)))
    table = scene_glows(made)
    at = made.marker_names.index("lamp/a")
    for pulse in range(32):
        first = lit_during(table, pulse / 50.0, 1e-3).first[at]
        assert (first[1] > first[0]) == lamp_bits(7)[pulse % 16]


def test_a_worn_lamp_shines_to_all_sides_alike():
    made = scene(BodyLamp("lamp/a", "head", (0.0, 0.3, 0.2), 0.02, in_step(lamp_bits(0), 50.0)))
    at = made.marker_names.index("lamp/a")
    state = made.sampler().at(0.1)
    found = []
    for way in np.concatenate([np.eye(3), -np.eye(3)]):
        place = state.marker_xyz[at] + 0.7 * way
        light = target_light(scene_glows(made), 1e4, state.marker_xyz, state.marker_axis, place, np.eye(3))
        found.append(light.electrons[at])
    np.testing.assert_allclose(found, 1e4)


def test_a_lamp_without_a_code_is_a_marker_that_is_always_on():
    assert scene(BodyLamp("lamp/a", "head", (0.0, 0.3, 0.2))).glows == {}


def test_only_lamps_shine_to_all_sides():
    assert Glow("lamp", half_deg=ALL_SIDES_DEG).half_deg == 180.0
    for kind, half in (("retro", 180.0), ("lamp", 90.0), ("lamp", 200.0)):
        with pytest.raises(ValueError, match="of a lamp 180"):
            Glow(kind, half_deg=half)
