"""Test, from the truth, of whether the disturbances that a scenario states were present: jitter, shake and lens gap.

An accuracy claim depends on them. The stated rms of a random disturbance is compared with its rms in the truth by the
chi-square distribution. The twin's own formulas are not used here.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.truth import NO_FRAME, Truth
from scenarios.score.premises import between
from twin.cameras.exposure.mount import Mount
from twin.cameras.virtual_camera import VirtualCamera

FALSE_ALARM = 1e-6
"""Probability that a sound run is refused, for each disturbance."""
LEAST_JITTER_S = 1e-8
"""Jitter below which it is not judged: times are whole nanoseconds."""
GAP_FRAMES = 25
"""Number of frames of each camera, spread over the run, from which the gap is measured."""
MOTION_FACTOR = 2.0
"""Largest factor by which the rms of a camera's motion may be above or below the stated one: a short run has few of
its periods."""
GAPS_PX = {"none": (0.0, 0.01), "measured": (0.01, np.inf), "stress": (0.05, np.inf)}
"""Least and largest median distance of true images from the pipeline's lens model for each ``model_gap``: half of the
least rms that is stated for it, since targets fill only a part of the image."""
FEWEST_PLACES = 20
"""Least number of targets times cameras for which the gap is judged: the median of fewer places may be less than half
by chance (one lamp before four cameras: one seed of five; of 20 independent places one in 300)."""


@dataclass(frozen=True, eq=False)
class _Frames:
    """Frames of one camera (n), from the truth: number, true mid-exposure, pose, images of the m markers."""

    number: Array
    middle_ns: Array
    rotation: Array
    position: Array
    xy_px: Array


def disturbances(
    truth: Truth, cameras: tuple[VirtualCamera, ...], nominal: Rig, model_gap: str
) -> dict[str, dict[str, Any]]:
    """Return each stated disturbance: its value in the truth, and the range in which it must lie.

    ``nominal``: the calibration of ``cameras`` whose lenses are the pipeline's model fitted to the true ones.
    Cameras that are not in it, since they are on bodies, are judged only by their jitter.
    """
    stated = {one.camera.name: one for one in cameras}
    jitter, shake, motion, gap = [], [], [], []
    for c, name in enumerate(truth.cameras):
        virtual, frames = stated[name], _frames_of(truth, c)
        if virtual.timing.strobe_s is None or virtual.timing.strobe == "own":  # else the rig's light sets the instant
            jitter.append(_jitter(frames, virtual.timing.jitter_s))
        if name not in nominal.names or len(frames.number) < 2:  # it is on a body, or took no frames
            continue
        shift = _shift_px(frames, virtual.camera)
        still, moving = virtual.mount.body_px, _motion_px(virtual.mount, frames.middle_ns * 1e-9)
        if moving == 0.0:
            shake.append((float((shift**2).sum()), 2 * (len(shift) - 1), still))
        elif np.isfinite(moving):
            motion.append((float((shift**2).mean()), still**2 + moving**2))
        gap.append(_misfit_px(truth, frames, virtual, nominal.camera(name)))
    found = _random("trigger_jitter_s", jitter) | _random("shake_px", shake)
    if motion:
        value, wanted = np.sqrt(np.mean(motion, axis=0))
        found["motion_px"] = between(float(value), wanted / MOTION_FACTOR, wanted * MOTION_FACTOR)
    off = np.concatenate(gap) if gap else np.empty(0)
    if len(off) and len(gap) * len(truth.names) >= FEWEST_PLACES:
        found["gap_px"] = between(float(np.median(off)), *GAPS_PX[model_gap])
    return found


def _random(name: str, parts: list[tuple[float, int, float]]) -> dict[str, dict[str, Any]]:
    """Return the rms of a random disturbance from cameras' sums of squares, degrees of freedom and stated rms."""
    given = [one for one in parts if one[1] > 0 and one[2] > 0.0]
    if not given:
        return {}
    squares, freedom, stated = np.array(given).T
    dof = float(freedom.sum())
    wanted = np.sqrt((stated**2 * freedom).sum() / dof)
    low, high = np.sqrt(chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], dof) / dof)
    value = float(wanted * np.sqrt((squares / stated**2).sum() / dof))
    return {name: between(value, low * wanted, high * wanted)}


