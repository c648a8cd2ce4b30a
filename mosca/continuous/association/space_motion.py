"""Speed and acceleration of targets in space, from the cameras' image tracks: used to set matching and tracking.

The settings' speed and acceleration are those that a user expects; where the images show larger ones, these are used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.continuous.association.image_motion import FEWEST, GATE_SIGMA, quantile_size
from mosca.continuous.association.tracklets_2d import Tracklets
from mosca.data.arrays import Array
from mosca.data.rig import Rig, principal_distances_px
from mosca.pipeline import PipelineSettings
from mosca.tracking.motion_scale import motion_scale


@dataclass(frozen=True)
class SpaceMotion:
    """Standard deviations per axis of the targets' speed [m/s] and acceleration [m/s^2], and of positions between
    exposures [m].
    """

    speed_mps: float
    acceleration_mps2: float
    between_m: float


def space_motion(paths: Sequence[Tracklets], rig: Rig) -> SpaceMotion:
    """Return the motion that image tracks show at the distance at which the cameras are aimed; of all cameras the
    largest values.
    """
    speed = acceleration = between = 0.0
    for path, scale in zip(paths, _metres_per_pixel(rig), strict=True):
        t, xy, left = path.time_s, path.xy_px, path.left
        a = left[1:][left[1:] == left[:-1] + 1]
        if len(a) < FEWEST:
            continue
        before, after = ((xy[a + k + 1] - xy[a + k]) / (t[a + k + 1] - t[a + k])[:, None] for k in (-1, 0))
        change = (after - before) / (0.5 * (t[a + 1] - t[a - 1]))[:, None]
        speed = max(speed, scale * quantile_size((after**2).sum(axis=1)))
        acceleration = max(acceleration, scale * quantile_size((change**2).sum(axis=1)))
        between = max(between, scale * path.interpolation_px)
    return SpaceMotion(speed, acceleration, between)


def quick_for(settings: PipelineSettings, motion: SpaceMotion, step_s: float) -> bool:
    """Return whether the motion leaves the settings' gate within ``step_s``, so that closer instants are needed."""
    return GATE_SIGMA * motion.acceleration_mps2 * step_s**2 > motion_scale(settings.track).gate_m


def settings_for(settings: PipelineSettings, motion: SpaceMotion, step_s: float) -> PipelineSettings:
    """Return the settings with gates as wide as the motion needs at instants ``step_s`` apart."""
    track, match, scale = settings.track, settings.match, motion_scale(settings.track)
    wide = GATE_SIGMA * float(np.hypot(motion.acceleration_mps2 * step_s**2, motion.between_m))
    fast = motion.acceleration_mps2 > scale.acceleration_mps2
    track = replace(
        track,
        acceleration_mps2=max(scale.acceleration_mps2, motion.acceleration_mps2),
        speed_mps=max(scale.speed_mps, motion.speed_mps),
        # duration of an acceleration: for oscillations the time in which a speed changes by its own size
        memory_s=min(track.memory_s, motion.speed_mps / motion.acceleration_mps2) if fast else track.memory_s,
        gate_m=max(scale.gate_m, 2.0 * wide),
    )
    worst = float(np.hypot(match.worst_sigma_m, GATE_SIGMA * motion.between_m))
    return replace(settings, track=track, match=replace(match, worst_sigma_m=worst))


def _metres_per_pixel(rig: Rig) -> Array:
    """Return the size [m] of a pixel of each camera (c,) at the point nearest to all cameras' axes."""
    poses = [camera.world_from_camera for camera in rig.cameras]
    axis, centre = np.array([p.rotation[:, 2] for p in poses]), np.array([p.translation for p in poses])
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centre), rcond=None)[0]
    distance = np.linalg.norm(middle - centre, axis=1)
    focal = [float(np.mean(principal_distances_px(camera.lens))) for camera in rig.cameras]
    return np.asarray(distance / np.array(focal))
