"""A quadrotor of the size and mass of the Parrot AR.Drone 2.0, flown along a path in the working space.

Size 0.515 x 0.515 m, mass 0.366 kg and speed 0.5 m/s are from the Mosca paper, table 3. The physics (gravity, four
rotors, gusts, the controller) runs once when the scene is built; after that the flight is a function of
time. Body axes: x forward, y left, z up, origin in the middle between the motors.
"""

from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.scenes.flight import PHYSICS_STEP_S, FlightPath, Reference, fly, plan_flight
from twin.scenes.live_flight import Bounds, LiveFlight, Steering
from twin.scenes.paths import step_path
from twin.scenes.scene import Scene
from twin.scenes.world import (
    Box,
    Shape,
    add_ball_marker,
    add_shape,
    block,
    capsule,
    compiled,
    cylinder,
    ellipsoid,
    new_stage,
    outermost,
    positive,
)

MASS_KG = 0.366
EDGE_M = 0.515
_MOTOR_M = 0.127  # each motor's x and y
_TUBE_M = 0.005  # radius of the hull's rim
_RIM_M = EDGE_M / 2 - _MOTOR_M - _TUBE_M  # radius of the rim's middle line
_RIM_PIECES = 12
_YAW_ARM_M = 0.016  # rotor drag moment over thrust
LOWEST_M = 0.05
"""Height of the body's origin at which the lowest parts touch the floor, rounded up."""
_MARGIN_M = np.array([0.45, 0.45, 0.15])  # half the drone's diagonal and the tracking error

# Positions of the markers: a ray from the first point along the direction, in body axes. D1-D5 below, as in
# the Mosca paper's figure 5, the others above; the set has no symmetry.
_MARKER_RAYS: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((_MOTOR_M, _MOTOR_M, 0.0), (0, 0, -1)),
    ((0.078, -0.078, 0.0), (0, 0, -1)),
    ((-_MOTOR_M - _RIM_M, -_MOTOR_M, 0.0), (-0.2, 0, -1)),
    ((-0.171, 0.24, 0.0), (0.0, 0.2, -1)),
    ((0.095, 0.0, 0.0), (0.2, 0, -1)),
    ((_MOTOR_M, -_MOTOR_M - _RIM_M, 0.0), (0, -0.3, 1)),
    ((-0.05, 0.012, 0.0), (0, 0, 1)),
    ((-0.088, 0.088, 0.0), (0, 0, 1)),
)
FEWEST_MARKERS, MOST_MARKERS = 5, len(_MARKER_RAYS)


@dataclass(frozen=True, eq=False)
class Flight:
    """A scene with a drone, and the reference path of its flight."""

    scene: Scene
    reference: Reference
    live: LiveFlight | None = None
    """The flight in progress where a pilot steers it; None where it was flown beforehand."""


