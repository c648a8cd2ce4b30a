"""A rig from a wand that is waved through the volume: focal lengths are estimated, the wand's length is the scale."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mosca.calibration.bundle.solver import Distances
from mosca.calibration.quality.findings import note
from mosca.calibration.uncalibrated.end_order import ordered
from mosca.calibration.uncalibrated.final_adjustment import finished
from mosca.calibration.uncalibrated.image_points import PointViews, point_views
from mosca.calibration.uncalibrated.incremental import grow
from mosca.calibration.uncalibrated.initial_pair import wand_start
from mosca.calibration.uncalibrated.partial_adjustment import CLEAR_SIGMAS, cleaned, intersected
from mosca.calibration.uncalibrated.result import calibration_of, check
from mosca.calibration.uncalibrated.view_graph import FEWEST_COMMON, check_links, common_bend
from mosca.calibration.uncalibrated.whole_balls import whole_balls
from mosca.camera.eccentricity import ball_eccentricity_px
from mosca.data.calibration import Calibration
from mosca.data.rig import Camera, Lens
from mosca.data.sightings import Sightings
from mosca.data.wands import Wand
from mosca.errors import CalibrationError

MOST_WHILE_GROWING = 1200
"""Largest number of image points a camera for the start and the growth; the last adjustment uses all."""
# relative standard deviation of a distance that is stated as exact
EXACT = 1e-5
# share by which one distance on a wand may be off against its length
WRONG_SHAPE = 0.004


def calibrate_wand(
    sightings: Sightings,
    wand: Wand,
    rng: np.random.Generator,
    lenses: Sequence[Lens],
    free: tuple[str, ...] | None = None,
) -> Calibration:
    """Calibrate cameras of unknown focal length from sightings of a wand.

    ``sightings``: marks are the wand's balls; where their order is not known (-1), the rows of an image are in order
    along the line, from either end. ``lenses``: one a camera; only model (mosca or opencv) and shape of the pixels
    are used, all else is estimated. ``free``: the lens parameters to estimate, including the focal length;
    None: those that the data determine. Lengths are the wand's; axes are near those of one of the cameras.
    CalibrationError where cameras are not joined by common views, or where the result cannot be a rig.
    """
    balls = len(wand.along_m)
    sightings = ordered(sightings, balls, lenses, rng)
    tracks = point_views(sightings, balls, lenses, rods_of(wand, sightings.frames))
    check_links(tracks)
    some = tracks.thinned(MOST_WHILE_GROWING * len(tracks.names), rng)
    bend = common_bend(some, rng)
    start = grow(wand_start(some, bend, rng), some, bend, rng)
    whole = whole_balls(sightings, tracks, start.cameras)
    hidden, sightings = int((~whole).sum()), sightings.only(whole)
    tracks = point_views(sightings, balls, lenses, tracks.rods)
    _check_shape(cleaned(tracks, start.cameras, CLEAR_SIGMAS * start.spread), start.cameras, wand)
    tracks = _of_centres(tracks, start.cameras, wand.diameter_m / 2)
    final = finished(start, tracks, free)
    check(final, tracks)
    length = wand.along_m[-1] - wand.along_m[0]
    found = calibration_of(
        final, tracks, sightings, f"the wand's length {length:g} m", wand.sigma_m * np.sqrt(2) / length
    )
    if not hidden:
        return found
    told = note(
        "hidden-balls",
        f"{hidden} of {hidden + len(sightings)} images of balls are cut by what is before them, and left out",
    )
    return replace(found, findings=(*found.findings, told))


def _of_centres(tracks: PointViews, cameras: Mapping[int, Camera], radius_m: float) -> PointViews:
    """Return the image points of the balls' centres: those of their outlines minus the eccentricity.

    The eccentricity is a share (r / R)^2 of the distance from the principal point, with R the ball's distance, so
    that rough cameras are sufficient.
    """
    points, xy = intersected(tracks, cameras), np.array(tracks.xy_px)
    for k, camera in cameras.items():
        mine = tracks.camera == k
        xy[mine] -= np.nan_to_num(ball_eccentricity_px(camera, points[tracks.point[mine]], radius_m))
    return replace(tracks, xy_px=xy)


def _check_shape(tracks: PointViews, cameras: Mapping[int, Camera], wand: Wand) -> None:
    """Raise CalibrationError where the wand's balls do not lie as in its file."""
    points = intersected(tracks, cameras).reshape(-1, len(wand.along_m), 3)
    first, second = np.triu_indices(len(wand.along_m), 1)
    along = np.array(wand.along_m)
    ratio = np.linalg.norm(points[:, first] - points[:, second], axis=2) / (along[second] - along[first])
    ratio = ratio[np.isfinite(ratio).all(axis=1)]
    if len(ratio) < FEWEST_COMMON:
        return
    off = ratio - ratio[:, [len(along) - 2]]
    middle = np.median(off, axis=0)
    doubt = 1.4826 * np.median(np.abs(off - middle), axis=0) / np.sqrt(len(off))
    worst = int(np.argmax(np.abs(middle)))
    if abs(middle[worst]) > WRONG_SHAPE + 5 * doubt[worst]:
        raise CalibrationError(
            f"wrong-size: balls {first[worst] + 1} and {second[worst] + 1} of the wand come out "
            f"{100 * middle[worst]:+.1f} % off the file's distance compared with its length; measure the wand again, "
            "and check the order of its balls in along_m"
        )


def rods_of(wand: Wand, frames: int) -> Distances:
    """Return the distances of all balls of all frames; ball k of frame f is the object point f * balls + k.

    An error of the wand is the same in all frames and is added to the covariance separately. Here its standard
    deviation only weights several distances on one wand against each other.
    """
    balls = len(wand.along_m)
    first, second = np.triu_indices(balls, 1)
    base = balls * np.arange(frames)[:, None]
    length = np.array(wand.along_m)[second] - np.array(wand.along_m)[first]
    sigma = np.maximum(wand.sigma_m * np.sqrt(2), EXACT * length)
    every = np.ones((frames, 1))
    return Distances(
        (base + first).ravel(), (base + second).ravel(), (every * length).ravel(), (every * sigma).ravel()
    )
