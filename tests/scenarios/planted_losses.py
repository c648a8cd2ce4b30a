"""Losses of about 5 %, planted in stages of the pipeline; as a program, ``mosca`` with one of them.

    PLANTED=lost_points python tests/scenarios/planted_losses.py suite scenarios/library/rigs/points_200.toml

The noise follows from the data alone, so that it is the same in any process and order.
"""

import os
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from types import ModuleType

import numpy as np

import mosca.continuous.association.frame_detections
import mosca.pipeline
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import match
from mosca.data.frames import mid_exposure_ns

FIVE_PERCENT = np.sqrt(1.05**2 - 1)
"""Noise, over that which is there, that makes errors 5 % larger."""
JITTER_S = 30e-6
"""Of time stamps: at 1 m/s 30 um, which make an error of 0.1 mm 5 % larger."""


def noise_for(values):
    """Return a generator that follows from an array."""
    return np.random.default_rng(zlib.crc32(np.ascontiguousarray(values).tobytes()))


def noisy_detections(rig, detections, camera_sigma_px, target="point"):
    """Detections with more noise than they and the cameras have."""
    shaken = {}
    for camera, own_px in zip(rig.names, np.broadcast_to(camera_sigma_px, len(rig.names)), strict=True):
        seen = detections[camera]
        sigma = np.sqrt(np.trace(seen.covariance_px2, axis1=1, axis2=2) / 2 + own_px**2)
        noise = FIVE_PERCENT * sigma[:, None] * noise_for(seen.xy_px).normal(size=seen.xy_px.shape)
        shaken[camera] = replace(seen, xy_px=seen.xy_px + noise)
    return make_ray_table(rig, shaken, camera_sigma_px, target)


def shifted_camera(rig, detections, camera_sigma_px, target="point"):
    """One camera's principal point is off by a fiftieth of a pixel."""
    name = rig.names[0]
    moved = replace(detections[name], xy_px=detections[name].xy_px + [0.02, 0.0])
    return make_ray_table(rig, {**detections, name: moved}, camera_sigma_px, target)


def noisy_points(*arguments):
    """Points with more noise than they state."""
    points = match(*arguments)
    rng = noise_for(points.xyz)
    noise = [rng.multivariate_normal(np.zeros(3), FIVE_PERCENT**2 * c) for c in points.covariance]
    return replace(points, xyz=points.xyz + np.reshape(noise, (-1, 3)))


def lost_points(*arguments):
    """One point of 20 is lost."""
    points = match(*arguments)
    rows = noise_for(points.xyz).random(len(points)) >= 0.05
    return replace(points, **{f.name: getattr(points, f.name)[rows] for f in fields(points)})


def bragging(*arguments):
    """Standard deviations are stated 5 % too small."""
    points = match(*arguments)
    return replace(points, covariance=points.covariance / 1.05**2)


def jittered_stamps(frame):
    """Frames of unsynchronised cameras have noisy time stamps."""
    time_ns = mid_exposure_ns(frame)
    return time_ns + round(1e9 * JITTER_S * noise_for(np.array([time_ns])).normal())


FREE_FRAMES = mosca.continuous.association.frame_detections
PLANTS: dict[str, tuple[ModuleType, str, Callable]] = {
    "noisy_detections": (mosca.pipeline, "make_ray_table", noisy_detections),
    "shifted_camera": (mosca.pipeline, "make_ray_table", shifted_camera),
    "noisy_points": (mosca.pipeline, "match", noisy_points),
    "lost_points": (mosca.pipeline, "match", lost_points),
    "bragging": (mosca.pipeline, "match", bragging),
    "jittered_stamps": (FREE_FRAMES, "mid_exposure_ns", jittered_stamps),
}
"""Name -> module, name of a function in it, what is put in its place."""

# the suite's worker processes import this program again
if __name__ in ("__main__", "__mp_main__"):
    if os.environ["PLANTED"] != "nothing":
        setattr(*PLANTS[os.environ["PLANTED"]])
    if __name__ == "__main__":
        from scenarios.cli.main import main

        main()
