"""Initial network of a self-calibration without known lengths: a projective core, upgraded to metric.

After Svoboda, Martinec and Pajdla 2005 (MultiCamSelfCal): pairs, projective reconstruction, metric upgrade by what
is known of any camera. The upgrade here tries all focal lengths (``metric_upgrade``) and lets bundle
adjustments of the likeliest guesses decide.
"""

import numpy as np

from mosca.calibration.bundle.solver import FOCAL
from mosca.calibration.initial.metric_upgrade import (
    MetricGuess,
    ProjectiveReconstruction,
    grown,
    metric_guesses,
    pair_matrices,
)
from mosca.calibration.initial.projective import epipolar_distance, intersect, plane_misfit
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.incremental import ROUGH_LENS, WORST_MISFIT
from mosca.calibration.uncalibrated.partial_adjustment import Network, rough
from mosca.calibration.uncalibrated.view_graph import (
    LEAST_INLIERS,
    LITTLE_DEPTH,
    flat,
    pair_geometry,
    strongest_pairs,
)
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Pose
from mosca.errors import CalibrationError

PAIRS, CORES, GUESSES = 6, 2, 6
FEWEST_TRIPLE, MOST_IN_CORE = 20, 5
FEWEST_CAMERAS = 3
# an ordinary lens's focal length in half diagonals, only to scale numbers
USUAL_FOCAL = 1.6
# guesses so much worse than the best are not examined
WORSE_FACTOR, WORSE_BY = 3.0, 5.0
MOST_POINTS = 500


def core(tracks: PointViews, bend: float, rng: np.random.Generator) -> Network:
    """Return three cameras or more with their points, metric but for the scale; CalibrationError where none fit."""
    if len(tracks.names) < FEWEST_CAMERAS:
        raise CalibrationError(
            f"few-views: {len(tracks.names)} cameras cannot be calibrated from points of unknown distances; add a "
            "third camera, or wave a wand of known length"
        )
    best: Network | None = None
    for first, second in _firm_pairs(tracks, bend, rng)[:CORES]:
        guesses = _guesses(tracks, first, second, bend, rng)
        for metric, cameras in guesses:
            if metric.cost > WORSE_FACTOR * guesses[0][0].cost + WORSE_BY:
                break
            found = _adjusted(tracks, metric, cameras, bend)
            if found is not None and (best is None or found.spread < 0.8 * best.spread):
                best = found
        if best is not None and _fits(best, tracks):
            return best
    if best is None or not _fits(best, tracks):
        raise CalibrationError(
            "few-views: no three cameras with enough common points agree on focal lengths and places; wave the light "
            "where three cameras see it at the same time, through the depth of the volume too, and check that the "
            "images are each camera's own and of the same instants"
        )
    return best


def _firm_pairs(tracks: PointViews, bend: float, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return pairs of cameras with many points and much parallax, the firmest first."""
    scored, level = [], 0
    for first, second in strongest_pairs(tracks, PAIRS):
        both, x, y, found = pair_geometry(tracks, first, second, bend, rng)
        if found.inliers.mean() < LEAST_INLIERS:
            continue
        if flat(x, y, found, rng):
            level += 1
            continue
        parallax = plane_misfit(x[found.inliers], y[found.inliers], rng)
        scored.append((len(both) * min(parallax, 0.1), (first, second)))
    if level and not scored:
        raise CalibrationError(LITTLE_DEPTH)
    return [pair for _, pair in sorted(scored, reverse=True)]


def _guesses(
    tracks: PointViews, first: int, second: int, bend: float, rng: np.random.Generator
) -> list[tuple[MetricGuess, tuple[int, ...]]]:
    """Return metric guesses of a core that grows from a pair, and its cameras."""
    chosen = _sample(tracks, first, second, rng)
    table = tracks.table()[:, chosen]
    xy = np.full((*table.shape, 2), np.nan)
    for k, row in enumerate(table):
        xy[k, row >= 0] = tracks.plain(k, tracks.xy_px[row[row >= 0]], bend)
    both = np.isfinite(xy[[first, second]]).all(axis=(0, 2))
    _, _, _, pair = pair_geometry(tracks, first, second, bend, rng)
    matrices = pair_matrices(pair.matrix, (USUAL_FOCAL, USUAL_FOCAL))
    limit = 6 * max(pair.median, 1e-9)
    good = np.asarray(np.isfinite(xy[[first, second]]).all(axis=2))
    good[:, both] &= epipolar_distance(pair.matrix, xy[first, both], xy[second, both]) <= limit
    trusted = np.where(good[:, :, None], xy[[first, second]], np.nan)
    start = ProjectiveReconstruction((first, second), matrices, intersect(matrices, trusted), good)
    one = grown(start, xy, FEWEST_TRIPLE, MOST_IN_CORE, rng)
    if len(one.cameras) < FEWEST_CAMERAS:
        return []
    return [(metric, one.cameras) for metric in metric_guesses(one, GUESSES)]


def _sample(tracks: PointViews, first: int, second: int, rng: np.random.Generator) -> Array:
    """Return object points that many cameras see, drawn by ``rng``, those of the pair first."""
    table = tracks.table() >= 0
    views = table.sum(axis=0)
    pair = table[first] & table[second]
    candidates = np.flatnonzero((views >= 3) | pair)
    if len(candidates) <= MOST_POINTS:
        return candidates
    order = np.lexsort((rng.random(len(candidates)), -np.minimum(views[candidates], 3)))
    return np.sort(candidates[order[:MOST_POINTS]])


def _adjusted(tracks: PointViews, metric: MetricGuess, cameras: tuple[int, ...], bend: float) -> Network | None:
    start = {}
    size = float(np.median(np.linalg.norm(metric.centre - metric.centre.mean(axis=0), axis=1)))
    for k, focal, turn, centre in zip(cameras, metric.focal, metric.rotation, metric.centre, strict=True):
        width, height = map(int, tracks.sizes[k])
        pose = Pose(turn.T, centre / max(size, 1e-12))
        start[k] = Camera(tracks.names[k], width, height, tracks.pinhole(k, float(focal), bend), pose)
    own = tracks.of_cameras(cameras).thinned(500 * len(cameras), np.random.default_rng(0))
    try:
        return rough(own, rough(own, start, (FOCAL,)).cameras, ROUGH_LENS)
    except CalibrationError:
        # a wrong guess need not determine anything; the next one may
        return None


def _fits(one: Network, tracks: PointViews) -> bool:
    far = np.linalg.norm(one.residuals_px, axis=1)
    reach = min(tracks.reach_px(k) for k in one.cameras)
    return float(np.median(np.nan_to_num(far, nan=np.inf))) < WORST_MISFIT * reach
