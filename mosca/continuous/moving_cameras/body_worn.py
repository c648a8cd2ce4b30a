"""Cameras on the limbs of the body that they film: their poses over time, and the markers.

Steps: detect in every frame -> identify lamps by their blinks (``blink_codes``) -> estimate cameras' poses at common
instants from each other's lamps alone (``mutual_pose``) -> match markers at these instants with these poses ->
estimate curves and poses together from every image point at its own instant, with lamps as points that cameras carry
(``estimate``, ``cameras = "moving"``) -> assign image points to markers again with these -> repeat the last two once.

Required: the lenses, the relative poses of two or more cameras (they define frame and scale), the position of each
camera's lamp relative to its lens, and stamps of one clock. No starting values and no names are needed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.continuous.association.associate import AssociationSettings, check_long_enough, markers_of
from mosca.continuous.association.blink_codes import LampSettings, blinking
from mosca.continuous.association.coarse_sync import common_clock
from mosca.continuous.association.correspondence import common_instants, observed
from mosca.continuous.association.frame_detections import COLUMNS, CameraDetections, FrameCount, detect_in_frames
from mosca.continuous.association.tracklets_2d import tracklets
from mosca.continuous.estimator.estimate import ContinuousSettings, estimate
from mosca.continuous.findings import association_findings
from mosca.continuous.model.camera_paths import PosedCameras
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations
from mosca.continuous.model.rig_at_time import MovingRig, images_at, lamp_positions_at
from mosca.continuous.moving_cameras.mutual_pose import MutualPoses, lamp_rays, poses_from_lamps
from mosca.continuous.reconstruct import BETTER_PX, EstimatedClock, Reconstructed
from mosca.data.arrays import Array
from mosca.data.detections import MERGED
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.pipeline import check_source

LAMP_PX = 2.0
"""Gate of an image point about a lamp's predicted image [px]."""
VALID_PERIODS = 1.5
"""Maximum time from an LED observation at which a camera pose is valid, in frame periods."""
COARSER = 2.0
"""Factor on the knot spacing in the first estimate."""
LONGEST_S = 0.5
"""Longest gap [s] over which estimated poses are used."""


@dataclass(frozen=True)
class Lamps:
    """Lamps that cameras carry, in the order of the rig: ``numbers`` (c,) that they blink; ``at_m`` (c, 3): positions
    in their cameras' frames [m]; ``bit_s``: duration of a bit of their codes [s].
    """

    numbers: tuple[int, ...]
    at_m: Array
    bit_s: float

    def __post_init__(self) -> None:
        if len(set(self.numbers)) != len(self.numbers):
            raise InputError(f"lamps: numbers = {list(self.numbers)} given; each lamp needs a number of its own")


@dataclass(frozen=True, eq=False)
class Worn:
    """Result from body-worn cameras. ``reconstructed``: result with the cameras' paths; ``lamp_poses``: poses from
    lamps alone; ``lamp``: for each camera's image points (n,) the camera whose lamp it is, or -1; ``by_code``: the
    same for those identified by code; ``lamp_rms_px``: rms residual of lamps' images at the estimated poses.
    """

    reconstructed: Reconstructed
    lamp_poses: MutualPoses
    lamp: tuple[Array, ...]
    by_code: tuple[Array, ...]
    lamp_rms_px: float


def reconstruct_worn(
    source: FrameSource,
    rig: Rig,
    known: Sequence[str],
    lamps: Lamps,
    gathering: AssociationSettings | None = None,
    settings: ContinuousSettings | None = None,
    backgrounds: Mapping[str, Array] | None = None,
    attend: Callable[[int], None] | None = None,
) -> Worn:
    """Reconstruct the curves of markers and the paths of the cameras, from frames of free-running cameras on a body's
    limbs.

    ``known``: names of the cameras whose poses in ``rig`` are right; those of the others are not used. Known cameras
    come first in the result: the first defines the frame, its distance to the second the scale. Without
    ``settings.knot_s`` knots have the spacing of the fastest camera's frames. InputError where fewer than two cameras
    are known, or where lamps do not determine the others.
    """
    check_source(source, rig)
    gathering = AssociationSettings() if gathering is None else gathering
    count = FrameCount()
    seen = detect_in_frames(source, rig.names, gathering.pipeline.detection, backgrounds, count, attend)
    return solve_worn(seen, rig, known, lamps, gathering, settings, count, attend)


