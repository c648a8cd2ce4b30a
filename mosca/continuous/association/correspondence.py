"""Data association between unsynchronised cameras.

The tracklets of all cameras are interpolated at common instants (the exposures of the fastest camera), and the
synchronous matcher and tracker process these positions as frame sets. Curves are fitted to the resulting tracks, and
every measured image point, at its own instant, is assigned to the nearest curve: interpolated positions serve data
association only and are never used as measurements.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from mosca.continuous.association.coarse_sync import ClockTie
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.association.interpolated_tracks import SampledCurves
from mosca.continuous.association.tracklets_2d import Tracklets, detections_at
from mosca.continuous.estimator.observation_equations import HUBER
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations, UncertainCurves, no_carriers
from mosca.continuous.model.rig_at_time import MovingRig, RigAtEach, centres_at, images_at, images_of
from mosca.data.arrays import Array
from mosca.data.detections import MERGED, Seen
from mosca.data.frames import FrameSet
from mosca.data.rig import Camera, Rig
from mosca.data.tracks import Samples, Tracks, table
from mosca.diagnostics.camera_health import Health, HealthSettings
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, run_seen

FEWEST_SAMPLES = 6
"""Tracks of fewer samples are dropped."""
CLOSEST = 0.2
"""Approximate least spacing of the instants at which cameras are compared, in periods of the fastest camera."""
GATE_SIGMA, CURVE_PX = 4.5, 0.25
"""Gate of an image point about its curve in standard deviations; standard deviation per axis of a curve through
samples."""
WORST_PX = 1.0
"""Image points with a larger standard deviation are not used (those to which no disc could be fitted)."""
ODD_SHARE = 0.15
"""Largest relative difference of an image's area from the usual one; above it the target counts as partly hidden."""
MOST_TAKEN = 0.95
"""Largest share of an image point's own error that its curve takes up: above it the others give no prediction."""
CHUNK = 500
"""Number of frames whose points are projected at a time."""


def common_instants(seen: Sequence[CameraDetections], ties: Sequence[ClockTie], all_cameras: bool = False) -> Array:
    """Return the instants (t,) of the common clock at which cameras are compared: the exposures of the fastest one,
    or those of ``all_cameras``, at least a fifth of its period apart.

    Only instants at which two or more cameras were running. InputError where a camera never ran with another.
    """
    times = [tie.common_s((one.frame_ns - tie.origin_ns) * 1e-9) for one, tie in zip(seen, ties, strict=True)]
    begins, ends = np.array([t[0] for t in times]), np.array([t[-1] for t in times])
    for c, one in enumerate(seen):
        others = np.arange(len(seen)) != c
        shared = np.minimum(ends[c], ends[others]) - np.maximum(begins[c], begins[others])
        if not len(shared) or shared.max() <= 0.0:
            raise InputError(
                f"camera '{one.info.name}': filmed from {begins[c]:.3f} to {ends[c]:.3f} s, at no time "
                "together with another camera; check its stamps, say --clocks own where each camera has a "
                "clock of its own, or leave it out of the rig file"
            )
    fastest = int(np.argmin([one.period_s for one in seen]))
    t = times[fastest]
    # beyond that camera's run, instants of the others continue at its rate
    period = seen[fastest].period_s
    before = t[0] - period * np.arange(int(max(0.0, t[0] - begins.min()) / period), 0, -1)
    after = t[-1] + period * np.arange(1, int(max(0.0, ends.max() - t[-1]) / period) + 1)
    instants = np.concatenate([before, t, after])
    if all_cameras:
        instants = np.sort(np.concatenate(times))
        cell = np.floor((instants - instants[0]) / (CLOSEST * period))
        instants = instants[np.diff(cell, prepend=-1.0) > 0]
    running = (instants[:, None] >= begins) & (instants[:, None] <= ends)
    result: Array = instants[running.sum(axis=1) >= 2]
    return result


