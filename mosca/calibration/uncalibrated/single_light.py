"""A rig from a light that is waved through the volume, with neither lengths nor focal lengths known.

In the manner of MultiCamSelfCal (Svoboda, Martinec and Pajdla 2005). Two cameras do not determine their focal
lengths; a third one does. Plausible focal lengths, equal for the first two cameras, are tried. Each gives a relative
orientation (Longuet-Higgins 1981), on whose points a third camera is resected. All three are adjusted with free focal
lengths, and the network that fits best is continued. Axes are near those of one of the cameras. The scale is that of
the stated distance of two cameras, or arbitrary.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mosca.calibration.initial.projective import FOCAL_RANGE, Robust
from mosca.calibration.quality.findings import warn
from mosca.calibration.uncalibrated.final_adjustment import Free, finished
from mosca.calibration.uncalibrated.focal_pair import motions
from mosca.calibration.uncalibrated.image_points import PointViews, point_views
from mosca.calibration.uncalibrated.incremental import grow, with_next_camera
from mosca.calibration.uncalibrated.partial_adjustment import CLEAR_SIGMAS, Network, cleaned, intersected, rough
from mosca.calibration.uncalibrated.result import calibration_of, check
from mosca.calibration.uncalibrated.view_graph import (
    LEAST_INLIERS,
    LITTLE_DEPTH,
    check_links,
    common_bend,
    flat,
    pair_geometry,
    strongest_pairs,
)
from mosca.calibration.uncalibrated.wand import MOST_WHILE_GROWING
from mosca.data.calibration import Calibration
from mosca.data.rig import Camera, Lens, Pose, Rig
from mosca.data.sightings import Sightings
from mosca.data.wands import SingleLight
from mosca.errors import CalibrationError, InputError

FOCALS = 8
"""Number of focal lengths tried in ``FOCAL_RANGE``, a factor of 1.7 apart: the adjustment finds those between."""
PAIRS = 3
"""Number of pairs of cameras, those with most common points, that are tried as the first pair."""
FEWEST_CAMERAS = 3


def calibrate_light(
    sightings: Sightings,
    light: SingleLight,
    rng: np.random.Generator,
    lenses: Sequence[Lens],
    free: Free | None = None,
) -> Calibration:
    """Calibrate cameras of unknown focal length from sightings of one light a frame.

    ``lenses``: one a camera; only model and shape of the pixels are used, all else is estimated. CalibrationError
    where cameras are not joined by common views, or where the result cannot be a rig; InputError where ``light``
    names other cameras.
    """
    if len(sightings.cameras) < FEWEST_CAMERAS:
        raise CalibrationError(
            f"few-views: {len(sightings.cameras)} cameras cannot be calibrated from a light of unknown distances; "
            "add a third camera, or wave a wand of known length"
        )
    for name in light.between or ():
        if name not in sightings.cameras:
            raise InputError(f"light: key 'between': '{name}' given; there are {', '.join(sightings.cameras)}")
    tracks = point_views(sightings, 1, lenses)
    check_links(tracks)
    some = tracks.thinned(MOST_WHILE_GROWING * len(tracks.names), rng)
    bend = common_bend(some, rng)
    final = finished(grow(_three_cameras(some, bend, rng), some, bend, rng), tracks, free)
    check(final, tracks)
    return _scaled(calibration_of(final, tracks, sightings, "", 0.0), light)


def _three_cameras(tracks: PointViews, bend: float, rng: np.random.Generator) -> Network:
    """Return three cameras with their points; CalibrationError where none fit."""
    found: list[Network] = []
    level = False
    for first, second in strongest_pairs(tracks, PAIRS):
        both, x, y, pair = pair_geometry(tracks, first, second, bend, rng)
        if pair.inliers.mean() < LEAST_INLIERS:
            continue
        if flat(x, y, pair, rng):
            level = True
            continue
        clean = np.ones(tracks.points, dtype=bool)
        clean[both[~pair.inliers]] = False
        good = tracks.only(clean[tracks.point] | ~np.isin(tracks.camera, (first, second)))
        for focal in np.geomspace(*FOCAL_RANGE, FOCALS):
            try:
                start = rough(good, _pair(good, first, second, pair, float(focal), bend), ())
                rest = cleaned(good, start.cameras, CLEAR_SIGMAS * start.spread)
                one, _ = with_next_camera(start, rest, bend, rng)
            except CalibrationError:
                # a wrong guess need not determine anything; the next one may
                continue
            found += [] if one is None else [one]
    if found:
        return min(found, key=lambda one: one.spread)
    if level:
        raise CalibrationError(LITTLE_DEPTH)
    raise CalibrationError(
        "few-views: no three cameras agree on focal lengths and places; wave the light where three cameras see it at "
        "the same time, through the depth of the volume too, and check that the images are each camera's own and of "
        "the same instants"
    )


def _pair(tracks: PointViews, first: int, second: int, found: Robust, focal: float, bend: float) -> dict[int, Camera]:
    """Return two cameras of a focal length [half diagonals], unit distance apart, with most points before both."""
    turns, shifts = motions(found.matrix, np.array([focal]), np.array([focal]))
    trials = []
    for turn in turns[0]:
        for shift in (shifts[0], -shifts[0]):
            cameras = {}
            for k, pose in ((first, Pose(np.eye(3), np.zeros(3))), (second, Pose(turn.T, -turn.T @ shift))):
                width, height = map(int, tracks.sizes[k])
                cameras[k] = Camera(tracks.names[k], width, height, tracks.pinhole(k, focal, bend), pose)
            points = intersected(tracks.of_cameras(cameras), cameras)
            poses = [camera.world_from_camera for camera in cameras.values()]
            depths = np.array([(points - pose.translation) @ pose.rotation[:, 2] for pose in poses])
            trials.append((int((depths > 0).all(axis=0).sum()), cameras))
    return max(trials, key=lambda trial: trial[0])[1]


def _scaled(one: Calibration, light: SingleLight) -> Calibration:
    """Return the calibration with the stated distance of two cameras, else with that of the first two as 1 m."""
    first, second = light.between or one.rig.names[:2]
    places = [one.rig.camera(name).world_from_camera.translation for name in (first, second)]
    scale = light.apart_m / float(np.linalg.norm(places[1] - places[0]))
    cameras = []
    for camera in one.rig.cameras:
        pose = camera.world_from_camera
        cameras.append(replace(camera, world_from_camera=Pose(pose.rotation, scale * pose.translation)))
    length = np.array([scale if name.endswith(("X_m", "Y_m", "Z_m")) else 1.0 for name in one.parameters])
    said = f"the distance of cameras '{first}' and '{second}', {light.apart_m:g} m"
    findings = one.findings
    if light.between is None:
        said = f"nothing: the distance of cameras '{first}' and '{second}' is taken for 1 m"
        text = "a light alone has no scale: all lengths are in units of the distance of cameras "
        findings = (*findings, warn("scale-error", f"{text}'{first}' and '{second}'; give 'between' and 'apart_m'"))
    return replace(
        one,
        rig=Rig(tuple(cameras)),
        target="light",
        covariance=one.covariance * np.outer(length, length),
        marks_m=scale * one.marks_m,
        sigma_m=scale * one.sigma_m,
        scaled_by=said,
        findings=findings,
    )
