"""A four-wheeled skid-steered robot like the Mosca paper's Hercules, with 13 flat targets on its deck.

It is 0.36 m long and 0.32 m wide and weighs 4 kg. It is simulated with contact physics: turning drags its wheels
sideways over the floor, so that its dynamics are not trivial to identify. Body axes: x forward, y left, z up, origin
on the floor under the deck's centre.

Targets (paper, figure 8): #8 in the centre; #6 and #10 on the x axis, #3 and #13 on the y axis. The paper
has no drawing of the others; here they are in rows 1-5, 6-10 and 11-13, so that the pattern has no symmetry.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.scenes.driving import (
    FREE_SPEED_RAD_S,
    FULL_PWM,
    HALF_DIAGONAL_M,
    PHYSICS_STEP_S,
    STALL_TORQUE_N_M,
    drive,
    given,
    noise,
)
from twin.scenes.paths import step_path
from twin.scenes.scene import UNSEEN_GROUP, Scene
from twin.scenes.world import (
    Box,
    add_flat_target,
    add_shape,
    block,
    compiled,
    cylinder,
    ellipsoid,
    new_stage,
    positive,
)

MASS_KG = 4.0
LENGTH_M, WIDTH_M = 0.36, 0.32
_WHEEL_RADIUS_M, _WHEEL_WIDTH_M, _WHEEL_MASS_KG = 0.0675, 0.04, 0.25
_AXLE_X_M = LENGTH_M / 2 - _WHEEL_RADIUS_M
_AXLE_Y_M = WIDTH_M / 2 - _WHEEL_WIDTH_M / 2
_DECK_TOP_M = 0.15
_DECK_M = np.array([0.34, 0.25, 0.006])
_FRICTION = 0.5
_ROTOR_INERTIA_KG_M2 = 0.01  # of motor and gear, seen at the wheel
_TURN_BACK_M = 0.15
"""Safety margin on the distance from the box's side at which the robot's direction is reversed."""

TARGET_XY_M: tuple[tuple[float, float], ...] = (
    *((x, 0.10) for x in (-0.15, -0.075, 0.0, 0.075, 0.15)),
    *((x, 0.0) for x in (-0.15, -0.075, 0.0, 0.075, 0.15)),
    *((x, -0.10) for x in (-0.15, -0.075, 0.0)),
)
"""Targets #1..#13 on the deck, body axes [m]."""
DECK_CENTRE_M = (0.0, 0.0, _DECK_TOP_M)
"""Centre of target #8, body axes."""


