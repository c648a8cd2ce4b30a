"""The second paper's experiment as we read it: recorded motions seen by three alternating cameras.

The paper states (section 5.1): motions of CMU's database, three cameras "at different positions", wide angle, that
see each other, each "off by three frames", points without noise. Its figure 4 bears no scale. Stated here: every
camera takes each ninth frame of 120 Hz, the second three frames after the first, the third three after that; the
cameras are still, on a circle of 3 m round the middle of the motion (wider where the actor would come nearer than
1.5 m to a camera), 120 degrees apart, 1.0, 1.6 and 2.2 m high, aimed at the middle at 1 m; equidistant lenses of
656 x 491 pixels and 290 px/rad (130 x 97 degrees), so that each sees the other two 30 degrees from its axis.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mosca.calibration.common.robust_fit import similarity
from mosca.camera.projection import project
from mosca.continuous.model.camera_paths import StillCameras
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations
from mosca.data.arrays import Array
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import Motion, PointMotion, forward_kinematics
from mosca.data.rig import Camera, FisheyeLens, Pose, Rig
from tests.rigs import looking_at

FRAME_RATE_HZ = 120.0
EVERY, APART = 9, 3
"""Frames from exposure to exposure of one camera, and from one camera's exposure to the next camera's."""
WIDTH, HEIGHT, SCALE_PX = 656, 491, 290.0
CIRCLE_M, NEAREST_M, HEIGHTS_M, AIM_M = 3.0, 1.5, (1.0, 1.6, 2.2), 1.0
BVH_UNIT_M = 0.0104
"""CMU's converted BVH files: 1.02 to 1.06 cm a unit, measured on motions that exist in both forms."""
BVH_DROP = 8
"""Frames left out of these files: the added T-pose and seven over which it was smeared (hands at 25 m/s)."""
LONGEST_FRAMES = 600
UNCAPTURED = ("finger", "thumb", "Thumb", "Index", "Mid", "Ring", "Pinky", "Eye")
"""Parts of names of points that carry no captured data (CMU says: ignore)."""
JUMP = "13_11"
MOTIONS: dict[str, tuple[str, str]] = {
    "13_11": ("bvh/13/13_11.bvh", ""),
    "02_01": ("asfamc/02/02_01.amc", "asfamc/02/02.asf"),
    "02_03": ("asfamc/02/02_03.amc", "asfamc/02/02.asf"),
    "02_04": ("asfamc/02/02_04.amc", "asfamc/02/02.asf"),
    "02_05": ("asfamc/02/02_05.amc", "asfamc/02/02.asf"),
    "02_06": ("asfamc/02/02_06.amc", "asfamc/02/02.asf"),
    "02_07": ("asfamc/02/02_07.amc", "asfamc/02/02.asf"),
    "03_01": ("asfamc/03/03_01.amc", "asfamc/03/03.asf"),
    "09_06": ("asfamc/usc520/09_06-run.amc", "asfamc/usc520/09-run.asf"),
    "131_04": ("asfamc/usc520/131_04-dance.amc", "asfamc/usc520/131-dance.asf"),
}
"""The ten motions of table 2 (the paper does not name its own): one of each kind, true skeletons where there are."""
TUNING: dict[str, tuple[str, str]] = {
    "13_39": ("bvh/13/13_39.bvh", ""),
    "09_01": ("bvh/09/09_01.bvh", ""),
    "02_02": ("asfamc/02/02_02.amc", "asfamc/02/02.asf"),
    "05_01": ("bvh/05/05_01.bvh", ""),
}
"""Motions on which settings are chosen; none is in the tables."""


def read_motion(folder: Path, name: str) -> Motion:
    """Return CMU motion ``name`` (of MOTIONS or TUNING) under ``folder`` in metres, without the T-pose."""
    file, skeleton = (MOTIONS | TUNING)[name]
    if skeleton:
        return read_asf_amc(folder / skeleton, folder / file, frame_rate_hz=FRAME_RATE_HZ)
    return read_bvh(folder / file, metres_per_unit=BVH_UNIT_M, frame_rate_hz=FRAME_RATE_HZ, drop_frames=BVH_DROP)


