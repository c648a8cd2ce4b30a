"""Comparison with an earlier rig: whether two cameras were exchanged, and whether one moved.

The new poses are transformed into the earlier rig's frame by the common motion of most cameras. The new target points
are projected by the earlier cameras and compared with the observations, in px and independent of the frames.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mosca.calibration.quality.findings import refuse, warn
from mosca.calibration.quality.jacobian import sensitivity
from mosca.calibration.quality.limits import QualityLimits
from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.rotations import nearest_rotation

MOST_POINTS = 60
"""Largest number of points compared for each camera."""
MOST_PAIRS = 40
"""Largest number of exchanges that are tried."""
UNSEEN_PX = 1e4
"""Difference [px] counted where a lens does not image a point."""


@dataclass(frozen=True, eq=False)
class _CameraView:
    """Observations of a new camera: points (n, 3) of the new world at pixels (n, 2)."""

    camera: Camera
    points: Array
    xy_px: Array


def exchanged(calibration: Calibration, known: Rig, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return a refusal where two cameras fit the earlier rig far better with their names exchanged."""
    seen = _seen(calibration, known)
    if len(seen) < 2:
        return ()
    names = [one.camera.name for one in seen]
    asis = best_misfit(seen, [known.camera(name) for name in names])
    if np.median(asis) <= settings.swap_least_px and asis.max() <= settings.swap_least_px:
        return ()
    found, total = None, _overall(asis)
    for i, j in _pairs(asis):
        order = list(names)
        order[i], order[j] = order[j], order[i]
        if not _same_size(seen[i].camera, known.camera(order[i])) or not _same_size(
            seen[j].camera, known.camera(order[j])
        ):
            continue
        misfit = _overall(best_misfit(seen, [known.camera(name) for name in order]))
        if misfit * settings.swap_ratio < _overall(asis) and misfit < total:
            found, total = (names[i], names[j]), misfit
    if found is None:
        return ()
    text = (
        f"cameras '{found[0]}' and '{found[1]}' stand for each other: with their names exchanged the earlier "
        f"rig fits to {total:.3g} px, as they are to {_overall(asis):.3g} px only; exchange the two in the "
        "recording (or the cables), then calibrate again"
    )
    return (refuse("swapped-cameras", text, found[0]),)


