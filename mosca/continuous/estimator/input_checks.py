"""Checks that refuse unusable recordings with a one-line message, before anything is estimated."""

import numpy as np

from mosca.continuous.model.observations import TimedObservations
from mosca.data.rig import Rig
from mosca.errors import InputError

FEWEST_EXPOSURES = 4
LEAST_APART_M = 1e-9
"""Cameras nearer to each other than this are at one place: rounding of the coordinates [m]."""
LEAST_SIGMA_PX = 1e-6
"""Smallest image error [px]: smaller ones are below the rounding of pixel coordinates."""


def check(observations: TimedObservations, rig: Rig) -> None:
    """Raise InputError for unknown cameras, equal or unsorted time stamps, no shared time, or too short a recording.

    Cameras share time where their spans overlap. With unknown clocks this is still required of the stamps, since an
    offset is only searched for around zero.
    """
    for name in observations.cameras:
        rig.camera(name)
    if not len(observations):
        raise InputError("continuous: no image points given; detect and identify markers first")
    _check_errors(observations, rig)
    spans = []
    for c, name in enumerate(observations.cameras):
        own = observations.camera == c
        if not own.any():
            raise InputError(f"continuous: camera '{name}' has no image points; leave it out")
        exposure, at = np.unique(observations.exposure[own], return_index=True)
        time = observations.time_s[own]
        if np.any(time != time[at][np.searchsorted(exposure, observations.exposure[own])]):
            raise InputError(f"continuous: camera '{name}' has an exposure with two time stamps; give each one")
        steps = np.diff(time[at])
        if len(exposure) < FEWEST_EXPOSURES:
            raise InputError(
                f"continuous: camera '{name}' has {len(exposure)} exposures, at least {FEWEST_EXPOSURES} are needed; "
                "record longer"
            )
        for wrong, what in ((steps == 0, "the same time stamp"), (steps < 0, "an earlier time stamp")):
            if wrong.any():
                k = int(np.flatnonzero(wrong)[0])
                raise InputError(
                    f"continuous: camera '{name}' gives exposure {exposure[k + 1]} {what} ({time[at][k + 1]:.6f} s) "
                    f"{'as' if steps[k] == 0 else 'than'} exposure {exposure[k]}; frames must come sorted, each with "
                    "its own time"
                )
        spans.append((time.min(), time.max()))
    for c, name in enumerate(observations.cameras):
        others = [s for k, s in enumerate(spans) if k != c]
        if len(spans) > 1 and not any(spans[c][0] <= b and a <= spans[c][1] for a, b in others):
            raise InputError(
                f"continuous: camera '{name}' ({spans[c][0]:.3f} to {spans[c][1]:.3f} s) shares no time with the "
                "others; check its clock or leave it out"
            )
    if len(spans) < 2:
        raise InputError(
            f"continuous: only camera '{observations.cameras[0]}' is there; two at least are needed to see depth"
        )


def check_places(cameras: tuple[str, ...], rig: Rig) -> None:
    """Raise InputError where all cameras are at one place: their images do not determine depth."""
    centres = np.array([rig.camera(name).world_from_camera.translation for name in cameras])
    apart = np.linalg.norm(centres - centres[0], axis=1)
    if apart.max() <= LEAST_APART_M:
        raise InputError(
            f"continuous: cameras {', '.join(cameras)} are all at {centres[0].tolist()} m: they see no depth; give "
            "the rig's poses, as a start where they are not known"
        )


def _check_errors(observations: TimedObservations, rig: Rig) -> None:
    """Raise InputError for image points or covariances that are not finite, and for impossibly small errors."""
    widest = max(max(rig.camera(name).width, rig.camera(name).height) for name in observations.cameras)
    covariance = observations.covariance_px2
    known = np.asarray(np.isfinite(observations.xy_px).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    sizes = np.linalg.eigvalsh(np.where(known[:, None, None], covariance, np.eye(2)))
    usable = known & (sizes[:, 0] >= LEAST_SIGMA_PX**2) & (sizes[:, 1] <= widest**2)
    if usable.all():
        return
    k = int(np.flatnonzero(~usable)[0])
    where = (
        f"continuous: camera '{observations.cameras[observations.camera[k]]}', exposure {observations.exposure[k]}, "
        f"point '{observations.points[observations.point[k]]}'"
    )
    if not np.isfinite(observations.xy_px[k]).all():
        raise InputError(f"{where}: image point {observations.xy_px[k].tolist()} given; leave out what was not seen")
    raise InputError(
        f"{where}: covariance {covariance[k].tolist()} px^2 given; a positive definite one is wanted, of standard "
        f"deviations from {LEAST_SIGMA_PX:g} to {widest} px; give the images' error, 0.1 px for example"
    )
