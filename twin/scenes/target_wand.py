"""Wand, scale bar and L-frame before the cameras.

Balls are on thin stems at a distance from the bar, so that the bar hides little of them from the front. Their
centres are exactly those of the target definition.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.targets import BallTarget, CodedTarget, ScaleBar, half_width_m
from mosca.data.wands import LFrame, Wand
from mosca.errors import InputError
from twin.scenes.emission import Glow
from twin.scenes.scene import Scene
from twin.scenes.target_motion import CarriedPath, carried_body, carried_by_hand, carried_scene, room_around, standing
from twin.scenes.target_plate import FILM_M, RETRO, add_ball_at, add_target, figures_of
from twin.scenes.world import Box, add_shape, block, capsule, new_stage, positive

BAR_RADIUS, STEM_RADIUS, STEM = 0.4, 0.15, 2.5
"""Radii of bar and stems and the bar's distance from the balls' centres, in diameters of a ball."""
_SWAY_RAD = 1.2
_DOWN = np.array([0.0, 0.0, -1.0])


def build_wand(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    wand: Wand | None = None,
    speed_mps: float = 0.8,
    turn_rad_s: float = 1.0,
    glow: Glow = RETRO,
    floor: bool = True,
) -> Scene:
    """Return ``wand`` (by default three balls, a third of the box long) waved through the working space.

    ``speed_mps``: rms speed of its middle; ``turn_rad_s``: rms rate of its tilt, and rate of its rotation about
    the vertical. ``rng`` draws the path. Markers wand/1, wand/2, ... of the rigid body "wand". Raises
    InputError where it does not fit into the box.
    """
    box = Box(box_center_m, box_size_m)
    wand = default_wand(box) if wand is None else wand
    centres = wand.positions()
    reach = float(np.abs(centres).max()) + wand.diameter_m / 2
    path = _waved(box, reach, "this wand", duration_s, speed_mps, turn_rad_s, rng)
    spec = new_stage(floor=floor)
    body = carried_body(spec, "wand")
    _add_balls(body, wand.names, centres, wand.diameter_m)
    _add_bar(body, centres[0], centres[-1], wand.diameter_m)
    return carried_scene(spec, wand.names, path, duration_s, body="wand", glow=glow)


def build_scale_bar(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    bar: ScaleBar | None = None,
    speed_mps: float = 0.4,
    turn_rad_s: float = 0.4,
    glow: Glow = RETRO,
    floor: bool = True,
) -> Scene:
    """Return ``bar`` (by default coded targets 0 and 1, a third of the box apart) waved through the working space.

    Other parameters as for ``build_wand``; the rigid body is "scale_bar". The bar is exactly as long as its
    certificate states. Raises InputError where it does not fit into the box.
    """
    box = Box(box_center_m, box_size_m)
    bar = default_scale_bar(box) if bar is None else bar
    width = 2 * max(map(half_width_m, bar.ends))
    reach = float(np.hypot(bar.length_m + width, width)) / 2
    path = _waved(box, reach, "this scale bar", duration_s, speed_mps, turn_rad_s, rng)
    spec = new_stage(floor=floor)
    body = carried_body(spec, "scale_bar")
    placed = bar.placed()
    for one in placed:
        add_target(body, one)
    if isinstance(bar.ends[0], BallTarget):
        _add_bar(body, placed[0].position, placed[1].position, bar.ends[0].diameter_m)
        for one in placed:
            _add_stem(body, one.position, bar.ends[0].diameter_m)
    else:
        thickness = width / 8
        plank = block((FILM_M + thickness / 2) * _DOWN, np.array([bar.length_m + width, width, thickness]))
        add_shape(body, plank, name="scale_bar/plank")
    figures = figures_of(placed, glow)
    return carried_scene(spec, bar.names, path, duration_s, body="scale_bar", glow=glow, figures=figures)


def build_l_frame(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    l_frame: LFrame | None = None,
    azimuth_rad: float = 0.0,
    glow: Glow = RETRO,
    floor: bool = True,
) -> Scene:
    """Return ``l_frame`` standing at the bottom of the working space, its middle in the box's middle.

    ``azimuth_rad``: rotation about the vertical. Markers are named "l_frame/..." on the rigid body "l_frame", whose
    pose in the world is to be estimated. Raises InputError where it does not fit.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s})
    frame = default_l_frame(box) if l_frame is None else l_frame
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = frame.positions @ turn.T
    low = turned.min(axis=0) - frame.diameter_m * np.array([0.5, 0.5, STEM + BAR_RADIUS])
    high = turned.max(axis=0) + frame.diameter_m / 2
    if (high - low > box.size).any():
        raise InputError(
            f"box_size_m = {box.size.tolist()}: too small for this L-frame, which takes "
            f"{' x '.join(f'{e:.3g}' for e in high - low)} m; enlarge the box"
        )
    origin = box.center - (low + high) / 2
    origin[2] = box.low[2] - low[2]
    spec = new_stage(floor=floor)
    body = carried_body(spec, "l_frame")
    names = tuple(f"l_frame/{name}" for name in frame.names)
    _add_balls(body, names, frame.positions, frame.diameter_m)
    for position in frame.positions[1:]:
        _add_bar(body, frame.positions[0], position, frame.diameter_m)
    return carried_scene(spec, names, standing(origin, turn), duration_s, body="l_frame", glow=glow)


def default_wand(box: Box) -> Wand:
    """Return three balls at different distances, a third of the box's shortest edge from end to end."""
    length = float(box.size.min()) / 3
    return Wand((0.0, 0.4 * length, length), 0.04 * length)


def default_scale_bar(box: Box) -> ScaleBar:
    """Return coded targets 0 and 1, a third of the box's shortest edge apart, known to 10 millionths."""
    length = float(box.size.min()) / 3
    ends = CodedTarget.of_dot(0, 0.02 * length), CodedTarget.of_dot(1, 0.02 * length)
    return ScaleBar(length, 1e-5 * length, ends)


def default_l_frame(box: Box) -> LFrame:
    """Return four balls: origin, two on the x arm (a third of the box's shortest edge), one on the y arm."""
    arm = float(box.size.min()) / 3
    places = arm * np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.7, 0.0]])
    return LFrame(("origin", "x1", "x2", "y"), places, 0.04 * arm)


def _waved(
    box: Box,
    reach: float,
    what: str,
    duration_s: float,
    speed_mps: float,
    turn_rad_s: float,
    rng: np.random.Generator,
) -> CarriedPath:
    positive({"duration_s": duration_s, "speed_mps": speed_mps, "turn_rad_s": turn_rad_s})
    return carried_by_hand(
        room_around(box, reach, what),
        center=box.center,
        rotation=np.eye(3),
        sway_rad=np.full(3, _SWAY_RAD),
        speed_mps=speed_mps,
        turn_rad_s=turn_rad_s,
        spin=turn_rad_s,
        rng=rng,
    )


def _add_balls(body: mujoco.MjsBody, names: Sequence[str], centres: Array, diameter: float) -> None:
    for name, centre in zip(names, centres, strict=True):
        add_ball_at(body, name, centre, diameter)
        _add_stem(body, centre, diameter)


def _add_stem(body: mujoco.MjsBody, centre: Array, diameter: float) -> None:
    top, foot = centre + 0.5 * diameter * _DOWN, centre + STEM * diameter * _DOWN
    add_shape(body, capsule(top, foot, STEM_RADIUS * diameter))


def _add_bar(body: mujoco.MjsBody, start: Array, end: Array, diameter: float) -> None:
    below = STEM * diameter * _DOWN
    add_shape(body, capsule(start + below, end + below, BAR_RADIUS * diameter))
