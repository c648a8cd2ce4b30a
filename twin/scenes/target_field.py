"""A test field before the cameras: targets at known positions on one rigid body, at rest or rotating."""

from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.target_file import read_target_file
from mosca.data.targets import TestField, half_width_m
from mosca.errors import InputError
from twin.scenes.emission import Glow
from twin.scenes.field_layout import FieldLayout, LaidOutField, lay_out_field
from twin.scenes.scene import Scene
from twin.scenes.target_motion import CarriedPath, SteppedPath, carried_body, carried_scene, standing
from twin.scenes.target_plate import RETRO, add_target, figures_of
from twin.scenes.world import Box, add_shape, new_stage, positive

BODY = "field"


def build_field(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    n: int = 100,
    layout: FieldLayout = "tower",
    dot_radius_m: float | None = None,
    target_file: Path | None = None,
    turn_rad_s: float = 0.0,
    glow: Glow = RETRO,
    floor: bool = True,
) -> Scene:
    """Return a test field of ``n`` coded targets that fills the working space, or the one in ``target_file``.

    ``layout`` and ``dot_radius_m``: see ``lay_out_field``. ``turn_rad_s``: rotation rate about the vertical through
    the box's middle [rad/s]; a rotating field is made small enough to stay inside.
    Targets are named by their numbers, "code/017", on the rigid body "field". Raises InputError for a file
    that cannot be used or a field that does not fit.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s})
    if not np.isfinite(turn_rad_s):
        raise InputError(f"turn_rad_s = {turn_rad_s} given; a finite number is wanted")
    if target_file is None:
        size = turning_room(box) if turn_rad_s else box.size
        laid = lay_out_field(size, rng, n=n, layout=layout, dot_radius_m=dot_radius_m)
        middle = np.zeros(3)
    else:
        laid = LaidOutField(read_field(Path(target_file)), ())
        middle = _middle_inside(laid.field, box, turns=turn_rad_s != 0, source=target_file)
    phase = float(rng.uniform(0, 2 * np.pi)) if turn_rad_s else 0.0
    path = standing(box.center, spin=turn_rad_s, phase=phase)
    return field_scene(laid, path, duration_s, origin=-middle, glow=glow, floor=floor)


def field_scene(
    laid: LaidOutField,
    path: CarriedPath | SteppedPath,
    duration_s: float,
    *,
    origin: Array,
    glow: Glow = RETRO,
    floor: bool = True,
) -> Scene:
    """Return the scene of a field on a body that moves along ``path``.

    ``origin`` (3,): the field's origin in the axes of that body [m]; the axes are parallel.
    """
    spec = new_stage(floor=floor)
    body = carried_body(spec, BODY)
    frame = body.add_body(name=f"{BODY}/origin", pos=np.asarray(origin))
    for k, shape in enumerate(laid.shapes):
        add_shape(frame, shape, name=f"{BODY}/block{k + 1}")
    for placed in laid.field.targets:
        add_target(frame, placed)
    figures = figures_of(laid.field.targets, glow)
    return carried_scene(spec, laid.field.names, path, duration_s, body=BODY, glow=glow, figures=figures)


def read_field(path: Path) -> TestField:
    """Return the test field that a target file describes; InputError for a file of another kind."""
    field = read_target_file(path)
    if not isinstance(field, TestField):
        raise InputError(f'{path}: a test field is wanted; set kind = "field"')
    return field


def turning_room(box: Box) -> Array:
    """Return the size (3,) [m] of the largest square prism that can rotate about the box's vertical axis."""
    edge = min(box.size[0], box.size[1]) / np.sqrt(2)
    return np.array([edge, edge, box.size[2]])


def _middle_inside(field: TestField, box: Box, *, turns: bool, source: Path) -> Array:
    """Return the field's middle (3,) in its axes; InputError where the field does not fit into the box."""
    reach = np.array([[half_width_m(placed.target)] for placed in field.targets])
    low, high = (field.positions - reach).min(axis=0), (field.positions + reach).max(axis=0)
    middle, needed = (low + high) / 2, high - low
    if turns:
        needed[:2] = 2 * (np.linalg.norm((field.positions - middle)[:, :2], axis=1) + reach[:, 0]).max()
    if (needed > box.size).any():
        raise InputError(
            f"{source}: the field takes {' x '.join(f'{e:.3g}' for e in needed)} m, the working space has "
            f"{' x '.join(f'{e:g}' for e in box.size)} m; enlarge box_size_m"
        )
    return np.asarray(middle)