def build_drone(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    path: FlightPath = "figure_eight",
    speed_mps: float = 0.5,
    gust_n: float = 0.02,
    mass_kg: float = MASS_KG,
    markers: int = MOST_MARKERS,
    marker_diameter_m: float = 0.016,
    floor: bool = True,
    pilot: Steering | None = None,
) -> Flight:
    """Return a drone that flies ``path`` in the working space, and the reference path.

    Raises InputError where the box is too small or the speed is too high for the path's bends.

    Parameters
    ----------
    duration_s
        Length of the scene.
    box_center_m, box_size_m
        (3,) the working space.
    rng
        Draws start, gusts and waypoints.
    path
        "figure_eight", "circle", "waypoints", "hover" or "steps".
    speed_mps
        Speed along the path.
    gust_n
        Rms force of a smooth gust on each axis [N].
    mass_kg
        Mass of the drone.
    markers, marker_diameter_m
        5 to 8 balls named D1, D2, ... of the rigid body "drone".
    floor
        Whether there is a floor.
    pilot
        Steers it while it is filmed, in place of the controller that uses the truth; a crash ends the flight.
    """
    box = Box(box_center_m, box_size_m)
    positive(
        {"duration_s": duration_s, "speed_mps": speed_mps, "mass_kg": mass_kg, "marker_diameter_m": marker_diameter_m}
    )
    if not 0 <= gust_n <= 0.2 * mass_kg * 9.81:
        raise InputError(f"gust_n = {gust_n} given; 0 to a fifth of the weight ({0.2 * mass_kg * 9.81:.2f} N)")
    if not FEWEST_MARKERS <= markers <= MOST_MARKERS:
        raise InputError(f"markers = {markers} given; {FEWEST_MARKERS} to {MOST_MARKERS} fit on the drone")
    reference = plan_flight(path, box.center, box.half_inside(_MARGIN_M, "a flying drone"), speed_mps, rng)
    names = tuple(f"D{k + 1}" for k in range(markers))
    model, geoms = compiled(drone_spec(mass_kg, names, marker_diameter_m, floor=floor), names)
    if pilot is not None:
        bounds = Bounds(box.center, box.size / 2, LOWEST_M if floor else None)
        live = LiveFlight(model, reference, pilot, bounds, gust_n, -0.1, rng)
        return Flight(Scene(model, names, geoms, live, duration_s, {"drone": names}), reference, live)
    first, qpos, qvel = fly(model, reference, -0.1, duration_s + 0.1, gust_n, rng)
    flown = step_path(model, first, PHYSICS_STEP_S, qpos, qvel)
    return Flight(Scene(model, names, geoms, flown, duration_s, {"drone": names}), reference)


def drone_spec(mass_kg: float, names: tuple[str, ...], diameter: float, *, floor: bool) -> mujoco.MjSpec:
    """Return the drone, body "drone", with ball markers ``names`` of ``diameter`` [m] and four rotors."""
    spec = new_stage(floor=floor)
    spec.option.timestep = PHYSICS_STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    body = spec.worldbody.add_body(name="drone")
    body.add_freejoint(name="drone")
    weighed = _airframe()
    total = sum(share for _, share in weighed)
    for shape, share in weighed:
        add_shape(body, shape, mass=mass_kg * share / total)
    shapes = [shape for shape, _ in weighed]
    for name, (origin, direction) in zip(names, _MARKER_RAYS, strict=False):
        surface, normal = outermost(shapes, np.array(origin), np.array(direction, dtype=np.float64))
        add_ball_marker(body, name, surface, normal, diameter)
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
        site = body.add_site(name=f"rotor{k}", pos=[x * _MOTOR_M, y * _MOTOR_M, 0.02])
        actuator = spec.add_actuator(name=f"rotor{k}", trntype=mujoco.mjtTrn.mjTRN_SITE, target=site.name)
        # Neighbouring rotors turn against each other: their drag moments steer the yaw.
        actuator.gear = [0, 0, 1, 0, 0, _YAW_ARM_M * (1 if k % 2 else -1)]
        actuator.ctrllimited = True
        actuator.ctrlrange = [0, mass_kg * 9.81 / 2]
    return spec


def _airframe() -> list[tuple[Shape, float]]:
    """Return the airframe's shapes with their shares of the mass."""
    parts: list[tuple[Shape, float]] = [
        (ellipsoid(np.zeros(3), np.array([0.13, 0.045, 0.03])), 0.30),
        (block(np.array([0.0, 0.0, 0.032]), np.array([0.13, 0.045, 0.02])), 0.28),
    ]
    for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
        motor = _MOTOR_M * np.array([x, y, 0.0])
        parts.append((capsule(np.zeros(3), motor, 0.006), 0.02))
        parts.append((cylinder(motor - [0, 0, 0.02], motor + [0, 0, 0.02], 0.014), 0.065))
        angles = np.linspace(0, 2 * np.pi, _RIM_PIECES + 1)
        rim = motor + _RIM_M * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
        parts += [(capsule(a, b, _TUBE_M), 0.02 / _RIM_PIECES) for a, b in pairwise(rim)]
    return parts