def solve_worn(
    seen: Sequence[CameraDetections],
    rig: Rig,
    known: Sequence[str],
    lamps: Lamps,
    gathering: AssociationSettings,
    settings: ContinuousSettings | None = None,
    count: FrameCount | None = None,
    attend: Callable[[int], None] | None = None,
) -> Worn:
    """As ``reconstruct_worn``, from given detections of the rig's cameras."""
    rig, lamps, seen = _known_first(rig, known, lamps, seen)
    for one in seen:
        check_long_enough(one)
    fixed = np.array([name in known for name in rig.names])
    ties = common_clock(seen)
    times = [tie.common_s(one.time_s(tie.origin_ns)) for one, tie in zip(seen, ties, strict=True)]
    by_code = tuple(_carriers(one, lamps) for one in seen)
    instants = common_instants(seen, ties)
    sights = lamp_rays(seen, times, by_code, rig, instants, lamps.bit_s)
    lamp_poses = poses_from_lamps(sights, rig, fixed, lamps.at_m)
    period = max(one.period_s for one in seen)
    moving = _moving(rig, lamp_poses, VALID_PERIODS * period)
    lamp = tuple(
        _lamps_near(one, c, t, own, rig, moving, lamps)
        for c, (one, t, own) in enumerate(zip(seen, times, by_code, strict=True))
    )
    marked = tuple(_without(one, own) for one, own in zip(seen, lamp, strict=True))
    tracklet = [tracklets(one, learned=False) for one in marked]
    gathered = markers_of(marked, tracklet, ties, rig, gathering, count or FrameCount(), attend, moving)
    settings = settings or ContinuousSettings()
    # a camera's path is observed only at its own exposures: knots with the spacing of the fastest one's frames
    knot_s = settings.knot_s or min(one.period_s for one in seen)
    settings = replace(settings, cameras="moving", clocks="known", knot_s=knot_s)
    found, paths = gathered.observations, moving.paths
    start: Curves | None = gathered.start
    # the first pass only bridges gaps between poses, and assigns image points to markers again
    quick = replace(settings, limbs=False, knot_s=COARSER * knot_s)
    for now in (quick, settings):
        whole = with_lamps(found, seen, times, lamp, gathered.sigma_px, lamps)
        estimated = estimate(whole, rig, now, start, paths)
        start, paths = estimated.curves, estimated.paths
        moving = replace(moving, paths=paths, valid_s=LONGEST_S)
        if now is quick:
            found, _row = observed(marked, ties, rig, start, gathered.sigma_px, BETTER_PX, moving)
    findings = (
        f"frame and metre are those of {' and '.join(map(repr, known))}, whose poses were given",
        *association_findings(gathered, found),
        *(line for line in estimated.findings if not line.startswith("scale:")),
    )
    clocks = tuple(EstimatedClock(one.info.name, origin_ns=ties[0].origin_ns) for one in seen)
    return Worn(
        Reconstructed(gathered, estimated, found, clocks, findings, rig, estimated.paths),
        lamp_poses,
        lamp,
        by_code,
        _lamp_rms_px(seen, times, lamp, rig, estimated.paths, lamps),
    )


def _known_first(
    rig: Rig, known: Sequence[str], lamps: Lamps, seen: Sequence[CameraDetections]
) -> tuple[Rig, Lamps, tuple[CameraDetections, ...]]:
    """Return rig, lamps and detections with the known cameras first."""
    for name in known:
        rig.camera(name)
    if len(known) < 2:
        raise InputError(
            f"worn cameras: {len(known)} of known place given; two at least are needed, the frame and the metre"
        )
    order = sorted(range(len(rig.cameras)), key=lambda k: rig.names[k] not in known)
    return (
        Rig(tuple(rig.cameras[k] for k in order)),
        Lamps(tuple(lamps.numbers[k] for k in order), lamps.at_m[order], lamps.bit_s),
        tuple(seen[k] for k in order),
    )


def _carriers(one: CameraDetections, lamps: Lamps) -> Array:
    """Return for each image point the camera (n,) whose lamp it is by its code, or -1."""
    of_number = {number: c for c, number in enumerate(lamps.numbers)}
    found = blinking(one, lamps.numbers, LampSettings(lamps.bit_s))
    return np.array([of_number.get(k, -1) for k in found.tolist()], int)


