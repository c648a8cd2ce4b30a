"""Worn cameras: their poses on the bodies, and the lamps that they carry."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mosca.data.lamp_codes import lamp_bits
from mosca.data.rig import Pose
from mosca.errors import InputError
from scenarios.spec.cameras import CameraSpec

if TYPE_CHECKING:
    from scenarios.spec.scenario import Scenario
    from twin.scenes.actor import BodyLamp

LAMP = "lamp/"
"""Prefix of the names of worn cameras' lamps; the camera's name follows."""


def rider_pose(own: CameraSpec) -> Pose:
    """Return ``body_from_camera`` of a camera on a body."""
    forward, up = np.array(own.forward, float), np.array(own.up, float)
    right = np.cross(forward, up)
    if np.linalg.norm(right) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise InputError(f"camera '{own.name}': forward = {own.forward} and up = {own.up} must not be parallel")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    turn = np.column_stack([right, np.cross(forward, right), forward])
    return Pose(turn, np.array(own.place_m, float))


def worn_lamps(spec: Scenario) -> tuple[BodyLamp, ...]:
    """Return the lamps of the scenario's worn cameras."""
    from twin.scenes.actor import BodyLamp
    from twin.scenes.target_lamps import in_step

    lamps = []
    for own in spec.camera:
        if own.lamp_m is not None:
            assert own.body is not None
            x, y, z = rider_pose(own).transform(np.array([own.lamp_m]))[0].tolist()
            blink = None
            if own.lamp_number is not None:
                blink = in_step(lamp_bits(own.lamp_number), spec.capture.frame_rate_hz)
            lamps.append(BodyLamp(LAMP + own.name, own.body, (x, y, z), own.lamp_diameter_m, blink))
    return tuple(lamps)


def check_no_lamps(spec: Scenario) -> None:
    """Raise InputError where a camera carries a lamp in a scene that cannot have it."""
    for own in spec.camera:
        if own.lamp_m is not None:
            raise InputError(
                f"camera '{own.name}': lamp_m = {own.lamp_m} given; only an actor's cameras carry lamps: leave it out"
            )