def build_robot(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    average_pwm: float = 30.0,
    difference_pwm: float = 60.0,
    hold_s: float = 0.2,
    target_diameter_m: float = 0.03,
    commands: Sequence[tuple[int, str]] | None = None,
    heading_rad: float | None = None,
) -> Scene:
    """Return a robot on the floor z = 0 that white noise, or ``commands``, drive about the working space.

    The scene's commands hold pwm_average, pwm_difference, pwm_left, pwm_right from 0 s on. Raises InputError that
    names the fault.

    Parameters
    ----------
    duration_s, box_center_m, box_size_m
        Length of the scene, and working space ((3,) each).
    rng
        Draws the first heading and the noise.
    average_pwm, difference_pwm
        Amplitudes a_m and d_m of the noise, out of 255. Near the side of the box, an average that would drive the
        robot out is negated (see ``driving.noise``).
    hold_s
        Duration of each command.
    target_diameter_m
        Diameter of the flat targets T1..T13 of the rigid body "robot".
    commands
        Session time [ns] and line of text of each command (see ``driving.given``), instead of noise.
    heading_rad
        Angle of the robot's x axis to that of the world at the start.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s, "hold_s": hold_s, "target_diameter_m": target_diameter_m})
    for name, value in (("average_pwm", average_pwm), ("difference_pwm", difference_pwm)):
        if not 0 <= value <= FULL_PWM:
            raise InputError(f"{name} = {value} given; 0 to {FULL_PWM:g} wanted")
    if hold_s < PHYSICS_STEP_S:
        raise InputError(f"hold_s = {hold_s} given; at least the physics step of {PHYSICS_STEP_S} s wanted")
    if target_diameter_m > 0.06:
        raise InputError(f"target_diameter_m = {target_diameter_m} given; up to 0.06 m do not touch on the deck")
    names = tuple(f"T{k + 1}" for k in range(len(TARGET_XY_M)))
    model, geoms = compiled(_specify(names, target_diameter_m), names)
    drawn_rad = rng.uniform(0, 2 * np.pi)
    if commands is not None:
        box.half_inside(np.array([HALF_DIAGONAL_M, HALF_DIAGONAL_M, 0.0]), "this robot")
        sides = given(commands, box)
    else:
        # The largest distance that the robot can move while it obeys one command.
        overrun = (average_pwm / FULL_PWM) * FREE_SPEED_RAD_S * _WHEEL_RADIUS_M * hold_s
        margin = HALF_DIAGONAL_M + _TURN_BACK_M + overrun
        box.half_inside(np.array([margin, margin, 0.0]), "a robot that can turn back")
        pwm = {"average_pwm": average_pwm, "difference_pwm": difference_pwm, "hold_s": hold_s}
        sides = noise(box, margin, **pwm, rng=rng)
    run = drive(model, box.center[:2], drawn_rad if heading_rad is None else heading_rad, duration_s, sides)
    driven = step_path(model, run.first_s, PHYSICS_STEP_S, run.qpos, run.qvel)
    return Scene(model, names, geoms, driven, duration_s, {"robot": names}, run.commands)


def _specify(names: tuple[str, ...], diameter: float) -> mujoco.MjSpec:
    spec = new_stage(floor=True)
    spec.option.timestep = PHYSICS_STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    body = spec.worldbody.add_body(name="robot")
    body.add_freejoint(name="robot")
    chassis = block(np.array([0, 0, 0.09]), np.array([LENGTH_M - 0.04, 2 * _AXLE_Y_M - 0.06, 0.07]))
    deck = block(np.array([0, 0, _DECK_TOP_M - _DECK_M[2] / 2]), _DECK_M)
    add_shape(body, chassis, name="chassis", mass=MASS_KG - 4 * _WHEEL_MASS_KG - 0.4)
    add_shape(body, deck, name="deck", mass=0.4)
    for x, y in ((0.1, 0.09), (0.1, -0.09), (-0.1, 0.09), (-0.1, -0.09)):
        add_shape(body, cylinder(np.array([x, y, 0.12]), np.array([x, y, 0.145]), 0.006), mass=0.0)
    for name, (x, y) in zip(names, TARGET_XY_M, strict=True):
        add_flat_target(body, name, np.array([x, y, _DECK_TOP_M]), np.array([0.0, 0.0, 1.0]), diameter)
    for side, y in (("left", _AXLE_Y_M), ("right", -_AXLE_Y_M)):
        for end, x in (("front", _AXLE_X_M), ("rear", -_AXLE_X_M)):
            _add_wheel(spec, body, f"{side}_{end}", x, y)
    return spec


def _add_wheel(spec: mujoco.MjSpec, robot: mujoco.MjsBody, name: str, x: float, y: float) -> None:
    wheel = robot.add_body(name=name, pos=[x, y, _WHEEL_RADIUS_M])
    hinge = wheel.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    hinge.armature = _ROTOR_INERTIA_KG_M2
    axle = np.array([0.0, _WHEEL_WIDTH_M / 2, 0.0])
    add_shape(wheel, cylinder(-axle, axle, _WHEEL_RADIUS_M), mass=_WHEEL_MASS_KG)
    # A ball inside the wheel touches the floor in one steady point; a rolling cylinder does not.
    tread = ellipsoid(np.zeros(3), np.full(3, _WHEEL_RADIUS_M))
    geom = add_shape(wheel, tread, name=name, solid=True, mass=0.0)
    geom.type, geom.group = mujoco.mjtGeom.mjGEOM_SPHERE, UNSEEN_GROUP
    geom.friction = [_FRICTION, 0.005, 0.0001]
    geom.condim, geom.priority = 4, 1  # the floor's own friction does not count
    motor = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    # torque = gain * pwm + bias * wheel speed, see driving.
    motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    motor.gainprm[0] = STALL_TORQUE_N_M / FULL_PWM
    motor.biasprm[2] = -STALL_TORQUE_N_M / FREE_SPEED_RAD_S
    motor.ctrllimited, motor.ctrlrange = True, [-FULL_PWM, FULL_PWM]
