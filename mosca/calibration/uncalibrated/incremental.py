"""Growth of a metric network by one camera at a time: resection on its points, or common views of a wand.

Zones can form a chain: a camera need only share views with some calibrated camera. After each camera the whole
network is adjusted (incremental reconstruction, Snavely et al. 2006).
"""

import numpy as np

from mosca.calibration.bundle.solver import FOCAL
from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_2D
from mosca.calibration.initial.projective import fundamental
from mosca.calibration.initial.resection import aim, resect
from mosca.calibration.uncalibrated.focal_pair import pair_guesses
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.partial_adjustment import (
    CLEAR_SIGMAS,
    Network,
    cleaned,
    intersected,
    residuals,
    rough,
)
from mosca.calibration.uncalibrated.view_graph import FEWEST_COMMON, pair_geometry, refuse_groups
from mosca.camera.projection import lens_directions
from mosca.data.arrays import Array
from mosca.data.rig import Camera, OpenCVLens
from mosca.errors import CalibrationError

ROUGH_LENS = (FOCAL, "k1")
# a start whose median residual exceeds this share of half the diagonal is rejected
WORST_MISFIT = 0.01
FEWEST_FOR_RESECTION, MOST_RESECTED = 25, 200


def grow(start: Network, tracks: PointViews, bend: float, rng: np.random.Generator) -> Network:
    """Return the network with all cameras of ``tracks``; CalibrationError where one cannot be joined."""
    one, tracks = start, cleaned(tracks, start.cameras, CLEAR_SIGMAS * start.spread)
    failures: dict[int, CalibrationError] = {}
    while len(one.cameras) < len(tracks.names):
        found, failures = with_next_camera(one, tracks, bend, rng)
        if found is None:
            break
        one, tracks = found, cleaned(tracks, found.cameras, CLEAR_SIGMAS * found.spread)
    if len(one.cameras) < len(tracks.names):
        if failures:
            k, reason = next(iter(failures.items()))
            raise CalibrationError(
                f"camera '{tracks.names[k]}' fits none of the others; check that its images are its own and of the "
                f"same instants, and wave through more of its image ({reason})"
            )
        refuse_groups(tracks.names, set(one.cameras), "too few common views join")
    return one


def with_next_camera(
    one: Network, tracks: PointViews, bend: float, rng: np.random.Generator
) -> tuple[Network | None, dict[int, CalibrationError]]:
    """Return the network with one camera more, or None, and the reasons why cameras with common views did not fit."""
    points = trusted_points(one, tracks)
    links = np.bincount(tracks.camera[np.isfinite(points[tracks.point]).all(axis=1)], minlength=len(tracks.names))
    failures: dict[int, CalibrationError] = {}
    for camera in np.argsort(-links, kind="stable"):
        k = int(camera)
        if k in one.cameras:
            continue
        try:
            if links[k] >= FEWEST_FOR_RESECTION:
                return _joined(one, tracks, k, _resected(tracks, k, points, bend, rng)), {}
        except CalibrationError as failure:
            failures[k] = failure
        try:
            camera_beside = _beside(one, tracks, k, bend, rng)
            if camera_beside is not None:
                return _joined(one, tracks, k, camera_beside), {}
        except CalibrationError as failure:
            failures.setdefault(k, failure)
    return None, failures


def trusted_points(one: Network, tracks: PointViews) -> Array:
    """Return the points (p, 3) that the network's cameras determine, NaN for those that its rays contradict."""
    mine = tracks.of_cameras(one.cameras)
    points = intersected(mine, one.cameras)
    far = np.linalg.norm(residuals(mine, one.cameras, points), axis=1)
    limit = 5 * max(float(np.nanmedian(far)) * SIGMA_BY_MEDIAN_2D, 1e-6)
    points[mine.point[~(far <= limit)]] = np.nan
    return points


