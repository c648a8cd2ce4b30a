"""Lamps: markers that shine by themselves, blink their number, or blink the time."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.lamp_codes import LAMP_NUMBERS, lamp_bits, m_sequence
from mosca.errors import InputError
from twin.scenes.emission import ALL_SIDES_DEG, Blink, Glow
from twin.scenes.scene import Scene
from twin.scenes.target_motion import carried_body, carried_by_hand, carried_scene, room_around
from twin.scenes.target_plate import add_ball_at
from twin.scenes.world import Box, new_stage, positive

LAMP = Glow("lamp", half_deg=60.0)
ALL_ROUND = Glow("lamp", half_deg=ALL_SIDES_DEG)
LIGHT_MARKER = "light"
LEAD = 0.25
"""Share of a frame's period by which a bit begins before the pulse; exposures up to the rest lie within one bit."""
BLINKS_FROM_S = -0.1
"""Session time from which the light marker blinks [s]: scenes are defined from there."""
_SIZE_SHARE = 0.012  # of the box's shortest edge: the light marker's default diameter


def in_step(bits: Sequence[bool], frame_rate_hz: float, frames_per_bit: int = 1) -> Blink:
    """Return the blink that shows ``bits`` in step with the pulses, the first one at pulse 0.

    A triggered camera sees each lamp on or off for ``frames_per_bit`` frames, never half lit, if its exposure and
    delays stay within 3/4 of a period. Raises InputError for a rate or a count of 0.
    """
    positive({"frame_rate_hz": frame_rate_hz, "frames_per_bit": frames_per_bit})
    return Blink(tuple(bits), frames_per_bit / frame_rate_hz, -LEAD / frame_rate_hz)


def with_lamps(scene: Scene, blinks: Mapping[str, Blink | None], glow: Glow = LAMP) -> Scene:
    """Return ``scene`` with the markers named in ``blinks`` as lamps that blink with these codes (None: always on).

    ``glow``: a lamp's strength and angle. Other markers are unchanged. InputError for an unknown marker.
    """
    for name in blinks:
        if name not in scene.marker_names:
            raise InputError(f"marker '{name}': the scene has {', '.join(scene.marker_names)}")
    lamps = {name: replace(glow, kind="lamp", blink=blink) for name, blink in blinks.items()}
    return replace(scene, glows={**scene.glows, **lamps})


def with_numbered_lamps(
    scene: Scene,
    frame_rate_hz: float,
    *,
    names: Sequence[str] | None = None,
    frames_per_bit: int = 1,
    glow: Glow = LAMP,
) -> Scene:
    """Return ``scene`` with its markers (or those in ``names``) as lamps that blink 0, 1, ... in that order.

    ``mosca.data.lamp_codes`` has the codes of 75 numbers. Raises InputError for more lamps or an unknown one.
    """
    lamps = scene.marker_names if names is None else tuple(names)
    if len(lamps) > LAMP_NUMBERS:
        raise InputError(f"{len(lamps)} lamps given; there are numbers for {LAMP_NUMBERS}: name fewer markers")
    blinks = {name: in_step(lamp_bits(k), frame_rate_hz, frames_per_bit) for k, name in enumerate(lamps)}
    return with_lamps(scene, blinks, glow)


def build_light_marker(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    bit_s: float = 0.04,
    order: int = 8,
    diameter_m: float | None = None,
    speed_mps: float = 0.3,
    glow: Glow = ALL_ROUND,
    floor: bool = True,
) -> Scene:
    """Return one lamp, "light", that shines to all sides, is waved through the working space and blinks the time.

    From session time -0.1 s on it shows the maximum length sequence of ``order`` (2^order - 1 bits of ``bit_s``; by
    default 10 s): any ``order`` successive bits identify the instant, for any clock of a camera.
    ``diameter_m``: by default 1.2 % of the box's shortest edge. Raises InputError where it does not fit.
    """
    box = Box(box_center_m, box_size_m)
    diameter = _SIZE_SHARE * float(box.size.min()) if diameter_m is None else diameter_m
    positive({"duration_s": duration_s, "bit_s": bit_s, "diameter_m": diameter, "speed_mps": speed_mps})
    blink = Blink(m_sequence(order), bit_s, BLINKS_FROM_S)
    path = carried_by_hand(
        room_around(box, diameter / 2, "this lamp"),
        center=box.center,
        rotation=np.eye(3),
        sway_rad=np.zeros(3),
        speed_mps=speed_mps,
        turn_rad_s=0.0,
        spin=0.0,
        rng=rng,
    )
    spec = new_stage(floor=floor)
    body = carried_body(spec, LIGHT_MARKER)
    add_ball_at(body, LIGHT_MARKER, np.zeros(3), diameter)
    scene = carried_scene(spec, (LIGHT_MARKER,), path, duration_s, body=LIGHT_MARKER, glow=glow)
    return with_lamps(scene, {LIGHT_MARKER: blink}, glow)