def read_points(folder: Path, name: str) -> PointMotion:
    """Return the joints of CMU motion ``name`` (of MOTIONS or TUNING) under ``folder``, 5 s at most.

    Left out: fingers and thumbs, joints that coincide with another, and the T-pose of converted
    files with its traces.
    """
    motion = read_motion(folder, name)
    xyz = forward_kinematics(motion)[0][:LONGEST_FRAMES]
    names = motion.skeleton.names
    keep: list[int] = []
    for k, joint in enumerate(names):
        apart = all(np.abs(xyz[:, k] - xyz[:, other]).max() > 1e-3 for other in keep)
        if apart and not any(part in joint for part in UNCAPTURED):
            keep.append(k)
    return PointMotion(tuple(names[k] for k in keep), np.arange(len(xyz)) / FRAME_RATE_HZ, xyz[:, keep])


def surround(truth: PointMotion, cameras: int = 3) -> Rig:
    """Return the cameras round a motion (module's header)."""
    low, high = np.nanmin(truth.xyz, axis=(0, 1)), np.nanmax(truth.xyz, axis=(0, 1))
    middle = (low + high) / 2
    reach = float(np.nanmax(np.linalg.norm((truth.xyz - middle)[..., :2], axis=-1)))
    radius = max(CIRCLE_M, reach + NEAREST_M)
    made = []
    for k in range(cameras):
        angle = 2 * np.pi * k / cameras + np.radians(20.0)
        height = low[2] + HEIGHTS_M[k % len(HEIGHTS_M)]
        centre = np.array([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle), height])
        aim = np.array([middle[0], middle[1], low[2] + AIM_M])
        made.append(wide_camera(f"camera{k}", centre, aim))
    return Rig(tuple(made))