def _resected(tracks: PointViews, k: int, points: Array, bend: float, rng: np.random.Generator) -> Camera:
    """Return a camera of unknown focal length from the points of the network."""
    mine = np.flatnonzero((tracks.camera == k) & np.isfinite(points[tracks.point]).all(axis=1))
    mine = rng.permutation(mine)[:MOST_RESECTED]
    middle, reach = tracks.middle_px(k), tracks.reach_px(k)
    straight = tracks.plain(k, tracks.xy_px[mine], bend) * reach + middle
    name = tracks.names[k]
    found = resect(f"camera '{name}'", straight, points[tracks.point[mine]], rng)
    assert isinstance(found.lens, OpenCVLens)  # resect's pinhole
    focal = float(np.sqrt(found.lens.fx_px * found.lens.fy_px)) / reach
    width, height = map(int, tracks.sizes[k])
    return Camera(name, width, height, tracks.pinhole(k, focal, bend), aim(found, (middle[0], middle[1])))


def _beside(one: Network, tracks: PointViews, k: int, bend: float, rng: np.random.Generator) -> Camera | None:
    """Return a camera from the wands it shares with one camera of the network; None with too few."""
    common = tracks.common()[k].copy()
    common[[j for j in range(len(common)) if j not in one.cameras]] = 0
    other = int(np.argmax(common))
    if common[other] < FEWEST_COMMON:
        return None
    both, _, y, _ = pair_geometry(tracks, other, k, bend, rng, samples=1)
    stands = one.cameras[other]
    first = _straight(tracks, stands, other, both)
    found = fundamental(first, y, rng)
    ends = wand_ends(tracks, both, found.inliers)
    if len(ends) < FEWEST_COMMON // 2:
        return None
    assert isinstance(stands.lens, OpenCVLens)  # while growing
    focal = stands.lens.fx_px / tracks.reach_px(other)
    rods = tracks.rods.length_m[ends[:, 2]]
    guesses = pair_guesses(found.matrix, first[ends[:, :2]], y[ends[:, :2]], rods, focal)
    best = guesses[0]
    width, height = map(int, tracks.sizes[k])
    pose = stands.world_from_camera @ best.first_from_second
    return Camera(tracks.names[k], width, height, tracks.pinhole(k, best.focal[1], bend), pose)


def _straight(tracks: PointViews, camera: Camera, k: int, points: Array) -> Array:
    """Return the plain coordinates (m, 2) of a known camera's image points, straightened by its own lens."""
    v = lens_directions(camera.lens, tracks.xy_px[tracks.table()[k, points]])
    assert isinstance(camera.lens, OpenCVLens)
    return np.asarray(v[:, :2] / v[:, 2:] * camera.lens.fx_px / tracks.reach_px(k))


def wand_ends(tracks: PointViews, points: Array, good: Array) -> Array:
    """Return the rods (w, 3) with both ends among the good ``points`` (m,): positions of the ends in it, and rod."""
    place = np.full(tracks.points, -1)
    place[points[good]] = np.flatnonzero(good)
    first, second = place[tracks.rods.first], place[tracks.rods.second]
    both = np.flatnonzero((first >= 0) & (second >= 0))
    # the longest rod of a wand is the most accurate
    longest = tracks.rods.length_m[both] >= 0.9 * tracks.rods.length_m.max(initial=0.0)
    both = both[longest]
    return np.column_stack([first[both], second[both], both])


def _joined(one: Network, tracks: PointViews, k: int, camera: Camera) -> Network:
    """Return the network adjusted with one camera more; CalibrationError where that one does not fit."""
    grown = rough(tracks, {**one.cameras, k: camera}, ROUGH_LENS)
    mine = grown.tracks.camera == k
    far = np.linalg.norm(grown.residuals_px[mine], axis=1)
    misfit = float(np.median(np.nan_to_num(far, nan=np.inf))) if mine.any() else np.inf
    if misfit > WORST_MISFIT * tracks.reach_px(k):
        raise CalibrationError(f"half of its points miss the other cameras' by more than {misfit:.1f} px")
    return grown