def moved(calibration: Calibration, known: Rig, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras that moved since the earlier rig, relative to the common motion of most cameras."""
    seen = _seen(calibration, known)
    if len(seen) < 2:
        return ()
    misfit = best_misfit(seen, [known.camera(one.camera.name) for one in seen])
    own = np.array([_own_sigma(calibration, one) for one in seen])
    found = []
    for one, size, sigma in zip(seen, misfit, own, strict=True):
        # the earlier rig was as uncertain as this one, and so is the motion common to the other cameras
        uncertain = np.sqrt(2) * np.hypot(sigma, np.median(own))
        allowed = max(settings.moved_px, settings.moved_sigmas * uncertain)
        if size > allowed:
            shift, turn = _motion(seen, known, one, misfit)
            which = "which of the two, two cameras alone cannot tell; " if len(seen) == 2 else ""
            text = (
                f"camera '{one.camera.name}' no longer stands where the earlier rig has it: {size:.2f} px, "
                f"{allowed:.2f} px allowed ({1e3 * shift:.2f} mm and {1e3 * turn:.2f} mrad against the others); "
                f"{which}"
                "use the new calibration for what is recorded from now on, and fix the camera's mount"
            )
            found.append(warn("rig-moved", text, one.camera.name))
    return tuple(found)


def best_misfit(seen: list[_CameraView], assigned: list[Camera]) -> Array:
    """Return the rms difference [px] (c,) of each camera to its assigned earlier one, moved by the motion that most
    cameras share.

    Each camera proposes a common motion; the one on which most agree is taken.
    """
    every = []
    for voter, camera in zip(seen, assigned, strict=True):
        new_from_old = voter.camera.world_from_camera @ camera.world_from_camera.inverse()
        every.append(np.array([_misfit(one, c, new_from_old) for one, c in zip(seen, assigned, strict=True)]))
    every.append(
        np.array([_misfit(one, c, _mean_motion(seen, assigned)) for one, c in zip(seen, assigned, strict=True)])
    )
    return min(every, key=_agreement)


def _agreement(misfit: Array) -> float:
    """Return the misfit of a common motion: the median, plus a small part of the mean."""
    return float(np.median(misfit) + 1e-3 * np.minimum(misfit, 1e3).mean())


def _overall(misfit: Array) -> float:
    return float(np.sqrt(np.mean(misfit**2)))


def _misfit(one: _CameraView, old: Camera, new_from_old: Pose) -> float:
    moved_camera = replace(old, world_from_camera=new_from_old @ old.world_from_camera)
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.linalg.norm(project(moved_camera, one.points) - one.xy_px, axis=1)
    off = np.minimum(np.nan_to_num(off, nan=UNSEEN_PX), UNSEEN_PX)
    return float(np.sqrt(np.mean(off**2)))


def _mean_motion(seen: list[_CameraView], assigned: list[Camera]) -> Pose:
    """Return the motion that on average carries the earlier centres and axes onto the new ones."""
    pairs = [(one.camera.world_from_camera, c.world_from_camera) for one, c in zip(seen, assigned, strict=True)]
    rotation = nearest_rotation(sum((new.rotation @ old.rotation.T for new, old in pairs), np.zeros((3, 3))))[0]
    shift = np.mean([new.translation - rotation @ old.translation for new, old in pairs], axis=0)
    return Pose(rotation, shift)


def _seen(calibration: Calibration, known: Rig) -> list[_CameraView]:
    """Return the observations of the cameras that the earlier rig also has, at most MOST_POINTS each."""
    world, found = calibration.points_in_world(), []
    for k, camera in enumerate(calibration.rig.cameras):
        rows = np.flatnonzero(calibration.used & (calibration.sightings.camera == k))
        if camera.name in known.names and len(rows):
            rows = rows[:: max(1, -(-len(rows) // MOST_POINTS))]
            # the new camera's own projection of the points, so that noise is no difference
            found.append(_CameraView(camera, world[rows], project(camera, world[rows])))
    return found


def _pairs(misfit: Array) -> list[tuple[int, int]]:
    """Return the pairs to try, those that fit worst first."""
    pairs = sorted(combinations(range(len(misfit)), 2), key=lambda ij: -misfit[ij[0]] - misfit[ij[1]])
    return pairs[:MOST_PAIRS]


def _same_size(one: Camera, other: Camera) -> bool:
    return (one.width, one.height) == (other.width, other.height)


def _own_sigma(calibration: Calibration, one: _CameraView) -> float:
    """Return the standard deviation [px] of the camera's projections due to the errors of its own parameters."""
    k = calibration.rig.names.index(one.camera.name)
    slope = sensitivity(calibration.rig, k, calibration.parameters, one.points)
    block = calibration.covariance[np.ix_(slope.columns, slope.columns)]
    spread = np.einsum("nij,jk,nik->n", slope.by_parameter, block, slope.by_parameter)
    return float(np.sqrt(np.mean(spread)))


def _motion(seen: list[_CameraView], known: Rig, one: _CameraView, misfit: Array) -> tuple[float, float]:
    """Return the shift [m] and rotation [rad] of a camera against the camera that fits best."""
    others = [k for k, other in enumerate(seen) if other is not one]
    anchor = seen[min(others, key=lambda k: misfit[k])].camera
    motion = anchor.world_from_camera @ known.camera(anchor.name).world_from_camera.inverse()
    before = motion @ known.camera(one.camera.name).world_from_camera
    now = one.camera.world_from_camera
    turn = (np.trace(before.rotation.T @ now.rotation) - 1) / 2
    return float(np.linalg.norm(now.translation - before.translation)), float(np.arccos(np.clip(turn, -1, 1)))
