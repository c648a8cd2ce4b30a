"""Initial pair of a wand calibration: the two cameras with the best views of the wand."""

import numpy as np

from mosca.calibration.bundle.solver import FOCAL
from mosca.calibration.uncalibrated.focal_pair import pair_guesses
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.incremental import ROUGH_LENS, WORST_MISFIT, wand_ends
from mosca.calibration.uncalibrated.partial_adjustment import Network, rough
from mosca.calibration.uncalibrated.view_graph import (
    FEWEST_COMMON,
    LEAST_INLIERS,
    LITTLE_DEPTH,
    flat,
    pair_geometry,
    strongest_pairs,
)
from mosca.data.rig import Camera, Pose
from mosca.errors import CalibrationError

PAIRS, GUESSES = 3, 3
# guesses so much worse than the best are not examined
WORSE_FACTOR, WORSE_BY = 3.0, 0.1
# angle between the rays of a point beyond which a larger one is no better
WIDE_RAD = 0.6


def wand_start(tracks: PointViews, bend: float, rng: np.random.Generator) -> Network:
    """Return two cameras and the wands that both saw, metric; CalibrationError where no pair fits."""
    best: tuple[float, Network] | None = None
    reasons = []
    level: CalibrationError | None = None
    for first, second in strongest_pairs(tracks, PAIRS):
        names = f"{tracks.names[first]} and {tracks.names[second]}"
        try:
            found = _pair(tracks, first, second, bend, rng)
        except CalibrationError as failure:
            level, found = failure, None
        if found is None:
            reasons.append(names)
            continue
        score = len(found.tracks) * min(1.0, _crossing(found) / WIDE_RAD)
        if best is None or score > best[0]:
            best = (score, found)
    if best is None and level is not None:
        raise level
    if best is None:
        raise CalibrationError(
            f"the wand is not of one length in any two cameras (tried {'; '.join(reasons)}); check that the images "
            "are of the same instants and each camera's own, and that the wand's file describes this wand"
        )
    return best[1]


def _pair(tracks: PointViews, first: int, second: int, bend: float, rng: np.random.Generator) -> Network | None:
    both, x, y, found = pair_geometry(tracks, first, second, bend, rng)
    if found.inliers.mean() < LEAST_INLIERS:
        return None
    if flat(x, y, found, rng):
        raise CalibrationError(LITTLE_DEPTH)
    ends = wand_ends(tracks, both, found.inliers)
    if len(ends) < FEWEST_COMMON // 2:
        return None
    length = tracks.rods.length_m[ends[:, 2]]
    clean = np.zeros(tracks.points, dtype=bool)
    clean[both[found.inliers]] = True
    pair = tracks.of_cameras((first, second))
    pair = pair.only(clean[pair.point]).thinned(900, rng)
    trials = []
    guesses = pair_guesses(found.matrix, x[ends[:, :2]], y[ends[:, :2]], length, most=GUESSES)
    for guess in guesses:
        if guess.spread > WORSE_FACTOR * guesses[0].spread + WORSE_BY:
            break
        cameras = {}
        poses = (Pose(np.eye(3), np.zeros(3)), guess.first_from_second)
        for k, focal, pose in zip((first, second), guess.focal, poses, strict=True):
            width, height = map(int, tracks.sizes[k])
            cameras[k] = Camera(tracks.names[k], width, height, tracks.pinhole(k, focal, bend), pose)
        try:
            trials.append(rough(pair, rough(pair, cameras, (FOCAL,)).cameras, ROUGH_LENS))
        except CalibrationError:
            # a wrong guess need not determine anything; the next one may
            continue
    if not trials:
        return None
    one = min(trials, key=lambda trial: trial.spread)
    misfit = float(np.nanmedian(np.linalg.norm(one.residuals_px, axis=1)))
    return one if misfit < WORST_MISFIT * min(tracks.reach_px(first), tracks.reach_px(second)) else None


def _crossing(one: Network) -> float:
    """Return the median angle [rad] at which two cameras' rays cross, folded to at most a right angle."""
    centres = [camera.world_from_camera.translation for camera in one.cameras.values()]
    points = one.points[np.isfinite(one.points).all(axis=1)]
    a, b = ((points - c) / np.linalg.norm(points - c, axis=1, keepdims=True) for c in centres)
    return float(np.median(np.arcsin(np.clip(np.linalg.norm(np.cross(a, b), axis=1), 0, 1))))