def wide_camera(name: str, centre: Array, aim: Array) -> Camera:
    """Return a wide-angle camera at ``centre`` (3,) that is aimed at ``aim`` (3,) [m], upright."""
    lens = FisheyeLens(SCALE_PX, SCALE_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    return Camera(name, WIDTH, HEIGHT, lens, looking_at(centre, aim))


def observe(
    truth: PointMotion,
    rig: Rig,
    *,
    every: int = EVERY,
    apart: int = APART,
    epipoles: bool = True,
    paths: CameraPaths | None = None,
    noise_px: float = 0.0,
    seed: int = 0,
) -> TimedObservations:
    """Return what the cameras of ``rig`` see of a motion, camera k at frames ``apart * k + every * i``.

    ``epipoles``: the cameras see each other's projection centres, too. ``paths``: cameras that move (default:
    those of the rig). ``noise_px``: standard deviation an axis of normal errors; their covariance is stated as at
    least 0.01 px, so that exact points have a weight.
    """
    moving: CameraPaths = paths or StillCameras.of(rig)
    rng = np.random.default_rng(seed)
    n = len(truth.names)
    names = truth.names + (tuple(f"lens of {name}" for name in rig.names) if epipoles else ())
    columns: list[tuple[Array, ...]] = []
    for k, camera in enumerate(rig.cameras):
        frames = np.arange(apart * k, len(truth.time_s), every)
        rotations, centres = moving.at(truth.time_s[frames])
        for running, frame in enumerate(frames):
            here = Pose(rotations[running, k], centres[running, k])
            at = Camera(camera.name, camera.width, camera.height, camera.lens, here)
            others = np.delete(np.arange(len(rig.cameras)), k) if epipoles else np.zeros(0, int)
            point = np.concatenate([np.arange(n), n + others])
            xy = project(at, np.concatenate([truth.xyz[frame], centres[running, others]]))
            xy = xy + rng.normal(0, noise_px, xy.shape) if noise_px else xy
            inside = ((xy >= -0.5) & (xy <= np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
            m = int(inside.sum())
            columns.append(
                (np.full(m, k), point[inside], np.full(m, running), np.full(m, truth.time_s[frame]), xy[inside])
            )
    camera_, point_, exposure, time_s, xy_px = (np.concatenate(column) for column in zip(*columns, strict=True))
    covariance = np.tile(np.eye(2) * max(noise_px, 0.01) ** 2, (len(xy_px), 1, 1))
    carried_by = np.concatenate([np.full(n, -1), np.arange(len(rig.cameras))])[: len(names)]
    return TimedObservations(
        rig.names, names, camera_, point_, exposure, time_s, xy_px, covariance, carried_by, np.zeros((len(names), 3))
    )


def shared_frames(observations: TimedObservations, truth: PointMotion) -> Array:
    """Return the motion's frames (f,) between the last camera's first exposure and the first camera's last."""
    times = [observations.time_s[observations.camera == k] for k in range(len(observations.cameras))]
    first, last = max(t.min() for t in times), min(t.max() for t in times)
    return np.flatnonzero((truth.time_s >= first - 1e-9) & (truth.time_s <= last + 1e-9))


Aligned = Literal["as is", "once", "each frame"]


@dataclass(frozen=True)
class Score:
    """RMSE of all points over all shared frames [m], and the share of positions that are known.

    ``camera_m``: rms error of the projection centres after the same alignment; 0 where they were known.
    """

    rms_m: float
    completeness: float
    camera_m: float = 0.0


def score(
    curves: Curves, truth: PointMotion, frames: Array, *, aligned: Aligned = "as is",
    paths: CameraPaths | None = None, true_paths: CameraPaths | None = None,
) -> Score:  # fmt: skip
    """Compare curves, and cameras if given, with a motion at its ``frames`` (f,).

    ``aligned``: by nothing, by one similarity for the whole motion, or by one for each frame (Umeyama, on the
    points), the only meaningful one for cameras without a datum of their own.
    """
    time_s = truth.time_s[frames]
    column = [curves.points.index(name) for name in truth.names]
    found, wanted = curves.at(time_s)[:, column], truth.xyz[frames]
    known = np.asarray(np.isfinite(found).all(axis=2) & np.isfinite(wanted).all(axis=2))
    centres, true_centres = np.zeros((len(time_s), 0, 3)), np.zeros((len(time_s), 0, 3))
    if paths is not None and true_paths is not None:
        centres, true_centres = paths.at(time_s)[1], true_paths.at(time_s)[1]
    squares: list[Array] = []
    camera_squares: list[Array] = []
    whole = np.arange(len(time_s))
    for part in whole[:, None] if aligned == "each frame" else (whole,):
        here = known[part]
        if here.sum() < 3:
            continue
        source, target = found[part][here], wanted[part][here]
        scale, motion = (1.0, Pose(np.eye(3), np.zeros(3))) if aligned == "as is" else similarity(source, target)
        squares.append(((motion.transform(scale * source) - target) ** 2).sum(axis=1))
        away = motion.transform(scale * centres[part].reshape(-1, 3)) - true_centres[part].reshape(-1, 3)
        camera_squares.append((away**2).sum(axis=1))
    if not squares:
        return Score(float("nan"), 0.0, float("nan"))
    rest = np.concatenate(camera_squares)
    camera_m = float(np.sqrt(np.nanmean(rest))) if np.isfinite(rest).any() else 0.0
    return Score(float(np.sqrt(np.mean(np.concatenate(squares)))), float(known.mean()), camera_m)


def equal_knots_m(truth: PointMotion, frames: Array, knot_frames: float = EVERY) -> float:
    """Return what a cubic spline with a knot each ``knot_frames`` frames leaves, fitted to the truth itself [m]."""
    from scipy.interpolate import make_lsq_spline

    t = truth.time_s[frames]
    spans = max(1, round((len(t) - 1) / knot_frames))
    inner = np.linspace(t[0], t[-1], spans + 1)
    knots = np.concatenate([[t[0]] * 3, inner, [t[-1]] * 3])
    values = truth.xyz[frames].reshape(len(t), -1)
    rest = make_lsq_spline(t, values, knots)(t) - values
    return float(np.sqrt(np.mean(np.sum(rest.reshape(-1, 3) ** 2, axis=1))))