def tracked(
    seen: Sequence[CameraDetections],
    paths: Sequence[Tracklets],
    instants_s: Array,
    rig: Rig,
    settings: PipelineSettings,
    attend: Callable[[int], None] | None = None,
    moving: MovingRig | None = None,
) -> tuple[Tracks, Array]:
    """Return the tracks at common instants, and each camera's random error besides its detections' (c,) [px].

    ``paths``: the cameras' tracklets on the common clock. ``moving``: the same rig's poses where they change.
    """
    # neighbouring instants are interpolated between the same exposures
    health = Health(rig, HealthSettings(start_px=settings.match.camera_sigma_px, every=2))
    places = [path.at(instants_s) for path in paths]
    there = np.ones((len(instants_s), len(seen)), dtype=bool)
    keeper = None
    if moving is not None:
        there, keeper = moving.there(instants_s), RigAtEach(moving.rigs(instants_s))
        rig = keeper.rig

    def sets() -> Iterator[Seen]:
        for k, instant in enumerate(instants_s):
            found = {one.info.name: detections_at(one, places[c], k)[0] for c, one in enumerate(seen) if there[k, c]}
            yield FrameSet(k, round(instant * 1e9)), found, 0.0

    samples: list[Samples] = []
    for done, step in enumerate(run_seen(sets(), rig, settings, keeper, health), start=1):
        samples.append(step.samples)
        if attend is not None:
            attend(done)
    return table(samples), np.asarray(health.noise.sigma_px)


def curves_of(tracks: Tracks, coast_s: float) -> SampledCurves:
    """Return the tracks as curves; InputError where there is none."""
    curves = SampledCurves.of(tracks, FEWEST_SAMPLES, coast_s)
    if not curves.points:
        raise InputError(
            "no marker was followed by two cameras: check the rig, that the stamps are of one clock (else "
            "--clocks own), and the settings match.camera_sigma_px, match.worst_sigma_m and [volume]"
        )
    return curves


def observed(
    seen: Sequence[CameraDetections],
    ties: Sequence[ClockTie],
    rig: Rig,
    curves: Curves,
    sigma_px: Array,
    curve_px: float = CURVE_PX,
    moving: MovingRig | None = None,
    used: tuple[TimedObservations, Array] | None = None,
) -> tuple[TimedObservations, Array]:
    """Return the image points that belong to ``curves``, each at its own instant on the common clock, and their
    indices (n,) among each camera's own image points.

    ``sigma_px`` (c,): random error of each camera's image points besides their detections'. ``curve_px``: error of
    the curves in the images besides their own covariance, if they have one. Merged images of two targets are left
    out. ``moving``: as in ``tracked``. ``used``: the earlier result from which the curves were estimated, if any:
    each image point is then compared with the prediction of its curve from the other points.
    """
    parts, numbers = [], []
    for c, (one, tie) in enumerate(zip(seen, ties, strict=True)):
        times = tie.common_s(one.time_s(tie.origin_ns))
        row, point, away = _assigned(
            one, tie, rig, c, curves, sigma_px[c], curve_px, moving, _points_of(one, c, used)
        )
        keep = (one.flags[row] & MERGED) == 0
        row, point, away = row[keep], point[keep], away[keep]
        odd = odd_sizes_px(one.diameter_px[row], away, point)
        extra = sigma_px[c] ** 2 + odd**2
        covariance = one.covariance_px2[row] + extra[:, None, None] * np.eye(2)
        numbers.append(row)
        parts.append((np.full(len(row), c), point, one.frame[row], times[row], one.xy_px[row], covariance))
    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
    points = curves.points
    return TimedObservations(rig.names, points, *columns, **no_carriers(points)), np.concatenate(numbers)


def odd_sizes_px(diameter_px: Array, away_m: Array, point: Array) -> Array:
    """Return the standard deviation (n,) [px] of an additional error of images of odd size.

    The image of a target that is partly hidden, or merged with another, is displaced by about the share of its area
    that is missing times its radius. ``away_m`` (n,): distance of the target; its usual size is the median of its own
    images in the camera.
    """
    size = diameter_px * away_m
    names, of = np.unique(point, return_inverse=True)
    usual = np.array([np.median(size[of == k]) for k in range(len(names))])[of]
    # not more than the whole target can be hidden: a larger share means a wrong distance
    share = np.minimum(np.abs(1.0 - (size / usual) ** 2), 1.0)
    return np.where(share > ODD_SHARE, share * 0.5 * diameter_px, 0.0)