def _frames_of(truth: Truth, c: int) -> _Frames:
    table = truth.frames
    rows = np.empty(0, int) if table is None else np.flatnonzero(table.camera == c)
    if table is not None and len(rows):
        return _Frames(
            table.index[rows], table.exposure_mid_ns[rows], table.camera_rotation[rows],
            table.camera_position[rows], table.image_xy_px[rows],
        )  # fmt: skip
    rows = np.flatnonzero(truth.exposure_mid_ns[:, c] != NO_FRAME)
    assert truth.camera_rotation is not None
    assert truth.camera_position is not None
    return _Frames(
        rows, truth.exposure_mid_ns[rows, c], truth.camera_rotation[rows, c], truth.camera_position[rows, c],
        truth.image_xy_px[rows, :, c],
    )  # fmt: skip


def _jitter(frames: _Frames, stated_s: float) -> tuple[float, int, float]:
    """Return the sum of squares of mid-exposures about even spacing [s^2], degrees of freedom, and the stated rms."""
    n = len(frames.number)
    if n < 3 or stated_s < LEAST_JITTER_S:
        return 0.0, 0, stated_s
    number = frames.number - frames.number.mean()
    middle = (frames.middle_ns - frames.middle_ns[0]) * 1e-9
    rest = middle - np.polyval(np.polyfit(number, middle, 1), number)
    return float((rest**2).sum()), n - 2, stated_s


def _shift_px(frames: _Frames, camera: Camera) -> Array:
    """Return the image shifts by the camera's rotations about their mean (n, 2) [px]."""
    turned = Rotation.from_matrix(camera.world_from_camera.rotation.T @ frames.rotation).as_rotvec()[:, :2]
    ahead = replace(camera, world_from_camera=Pose(np.eye(3), np.zeros(3)))
    small = 1e-4
    xy = project(ahead, np.array([[0.0, 0.0, 1.0], [small, 0.0, 1.0], [0.0, small, 1.0]]))
    per_rad = np.linalg.norm(xy[1:] - xy[0], axis=1)[::-1] / small  # a rotation about x moves the image along y
    shift: Array = turned * per_rad
    about_mean: Array = shift - shift.mean(axis=0)
    return about_mean


def _motion_px(mount: Mount, time_s: Array) -> float:
    """Return the stated rms of an image axis's motion about its mean, without white shake; NaN for a random walk."""
    if mount.wander_px > 0.0:
        return float("nan")
    drift = np.array(mount.drift_px_per_s) * time_s[:, None]
    bump = np.array(mount.bump_px) * (0.0 if mount.bump_s is None else (time_s >= mount.bump_s)[:, None])
    return float(np.sqrt((drift + bump).var(axis=0).mean() + mount.vibration_px**2))


def _misfit_px(truth: Truth, frames: _Frames, virtual: VirtualCamera, believed: Camera) -> Array:
    """Return the distances of true images from those by the assumed lens [px], for all images (k,).

    Markers are taken at the instant of each image, by a cubic spline between the truth's instants.
    """
    if len(truth.time_ns) < 4 or not len(truth.names):
        return np.empty(0)
    paths = CubicSpline((truth.time_ns - truth.time_ns[0]) * 1e-9, truth.xyz, axis=0)
    off = []
    for f in np.unique(np.linspace(0, len(frames.number) - 1, GAP_FRAMES).astype(int)):
        xy = frames.xy_px[f]
        row_s = virtual.timing.row_time_s * (xy[:, 1] - 0.5 * (believed.height - 1))
        at = (frames.middle_ns[f] - truth.time_ns[0]) * 1e-9 + row_s
        seen = np.flatnonzero((at >= paths.x[0]) & (at <= paths.x[-1]))
        xyz = paths(at[seen])[np.arange(len(seen)), seen]
        here = replace(believed, world_from_camera=Pose(frames.rotation[f], frames.position[f]))
        off.append(np.linalg.norm(project(here, xyz) - xy[seen], axis=1))
    return np.concatenate(off)
