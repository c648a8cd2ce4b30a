"""Rig and settings of cameras that are worn on the body that they film."""

from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from mosca.continuous.moving_cameras.body_worn import Lamps
from mosca.data.rig import Pose, Rig
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from scenarios.build.cameras import Calibrated, fitted_cameras
from scenarios.build.scene import stage_settings
from scenarios.spec.scenario import Scenario
from twin.cameras.virtual_camera import VirtualCamera

NO_POSE = Pose(np.eye(3), np.zeros(3))


def worn_cameras(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> tuple[VirtualCamera, ...]:
    """Return the cameras on the body ``worn_on``; with ``moving``, then those on other bodies that also film it.

    InputError where fewer than two are on the body itself.
    """
    assert spec.continuous is not None
    body = spec.continuous.worn_on
    worn = tuple(v for v in cameras if v.mount.body == body)
    others = tuple(v for v in cameras if v.mount.body not in (None, body)) if spec.continuous.moving else ()
    if len(worn) < 2:
        raise InputError(
            f"continuous.worn_on = '{body}': {len(worn)} [[camera]] tables have body = '{body}'; two at "
            "least are wanted"
        )
    return worn + others


def worn_rig(spec: Scenario, worn: tuple[VirtualCamera, ...]) -> Calibrated:
    """Return the rig in the body's frame, with the pipeline's lens model fitted to the true lenses' rays.

    Poses of cameras on other bodies are unknown.
    """
    assert spec.continuous is not None
    found = fitted_cameras(spec, worn, 0.5 * spec.continuous.reach_m)
    if not spec.continuous.moving:
        return found
    known = {v.camera.name for v in worn if v.mount.body == spec.continuous.worn_on}
    return replace(found, rig=without_poses(found.rig, known))


def worn_settings(spec: Scenario) -> PipelineSettings:
    """Return the pipeline's settings for markers around the body."""
    assert spec.continuous is not None
    r = spec.continuous.reach_m
    return stage_settings(spec.pipeline, ((-r, -r, -r), (r, r, r)))


def without_poses(rig: Rig, known: AbstractSet[str]) -> Rig:
    """Return the rig with the poses of the cameras ``known`` only; the other poses are placeholders."""
    return Rig(tuple(one if one.name in known else replace(one, world_from_camera=NO_POSE) for one in rig.cameras))


def known_lamps(spec: Scenario, rig: Rig) -> tuple[tuple[str, ...], Lamps]:
    """Return the cameras on the body itself (with known poses) and the lamps of all; InputError without lamps."""
    assert spec.continuous is not None
    of_name = {own.name: own for own in spec.camera}
    numbers, places = [], []
    for name in rig.names:
        own = of_name[name]
        if own.lamp_m is None or own.lamp_number is None:
            raise InputError(
                f"camera '{name}': continuous.moving wants each worn camera's lamp_m and lamp_number; give them"
            )
        numbers.append(own.lamp_number)
        places.append(own.lamp_m)
    known = tuple(name for name in rig.names if of_name[name].body == spec.continuous.worn_on)
    return known, Lamps(tuple(numbers), np.array(places, dtype=float), 1.0 / spec.capture.frame_rate_hz)