def _assigned(
    one: CameraDetections, tie: ClockTie, rig: Rig, c: int, curves: Curves, sigma_px: float, curve_px: float,
    moving: MovingRig | None, used: Array
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return image points of a camera, the curves that they belong to, and the distances of these [m].

    ``used`` (n,): the curve that each image point helped to estimate, -1 where none.
    """
    camera = rig.cameras[c]
    first_row = tie.common_s((one.frame_ns - tie.origin_ns) * 1e-9)
    at = first_row + 0.5 * one.row_time_s * (camera.height - 1)
    cameras = None if moving is None else moving.paths
    there = np.ones(len(at), dtype=bool) if moving is None else moving.there(at)[:, c]
    rows, points, aways = [], [], []
    for begin in range(0, len(at), CHUNK):
        some = at[begin : begin + CHUNK]
        xyz = curves.at(some)
        image = images_at(camera, c, cameras, some, xyz)
        image[~there[begin : begin + CHUNK]] = np.nan
        origin = centres_at(camera, c, cameras, some)
        if one.row_time_s > 0.0:
            flow = (images_of(curves, camera, c, cameras, some + 1e-3) - image) / 1e-3
            late = one.row_time_s * (image[..., 1:] - 0.5 * (camera.height - 1))
            image = image + flow * late
        of_curve = _variances_px2(curves, camera, c, cameras, some, xyz, image)
        for k in range(len(some)):
            own = np.arange(one.start[begin + k], one.start[begin + k + 1])
            _without_own(image[k], of_curve[k], one, own[used[own] >= 0], used, sigma_px)
            near = np.flatnonzero(np.isfinite(image[k]).all(axis=1))
            which, to = _nearest(one, own, image[k, near], sigma_px**2 + curve_px**2 + of_curve[k, near])
            rows.append(own[which])
            points.append(near[to])
            aways.append(np.linalg.norm(xyz[k, near[to]] - origin[k], axis=1))
    return np.concatenate(rows), np.concatenate(points), np.concatenate(aways)


def _points_of(one: CameraDetections, c: int, used: tuple[TimedObservations, Array] | None) -> Array:
    """Return the point (n,) that each image point of camera number ``c`` was used for, -1 for none."""
    of = np.full(len(one.xy_px), -1)
    if used is not None:
        own = used[0].camera == c
        of[used[1][own]] = used[0].point[own]
    return of


def _without_own(
    image: Array, variance: Array, one: CameraDetections, rows: Array, used: Array, sigma_px: float
) -> None:
    """Remove the influence of image points ``rows`` (r,) from the ``image`` (p, 2) of their curves and its
    ``variance`` (p,).

    A curve that follows a wrong image point would keep it. Let h be the leverage of an image point (the share of its
    error e that its curve takes up, by its weight in the estimate). The prediction from all other points then lies
    e h / (1 - h) from the curve, away from the point.
    """
    point = used[rows]
    off = one.xy_px[rows] - image[point]
    own = one.covariance_px2[rows].trace(axis1=1, axis2=2) / 2 + sigma_px**2
    weight = np.minimum(1.0, HUBER**2 * own / np.maximum((off**2).sum(axis=1), 1e-12))
    taken = np.minimum(weight * variance[point] / own, MOST_TAKEN)
    image[point] -= (taken / (1.0 - taken))[:, None] * off
    variance[point] /= 1.0 - taken


def _variances_px2(
    curves: Curves, camera: Camera, c: int, cameras: CameraPaths | None, time_s: Array, xyz: Array, image: Array
) -> Array:
    """Return the variance (t, points) an axis [px^2] of the images (t, points, 2) of curves, 0 where not stated."""
    # with moving cameras the curves' covariance contains that of the poses, which move all images alike
    if cameras is not None or not isinstance(curves, UncertainCurves):
        return np.zeros(image.shape[:2])
    small = 1e-3
    by = [(images_at(camera, c, cameras, time_s, xyz + small * e) - image) / small for e in np.eye(3)]
    slope = np.stack(by, axis=-1)
    return np.asarray(0.5 * np.einsum("tpai,tpij,tpaj->tp", slope, curves.covariance_at(time_s), slope))


def _nearest(one: CameraDetections, own: Array, image: Array, variance: Array) -> tuple[Array, Array]:
    """Return the assignment of image points ``own`` to the images (p, 2) of curves with ``variance`` (p,).

    It has the greatest likelihood, and pairs only where that is above the density of unrelated image points.
    """
    if not len(own) or not len(image):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    off = one.xy_px[own][:, None] - image[None]
    # the mean variance of both axes of a detection's error is taken for each
    detected = one.covariance_px2[own].trace(axis1=1, axis2=2) / 2
    whole = detected[:, None] + variance
    squared = (off**2).sum(axis=2) / whole
    spread = one.info.width * one.info.height / (2.0 * np.pi * len(own))
    allowed = (squared < GATE_SIGMA**2) & (whole < spread) & (detected < WORST_PX**2)[:, None]
    cost = squared + 2.0 * np.log(whole / whole.min())
    which, to = linear_sum_assignment(np.where(allowed, cost, 1e6))
    good = allowed[which, to]
    return which[good], to[good]
