"""A drone before a test field: the scene for the rig, and the scene for its own camera.

There are two scenes of one flight. The rig, with short exposures under ring lights, sees the drone's markers and a
blinking lamp; printed targets stay dark there. The camera of the drone sees the evenly lit test field and the lamp.
Field axes: x right and y up for a viewer who faces the field, z towards the drone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.lamp_codes import m_sequence
from mosca.data.rig import Pose
from mosca.data.rotations import quaternion_from_rotation, rotation_from_vector
from mosca.data.target_codes import NUMBERS
from mosca.data.targets import CodedTarget, PlacedTarget, TestField
from mosca.errors import InputError
from twin.scenes.drone import MASS_KG, Flight, drone_spec
from twin.scenes.emission import ALL_SIDES_DEG, Blink, Glow
from twin.scenes.field_layout import LaidOutField
from twin.scenes.scene import Scene
from twin.scenes.target_field import field_scene
from twin.scenes.target_lamps import BLINKS_FROM_S, LIGHT_MARKER
from twin.scenes.target_motion import SteppedPath, standing
from twin.scenes.target_plate import PAPER, add_ball_at, add_target, figures_of
from twin.scenes.world import compiled

FACING_DRONE = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""world_from_field of a field at +x that faces -x."""
CODE_ORDER = 8
"""The lamp shows the maximum length sequence of this order: 255 bits without repetition."""


@dataclass(frozen=True, eq=False)
class SurveyField:
    """A test field that stands in the room, and the lamp beside it."""

    field: TestField
    """True positions, in the field's own axes."""
    world_from_field: Pose
    light_m: Array
    """(3,): middle of the lamp, the field's axes [m]."""
    light_diameter_m: float
    bit_s: float
    """Length of a bit of the lamp's code; the bits' edges lie both between exposures and within them."""

    @property
    def blink(self) -> Blink:
        """Return the lamp's code."""
        return Blink(m_sequence(CODE_ORDER), self.bit_s, BLINKS_FROM_S)


def upright_field(
    size_m: tuple[float, float], n: int, relief_m: float, dot_radius_m: float, rng: np.random.Generator
) -> TestField:
    """Return ``n`` coded targets in rows over ``size_m`` (width, height), up to half of ``relief_m`` off the plane.

    ``rng`` draws numbers and relief. InputError where they do not fit.
    """
    columns = int(np.ceil(np.sqrt(n * size_m[0] / size_m[1])))
    rows = int(np.ceil(n / columns))
    cell = np.array([size_m[0] / columns, size_m[1] / rows])
    plate = CodedTarget.of_dot(0, dot_radius_m).plate_m
    if plate > cell.min():
        raise InputError(
            f"dot_radius_m = {dot_radius_m:g}: {n} targets on {size_m[0]:g} x {size_m[1]:g} m leave {cell.min():.3g} "
            f"m each, and their plates take {plate:.3g} m; take smaller or fewer ones"
        )
    numbers = rng.permutation(NUMBERS)[:n]
    targets = []
    for k, number in enumerate(numbers.tolist()):
        row, column = divmod(k, columns)
        place = [(column + 0.5) * cell[0] - size_m[0] / 2, size_m[1] / 2 - (row + 0.5) * cell[1]]
        depth = relief_m * rng.uniform(-0.5, 0.5)
        target = CodedTarget.of_dot(number, dot_radius_m)
        targets.append(PlacedTarget(target.name, target, np.array([*place, depth])))
    return TestField(tuple(targets))


def seen_by_rig(flight: Flight, there: SurveyField, markers: Sequence[str], marker_diameter_m: float) -> Scene:
    """Return the flight with the lamp, without the field."""
    spec = drone_spec(MASS_KG, tuple(markers), marker_diameter_m, floor=True)
    lamp = spec.worldbody.add_body(name=LIGHT_MARKER)
    place = there.world_from_field.transform(there.light_m[None])[0]
    add_ball_at(lamp, LIGHT_MARKER, place, there.light_diameter_m)
    names = (*markers, LIGHT_MARKER)
    model, geoms = compiled(spec, names)
    glow = Glow("lamp", half_deg=ALL_SIDES_DEG, blink=there.blink)
    return replace(flight.scene, model=model, marker_names=names, marker_geoms=geoms, glows={LIGHT_MARKER: glow})


def seen_by_drone(flight: Flight, there: SurveyField, light_strength: float = 0.6) -> Scene:
    """Return the flight before the field and the lamp; the drone carries only its camera.

    ``light_strength``: the lamp's light over that of white paper, so that its image is not saturated.
    """
    spec = drone_spec(MASS_KG, (), 0.01, floor=True)
    pose = there.world_from_field
    body = spec.worldbody.add_body(
        name="field", pos=pose.translation, quat=quaternion_from_rotation(pose.rotation).tolist()
    )
    for placed in there.field.targets:
        add_target(body, placed)
    add_ball_at(body, LIGHT_MARKER, there.light_m, there.light_diameter_m)
    names = (*there.field.names, LIGHT_MARKER)
    model, geoms = compiled(spec, names)
    lamp = Glow("lamp", strength=light_strength, half_deg=ALL_SIDES_DEG, blink=there.blink)
    glows = {**dict.fromkeys(there.field.names, PAPER), LIGHT_MARKER: lamp}
    return replace(
        flight.scene,
        model=model,
        marker_names=names,
        marker_geoms=geoms,
        bodies={},
        figures=figures_of(there.field.targets, PAPER),
        glows=glows,
    )


def field_at_rest(there: SurveyField, duration_s: float) -> Scene:
    """Return a scene of the field alone, at rest in its place."""
    path = standing(there.world_from_field.translation, there.world_from_field.rotation)
    laid = LaidOutField(there.field, ())
    return field_scene(laid, path, duration_s, origin=np.zeros(3), glow=PAPER, floor=False)


def field_by_hand(
    field: TestField, first: Pose, stands: int, hold_s: float, *, lead_s: float, tilt_rad: float, shift_m: float,
    rng: np.random.Generator,
) -> Scene:  # fmt: skip
    """Return a field that rests at ``first`` (world_from_field), then at poses about it.

    It is turned by up to ``tilt_rad`` (about its normal by any angle) and moved by up to ``shift_m`` on each axis.
    """
    rows = []
    for k in range(stands):
        pose = first
        if k:
            lean, side = rng.uniform(0.4, 1.0) * tilt_rad, 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / (stands - 1)
            axis = np.array([np.cos(side), np.sin(side), 0.0])
            roll = 0.5 * np.pi * (k % 4)
            turn = rotation_from_vector(lean * axis) @ rotation_from_vector(np.array([0.0, 0.0, roll]))
            shift = rng.uniform(-1, 1, 3) * shift_m
            pose = Pose(first.rotation @ turn, first.translation + shift)
        rows.append(np.concatenate([pose.translation, quaternion_from_rotation(pose.rotation)]))
    path = SteppedPath(np.array(rows), hold_s, lead_s)
    laid = LaidOutField(field, ())
    return field_scene(laid, path, stands * hold_s, origin=np.zeros(3), glow=PAPER, floor=False)
