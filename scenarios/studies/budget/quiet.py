"""Cameras without sensor noise, and scenes without occlusion of markers: no key of a scenario can set these."""

import copy
from collections.abc import Collection
from dataclasses import replace

from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import MARKER_GROUP, UNSEEN_GROUP, Scene

BRIGHTER = 10_000.0
"""Factor on the electrons of every pixel: shot noise falls to 1/100 of its share, read noise to 1/10,000. With more,
the quantisation of 12 bits, which is then the largest noise (0.3 steps rms of 4,095), would remain."""
FINEST_BITS = 12


def quiet_camera(one: VirtualCamera) -> VirtualCamera:
    """Return a camera with the same image and almost no noise: more light, 12 bits, no fixed patterns."""
    sensor = replace(
        one.sensor,
        full_well_e=BRIGHTER * one.sensor.full_well_e,
        background_e=BRIGHTER * one.sensor.background_e,
        dark_current_e_per_s=0.0,
        bits=FINEST_BITS,
        dsnu_e=0.0,
        prnu=0.0,
        hot_pixels=0.0,
        dead_pixels=0.0,
    )
    return replace(one, sensor=sensor)


def quiet_cameras(cameras: tuple[VirtualCamera, ...], names: Collection[str] | None) -> tuple[VirtualCamera, ...]:
    """Return ``cameras``, the named ones without noise (None: all)."""
    return tuple(quiet_camera(one) if names is None or one.camera.name in names else one for one in cameras)


def unhidden(scene: Scene) -> Scene:
    """Return the scene with bodies that do not occlude; markers still hide each other."""
    model = copy.copy(scene.model)
    solid = model.geom_group != MARKER_GROUP
    model.geom_group[solid] = UNSEEN_GROUP
    return replace(scene, model=model)