def _moving(rig: Rig, lamp_poses: MutualPoses, valid_s: float) -> MovingRig:
    good = np.asarray(np.isfinite(lamp_poses.centres).all(axis=2))
    for c, name in enumerate(rig.names):
        if good[:, c].sum() < 3:
            raise InputError(
                f"camera '{name}': lamps tell at {good[:, c].sum()} instants where it is, 3 are needed; let two "
                "cameras see its lamp and it two of theirs, and check their numbers and the time of a bit"
            )
    paths = PosedCameras(rig.names, lamp_poses.time_s, lamp_poses.rotations, lamp_poses.centres)
    return MovingRig(rig, paths, tuple(lamp_poses.time_s[good[:, c]] for c in range(len(rig.names))), valid_s)


def _lamps_near(
    one: CameraDetections, c: int, time_s: Array, by_code: Array, rig: Rig, moving: MovingRig, lamps: Lamps
) -> Array:
    """Return for each image point the camera (n,) whose lamp it is, by its code or the lamp's prediction, or -1."""
    lamp = np.array(by_code)
    frame = one.frame
    instants = np.full(len(one.frame_ns), np.nan)
    instants[frame] = time_s
    some = np.flatnonzero(np.isfinite(instants))
    there = moving.there(instants[some])
    image = images_at(
        rig.cameras[c], c, moving.paths, instants[some], lamp_positions_at(lamps.at_m, moving.paths, instants[some])
    )
    image[~there] = np.nan
    image[~there[:, c]] = np.nan
    image[:, c] = np.nan
    for k, f in enumerate(some.tolist()):
        own = np.arange(one.start[f], one.start[f + 1])
        for j in np.flatnonzero(np.isfinite(image[k, :, 0])):
            away = np.linalg.norm(one.xy_px[own] - image[k, j], axis=1)
            nearest = int(np.argmin(away))
            if away[nearest] < LAMP_PX and lamp[own[nearest]] < 0 and not (lamp[own] == j).any():
                lamp[own[nearest]] = j
    return lamp


def _without(one: CameraDetections, lamp: Array) -> CameraDetections:
    """Return a camera's detections without lamps."""
    keep = lamp < 0
    count = np.bincount(one.frame[keep], minlength=len(one.frame_ns))
    kept = {name: getattr(one, name)[keep] for name in COLUMNS}
    return replace(one, start=np.concatenate([[0], np.cumsum(count)]), **kept)


def with_lamps(
    found: TimedObservations,
    seen: Sequence[CameraDetections],
    times_s: Sequence[Array],
    lamp: Sequence[Array],
    sigma_px: Array,
    lamps: Lamps,
) -> TimedObservations:
    """Return the observations with the lamps' image points added, as points that cameras carry."""
    n = len(found.points)
    parts = [[found.camera, found.point, found.exposure, found.time_s, found.xy_px, found.covariance_px2]]
    for c, one in enumerate(seen):
        rows = np.flatnonzero((lamp[c] >= 0) & ((one.flags & MERGED) == 0))
        covariance = one.covariance_px2[rows] + sigma_px[c] ** 2 * np.eye(2)
        parts.append(
            [np.full(len(rows), c), n + lamp[c][rows], one.frame[rows], times_s[c][rows], one.xy_px[rows], covariance]
        )
    camera, point, exposure, time, xy, covariance = (np.concatenate(column) for column in zip(*parts, strict=True))
    names = (*found.points, *(f"lamp/{name}" for name in found.cameras))
    carried_by = np.concatenate([np.full(n, -1), np.arange(len(lamps.numbers))])
    carried_at = np.concatenate([np.zeros((n, 3)), lamps.at_m])
    return TimedObservations(
        found.cameras, names, camera, point, exposure, time, xy, covariance, carried_by, carried_at
    )


def _lamp_rms_px(
    seen: Sequence[CameraDetections],
    times_s: Sequence[Array],
    lamp: Sequence[Array],
    rig: Rig,
    paths: CameraPaths,
    lamps: Lamps,
) -> float:
    squares = []
    for c, camera in enumerate(rig.cameras):
        rows = np.flatnonzero(lamp[c] >= 0)
        if not len(rows):
            continue
        t = times_s[c][rows]
        image = images_at(camera, c, paths, t, lamp_positions_at(lamps.at_m, paths, t))
        squares.append(((seen[c].xy_px[rows] - image[np.arange(len(rows)), lamp[c][rows]]) ** 2).ravel())
    return float(np.sqrt(np.nanmean(np.concatenate(squares)))) if squares else float("nan")
