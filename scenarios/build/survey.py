"""The survey flight of a scenario with ``[self_orientation]``: field, lamp and flight, and stated values of these."""

from dataclasses import replace

import numpy as np

from mosca.data.rig import Pose
from mosca.data.rotations import rotation_from_vector
from mosca.data.targets import TestField
from mosca.machines.self_orientation.rig_side import LeverArm
from scenarios.spec.scenario import Scenario
from scenarios.spec.scenes import DroneScene
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.drone import Flight, build_drone
from twin.scenes.scene import Scene
from twin.scenes.survey_flight import FACING_DRONE, SurveyField, seen_by_rig, upright_field
from twin.streams import rng


def survey_flight(spec: Scenario) -> Flight:
    """Return the drone's flight, as in ``build_scene``."""
    assert isinstance(spec.scene, DroneScene)
    space = spec.working_space
    return build_drone(
        duration_s=spec.capture.duration_s,
        box_center_m=np.array(space.center_m),
        box_size_m=np.array(space.size_m),
        rng=rng(spec.seed, "scene"),
        **spec.scene.model_dump(exclude={"kind"}),
    )


def survey_field(spec: Scenario) -> SurveyField:
    """Return the true field and lamp."""
    given = spec.self_orientation
    assert given is not None
    draw = rng(spec.seed, "scene/field")
    field = upright_field(given.size_m, given.targets, given.relief_m, given.dot_radius_m, draw)
    there = Pose(FACING_DRONE, np.array(given.center_m))
    return SurveyField(field, there, np.array(given.light_m), given.light_diameter_m, given.bit_s)


def told_field(spec: Scenario, there: SurveyField) -> TestField:
    """Return the field as in its file: in error by its standard deviation."""
    assert spec.self_orientation is not None
    sigma, draw = spec.self_orientation.sigma_m, rng(spec.seed, "self_orientation/field")
    told = tuple(replace(one, position=one.position + sigma * draw.standard_normal(3)) for one in there.field.targets)
    return TestField(told, sigma)


def survey_scene(spec: Scenario) -> Scene:
    """Return the scene for the rig: the drone's markers and the lamp."""
    assert isinstance(spec.scene, DroneScene)
    flight = survey_flight(spec)
    return seen_by_rig(flight, survey_field(spec), flight.scene.marker_names, spec.scene.marker_diameter_m)


def told_lever_arm(spec: Scenario, true: Pose) -> LeverArm:
    """Return body_from_camera as measured on the drone: in error by its standard deviations."""
    given = spec.self_orientation
    assert given is not None
    draw = rng(spec.seed, "self_orientation/lever")
    sigma = np.repeat([given.lever_sigma_m, np.deg2rad(given.lever_sigma_deg)], 3)
    off = sigma * draw.standard_normal(6)
    turned = rotation_from_vector(off[3:]) @ true.rotation
    # never singular: a millionth of a millimetre and of a milliradian stand for an exact value
    return LeverArm(Pose(turned, true.translation + off[:3]), np.diag(np.maximum(sigma, 1e-9) ** 2))


def own_camera(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> VirtualCamera:
    """Return the camera on the drone that ``[self_orientation]`` names."""
    assert spec.self_orientation is not None
    name = spec.self_orientation.camera
    return next(one for one in cameras if one.camera.name == name)


def without_own_camera(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> tuple[VirtualCamera, ...]:
    """Return the cameras of the rig's take: that of the drone has its own scene (``twin.scenes.survey_flight``)."""
    if spec.self_orientation is None:
        return cameras
    return tuple(one for one in cameras if one.camera.name != spec.self_orientation.camera)
